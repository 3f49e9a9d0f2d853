"""Clusters of key points: the thesis's three cases, and rows that break, bend and come close."""

import geopandas as gpd
import numpy as np
import pytest
from pyproj import CRS
from scipy.sparse.csgraph import connected_components

from vinemap.geo.raster import Raster, grid_over
from vinemap.rows.clusters import cluster_rows, ellipse_graph
from vinemap.rows.pieces.joins import ends_of


def literal_clusters(xy, direction, along, across):
    """Cases A, B and C as the thesis tells them, one key point after the other."""
    cluster = np.full(len(xy), -1)
    for j in range(len(xy)):
        cos, sin = np.cos(direction[j]), np.sin(direction[j])
        x, y = (xy - xy[j]) @ [cos, sin], (xy - xy[j]) @ [-sin, cos]
        inside = (x / along[j]) ** 2 + (y / across[j]) ** 2 <= 1
        touched = np.unique(cluster[inside & (cluster >= 0)])
        oldest = touched.min() if len(touched) else cluster.max() + 1
        cluster[np.isin(cluster, touched) & (cluster >= 0)] = oldest
        cluster[inside] = oldest
    return cluster


@pytest.mark.parametrize("seed", range(8))
def test_components_are_what_cases_a_b_c_leave(seed):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 15, (150, 2))
    direction = rng.normal(0.3, 0.1, 150)
    along, across = rng.uniform(0.8, 1.5, 150), rng.uniform(0.2, 0.4, 150)
    literal = literal_clusters(xy, direction, along, across)
    found = connected_components(ellipse_graph(xy, direction, along=along, across=across), directed=False)[1]
    order = rng.permutation(150)
    again = literal_clusters(xy[order], direction[order], along[order], across[order])
    pairs = {(a, b) for a, b in zip(literal, found, strict=True)}
    assert len(pairs) == len(set(literal)) == len(set(found))
    assert len(set(zip(again, found[order], strict=True))) == len(set(found))


def key_points(rows, spacing=2.5, noise=0.03, seed=0):
    """Key points every 0.1 m on lines (n, 2), with the row they came from."""
    rng = np.random.default_rng(seed)
    parts = []
    for k, line in enumerate(rows):
        way = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        at = np.arange(0, way[-1], 0.1)
        xy = np.column_stack([np.interp(at, way, line[:, c]) for c in (0, 1)])
        tangent = np.gradient(xy, axis=0)
        angle = np.degrees(np.arctan2(tangent[:, 1], tangent[:, 0])) % 180
        parts.append(np.column_stack([xy + rng.normal(0, noise, xy.shape), angle, np.full(len(xy), k)]))
    data = np.concatenate(parts)
    data = data[rng.permutation(len(data))]
    return gpd.GeoDataFrame(
        {"direction_deg": data[:, 2], "spacing_m": spacing, "truth": data[:, 3].astype(int)},
        geometry=gpd.points_from_xy(data[:, 0], data[:, 1]),
        crs=32632,
    )


def assert_rows_are_kept_apart(found, n):
    assert len(found.groupby(["truth", "cluster"])) == n
    assert found["cluster"].nunique() == n


def test_straight_rows():
    rows = [np.array([[0, 2.5 * k], [40, 2.5 * k + 8]]) for k in range(6)]
    assert_rows_are_kept_apart(cluster_rows(key_points(rows)), 6)


def test_gaps_are_bridged_on_straight_and_curved_rows():
    angle = np.linspace(0, 1.2, 200)
    rows = [np.column_stack([(40 + 2.5 * k) * np.cos(angle), (40 + 2.5 * k) * np.sin(angle)]) for k in range(5)]
    points = key_points(rows)
    bearing = np.arctan2(points.geometry.y, points.geometry.x)
    row = points["truth"]
    holes = [(1, 0.3, 0.45), (2, 0.5, 0.8), (3, 0.2, 0.3), (3, 0.6, 0.7)]
    for k, low, high in holes:
        points = points[~((row == k) & (bearing > low) & (bearing < high))]
        row, bearing = points["truth"], bearing[points.index]
    found = cluster_rows(points.reset_index(drop=True))
    assert_rows_are_kept_apart(found, 5)
    assert cluster_rows(points.reset_index(drop=True), max_gap=0)["cluster"].nunique() == 9


def test_rows_that_come_close_stay_two():
    """Table 2.1's row 15 starts 1.5 m from row 14."""
    rows = [
        np.array([[0, 0], [30, 0], [50, -0.5], [110, 0]]),
        np.array([[32, 1.35], [70, 2.5], [110, 2.5]]),
        np.array([[0, -2.5], [110, -2.5]]),
    ]
    assert_rows_are_kept_apart(cluster_rows(key_points(rows)), 3)


