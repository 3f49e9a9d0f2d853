"""What stands in no row: on rasters of known plants, and on a simulated parcel whose rows are taken away."""

import geopandas as gpd
import numpy as np
import pytest
import shapely
from pyproj import CRS

from vinemap.canopy.numbers import summarise_rows
from vinemap.chain import map_rows, model_canopies
from vinemap.config.settings import Settings
from vinemap.evaluate.unmapped import find_unmapped
from vinemap.geo.raster import Grid, Raster

WEST, NORTH, WIDE, HIGH = 414_700.0, 4_940_760.0, 60.0, 40.0
SPACING, WIDTH, HEIGHT = 2.5, 0.5, 1.9


def box(west, south, east, north):
    """In metres from the raster's south-western corner."""
    return shapely.box(WEST + west, NORTH - HIGH + south, WEST + east, NORTH - HIGH + north)


def chm(*plants, resolution=0.25):
    """Canopy heights of 60 m by 40 m: polygons with their heights, on ground with a little noise."""
    grid = Grid(WEST, NORTH, resolution, round(HIGH / resolution), round(WIDE / resolution))
    values = np.random.default_rng(0).uniform(0, 0.1, grid.shape)
    x, y = np.meshgrid(*grid.centres())
    for polygon, height in plants:
        values[shapely.contains_xy(polygon, x, y)] = height
    return Raster(values, grid, CRS.from_epsg(32632))


def vines(south, *, height=HEIGHT, width=WIDTH, west=5, east=55):
    return box(west, south - width / 2, east, south + width / 2), height


def rows(*south, spacing=SPACING, width=WIDTH, height=HEIGHT):
    """Rows from west to east at these distances from the southern edge."""
    lines = [shapely.LineString([(WEST + 5, NORTH - HIGH + y), (WEST + 55, NORTH - HIGH + y)]) for y in south]
    numbers = {"spacing_m": spacing, "width_m": width, "height_m": height}
    return gpd.GeoDataFrame({name: [float(n)] * len(lines) for name, n in numbers.items()}, geometry=lines, crs=32632)


PLANTED = [5.1 + SPACING * k for k in range(8)]
TREE = shapely.Point(WEST + 30, NORTH - 8).buffer(3), 6.0


def told(found):
    return found["reason"].tolist()


@pytest.mark.parametrize("resolution", [0.1, 0.25, 0.5])
def test_rows_canopies_and_what_grows_between_them_are_mapped(resolution):
    strips = [vines(y + SPACING / 2, height=0.9, width=1.2) for y in PLANTED[::2]]
    plants = [*(vines(y) for y in PLANTED), *strips]
    assert len(find_unmapped(chm(*plants, resolution=resolution), rows(*PLANTED))) == 0


def test_canopies_wider_than_their_rows_mean_are_theirs():
    """Canopies that meet in places, without room for another between them."""
    bulges = [(box(20 * k, y, 20 * k + 4, y + SPACING), HEIGHT) for k, y in enumerate(PLANTED[2:4], start=1)]
    wide = [vines(y, width=1.4) for y in PLANTED]
    assert len(find_unmapped(chm(*wide, *bulges), rows(*PLANTED, width=1.4))) == 0


@pytest.mark.parametrize("resolution", [0.1, 0.25, 0.5])
def test_a_row_that_was_missed(resolution):
    found = find_unmapped(chm(*map(vines, PLANTED), resolution=resolution), rows(*PLANTED[:3], *PLANTED[4:]))
    assert told(found) == ["no rows seen"]
    assert found["area_m2"][0] == pytest.approx(50 * WIDTH, abs=50 * resolution)
    assert found["share"][0] == pytest.approx(found["area_m2"][0] / (WIDE * HIGH))
    assert found["height_m"][0] == pytest.approx(HEIGHT)
    assert found["width_m"][0] == pytest.approx(WIDTH, abs=max(0.2, resolution))
    assert shapely.hausdorff_distance(found.geometry[0], vines(PLANTED[3])[0]) < 0.6


def test_every_second_row():
    """Rows at twice the spacing, half way between which others stand."""
    found = find_unmapped(chm(*map(vines, PLANTED)), rows(*PLANTED[::2], spacing=2 * SPACING))
    assert set(told(found)) == {"no rows seen"}
    for y in PLANTED[1::2]:
        plants = vines(y)[0]
        assert shapely.intersection(found.union_all(), plants).area > 0.75 * plants.area


def test_a_block_that_was_missed_is_one_polygon_with_what_lies_between_its_rows():
    block = shapely.box(*shapely.total_bounds([vines(y)[0] for y in PLANTED[4:]]))
    found = find_unmapped(chm(*map(vines, PLANTED)), rows(*PLANTED[:4]))
    assert told(found) == ["no rows seen"]
    assert shapely.intersection(found.geometry[0], block).area > 0.9 * block.area
    assert found["area_m2"][0] < 1.05 * block.area
    assert len(shapely.get_coordinates(found.geometry[0])) < 20


