"""What wasn't seen of rows, and what lies outside of their parcel, is unknown and no gap of missing vines."""

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.chain import map_rows
from vinemap.cloud.points import PointCloud
from vinemap.geo.crs import parse_crs
from vinemap.geo.raster import Grid, Raster
from vinemap.rows.numbers import count_missing, number_rows
from vinemap.rows.standing.canopy import Standing
from vinemap.rows.standing.gaps import (
    MISSING,
    OUTSIDE,
    SEEN,
    UNSEEN,
    beyond_ends,
    lay_out,
)
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import hillside
from vinemap.surfaces.seen import Seen

LENGTH = 30.0
UTM = parse_crs("EPSG:32632")
FLAT = Raster(np.zeros((2, 2)), Grid(-50.0, 50.0, 50.0, 2, 2), UTM)


def seen(*voids):
    """From 5 m before the row to 5 m behind it and 5 m to both sides all is seen, but for voids."""
    grid = Grid(-6.0, 6.0, 0.1, 120, 420)
    x, y = np.meshgrid(*grid.centres())
    shown = shapely.contains_xy(shapely.box(-5, -5, LENGTH + 5, 5), x, y)
    shown &= ~shapely.contains_xy(shapely.union_all(voids), x, y)
    return Seen(shown, grid, shown, grid)


def standing(*runs):
    """A row from 0 to 30 m eastwards."""
    x = np.arange(0, LENGTH + 0.01, 0.05)
    return Standing(np.column_stack([x, np.zeros(len(x))]), np.array(runs, dtype=float), 0.9, (False, False))


def laid_out(runs, *voids, within=None):
    return lay_out([(2.5, standing(*runs))], seen(*voids), FLAT, within=within)


def strip(start, end, width=5.0):
    return shapely.box(start, -width, end, width)


def assert_told(gaps, told):
    assert gaps["state"].tolist() == [state for *_, state in told]
    assert gaps[["start_m", "end_m"]].to_numpy() == pytest.approx(np.array([edges for *edges, _ in told]), abs=0.11)


@pytest.mark.parametrize(
    ("voids", "told"),
    [
        ([], [(10, 16, MISSING)]),
        ([strip(9.8, 16.2)], [(10, 16, UNSEEN)]),
        ([strip(10.3, 15.6)], [(10, 16, UNSEEN)]),
        ([strip(11.5, 14)], [(10, 11.5, MISSING), (11.5, 14, UNSEEN), (14, 16, MISSING)]),
        ([strip(8, 13)], [(10, 13, UNSEEN), (13, 16, MISSING)]),
        ([strip(9, 12), strip(12.5, 14.6)], [(10, 14.6, UNSEEN), (14.6, 16, MISSING)]),
        ([strip(11, 11.5), strip(13, 13.6)], [(10, 16, MISSING)]),
        ([shapely.box(10, 0.3, 16, 5)], [(10, 16, MISSING)]),
    ],
)
def test_a_gap_is_parted_in_what_was_seen_and_what_was_not(voids, told):
    rows, gaps = laid_out([(0, 10), (16, LENGTH)], *voids)
    assert_told(gaps, told)
    hidden = sum(b - a for a, b, state in told if state == UNSEEN)
    assert rows["unseen_m"].iloc[0] == pytest.approx(hidden, abs=0.21)
    assert rows["gap_m"].iloc[0] + rows["unseen_m"].iloc[0] == pytest.approx(6)
    assert rows["support"].iloc[0] == pytest.approx(24 / (LENGTH - rows["unseen_m"].iloc[0]))


def test_missing_vines_are_counted_where_all_was_seen_whichever_way_a_row_runs():
    rows, gaps = laid_out([(0, 4), (6, 10), (16, 20), (22, LENGTH)], strip(12, 14))
    for turned in (False, True):
        lines = rows.geometry.reverse() if turned else rows.geometry
        known = gaps.assign(start_m=LENGTH - gaps["end_m"], end_m=LENGTH - gaps["start_m"]) if turned else gaps
        numbered = number_rows(rows.set_geometry(lines).assign(block=1), known)
        counted, told = count_missing(*numbered, vine_spacing=1.0)
        assert told["n_missing"].tolist() == [2, 2, 0, 2, 2]
        assert counted["n_missing"].tolist() == [8]
        assert_told(told[2:3], [(12, 14, UNSEEN)])