def test_small_clutter_is_dropped():
    rows = [np.array([[0, 0], [20, 0]]), np.array([[3, 1.2], [3.3, 1.2]])]
    found = cluster_rows(key_points(rows), min_points=6)
    assert set(found["truth"]) == {0}


def test_a_last_vine_beyond_a_gap_is_of_its_row_where_those_beside_it_stand():
    """Too few points for a piece of a row, which they are nowhere else: behind a headland, or too far away."""
    rows = [np.array([[0, 2.5 * k], [30, 2.5 * k]]) for k in range(5)]
    rows[2] = np.array([[0, 5.0], [25.6, 5.0]])
    vine = np.array([[29.6, 5.1], [30.0, 5.1]])
    own = cluster_rows(key_points([*rows, vine])).groupby("truth")["cluster"].unique()
    assert own[5] == own[2]
    for others, ended in ((30, 22.0), (25.6, 25.6)):
        rows = [np.array([[0, 2.5 * k], [ended if k == 2 else others, 2.5 * k]]) for k in range(5)]
        assert_rows_are_kept_apart(cluster_rows(key_points([*rows, vine])), 5)


def test_no_key_points():
    found = cluster_rows(key_points([np.array([[0, 0], [5.0, 0]])]).iloc[:0])
    assert len(found) == 0
    assert "cluster" in found.columns


@pytest.mark.parametrize("track", [3.0, 5.0])
def test_rows_end_at_a_track_but_not_at_missing_vines(track):
    """Rows on both sides of it; one of them also lacks vines for 6 m where its neighbours stand."""
    west = [np.array([[0, 2.5 * k], [30, 2.5 * k]]) for k in range(5)]
    east = [np.array([[30 + track, 2.5 * k + 0.1], [60, 2.5 * k + 0.1]]) for k in range(5)]
    points = key_points(west + east)
    x = points.geometry.x
    points = points[~((points["truth"] == 2) & (x > 10) & (x < 16))].reset_index(drop=True)
    assert_rows_are_kept_apart(cluster_rows(points), 10)
    assert cluster_rows(points, track_width=50)["cluster"].nunique() == 5