@pytest.mark.parametrize(
    ("plants", "reason"),
    [
        ([TREE], "too tall"),
        ([(box(10, 30, 50, 38), 2.1)], "too wide"),
        ([vines(34, height=0.6, width=0.3)], "too low"),
        ([vines(34, height=0.6, width=3.0)], None),
        ([vines(y, height=0.6, width=0.3) for y in (30, 32, 34)], "too low"),
        ([(box(30, 30, 31, 31.5), 1.5)], "alone"),
        ([(shapely.Point(WEST + 10 + 2 * k, NORTH - 8).buffer(0.5), 1.2) for k in range(12)], "alone"),
        ([(box(30, 30, 30.25, 30.5), 1.5)], None),
    ],
)
def test_what_stands_beside_the_rows(plants, reason):
    """Tree, pergola, vines planted lately, tall grass, several such rows, a bush, a row of bushes, a post."""
    found = find_unmapped(chm(*map(vines, PLANTED), *plants), rows(*PLANTED))
    assert told(found) == ([reason] if reason else [])


def test_parts_of_what_hangs_together():
    """A tree at the end of a pergola is told apart from it, a bush at the foot of a tree isn't."""
    at = box(10, 5, 40, 30), 2.1
    found = find_unmapped(chm(at, (shapely.Point(WEST + 42, NORTH - 20).buffer(4), 7.0)), rows())
    assert told(found) == ["too wide", "too tall"]
    found = find_unmapped(chm(TREE, (shapely.Point(WEST + 33, NORTH - 8).buffer(1.5), 1.5)), rows())
    assert told(found) == ["too tall"]


def test_a_roof_is_closed_as_wide_as_it_is():
    found = find_unmapped(chm((box(10, 10, 40, 30), 2.1)), rows())
    assert told(found) == ["too wide"]
    assert found["area_m2"][0] == pytest.approx(600, rel=0.02)
    assert found["width_m"][0] == pytest.approx(20, abs=0.5)


def test_a_hedge_around_a_parcel_doesn_t_fill_it():
    hedge = shapely.difference(box(2, 2, 58, 38), box(4.5, 4.5, 55.5, 35.5)), 2.0
    (area,) = find_unmapped(chm(hedge), rows())["area_m2"]
    assert area == pytest.approx(hedge[0].area, rel=0.1)


def test_beyond_the_parcel_nothing_is_told():
    south = gpd.GeoDataFrame(geometry=[box(0, 0, 60, 28)], crs=32632)
    assert len(find_unmapped(chm(*map(vines, PLANTED), TREE), rows(*PLANTED), south)) == 0
    found = find_unmapped(chm(*map(vines, PLANTED), TREE), rows(*PLANTED[:-1]), south)
    assert found["share"].sum() == pytest.approx(found["area_m2"].sum() / (60 * 28))
    assert found.within(south.geometry[0].buffer(1e-6)).all()


def test_without_anything_there_is_an_empty_table():
    none = chm()
    for heights in (none, Raster(np.full_like(none.values, np.nan), none.grid, none.crs)):
        found = find_unmapped(heights, rows())
        assert len(found) == 0
        assert {"reason", "area_m2", "share", "height_m", "width_m", "geometry"} == set(found.columns)


def test_rows_of_unknown_height_and_width():
    """Rows without a section of canopy have neither."""
    unknown = rows(*PLANTED).assign(height_m=np.nan, width_m=np.nan)
    assert len(find_unmapped(chm(*map(vines, PLANTED)), unknown)) == 0
    assert told(find_unmapped(chm(*map(vines, PLANTED)), unknown.drop(index=3))) == ["no rows seen"]


def test_rows_of_a_survey_that_are_taken_away(cloud, vineyard):
    """In leaves and weeds as they grow: nothing is told of rows that are there, and of all that aren't."""
    seen, settings = map_rows(cloud), Settings()
    table = model_canopies(seen, settings).table
    found = summarise_rows(seen.rows, table, step=settings.sections.step)
    assert len(find_unmapped(seen.chm, found)) == 0
    left = find_unmapped(seen.chm, found.iloc[[0, 1, 4, 5]])
    assert set(told(left)) == {"no rows seen"}
    for line in seen.rows.geometry.iloc[2:4]:
        assert line.intersection(left.union_all()).length > 0.7 * line.length
    (reason,) = set(told(find_unmapped(seen.chm, found.iloc[:0])))
    assert reason == "no rows seen"
