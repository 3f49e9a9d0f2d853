"""Remarks on what a product can be trusted for."""

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.geo.raster import Grid, Raster
from vinemap.product.notices import (
    ground_notices,
    height_notices,
    known_notices,
    notices,
    pair_notices,
    sight_notices,
)

WEST, NORTH = 414_700.0, 4_940_760.0
AREA = 60.0 * 40.0


def rows(*confidence, canopy=0.9):
    """Rows with these confidences; where they lie doesn't matter."""
    lines = [shapely.LineString([(0, k), (1, k)]) for k in range(len(confidence))]
    numbers = {"confidence": np.array(confidence, dtype=float)}
    numbers["canopy_confidence"] = canopy
    return gpd.GeoDataFrame(numbers, geometry=lines, crs=32632)


def parcel(*polygons):
    return gpd.GeoDataFrame(geometry=list(polygons or [box(0, 0, 60, 40)]), crs=32632)


def unmapped(*told):
    """Places in no row: reason, area, height, width."""
    columns = list(zip(*told, strict=True)) or [[]] * 4
    table = dict(zip(("reason", "area_m2", "height_m", "width_m"), map(list, columns), strict=True))
    table["share"] = [area / AREA for area in table["area_m2"]]
    return gpd.GeoDataFrame(table, geometry=[box(0, 0, 1, 1)] * len(told), crs=32632)


def heights_of(rows, chm, unmapped):
    return height_notices(rows, chm, unmapped, highest=3.6)


def notices_of(rows, chm, parcel, n_points, *places):
    return notices(rows, chm, parcel, unmapped(*places), n_points)


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
    assert notices_of(rows(0.5, 1), full, parcel(), int(AREA * 100)) == []


@pytest.mark.parametrize("resolution", [0.05, 0.25, 0.7, 2.0])
def test_what_is_not_covered(resolution):
    seen = chm(box(30, 0, 60, 40), resolution=resolution)
    (remark,) = notices_of(rows(1), seen, parcel(), int(AREA * 100))
    share = float(remark.removeprefix("the cloud covers ").removesuffix("% of the parcel"))
    assert share == pytest.approx(50, abs=4)


def test_a_little_that_is_not_covered(full):
    assert notices_of(rows(1), chm(box(0, 0, 2, 40)), parcel(), int(AREA * 100)) == []
    assert len(notices_of(rows(1), chm(box(0, 0, 4, 40)), parcel(), int(AREA * 100))) == 1


def test_between_rows_a_cell_without_points_is_covered():
    holes = [box(x, 0, x + 0.5, 40) for x in range(1, 60, 2)]
    assert notices_of(rows(1), chm(*holes), parcel(), int(AREA * 100)) == []


def test_a_parcel_beyond_the_cloud(full):
    """That the raster ends there doesn't hide it."""
    (remark,) = notices_of(rows(1), full, parcel(box(-60, 0, 60, 40)), int(AREA * 100))
    assert remark == "the cloud covers 50% of the parcel"
    (remark,) = notices_of(rows(1), full, parcel(box(30, 20, 90, 60)), int(AREA * 100))
    assert remark == "the cloud covers 25% of the parcel"
    (remark,) = notices_of(rows(1), full, parcel(box(100, 100, 160, 140)), int(AREA * 100))
    assert remark == "the cloud covers 0% of the parcel"


def test_parts_and_holes_of_a_parcel():
    """What is between its blocks need not be covered."""
    seen = chm(box(20, 0, 40, 40))
    parts = parcel(box(0, 0, 20, 40), box(40, 0, 60, 40))
    assert notices_of(rows(1), seen, parts, int(AREA * 100)) == []
    holed = shapely.difference(box(0, 0, 60, 40), box(20, 0, 40, 40))
    assert notices_of(rows(1), seen, parcel(holed), int(AREA * 100)) == []


def test_a_tiny_parcel(full):
    assert notices_of(rows(1), full, parcel(box(1.2, 1.2, 1.3, 1.3)), int(AREA * 100)) == []


def test_how_dense_the_points_are(full):
    assert notices_of(rows(1), full, parcel(), int(AREA * 60) + 1) == []
    said = ["20 points/m², canopies are poor below 60"]
    assert notices_of(rows(1), full, parcel(), int(AREA * 20)) == said
    half = chm(box(30, 0, 60, 40))
    assert notices_of(rows(1), half, parcel(box(0, 0, 30, 40)), int(AREA * 10)) == said


def test_rows_that_are_worth_a_look(full):
    said = notices_of(rows(0.1, 0.49, 0.5, 0.9), full, parcel(), int(AREA * 100))
    assert said == ["2 of 4 rows are doubtful (confidence below 0.5)"]


def test_canopies_whose_numbers_are_not_to_be_trusted(full):
    (said,) = notices_of(rows(1, 1, 1, canopy=[0.2, 0.9, np.nan]), full, parcel(), int(AREA * 100))
    assert said.startswith("heights, widths and volumes of 1 of 3 rows are doubtful")