def test_a_row_ends_where_its_parcel_does():
    parcel = strip(-5, LENGTH + 5).difference(shapely.box(12, -1, 14, 1)).difference(shapely.box(20, -2, 23, 9))
    runs = [(0, 5), (7, 11.9), (14.1, 20.05), (23, LENGTH)]
    rows, gaps = laid_out(runs, shapely.box(12, -1, 14, 1), within=parcel)
    ends = [shapely.get_coordinates(line)[[0, -1], 0].tolist() for line in rows.geometry]
    assert ends == [pytest.approx(end, abs=0.06) for end in ([0, 11.9], [14.1, 20], [23, LENGTH])]
    assert not shapely.union_all(rows.geometry).difference(parcel).length
    assert gaps["row"].tolist() == [0]
    assert_told(gaps, [(5, 7, MISSING)])
    assert rows["support"].tolist() == pytest.approx([9.9 / 11.9, 1, 1], abs=0.01)
    assert not rows["unseen_m"].any()
    whole, _ = laid_out(runs, within=strip(-5, LENGTH + 5))
    slit, _ = laid_out(runs, within=strip(-5, LENGTH + 5).difference(strip(12.4, 12.9)))
    assert len(whole) == len(slit) == 1
    assert len(laid_out(runs, within=strip(-3, 12.5).union(strip(13.6, 40)))[0]) == 2
    half, _ = laid_out(runs, within=strip(-5, 9))
    assert half.geometry[0].bounds[2] == pytest.approx(9, abs=0.06)
    beside, _ = laid_out(runs, within=strip(12.2, 13))
    assert beside.geometry.length.tolist() == pytest.approx([5, 4.9, 5.95, 7], abs=0.06)


def test_a_robot_is_told_where_a_row_may_go_on():
    lines = [shapely.LineString([(0, y, 0), (LENGTH, y, 0)]) for y in (0.0, 2.0)]
    rows = gpd.GeoDataFrame({"vine_spacing_m": 1.0}, geometry=lines, index=[0, 1], crs=UTM)
    shown = seen(shapely.box(LENGTH + 0.2, -1, LENGTH + 3, 1), strip(-3, -1.5))
    assert beyond_ends(rows, shown) == [SEEN, UNSEEN, SEEN, SEEN]
    within = shapely.box(-0.5, -4, LENGTH + 4, 4)
    assert beyond_ends(rows, shown, within) == [OUTSIDE, UNSEEN, OUTSIDE, SEEN]
    assert beyond_ends(rows[:0], shown) == []


class Field:
    """Seven rows of 24 m, 2.5 m apart at 20° from east, with three vines missing in the first; metres about its middle,
    along the rows and across them."""

    def __init__(self):
        lines = rows_of(7, length=24, azimuth=20)
        survey = simulate([Vineyard("A", lines, dead=0.0, gaps=(3,))], hillside(0.1), density=130, seed=1)
        self.xyz, self.missing = survey.xyz, survey.dead_vines
        self.middle = np.mean(lines, axis=(0, 1))
        way = lines[0][-1] - lines[0][0]
        self.axes = np.array([way, [-way[1], way[0]]]) / np.hypot(*way)

    def local(self, xy):
        return (np.asarray(xy)[:, :2] - self.middle) @ self.axes.T

    def placed(self, shape):
        return shapely.transform(shape, lambda xy: xy @ self.axes + self.middle)

    def mapped(self, *, without=(), within=None):
        """Rows and gaps by their place across, −7.5 to 7.5 m; of the cloud without some shapes, or clipped to one."""
        shape = None if within is None else self.placed(within)
        xyz = self.xyz if shape is None else self.xyz[shapely.contains_xy(shape, self.xyz[:, :2])]
        xyz = xyz[~shapely.contains_xy(shapely.union_all(list(without)), self.local(xyz))]
        found = map_rows(PointCloud(xyz, UTM), within=shape)
        ends = [self.local(shapely.get_coordinates(line)[[0, -1]]) for line in found.rows.geometry]
        across = np.array([2.5 * round(end[:, 1].mean() / 2.5) for end in ends])
        along = np.array([end[:, 0] for end in ends])
        rows = found.rows.assign(across=across, start=along.min(axis=1), end=along.max(axis=1))
        return rows, found.gaps.assign(across=found.gaps["row_id"].map(dict(zip(rows["row_id"], across, strict=True))))


@pytest.fixture(scope="module")
def field():
    return Field()