@pytest.mark.parametrize("aslant", [-0.5, 0.8])
def test_rows_end_at_a_track_that_crosses_them_aslant(aslant):
    """No more than 3 m of every row; what half of them lack on such a line is missing vines."""

    def crossed(lacking):
        ends = [(aslant * y + 1.5 * side, side) for y in 2.4 * (np.arange(8) - 4) for side in (-1, 1)]
        rows = [np.array([[25.0 * side, 2.4 * (k // 2)], [x, 2.4 * (k // 2)]]) for k, (x, side) in enumerate(ends)]
        return [np.vstack([rows[k], rows[k + 1][0]]) for k in range(0, 16, 2) if k % 4 >= lacking] + [
            row for k, row in enumerate(rows) if k % 4 < lacking
        ]

    assert cluster_rows(key_points(crossed(4), spacing=2.4))["cluster"].nunique() == 16
    assert cluster_rows(key_points(crossed(2), spacing=2.4))["cluster"].nunique() == 8


def test_rows_do_not_reach_over_their_headland():
    """Rows that end together, and in line with one of them a hedge; a row that outlasts its neighbours goes on."""
    rows = [np.array([[0, 2.5 * k], [30, 2.5 * k]]) for k in range(5)]
    hedge = np.array([[42, 5.2], [52, 5.2]])
    assert_rows_are_kept_apart(cluster_rows(key_points([*rows, hedge])), 6)
    longer = [np.array([[0, 2.5 * k], [30 + 8 * k, 2.5 * k]]) for k in range(5)]
    points = key_points(longer)
    gap = (points["truth"] == 3) & points.geometry.x.between(40, 50)
    assert_rows_are_kept_apart(cluster_rows(points[~gap].reset_index(drop=True)), 5)


def test_rows_stay_in_their_block_beside_one_of_another_direction():
    """Across a track of 5 m stand rows 5° off; where two ends happen to meet, their row isn't carried over."""
    west = [np.array([[k % 3, 1.8 * k], [30 - 0.3 * (k % 4), 1.8 * k]]) for k in range(14)]
    turn = np.radians(5)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    starts = [[35.5, 12.8] + 1.85 * (k - 7) * across for k in range(14)]
    east = [np.array([start, start + 14 * along]) for start in starts]
    points = key_points([*west, *east])
    assert_rows_are_kept_apart(cluster_rows(points), 28)
    assert cluster_rows(points, track_width=50)["cluster"].nunique() < 26


def test_gaps_of_some_neighbours_that_line_up_are_no_track():
    """Six rows of fourteen lack the same 7 m, the others go on."""
    rows = [np.array([[0, 2.4 * k], [40, 2.4 * k]]) for k in range(14)]
    points = key_points(rows)
    gap = points["truth"].between(4, 9) & points.geometry.x.between(15, 22)
    assert_rows_are_kept_apart(cluster_rows(points[~gap].reset_index(drop=True)), 14)


def test_rows_that_touch_where_blocks_abut_are_torn():
    """Two blocks 15° apart at a track that narrows to nothing; rows that all kink together go on."""
    turn = np.radians(15)
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    west = [np.array([[-30, 2 * k], [-1.4 * k, 2 * k]]) for k in range(10)]
    east = [np.array([[0.2, 0.1] + 2 * k * across, [0.2, 0.1] + 2 * k * across + 25 * along]) for k in range(10)]
    assert_rows_are_kept_apart(cluster_rows(key_points([*west, *east], spacing=2)), 20)
    kinked = [np.array([[-30, 2 * k], [0, 2 * k], [0, 2 * k] + 25 * along]) for k in range(10)]
    assert_rows_are_kept_apart(cluster_rows(key_points(kinked, spacing=2)), 10)


def spots(places):
    """Cover of posts, or weeds."""
    grid = grid_over([-2, -2], [47, 30], resolution=0.1)
    x, y = np.meshgrid(*grid.centres())
    values = np.zeros(grid.shape)
    for px, py in places:
        values[np.hypot(x - px, y - py) < 0.15] = 0.6
    return Raster(values, grid, CRS.from_epsg(32632))


def test_posts_tell_a_gap_of_all_rows_from_a_track():
    """All ten rows lack 5 m; posts stand there in some of them, or weeds anywhere."""
    rows = [np.array([[0, 2.5 * k], [40, 2.5 * k]]) for k in range(10)]
    points = key_points(rows)
    points = points[~points.geometry.x.between(17, 22)].reset_index(drop=True)
    posts = spots([(19.3, 2.5), (19.6, 12.5), (19.5, 20.0)])
    assert_rows_are_kept_apart(cluster_rows(points, posts), 10)
    weeds = spots([(19.3, 2.5), (19.3, 3.6), (19.6, 12.5), (19.5, 11.4)])
    assert cluster_rows(points, weeds)["cluster"].nunique() == 20
    assert cluster_rows(points)["cluster"].nunique() == 20


@pytest.mark.parametrize("aside", [12.5, 13.7])
def test_rows_end_at_a_track_though_something_stands_on_it(aside):
    """A car on a track of 5 m through fourteen rows, in line with one of them or between two."""
    rows = [np.array([[a, 2.5 * k], [b, 2.5 * k]]) for k in range(14) for a, b in ((0, 30), (35, 60))]
    found = cluster_rows(key_points([*rows, np.array([[31, aside], [34, aside]])]))
    pieces = found[found["truth"] < 28].groupby("truth")["cluster"].agg(set)
    whole = [west == east for west, east in zip(pieces[::2], pieces[1::2], strict=True)]
    assert sum(whole) <= (aside == 12.5)


def test_rows_end_at_a_track_that_ends_at_a_road():
    """Beyond the road other rows go on where the track would."""
    rows = [np.array([[a, 2.5 * k], [b, 2.5 * k]]) for k in range(12) for a, b in ((0, 30), (35, 60))]
    beyond = [np.array([[0, 32.0 + 2.5 * k], [60, 32.0 + 2.5 * k]]) for k in range(8)]
    assert_rows_are_kept_apart(cluster_rows(key_points([*rows, *beyond])), 32)


def test_rows_that_meet_across_a_road_by_chance_do_not_cross_it():
    """Two blocks of another spacing: some of the rows beside the gaps have no row to meet."""
    west = [np.array([[0, 2.0 * k], [30, 2.0 * k]]) for k in range(16)]
    east = [np.array([[37, 1.7 * k], [60, 1.7 * k]]) for k in range(18)]
    points = key_points([*west, *east], spacing=2.0)
    assert_rows_are_kept_apart(cluster_rows(points), 34)
    assert cluster_rows(points, track_width=50)["cluster"].nunique() < 26


@pytest.mark.parametrize("first", [4, 12])
def test_a_bare_strip_that_ends_within_a_field_is_no_track(first):
    """All rows from one on to the last lack 5 m."""
    points = key_points([np.array([[0, 2.5 * k], [60, 2.5 * k]]) for k in range(24)])
    gap = (points["truth"] >= first) & points.geometry.x.between(30, 35)
    assert_rows_are_kept_apart(cluster_rows(points[~gap].reset_index(drop=True)), 24)


def test_last_posts_of_rows_are_none_that_go_on():
    """At a track of 5 m some rows lack their last vines, so that their end posts stand in a gap that is longer."""
    rng = np.random.default_rng(4)
    lacking = np.where(rng.random((12, 2)) < 0.5, rng.uniform(1.5, 5, (12, 2)), 0)
    ends = [((0, 20 - before), (25 + after, 45)) for before, after in lacking]
    rows = [np.array([[a, 2.5 * k], [b, 2.5 * k]]) for k, both in enumerate(ends) for a, b in both]
    posts = spots([(x, 2.5 * k) for k, lack in enumerate(lacking) for x in np.array([20.3, 24.7])[lack > 0]])
    points = key_points(rows)
    assert_rows_are_kept_apart(cluster_rows(points, posts), 24)
    going_on = spots([(x, 2.5 * k) for k in range(12) for x in (18.0, 22.5, 27.0)])
    assert cluster_rows(points, going_on)["cluster"].nunique() == 12


def test_straight_rows_are_not_joined_by_a_bend():
    """Two rows of blocks of their own directions, in line with each other's ends; rows on an arc of the same turn."""
    turn = np.radians(24)
    away = np.array([[0, 0], [25.0, 0]]) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    rows = [np.array([[-25, 0], [0.0, 0]]), np.array([10.5, 2.3]) + away]
    assert_rows_are_kept_apart(cluster_rows(key_points(rows)), 2)
    angle = np.linspace(0, 1.4, 200)
    arc = key_points([np.column_stack([30 * np.cos(angle), 30 * np.sin(angle)])])
    bearing = np.arctan2(arc.geometry.y, arc.geometry.x)
    assert_rows_are_kept_apart(cluster_rows(arc[(bearing < 0.5) | (bearing > 0.9)].reset_index(drop=True)), 1)


def test_the_thesis_ellipse_finds_clean_rows_and_stops_at_gaps():
    rows = [np.array([[0, 2.5 * k], [40, 2.5 * k]]) for k in range(4)]
    assert_rows_are_kept_apart(cluster_rows(key_points(rows), method="ellipse"), 4)
    points = key_points(rows)
    gap = (points["truth"] == 1) & points.geometry.x.between(15, 19)
    assert cluster_rows(points[~gap].reset_index(drop=True), method="ellipse")["cluster"].nunique() == 5


@pytest.mark.parametrize("beside", [True, False])
def test_a_gap_at_a_bend_is_bridged_where_the_rows_beside_it_go_on(beside):
    """Rows that turn by 24° at once, of which one lacks its vines there."""
    turn = np.radians(24)
    corner = [np.array([-2.5 * k * np.tan(turn / 2), 2.5 * k]) for k in range(5)]
    way = np.array([np.cos(turn), np.sin(turn)])
    points = key_points([np.array([c - [25, 0], c, c + 25 * way]) for c in corner])
    from_corner = np.hypot(*(points.get_coordinates().to_numpy() - corner[2]).T)
    lacking = (points["truth"] == 2) & (from_corner < 2.5)
    points = points[~lacking & (beside | (points["truth"] == 2))].reset_index(drop=True)
    found = cluster_rows(points)
    assert found.groupby("truth")["cluster"].nunique().loc[2] == (1 if beside else 2)


@pytest.mark.parametrize(("long", "rows"), [(8.0, 7), (6.0, 6)], ids=["house", "tree"])
def test_rows_do_not_go_through_houses(long, rows):
    lines = [np.array([[0, 2.5 * k], [50, 2.5 * k]]) for k in range(6)]
    points = key_points(lines)
    x = points.geometry.x
    points = points[(points["truth"] != 2) | (np.abs(x - 25) > 5)].reset_index(drop=True)
    grid = grid_over(np.array([0.0, -3.0]), np.array([50.0, 16.0]), resolution=0.25)
    gx, gy = np.meshgrid(*grid.centres())
    heights = np.where((np.abs(gx - 25) < long / 2) & (np.abs(gy - 5) < 2), 5.0, 0.0)
    heights[:, ::5] = np.nan  # where no point fell
    chm = Raster(heights, grid, 32632)
    assert cluster_rows(points, chm=chm)["cluster"].nunique() == rows


def test_a_vine_by_itself_has_two_ends_however_its_points_lie():
    """The first and the last of them on one side of its middle."""
    xy = np.array([[0.4, -0.3], [0.0, 0.0], [0.9, 0.0], [0.42, 0.3]])
    ends = ends_of(xy, np.zeros(4), np.full(4, 2.0), np.zeros(4, dtype=np.int64), np.array([0.0, 0.5, 0.9, 1.2]))
    np.testing.assert_allclose(ends.tangent[0], -ends.tangent[1])
    np.testing.assert_allclose(sorted(ends.xy[:, 0]), [0.0, 0.9])
