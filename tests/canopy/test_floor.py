"""Where the canopy of low rows begins, above weeds and the soil's noise."""

import geopandas as gpd
import numpy as np
import pytest
import shapely
from pyproj import CRS

from vinemap.canopy.foliage import living_canopies, separate_canopy
from vinemap.canopy.model import model_sections
from vinemap.canopy.points import above_weeds, canopy_floor, canopy_size
from vinemap.canopy.sections import cut_sections
from vinemap.cloud.points import PointCloud
from vinemap.geo.raster import Grid, Raster

UTM = CRS.from_epsg(32632)
SPACING = 2.5


def block(rng, n, half, low, high):
    """Points (n, 2) spread evenly: metres to the left, and above ground."""
    return np.column_stack([rng.uniform(-half, half, n), rng.uniform(low, high, n)])


def ground(rng, n=20000):
    return np.column_stack([rng.uniform(-SPACING / 2, SPACING / 2, n), rng.normal(0, 0.025, n)])


def floor_of(*parts):
    """Floor of a row, and where it is by its height alone."""
    left, height = np.concatenate(parts).T
    size = canopy_size(left, height, SPACING, 3.6)
    return canopy_floor(left, height, size, SPACING), float(above_weeds(size[0]))


@pytest.mark.parametrize(("top", "bottom"), [(0.6, 0.05), (0.8, 0.1), (1.2, 0.2)])
def test_foliage_is_followed_down_to_where_it_ends(top, bottom):
    rng = np.random.default_rng(0)
    floor, usual = floor_of(ground(rng), block(rng, 4000, 0.12, bottom, top))
    assert floor < usual
    assert floor == pytest.approx(max(bottom, 0.1), abs=0.051)


def test_no_foliage_is_looked_for_among_weeds_that_stand_beside_it():
    rng = np.random.default_rng(0)
    weeds = block(rng, 12000, SPACING / 2, 0, 0.3)
    floor, usual = floor_of(ground(rng), weeds, block(rng, 4000, 0.12, 0.05, 0.9))
    assert usual <= floor <= 0.31


def test_weeds_that_stand_only_under_vines_are_no_canopy():
    """Whether trunks part them from the foliage, or foliage thins out in them."""
    rng = np.random.default_rng(0)
    foliage, thin = block(rng, 4000, 0.12, 0.45, 1.0), block(rng, 500, 0.12, 0.25, 0.45)
    floor, usual = floor_of(ground(rng), block(rng, 2000, 0.12, 0, 0.2), foliage)
    assert floor == usual
    for weeds in (block(rng, 4000, 0.12, 0, 0.35), block(rng, 8000, 0.4, 0, 0.35)):
        floor, usual = floor_of(ground(rng), weeds, thin, foliage)
        assert 0.34 <= floor <= 0.45
        assert usual < 0.35


@pytest.mark.parametrize("bottom", [0.05, 0.55])
def test_tall_rows_begin_at_the_margin(bottom):
    rng = np.random.default_rng(0)
    assert floor_of(ground(rng), block(rng, 6000, 0.25, bottom, 1.9))[0] == 0.4


def test_weeds_that_stand_out_on_both_sides_of_tall_rows_are_no_canopy():
    """Whether they end below the foliage or within it, but not if they stand on one side, or as high as can be told."""
    rng = np.random.default_rng(0)
    foliage, weeds = block(rng, 8000, 0.25, 0.7, 1.9), block(rng, 4000, 0.5, 0, 0.6)
    assert floor_of(ground(rng), foliage, weeds)[0] == pytest.approx(0.6, abs=0.06)
    assert floor_of(ground(rng), block(rng, 8000, 0.25, 0.5, 1.9), weeds)[0] == pytest.approx(0.5, abs=0.06)
    assert floor_of(ground(rng), foliage, weeds[weeds[:, 0] < 0.25])[0] == 0.4
    assert floor_of(ground(rng), foliage, block(rng, 40000, 1.2, 0, 1.5))[0] == 0.4


@pytest.mark.parametrize("density", [150, 1500])
def test_volumes_of_young_vines_on_bare_soil(density):
    """Foliage of 0.2 m by 0.55 m from 0.06 m up, however many points the soil has."""
    rng = np.random.default_rng(0)
    length, foliage = 20.0, 300 * density // 30
    left, height = np.concatenate(
        [ground(rng, round(SPACING * length * density)), block(rng, foliage, 0.1, 0.06, 0.61)]
    ).T
    xyz = np.column_stack([rng.uniform(0, length, len(left)), left, height])
    flat = Raster(np.zeros((2, 2)), Grid(-5.0, 25.0, 15.0, 2, 2), UTM)
    line = shapely.LineString([(0, 0, 0), (length, 0, 0)])
    rows = gpd.GeoDataFrame({"row_id": [1], "spacing_m": [SPACING]}, geometry=[line], crs=UTM)
    no_gaps = gpd.GeoDataFrame({"row_id": [], "start_m": [], "end_m": []}, geometry=[], crs=UTM)
    cloud = PointCloud(xyz, UTM, heights=xyz[:, 2])
    (canopy,) = living_canopies(cut_sections(cloud, rows, no_gaps, flat, separate_canopy))
    high = (height >= 0.15) & (np.abs(left) <= 0.1)
    assert np.isin(np.flatnonzero(high), canopy.sections.member).mean() > 0.98
    table = model_sections([canopy], UTM).table
    assert table["bottom_m"].mean() == pytest.approx(0.06, abs=0.05)
    assert table["area_m2"].mean() == pytest.approx(0.2 * 0.55, rel=0.15)
