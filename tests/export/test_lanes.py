"""Lanes between rows drawn by hand, in metres from where they must be."""

import json

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.export.field import Field
from vinemap.export.lanes import lanes_between, resampled
from vinemap.export.nav2 import write_nav2
from vinemap.geo.holes import comes_back
from vinemap.geo.main import Corner


def field(*lines, spacing=2.5, block=1, **columns):
    known = {"row_id": np.arange(1, len(lines) + 1), "block": np.broadcast_to(block, len(lines)), "spacing_m": spacing}
    return gpd.GeoDataFrame(known | columns, geometry=[shapely.LineString(line) for line in lines], crs=32632)


def row(start, end, y, y_end=None, z=0.0):
    """A row from west to east, with a vertex every half metre."""
    x = np.linspace(start, end, int(abs(end - start) * 2) + 1)
    return np.column_stack([x, np.linspace(y, y if y_end is None else y_end, len(x)), np.broadcast_to(z, len(x))])


def arc(radius, start=80, end=10):
    angle = np.radians(np.linspace(start, end, int(radius * np.radians(abs(end - start)) * 2)))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(len(angle))])


def dense(line):
    return shapely.get_coordinates(shapely.segmentize(line, 0.1), include_z=True)


def ends(lanes):
    return np.array([shapely.get_coordinates(line)[[0, -1]] for line in lanes.geometry])


def labels(lanes):
    return lanes["label"].tolist()


def assert_across_no_row(lanes, rows):
    assert not any(rows.intersects(line).any() for line in lanes.geometry)


def test_between_parallel_rows():
    rows = field(row(0, 60, 0, z=10), row(0, 60, 2.5, z=11), row(0, 60, 4.7, z=12), width_m=[0.4, 0.6, 0.8])
    lanes = lanes_between(rows, headland=4)
    assert lanes.crs == rows.crs
    assert lanes["lane_id"].tolist() == [1, 2]
    assert labels(lanes) == ["1-2", "2-3"]
    assert lanes[["right_rows", "left_rows"]].to_numpy().tolist() == [["1", "2"], ["2", "3"]]
    assert lanes["width_m"].to_numpy() == pytest.approx([2.5, 2.2])
    assert lanes["clear_m"].to_numpy() == pytest.approx([2.0, 1.5])
    assert lanes["length_m"].to_numpy() == pytest.approx([68, 68])
    assert ends(lanes) == pytest.approx(np.array([[[-4, 1.25], [64, 1.25]], [[-4, 3.6], [64, 3.6]]]))
    assert [len(line.coords) for line in lanes.geometry] == [2, 2]
    assert [line.coords[0][2] for line in lanes.geometry] == pytest.approx([10.5, 11.5])


@pytest.mark.parametrize(("start", "end"), [(80, 10), (170, -80)])
def test_between_arcs_runs_an_arc(start, end):
    lanes = lanes_between(field(*(arc(r, start, end) for r in (25, 27.5, 30))), headland=0)
    for line, radius in zip(lanes.geometry, (26.25, 28.75), strict=True):
        assert np.hypot(*dense(line)[:, :2].T) == pytest.approx(np.full(len(dense(line)), radius), abs=0.015)
        assert line.length == pytest.approx(radius * np.radians(start - end), abs=0.05)
        assert len(line.coords) < 1.3 * line.length
    assert lanes["width_m"].to_numpy() == pytest.approx([2.5, 2.5], abs=0.005)


def test_beyond_an_arc_it_runs_straight_on():
    (line,) = lanes_between(field(arc(30), arc(32.5)), headland=5).geometry
    last, before = np.array(line.coords)[-1, :2], 31.25 * np.array([np.cos(np.radians(10)), np.sin(np.radians(10))])
    tangent = np.array([np.sin(np.radians(10)), -np.cos(np.radians(10))])
    assert last == pytest.approx(before + 5 * tangent, abs=0.2)


