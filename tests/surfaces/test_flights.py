"""Two flights that disagree in height, and ground that only looks like it."""

import numpy as np
import pytest
from pyproj import CRS

from vinemap.cloud.points import PointCloud
from vinemap.config.settings import Settings
from vinemap.surfaces.flights import disagreement
from vinemap.surfaces.ground import terrain_model
from vinemap.surfaces.map import PDALS

SIDE, DENSITY = 30.0, 60.0
SURFACE = Settings().ground.model_dump(exclude=PDALS)


def over(surface, *, noise=0.025, seed=0):
    """Points of a square on a surface z(x, y, rng), and their terrain model."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, SIDE, (int(DENSITY * SIDE**2), 2))
    z = surface(*xy.T, rng) + rng.normal(0, noise, len(xy))
    cloud = PointCloud(np.column_stack([xy, z]), CRS.from_epsg(32632))
    return cloud, terrain_model(cloud, **SURFACE)


def twice(apart, *, share=0.5, part=1.0, slope=0.15):
    """A slope that was flown twice in a part of it; a share of the points there is from the higher flight."""
    return lambda x, y, rng: slope * x + apart * ((rng.random(len(x)) < share) & (y < part * SIDE))


@pytest.mark.parametrize("apart", [0.1, 0.2, 0.5])
@pytest.mark.parametrize(("share", "part"), [(0.5, 1.0), (0.3, 1.0), (0.5, 0.3)])
def test_flights_that_disagree(apart, share, part):
    metres, where = disagreement(*over(twice(apart, share=share, part=part)))
    assert metres == pytest.approx(apart, abs=0.02)
    assert where == pytest.approx(part, abs=0.2)


def test_flights_that_disagree_here_more_and_there_less():
    metres, where = disagreement(*over(lambda x, y, rng: (0.05 + 0.2 * x / SIDE) * (rng.random(len(x)) < 0.5)))
    assert 0.12 < metres < 0.22
    assert where > 0.5


def vineyard(apart, *, share=0.5, net=0.0):
    """Rows on a slope, flown twice, and a net above them in the other part of the points."""

    def surface(x, y, rng):
        z = 0.15 * x + np.where((x % 2.5 < 0.6) & (rng.random(len(x)) < 0.8), rng.uniform(0.4, 1.9, len(x)), 0.0)
        second = rng.random(len(x)) < share
        return np.where(second, 0.15 * x + net, z) if net else z + apart * second

    return surface


@pytest.mark.parametrize(
    ("apart", "share"), [(0.8, 0.5), (1.1, 0.5), (1.5, 0.5), (2.0, 0.5), (3.0, 0.5), (48.0, 0.5), (0.2, 0.13)]
)
def test_flights_over_rows_that_disagree_by_much_or_with_few_points(apart, share):
    """48 m: one above the ellipsoid, the other above the geoid."""
    metres, where = disagreement(*over(vineyard(apart, share=share)))
    assert metres == pytest.approx(apart, abs=0.02)
    assert where > 0.8


@pytest.mark.parametrize("net", [1.8, 3.3])
def test_a_net_is_no_flight(net):
    assert disagreement(*over(vineyard(0.0, share=0.4, net=net))) is None


GROUNDS = {
    "one flight": twice(0.0),
    "half as far apart": twice(0.05),
    "steep": twice(0.0, slope=0.8),
    "terraces": lambda x, y, rng: 0.6 * np.floor(x / 5),
    "low terraces": lambda x, y, rng: 0.15 * np.floor(x / 2.5),
    "furrows": lambda x, y, rng: 0.12 * (x % 1.0 < 0.5),
    "grass": lambda x, y, rng: rng.uniform(0, 0.3, len(x)),
    "grass that shows the soil": lambda x, y, rng: np.where(rng.random(len(x)) < 0.5, rng.uniform(0.1, 0.2, len(x)), 0),
    "strips of grass": lambda x, y, rng: 0.15 * (x % 2.5 < 1.5),
    "canopies": lambda x, y, rng: np.where(
        (x % 2.5 < 0.6) & (rng.random(len(x)) < 0.8), rng.uniform(0.4, 1.9, len(x)), 0
    ),
}


@pytest.mark.parametrize("ground", GROUNDS)
def test_ground_that_only_looks_like_it(ground):
    assert disagreement(*over(GROUNDS[ground])) is None


def test_few_points_tell_nothing():
    cloud = PointCloud(np.zeros((10, 3)), CRS.from_epsg(32632))
    assert disagreement(cloud, terrain_model(cloud, **SURFACE)) is None