def test_no_points_at_all():
    said = notices_of(rows(1), chm(box(-1, -1, 61, 41)), parcel(), 0)
    assert said == ["the cloud covers 0% of the parcel", "0 points/m², canopies are poor below 60"]


def test_what_stands_in_no_row(full):
    """The main reasons, the largest first; what is too tall is no vine."""
    roof = ("too wide", 600.0, 2.1, 20.0)
    (remark,) = notices_of(rows(1), full, parcel(), int(AREA * 100), roof, ("too tall", 900.0, 9.0, 30.0))
    assert remark == (
        "what stands on 600 m² (25% of the parcel) is in no row: closed over 20 m, so that no rows can be told"
    )
    seen = ("no rows seen", 350.0, 1.9, 0.5)
    (remark,) = notices_of(rows(1), full, parcel(), int(AREA * 100), roof, seen, seen, ("alone", 30.0, 1.0, 1.0))
    assert remark == (
        "what stands on 1,330 m² (55% of the parcel) is in no row: 700 m² like vines, but no rows were seen; "
        "600 m² closed over 20 m, so that no rows can be told"
    )
    (remark,) = notices_of(rows(1), full, parcel(), int(AREA * 100), ("too low", 60.0, 0.62, 0.5))
    assert remark.endswith("lower than half of the rows (0.6 m)")


def test_a_little_that_stands_in_no_row(full):
    assert notices_of(rows(1), full, parcel(), int(AREA * 100), ("alone", 0.019 * AREA, 1.5, 0.6)) == []
    assert notices_of(rows(1), full, parcel(), int(AREA * 100), ("too tall", 0.9 * AREA, 8.0, 30.0)) == []
    assert len(notices_of(rows(1), full, parcel(), int(AREA * 100), ("alone", 0.021 * AREA, 1.5, 0.6))) == 1


def test_why_no_row_was_found(full):
    bare = "no row was found: nothing stands there that is as high as vines"
    assert notices_of(rows(), full, parcel(), int(AREA * 100)) == [bare]
    assert notices_of(rows(), full, parcel(), int(AREA * 2))[-1] == f"{bare}, or too few points show it (2.0 a m²)"
    trees, bushes = ("too tall", 900.0, 9.0, 8.0), ("too wide", 10.0, 1.5, 3.0)
    (remark,) = notices_of(rows(), full, parcel(), int(AREA * 100), trees, bushes)
    assert remark == "no row was found in what stands on 910 m² (38% of the parcel): too tall for vines (up to 9 m)"
    (remark,) = notices_of(rows(), full, parcel(), int(AREA * 100), trees, ("too wide", 200.0, 2.1, 12.0))
    assert remark.endswith("9 m); 200 m² closed over 12 m, so that no rows can be told")


def at(height, **columns):
    """A row of 40 m, and canopies of that height along it, 0.6 m wide."""
    line = shapely.LineString([(WEST + 10, NORTH - 20), (WEST + 50, NORTH - 20)])
    seen = chm()
    x, y = np.meshgrid(*seen.grid.centres())
    seen.values[shapely.contains_xy(line.buffer(0.3), x, y)] = height
    return rows(1).set_geometry([line], crs=32632).assign(**{"height_m": height} | columns), seen


def test_heights_of_vines_need_no_remark():
    assert heights_of(*at(1.9), unmapped()) == []
    assert heights_of(*at(3.4, height_m=3.3), unmapped()) == []


def test_rows_whose_heights_are_not_known():
    (remark,) = heights_of(*at(0.6, height_m=np.nan), unmapped())
    assert remark.startswith("1 of 1 rows have no canopy that could be measured")
    assert "are heights in metres?" in remark


def test_rows_under_something_higher():
    (remark,) = heights_of(*at(6.2, height_m=3.5), unmapped())
    assert remark.startswith("plants are higher than 3.6 m on 100% of the rows")


@pytest.mark.parametrize(("area", "told"), [(0.2 * AREA, False), (0.5 * AREA, True)])
def test_more_that_is_too_tall_than_trees(area, told):
    """As where heights are in decimetres, or a part of the cloud lies above another datum, and a row was found."""
    remarks = heights_of(*at(1.9), unmapped(("too tall", area, 19.0, 2.0)))
    assert [remark.startswith("what stands on 1,200 m² (50% of the parcel) is up to 19.0 m") for remark in remarks] == [
        True
    ] * told


@pytest.mark.parametrize(("height", "told"), [(6.2, "6.2 m high"), (0.002, "0.002 m high"), (190.0, "190 m high")])
def test_no_row_among_heights_that_no_vineyard_has(height, told):
    seen = chm()
    seen.values[:, ::4] = height
    (remark,) = heights_of(rows(), seen, unmapped())
    assert told in remark
    assert "no row" not in remark  # as :func:`notices` says why
    seen.values[:, ::4] = 1.9
    assert heights_of(rows(), seen, unmapped()) == []


