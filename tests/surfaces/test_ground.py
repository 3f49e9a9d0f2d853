"""Terrain against known truth."""

import numpy as np
import pytest

from vinemap.cloud.points import PointCloud
from vinemap.errors import InputError
from vinemap.geo.crs import parse_crs
from vinemap.geo.raster import sample
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import hillside, terraced
from vinemap.surfaces.canopy_height import canopy_height_model
from vinemap.surfaces.ground import terrain_model

UTM = parse_crs("EPSG:32632")


def errors(survey):
    """Errors of the terrain model in metres, inside the parcel."""
    dtm = terrain_model(PointCloud(survey.xyz, UTM))
    west, south, east, north = survey.parcels.total_bounds
    x, y = np.random.default_rng(0).uniform([west + 2, south + 2], [east - 2, north - 2], (3000, 2)).T
    return sample(dtm, np.column_stack([x, y])) - survey.terrain(x, y)


@pytest.mark.parametrize("slope", [0.1, 0.45])
def test_slopes(slope):
    rows = rows_of(8, length=25, spacing=2.2, azimuth=20)
    error = errors(simulate([Vineyard("A", rows)], hillside(slope), seed=1))
    assert abs(np.median(error)) < 0.003
    assert np.median(np.abs(error)) < 0.006
    assert np.quantile(np.abs(error), 0.95) < 0.025


def soil(noise, density, *, weeds=0.0):
    """Points on a plane of 40 x 30 m; in the eastern half stand weeds, which are even from the soil up."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, [[40], [30]], (2, 1200 * density))
    z = 0.1 * x + rng.normal(0, noise, len(x))
    z += np.where(x > 20, weeds * rng.random(len(x)), 0)
    return PointCloud(np.column_stack([x, y, z]), UTM)


def bias(dtm, west, east):
    """Mean error in metres between two eastings, away from the edges."""
    x, y = np.meshgrid(*dtm.grid.centres())
    inner = (x > west + 2) & (x < east - 2) & (y > 2) & (y < 28)
    return np.mean((dtm.values - 0.1 * x)[inner])


@pytest.mark.parametrize(
    ("noise", "density", "quantile"),
    [(0.01, 400, 0.1), (0.025, 400, 0.1), (0.025, 80, 0.1), (0.025, 30, 0.1), (0.05, 400, 0.1), (0.025, 400, 0.3)],
)
def test_bare_soil_is_told_without_bias(noise, density, quantile):
    """Whatever the noise, the points a cell and the order of the height that stands for it."""
    assert abs(bias(terrain_model(soil(noise, density), quantile=quantile), 0, 40)) < 0.003


@pytest.mark.parametrize(("weeds", "most"), [(0.1, 0.01), (0.3, 0.01)])
def test_soil_beside_weeds_and_in_them(weeds, most):
    dtm = terrain_model(soil(0.025, 300, weeds=weeds))
    assert abs(bias(dtm, 0, 20)) < 0.003
    assert abs(bias(dtm, 20, 40)) < most


def test_every_order_of_the_height_gives_a_terrain():
    for quantile in (0.01, 0.5):
        assert abs(bias(terrain_model(soil(0.025, 100), quantile=quantile), 0, 40)) < 0.01


def slope_or_hill(kind):
    """Rows on bare ground of 100 x 60 m up to the very edges, and that ground."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, [[100], [60]], (2, 900_000))

    def ground(x, y):
        return 0.01 * (x - 30) ** 2 - 0.004 * (y - 10) ** 2 if kind == "hill" else kind * x

    z = ground(x, y) + rng.normal(0, 0.02, len(x))
    canopy = (np.abs(y - np.round(y / 2.5) * 2.5) < 0.28) & (np.abs(x - 50) < 46) & (rng.random(len(x)) < 0.85)
    z[canopy] += rng.uniform(0.6, 1.95, canopy.sum())
    return np.column_stack([x, y, z]), ground


@pytest.mark.parametrize("kind", [0.0, 0.3, 0.45, "hill"])
def test_slopes_and_hills_hold_up_to_their_edges(kind):
    xyz, ground = slope_or_hill(kind)
    dtm = terrain_model(PointCloud(xyz, UTM))
    error = (dtm.values - ground(*np.meshgrid(*dtm.grid.centres())))[1:-1, 1:-1]
    assert abs(np.mean(error)) < 0.003
    error = np.abs(error)
    assert np.quantile(error, 0.95) < 0.03
    assert error.max() < 0.25


def test_terraces():
    rows = rows_of(8, length=25, spacing=1.8)
    terrain = terraced(hillside(0.4), rows, spacing=1.8, riser=0.6)
    error = np.abs(errors(simulate([Vineyard("A", rows)], terrain, seed=1)))
    assert np.median(error) < 0.05
    assert np.quantile(error, 0.95) < 0.25