def test_voids_in_a_cloud_are_no_missing_vines(field):
    voids = [
        shapely.Point(2, 1.2).buffer(2.8),  # over three rows
        shapely.box(8, 4.2, 20, 5.8),  # over a row's end
        shapely.box(-6, -5.5, -3, -4.5),  # of a canopy alone, as where photographs didn't match
        shapely.box(-20, 7.5, 20, 20),  # all beyond the middle of the last row
    ]
    rows, gaps = field.mapped(without=voids)
    assert rows["across"].tolist() == [-7.5, -5, -2.5, 0, 2.5, 5, 7.5]
    assert rows["n_missing"].tolist() == [3, 0, 0, 0, 0, 0, 0]
    hidden = gaps[gaps["state"] == UNSEEN].groupby("across")["length_m"].sum().reindex(rows["across"], fill_value=0)
    truth = [0, 3, 0, 2 * np.sqrt(2.8**2 - 1.2**2), 2 * np.sqrt(2.8**2 - 1.3**2), 0, 0]
    assert hidden.to_numpy() == pytest.approx(truth, abs=0.5)
    assert rows["unseen_m"].to_numpy() == pytest.approx(hidden.to_numpy())
    assert rows["flags"].iloc[[0, 1, 2, 5, 6]].tolist() == ["", "", "", "", "edge"]
    assert rows["cut"].iloc[-1] > 0.9
    assert rows["confidence"].iloc[-1] < rows["confidence"].iloc[:-1].min() - 0.05
    assert rows["end"].iloc[5] == pytest.approx(8, abs=0.2)


def test_a_void_across_all_rows_is_no_track(field):
    rows, gaps = field.mapped(without=[shapely.Polygon([(-4, -20), (0, -20), (4, 20), (0, 20)])])
    assert rows["across"].tolist() == [-7.5, -5, -2.5, 0, 2.5, 5, 7.5]
    hidden = gaps[gaps["state"] == UNSEEN].groupby("across")["length_m"].sum()
    assert hidden.to_numpy() == pytest.approx(np.full(7, 4), abs=0.5)


def test_vines_beneath_the_crown_of_a_tree_are_not_seen():
    """And none is missing there; three are, in another row."""
    rows = rows_of(7, length=40)
    x, y = rows[3][len(rows[3]) // 2]
    tree = Obstacle(x, y, 2.2, 2.2, 6.0, 1.5)
    survey = simulate([Vineyard("A", rows, gaps=(3,), dead=0)], hillside(0.05), obstacles=[tree], density=200, seed=4)
    found = map_rows(PointCloud(survey.xyz, UTM))
    assert len(found.rows) == 7
    away = shapely.distance(found.gaps.geometry.to_numpy(), shapely.Point(x, y))
    under = found.gaps[(away < 2.5) & (found.gaps["length_m"] > 1.5)]
    assert set(under["state"]) == {UNSEEN}
    assert 2.5 < under["length_m"].sum() < 6
    assert found.gaps[away > 3]["state"].tolist() == [MISSING]


def test_rows_end_at_holes_and_notches_of_their_parcel_and_canopies_that_it_cuts_are_told(field):
    parcel = shapely.box(-16, -7.7, 16, 11)
    parcel = parcel.difference(shapely.box(0, -3.4, 4, 0.8)).difference(shapely.box(-9, 4, -4, 20))
    parcel = parcel.difference(shapely.box(3, 7.4, 40, 10))  # grazes the last row along its eastern half
    rows, gaps = field.mapped(within=parcel)
    placed = field.placed(parcel)
    assert rows["across"].value_counts().to_dict() == {-7.5: 1, -5: 1, -2.5: 2, 0: 2, 2.5: 1, 5: 2, 7.5: 2}
    assert rows.geometry.difference(placed.buffer(0.1)).length.sum() == 0
    for across, start, end in ((-2.5, 0, 4), (0, 0, 4), (5, -9, -4), (7.5, -9, -4)):
        one, other = rows[rows["across"] == across].sort_values("start").itertuples()
        assert (one.end, other.start) == pytest.approx((start, end), abs=0.15)
    assert rows["n_missing"].sum() == gaps["n_missing"].sum() == 3
    assert rows["unseen_m"].sum() == 0
    assert rows["confidence"].min() > 0.7
    edge = rows["flags"].str.contains("edge")
    assert set(zip(rows["across"][edge], rows["start"][edge].round(), strict=True)) == {(-7.5, -12), (7.5, -4)}