def test_no_points_have_no_heights():
    assert heights_of(rows(), chm(box(-1, -1, 61, 41)), unmapped()) == []


def test_what_was_not_seen_of_rows():
    some = rows(1, 1, 1).assign(unseen_m=[0.0, 3.2, 2.04])
    ends = gpd.GeoDataFrame(
        {"row_id": [1, 1, 2, 2, 3, 3], "beyond": ["seen", "outside", *["unseen"] * 2, "seen", "seen"]}
    )
    assert sight_notices(some, ends) == [
        "5.2 m of 2 of 3 rows were not seen: whether vines stand there is not known, and none is counted as missing",
        "1 of 3 rows may go on: beyond their ends nothing was seen",
    ]
    assert sight_notices(some.assign(unseen_m=0.0), ends.assign(beyond="outside")) == []
    assert sight_notices(some[:0], ends[:0]) == []


@pytest.mark.parametrize(
    ("spacing", "shift", "some"),
    [(2.5, 0.0, False), (2.5, 0.4, False), (2.2, 0.0, True), (2.2, 0.5, True), (2.8, -0.3, True)],
)
def test_rows_of_another_planting_are_told_from_a_shift(spacing, shift, some):
    """Known lines are 2.5 m apart and of a little noise; rows of 2.2 m are others."""
    noise = np.random.default_rng(1).normal(0, 0.05, 8)
    lines = [shapely.LineString([(0, y), (20, y)]) for y in 2.5 * np.arange(8) + noise]
    known = gpd.GeoDataFrame({"row_id": range(1, 9)}, geometry=lines, crs=32632).to_crs(3003)
    places = spacing * (np.arange(-20, 40) - 10) + shift
    nearest = [places[np.abs(places - 2.5 * k).argmin()] for k in range(8)]
    seen = gpd.GeoDataFrame(
        {"row_id": range(1, 9), "spacing_m": spacing, "support": 0.9},
        geometry=[shapely.LineString([(0, y), (20, y)]) for y in nearest],
        crs=32632,
    )
    said = known_notices(seen, known)
    assert len(said) == some
    assert not said or "of 8 rows stand 0." in said[0]
    assert known_notices(seen.iloc[:2], known) == known_notices(seen.assign(support=0.0), known) == []


def side_by_side(*distances, spacing=1.3):
    """Rows of 30 m, so far from each other."""
    at = np.cumsum([0.0, *distances])
    lines = [shapely.LineString([(WEST, NORTH + y, 200), (WEST + 30, NORTH + 5 + y, 201)]) for y in at]
    return gpd.GeoDataFrame({"spacing_m": spacing}, geometry=lines, index=range(len(at)), crs=32632)


def test_rows_that_stand_in_pairs():
    turn = 30 / np.hypot(30, 5)
    (told,) = pair_notices(side_by_side(*(np.array([1.2, 2.8, 1.2, 2.8, 1.2]) / turn)))
    assert told.startswith("rows stand in pairs, 1.2 m apart and 2.8 m from the next ones: ")


@pytest.mark.parametrize(
    "distances",
    [
        [],
        [1.2],
        [1.2, 2.8],
        [2.5] * 7,
        [2.0, 2.6] * 4,
        [1.2, 2.8, 1.2, 1.2, 1.2, 1.2, 1.2, 2.4, 1.2, 1.2],
        [1.0, 3.4, 1.7, 2.2, 1.1],
    ],
)
def test_rows_that_do_not(distances):
    assert pair_notices(side_by_side(*distances)) == []
    assert pair_notices(side_by_side()[:0]) == []


@pytest.mark.parametrize(("reach", "told"), [(0.5, True), (0.9, False), (2.0, False)])
def test_alleys_without_ground(reach, told):
    """Canopies alone, canopies with a little of the ground beside them, and all."""
    standing = side_by_side(2, 2, 2)
    grid = Grid(WEST - 5, NORTH + 20, 0.25, 120, 160)
    lines = shapely.union_all(standing.geometry.to_numpy())
    near = shapely.dwithin(shapely.points(np.stack(np.meshgrid(*grid.centres()), axis=-1)), lines, reach)
    remarks = ground_notices(standing.assign(spacing_m=2.0), Raster(np.where(near, 0.5, np.nan), grid, standing.crs))
    assert [remark.startswith("alleys show ground on 0% of their length only") for remark in remarks] == [True] * told


def test_alleys_of_a_sparse_cloud_show_ground():
    """Of 3 points a square metre few fall into cells of an alley's middle."""
    standing = side_by_side(2, 2, 2)
    grid = Grid(WEST - 5, NORTH + 20, 0.1, 300, 400)
    shown = np.random.default_rng(0).random(grid.shape) < 0.03
    assert (
        ground_notices(standing.assign(spacing_m=2.0), Raster(np.where(shown, 0.5, np.nan), grid, standing.crs)) == []
    )
