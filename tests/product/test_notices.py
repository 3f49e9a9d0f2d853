"""Remarks on what a product can be trusted for."""

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.geo.raster import Grid, Raster
from vinemap.product.notices import notices

WEST, NORTH = 414_700.0, 4_940_760.0
AREA = 60.0 * 40.0


def rows(*confidence, lines=None):
    """Rows with these confidences; where they lie doesn't matter to most remarks."""
    lines = lines or [shapely.LineString([(0, k), (1, k)]) for k in range(len(confidence))]
    numbers = {"confidence": np.array(confidence, dtype=float), "spacing_m": 2.5, "height_m": 1.9}
    return gpd.GeoDataFrame(numbers, geometry=lines, crs=32632)


def parcel(*polygons):
    return gpd.GeoDataFrame(geometry=list(polygons or [box(0, 0, 60, 40)]), crs=32632)


def box(west, south, east, north):
    """In metres from the raster's south-western corner."""
    return shapely.box(WEST + west, NORTH - 40 + south, WEST + east, NORTH - 40 + north)


def chm(*without, resolution=0.25):
    """Canopy heights of 60 m by 40 m, without points in some boxes."""
    grid = Grid(WEST, NORTH, resolution, int(40 / resolution), int(60 / resolution))
    values = np.zeros(grid.shape, dtype=np.float32)
    x, y = np.meshgrid(*grid.centres())
    for polygon in without:
        values[shapely.contains_xy(polygon, x, y)] = np.nan
    return Raster(values, grid, parcel().crs)


@pytest.fixture
def full():
    return chm()


def test_nothing_to_say(full):
    assert notices(rows(0.5, 1), full, parcel(), int(AREA * 100)) == []


@pytest.mark.parametrize("resolution", [0.05, 0.25, 0.7, 2.0])
def test_what_is_not_covered(resolution):
    seen = chm(box(30, 0, 60, 40), resolution=resolution)
    (remark,) = notices(rows(), seen, parcel(), int(AREA * 100))
    share = float(remark.removeprefix("the cloud covers ").removesuffix("% of the parcel"))
    assert share == pytest.approx(50, abs=4)


def test_a_little_that_is_not_covered(full):
    assert notices(rows(), chm(box(0, 0, 2, 40)), parcel(), int(AREA * 100)) == []
    assert len(notices(rows(), chm(box(0, 0, 4, 40)), parcel(), int(AREA * 100))) == 1


def test_between_rows_a_cell_without_points_is_covered():
    holes = [box(x, 0, x + 0.5, 40) for x in range(1, 60, 2)]
    assert notices(rows(), chm(*holes), parcel(), int(AREA * 100)) == []


def test_a_parcel_beyond_the_cloud(full):
    """That the raster ends there doesn't hide it."""
    (remark,) = notices(rows(), full, parcel(box(-60, 0, 60, 40)), int(AREA * 100))
    assert remark == "the cloud covers 50% of the parcel"
    (remark,) = notices(rows(), full, parcel(box(30, 20, 90, 60)), int(AREA * 100))
    assert remark == "the cloud covers 25% of the parcel"
    (remark,) = notices(rows(), full, parcel(box(100, 100, 160, 140)), int(AREA * 100))
    assert remark == "the cloud covers 0% of the parcel"


def test_parts_and_holes_of_a_parcel():
    """What is between its blocks need not be covered."""
    seen = chm(box(20, 0, 40, 40))
    parts = parcel(box(0, 0, 20, 40), box(40, 0, 60, 40))
    assert notices(rows(), seen, parts, int(AREA * 100)) == []
    holed = shapely.difference(box(0, 0, 60, 40), box(20, 0, 40, 40))
    assert notices(rows(), seen, parcel(holed), int(AREA * 100)) == []


def test_a_tiny_parcel(full):
    assert notices(rows(), full, parcel(box(1.2, 1.2, 1.3, 1.3)), int(AREA * 100)) == []


def test_how_dense_the_points_are(full):
    assert notices(rows(), full, parcel(), int(AREA * 60) + 1) == []
    said = ["20 points/m², canopies are poor below 60"]
    assert notices(rows(), full, parcel(), int(AREA * 20)) == said
    half = chm(box(30, 0, 60, 40))
    assert notices(rows(), half, parcel(box(0, 0, 30, 40)), int(AREA * 10)) == said


def test_rows_that_are_worth_a_look(full):
    said = notices(rows(0.1, 0.49, 0.5, 0.9), full, parcel(), int(AREA * 100))
    assert said == ["2 of 4 rows are doubtful (confidence below 0.5)"]


def test_no_points_at_all():
    said = notices(rows(), chm(box(-1, -1, 61, 41)), parcel(), 0)
    assert said == ["the cloud covers 0% of the parcel", "0 points/m², canopies are poor below 60"]


def grown(full, *plants, height):
    """Canopy heights with plants in some boxes."""
    x, y = np.meshgrid(*full.grid.centres())
    inside = np.any([shapely.contains_xy(plant, x, y) for plant in plants], axis=0)
    return Raster(np.where(inside, np.float32(height), full.values), full.grid, full.crs)


def test_plants_in_no_row(full):
    """A roof of leaves, bushes apart, and the same with rows through them; grass and trees are no vines."""
    roof = grown(full, box(10, 10, 40, 30), height=2.0)
    (remark,) = notices(rows(), roof, parcel(), int(AREA * 100))
    assert remark.startswith("plants of 0.5 to 3.6 m stand in no row on 600 m² (25% of the parcel): closed over 3 m")
    bushes = [box(5 * k, 5 * m, 5 * k + 2, 5 * m + 2) for k in range(10) for m in range(6)]
    (remark,) = notices(rows(), grown(full, *bushes, height=1.5), parcel(), int(AREA * 100))
    assert remark.endswith("no rows were seen in them")
    for height in (0.3, 5.0):
        assert notices(rows(), grown(full, *bushes, height=height), parcel(), int(AREA * 100)) == []
    strips = [box(5, 5 * k, 55, 5 * k + 1) for k in range(1, 8)]
    lines = [shapely.LineString([strip.bounds[:2], (strip.bounds[2], strip.bounds[1])]) for strip in strips]
    vines = grown(full, *strips, height=1.9)
    assert notices(rows(*[1] * 7, lines=lines), vines, parcel(), int(AREA * 100)) == []
    (remark,) = notices(rows(*[1] * 4, lines=lines[:4]), vines, parcel(), int(AREA * 100))
    assert "on 150 m² (6% of the parcel)" in remark