@pytest.mark.parametrize("length", [60, 12])
def test_in_a_fan_it_is_as_far_from_one_row_as_from_the_other(length):
    rows = field(row(0, length, 0), row(0, length, 1.5, 4), row(0, length, 3, 8))
    lanes = lanes_between(rows, headland=0)
    for line, right, left in zip(lanes.geometry, rows.geometry[:-1], rows.geometry[1:], strict=True):
        points = shapely.points(dense(line)[15:-15, :2])
        assert shapely.distance(points, right) == pytest.approx(shapely.distance(points, left), abs=0.01)
    assert lanes["narrowest_m"].to_numpy() == pytest.approx([1.5, 1.5], abs=0.1)
    assert lanes["width_m"].to_numpy() == pytest.approx([2.75, 2.75], abs=0.15)


def test_as_long_as_the_longer_row():
    rows = field(row(0, 60, 0), row(5, 40, 2.5), row(-2, 50, 5))
    lanes = lanes_between(rows, headland=1)
    assert ends(lanes) == pytest.approx(np.array([[[-1, 1.25], [61, 1.25]], [[-3, 3.75], [51, 3.75]]]), abs=0.01)


def test_away_from_a_row_that_goes_on_alone_where_the_other_came_close():
    rows = field(row(0, 60, 0), row(0, 30, 2.5, 1.2))
    (line,) = lanes_between(rows, headland=0).geometry
    xy = dense(line)[:, :2]
    assert xy[-1] == pytest.approx([60, 1.85 / 2], abs=0.02)
    assert xy[np.abs(xy[:, 0] - 30).argmin(), 1] == pytest.approx(0.6, abs=0.03)
    way = np.diff(xy, axis=0)
    assert np.abs(way[:, 1] / way[:, 0]).max() < 0.15


def test_on_past_a_gap_in_one_row():
    rows = field(row(0, 60, 0), row(0, 25, 2.5), row(31, 60, 2.5), row(0, 60, 5))
    lanes = lanes_between(rows, headland=2)
    assert labels(lanes) == ["1-2+3", "2+3-4"]
    assert ends(lanes) == pytest.approx(np.array([[[-2, 1.25], [62, 1.25]], [[-2, 3.75], [62, 3.75]]]), abs=0.01)


def test_an_end_on_both_sides_of_a_track_through_all_rows():
    rows = field(*(row(x, x + 25, y) for y in (0, 2.5, 5) for x in (0, 33)))
    lanes = lanes_between(rows, headland=2)
    assert labels(lanes) == ["1-3", "2-4", "3-5", "4-6"]
    assert ends(lanes)[:2] == pytest.approx(np.array([[[-2, 1.25], [27, 1.25]], [[31, 1.25], [60, 1.25]]]), abs=0.01)


def test_where_a_row_ends_in_a_wedge_its_two_lanes_end_and_another_begins():
    rows = field(row(0, 60, 0), row(0, 35, 2.5, 2), row(0, 60, 5, 2.2))
    lanes = lanes_between(rows, headland=3)
    assert labels(lanes) == ["1-2", "1-3", "2-3"]
    assert ends(lanes)[1, 0, 0] == pytest.approx(35, abs=1)
    assert ends(lanes)[1, 1, 0] == pytest.approx(63, abs=0.3)
    assert_across_no_row(lanes, rows)


def test_only_between_neighbours():
    missing = field(row(0, 60, 0), row(0, 60, 2.5), row(0, 60, 7.5), row(0, 60, 10))
    assert labels(lanes_between(missing)) == ["1-2", "3-4"]
    parted = field(row(0, 60, 0), row(0, 60, 1.5), row(0, 60, 3), block=[1, 2, 1])
    assert len(lanes_between(parted)) == 0
    apart = field(row(0, 20, 0), row(30, 50, 2.5))
    assert len(lanes_between(apart)) == 0


def test_a_single_row_and_none():
    one = field(row(0, 60, 0))
    assert len(lanes_between(one)) == 0
    lanes = lanes_between(one, outer=True, headland=0)
    assert labels(lanes) == ["left of 1", "right of 1"]
    assert sorted(ends(lanes)[:, 0, 1]) == pytest.approx([-1.25, 1.25])
    assert len(lanes_between(field(row(0, 60, 0), spacing=np.nan), outer=True)) == 0
    empty = lanes_between(one[:0])
    assert len(empty) == 0
    assert list(empty.columns) == list(lanes.columns)