def narrow_terraces(wall, density):
    """Terraces 2.5 m wide with dry-stone walls, and on each a row, beneath which every other point sees no soil."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, [[24], [20]], (2, 480 * density))

    def ground(x, y):
        return 0.03 * y + wall * np.floor((x + 0.3 * y) / 2.5)

    z = ground(x, y) + rng.normal(0, 0.015, len(x))
    canopy = (np.abs((x + 0.3 * y) % 2.5 - 1.25) < 0.25) & (rng.random(len(x)) < 0.5)
    z[canopy] += rng.uniform(0.6, 1.7, canopy.sum())
    return np.column_stack([x, y, z]), ground


@pytest.mark.parametrize("density", [90, 300])
@pytest.mark.parametrize("wall", [0.7, 1.5])
def test_narrow_terraces_up_to_the_brows_of_their_walls(wall, density):
    xyz, ground = narrow_terraces(wall, density)
    dtm = terrain_model(PointCloud(xyz, UTM))
    error = (dtm.values - ground(*np.meshgrid(*dtm.grid.centres())))[4:-4, 4:-4]
    assert abs(np.median(error)) < 0.02
    assert np.mean(error < -0.2) < 0.02
    assert np.mean(error > 0.2) < 0.06  # what lies in a cell with a wall is as high as its brow


def test_a_level_roof_is_no_terrace():
    """However large it is, and low: nothing leads up to it."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 20, (2, 80_000))
    roof = (np.abs(x - 10) < 1.0) & (np.abs(y - 10) < 2.2)
    cloud = PointCloud(np.column_stack([x, y, rng.normal(0, 0.02, len(x)) + 0.9 * roof]), UTM)
    assert np.abs(terrain_model(cloud).values).max() < 0.1


def test_trees_houses_weeds_and_floaters():
    rows = rows_of(6, length=25)
    x, y = rows[0].mean(axis=0)
    things = [Obstacle(x - 5, y - 4, 2.0, 2.0, 6.0, 1.0), Obstacle(x + 5, y - 4, 2.0, 1.5, 3.0, solid=True)]
    survey = simulate([Vineyard("A", rows)], hillside(0.2), obstacles=things, weeds=0.4, floaters=0.005, seed=2)
    error = np.abs(errors(survey))
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.1


def test_closed_canopy():
    """Rows so near and wide that little soil is seen between them."""
    rows = rows_of(10, length=20, spacing=1.5)
    survey = simulate([Vineyard("A", rows, half_width=0.5, leafiness=20)], hillside(0.3), seed=4)
    error = np.abs(errors(survey))
    assert np.median(error) < 0.05
    assert np.quantile(error, 0.95) < 0.15


def test_a_low_dense_canopy_is_no_soil_though_it_begins_there():
    rows = rows_of(10, length=20, spacing=1.7)
    low = Vineyard("A", rows, height=0.5, half_width=0.4, bottom=0.0)
    assert np.quantile(errors(simulate([low], hillside(0.1), seed=0)), 0.95) < 0.03


def test_heights_and_canopy_height_model(vineyard, cloud):
    dtm = terrain_model(cloud)
    above = cloud.above(dtm)
    truth = cloud.xyz[:, 2] - vineyard.terrain(cloud.xyz[:, 0], cloud.xyz[:, 1])
    assert np.median(np.abs(above.heights - truth)) < 0.02
    chm = canopy_height_model(above)
    assert np.nanquantile(chm.values, 0.99) == pytest.approx(vineyard.rows["mean_height"].mean(), abs=0.3)
    assert np.nanmin(chm.values) == 0


def test_a_handful_of_points():
    xyz = np.array([[0.0, 0, 5], [1, 0, 5.2], [0, 1, 5.1]])
    dtm = terrain_model(PointCloud(xyz, UTM))
    assert np.isfinite(dtm.values).all()
    assert np.abs(dtm.values - 5.1).max() < 1


def test_classified_points_make_the_terrain_and_bridge_what_has_none():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, [[40], [30]], (2, 200_000))
    ground = 0.3 * x + 0.002 * (y - 10) ** 2
    z = ground + rng.normal(0, 0.02, len(x))
    classes = np.full(len(x), 2, dtype=np.uint8)
    hidden = np.hypot(x - 25, y - 15) < 4
    wrong = rng.random(len(x)) < 0.02
    z[hidden | wrong] += 2
    classes[hidden] = 1
    cloud = PointCloud(np.column_stack([x, y, z]), UTM, classification=classes)
    error = sample(terrain_model(cloud, engine="pdal"), cloud.xyz) - ground
    inner = (np.abs(x - 20) < 18) & (np.abs(y - 15) < 13)
    assert np.quantile(np.abs(error[inner]), 0.95) < 0.06
    assert np.abs(error[hidden]).max() < 0.1


def test_clouds_without_ground_say_so(cloud):
    for classes in (None, np.ones(len(cloud.xyz), dtype=np.uint8)):
        with pytest.raises(InputError, match="classified as ground"):
            terrain_model(PointCloud(cloud.xyz, cloud.crs, classification=classes), engine="pdal")