def test_blocks_in_order_and_short_of_each_others_rows():
    across = [np.column_stack([np.full(23, x), np.arange(-3, 8.5, 0.5), np.zeros(23)]) for x in (34, 36.5)]
    rows = field(row(0, 30, 0), row(0, 30, 2.5), row(0, 30, 5), *across, block=[1, 1, 1, 2, 2])
    lanes = lanes_between(rows, headland=6, outer=True)
    assert labels(lanes) == ["right of 1", "1-2", "2-3", "left of 3", "left of 4", "4-5", "right of 5"]
    assert lanes["block"].tolist() == [1, 1, 1, 1, 2, 2, 2]
    assert ends(lanes)[:4, 0, 0] == pytest.approx(-6)
    assert ends(lanes)[:4, 1, 0] == pytest.approx(34 - 1.25)
    assert_across_no_row(lanes, rows)


def test_one_direction_where_rows_have_two():
    """Rows close to north-south start at their western end, be it the southern or the northern one."""
    rows = field(
        *(
            np.array([[x, 0, 0], [x + lean, 60, 0]])[:: 1 if lean > 0 else -1]
            for x, lean in ((0, 0.1), (2.5, -0.1), (5, 0.1), (7.5, 0.1))
        )
    )
    lanes = lanes_between(rows, headland=0)
    assert ends(lanes)[:, 0, 1] == pytest.approx(0, abs=0.05)
    assert ends(lanes)[:, 1, 1] == pytest.approx(60, abs=0.05)


def test_heights_follow_the_hill():
    x = np.linspace(0, 60, 121)
    hill = 2 * np.sin(x / 8)
    (line,) = lanes_between(field(row(0, 60, 0, z=hill), row(0, 60, 2.5, z=hill + 1)), headland=0).geometry
    xyz = dense(line)
    assert xyz[:, 2] == pytest.approx(np.interp(xyz[:, 0], x, hill) + 0.5, abs=0.035)
    assert len(line.coords) < 60


def test_so_many_vertices_at_equal_distances():
    lanes = lanes_between(field(arc(30), arc(32.5), arc(35)), vertices=17)
    for line in lanes.geometry:
        xyz = np.array(line.coords)
        step = np.hypot(*np.diff(xyz[:, :2], axis=0).T)
        assert len(xyz) == 17
        assert step == pytest.approx(np.full(16, step.mean()), rel=0.005)
    (line,) = resampled([shapely.LineString([[0, 0, 1], [3, 0, 4], [4, 0, 4]])], 5)
    assert np.array(line.coords) == pytest.approx(np.array([[0, 0, 1], [1, 0, 2], [2, 0, 3], [3, 0, 4], [4, 0, 4]]))


AROUND = shapely.box(-1, -2, 61, 12)
"""A parcel of five rows of 60 m, 2.5 m apart, about as tight as people draw them."""
POND = shapely.Point(30, 5).buffer(4)
"""A hole in it: of the row at 5 m, 8 m are left out, of those beside it 6.2 m."""
NOTCH = shapely.box(26, 6, 34, 20)


def rows_outside(shape):
    """The five rows, where they are outside of a shape."""
    whole = shapely.union_all([shapely.LineString(row(0, 60, 2.5 * k)[:, :2]) for k in range(5)])
    parts = sorted(
        shapely.get_parts(shapely.line_merge(whole.difference(shape))), key=lambda g: (g.bounds[1], g.bounds[0])
    )
    return field(*(row(part.bounds[0], part.bounds[2], part.bounds[1]) for part in parts))


@pytest.mark.parametrize(
    ("shape", "told"),
    [
        (POND, ["1-2", "1-3", "2-4", "3-5", "4-6", "5-7", "6-8", "7-8"]),
        (NOTCH, ["1-2", "2-3", "3-4", "3-5", "4-6", "5-7"]),
        (shapely.box(29, 3, 31, 4.5), ["1-2", "2-3 a", "2-3 b", "3-4", "4-5"]),
        (shapely.box(20, 1.5, 23, 3.5).union(shapely.box(40, -5, 43, 8.4)), None),
    ],
)
@pytest.mark.parametrize("outer", [False, True])
def test_no_lane_leads_through_a_hole_or_a_notch(shape, told, outer):
    rows, parcel = rows_outside(shape), AROUND.difference(shape)
    free = lanes_between(rows, headland=3, outer=outer)
    assert free.intersects(shape).any()
    lanes = lanes_between(rows, parcel, headland=3, outer=outer)
    assert lanes.intersection(shape).length.max() == pytest.approx(0, abs=1e-6)
    if told and not outer:
        assert labels(lanes) == told
    # As long as they can be: beyond the parcel's outer sides they have their headland, before the hole none is lost.
    covered = shapely.union_all(shapely.buffer(lanes.geometry, 0.3))
    lost = free.difference(shapely.buffer(shape, 0.8)).difference(covered)
    assert lost.length.max() == pytest.approx(0, abs=0.01)
    assert lanes.total_bounds[[0, 2]] == pytest.approx([-3, 63])
    assert lanes["lane_id"].tolist() == list(range(1, len(lanes) + 1))
    assert lanes["label"].is_unique


def test_a_tight_parcel_takes_nothing_of_lanes_where_its_headland_slants():
    rows = field(*(row(1.5 * k, 60 + 2.5 * k, 2.5 * k) for k in range(6)))
    around = shapely.Polygon([(-0.7, -0.5), (60, -0.5), (73, 13), (7.8, 13)])
    assert around.covers(shapely.union_all(rows.geometry))
    free, lanes = (lanes_between(rows, within, headland=3) for within in (None, around))
    assert not around.covers(shapely.union_all(lanes_between(rows, headland=0).geometry))
    assert shapely.equals_exact(lanes.geometry.to_numpy(), free.geometry.to_numpy(), 1e-9).all()


def test_beside_a_row_that_goes_on_alone_a_lane_keeps_within_the_parcel():
    rows, corner = field(row(0, 60, 0), row(0, 30, 2.5), row(0, 30, 5)), shapely.box(31, 0.6, 61, 9)
    (lane, _) = lanes_between(rows, shapely.box(-1, -2, 61, 6).difference(corner), headland=3).geometry
    assert lane.intersection(corner).length < 3
    assert lane.bounds[2] == pytest.approx(34, abs=0.6)
    assert lanes_between(rows, headland=3).geometry[0].bounds[2] == pytest.approx(63)


def test_what_comes_back():
    ways = {
        True: [[(20, 5), (40, 5)], [(-5, 5), (40, 5)], [(26, 5), (27, 8.5)]],
        False: [[(0, 0), (60, 0)], [(-5, 5), (25, 5)], [(28, 5), (31, 5)], [(-5, -9), (70, -9)]],
    }
    for back, lines in ways.items():
        drawn = np.array([shapely.LineString(line) for line in lines])
        assert (comes_back(drawn, AROUND.difference(POND)) == back).all()


def test_parts_of_a_lane_beyond_z():
    holes = shapely.union_all([shapely.box(5 * k, 0.5, 5 * k + 1, 2) for k in range(1, 28)])
    lanes = lanes_between(field(row(0, 140, 0), row(0, 140, 2.5)), shapely.box(-1, -1, 141, 3.5) - holes, headland=0)
    assert lanes["label"].tolist()[24:] == ["1-2 y", "1-2 z", "1-2 aa", "1-2 ab"]


def test_robots_go_round_a_hole(tmp_path):
    rows, parcel = rows_outside(POND), AROUND.difference(POND)
    outline = gpd.GeoDataFrame({"parcel": ["A"]}, geometry=[parcel], crs=rows.crs)
    rest = {"folder": tmp_path, "parcel": "A", "survey": "A", "flown": "2026-06-01", "key": "", "outline": outline}
    lanes = lanes_between(rows, parcel, headland=3)
    field_of = Field(**rest, origin=Corner(0, 0, 0), rows=rows, lanes=lanes, row_ends=rows, gaps=rows, bounded=True)
    through = []
    for one in (field_of, field_of._replace(bounded=False)):
        write_nav2(one, tmp_path, frame="map", grid=True)
        features = json.loads((tmp_path / "A_graph.geojson").read_text())["features"]
        ways = [shapely.LineString(f["geometry"]["coordinates"][0]) for f in features if "cost" in f["properties"]]
        through.append(sum(way.intersection(POND).length > 0.1 for way in ways))
    assert through[0] == 0 < through[1]
