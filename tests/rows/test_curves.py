"""Row curves: order, centre lines, ends and gaps on canopies in known places."""

from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pytest
import shapely
from pyproj import CRS

from vinemap.cloud.points import PointCloud
from vinemap.geo.raster import Grid, Raster
from vinemap.rows.curves import order_key_points, trace_rows
from vinemap.rows.fit import fit_rows
from vinemap.surfaces.cover import Levels
from vinemap.surfaces.seen import seen_cells

UTM = CRS.from_epsg(32632)


class Scene(NamedTuple):
    key_points: gpd.GeoDataFrame
    cover: Raster
    cloud: PointCloud
    dtm: Raster


def scene(lines, holes=(), width=0.5, resolution=0.1):
    """Canopies around lines (n, 2) except in holes (polygons), on flat terrain at 7 m, with key points on them."""
    shape = shapely.union_all([shapely.buffer(shapely.LineString(c), width / 2, cap_style="flat") for c in lines])
    canopy = shape.difference(shapely.union_all(holes)) if holes else shape
    west, south, east, north = np.array(shape.bounds) + [-6, -6, 6, 6]
    nx, ny = int((east - west) / resolution), int((north - south) / resolution)
    grid = Grid(west, north, resolution, ny, nx)
    fine = np.meshgrid(*Grid(west, north, resolution / 4, ny * 4, nx * 4).centres())
    inside = shapely.contains_xy(canopy, *fine).astype(float)
    cover = inside.reshape(ny, 4, nx, 4).mean(axis=(1, 3))
    dtm = Raster(np.full((2, 2), 7.0), Grid(west, north, max(east - west, north - south), 2, 2), UTM)
    frames = []
    for k, c in enumerate(lines):
        line = shapely.LineString(c)
        at = np.arange(0.2, line.length, 0.25)
        xy = shapely.get_coordinates(shapely.line_interpolate_point(line, at))
        way = shapely.get_coordinates(shapely.line_interpolate_point(line, at + 0.05)) - xy
        keep = shapely.contains_xy(canopy, xy)
        angle = np.degrees(np.arctan2(way[:, 1], way[:, 0])) % 180
        frames.append(np.column_stack([xy, angle, np.full(len(xy), k)])[keep])
    data = np.concatenate(frames)
    data = data[np.random.default_rng(0).permutation(len(data))]
    points = gpd.GeoDataFrame(
        {
            "direction_deg": data[:, 2],
            "cluster": data[:, 3].astype(int),
            "spacing_m": 2.5,
            "curtains_m": 0.0,
            "told": False,
        },
        geometry=gpd.points_from_xy(data[:, 0], data[:, 1]),
        crs=UTM,
    )
    xy = np.random.default_rng(0).uniform([west, south], [east, north], (int((east - west) * (north - south) * 400), 2))
    xyz = np.column_stack([xy, np.where(shapely.contains_xy(canopy, xy), 8.2, 7.0)])
    return Scene(points, Raster(cover, grid, UTM), PointCloud(xyz, UTM, heights=xyz[:, 2] - 7), dtm)


def level_of(scene):
    """Half a metre everywhere."""
    level = Raster(np.full_like(scene.cover.values, 0.5), scene.cover.grid, UTM)
    return Levels(level, level, np.zeros(level.grid.shape, dtype=bool))


def fit(scene):
    courses = trace_rows(scene.key_points, scene.cover)
    return fit_to(courses, scene)


def fit_to(courses, scene):
    seen = seen_cells(scene.cloud, scene.cover.grid)
    return fit_rows(courses, scene.cloud, scene.cover, level_of(scene), scene.dtm, seen)


def arc(radius=40.0, angle=1.0, n=200):
    t = np.linspace(0, angle, n)
    return np.column_stack([radius * np.sin(t), radius * (1 - np.cos(t))])


@pytest.mark.parametrize("line", [np.array([[0, 0], [30.0, 9.0]]), arc(), arc(20, 2.0)])
def test_curve_follows_the_canopy_from_end_to_end(line):
    beside = shapely.get_coordinates(shapely.offset_curve(shapely.LineString(line), -2.5))
    rows, gaps = fit(scene([line, beside]))
    assert len(rows) == 2
    assert len(gaps) == 0
    for row, truth in zip(rows.geometry, (line, beside), strict=True):
        true = shapely.LineString(truth)
        off = shapely.distance(true, shapely.points(shapely.get_coordinates(shapely.segmentize(row, 0.25))))
        assert off[1:-1].max() < 0.03
        assert row.length == pytest.approx(true.length, abs=0.06)
        ends = shapely.get_coordinates(row)[[0, -1]]
        ends = ends if np.hypot(*(ends[0] - truth[0])) < 1 else ends[::-1]
        assert np.hypot(*(ends - truth[[0, -1]]).T).max() < 0.06
        assert np.allclose(shapely.get_coordinates(row, include_z=True)[:, 2], 7)
    assert rows["support"].to_numpy() == pytest.approx(1, abs=0.01)


def test_gaps_are_where_canopy_lacks():
    line = np.array([[0, 0], [40.0, 0]])
    holes = [shapely.box(10, -1, 12.7, 1), shapely.box(30, -1, 30.5, 1)]
    rows, gaps = fit(scene([line, line + [0, 2.5]], holes))
    assert rows["gap_m"].to_numpy() == pytest.approx([2.7, 0], abs=0.1)
    assert len(gaps) == 1
    ends = np.sort(shapely.get_coordinates(gaps.geometry.iloc[0])[[0, -1], 0])
    assert ends == pytest.approx([10, 12.7], abs=0.06)
    assert gaps["length_m"].iloc[0] == pytest.approx(gaps["end_m"].iloc[0] - gaps["start_m"].iloc[0])


def test_wiggle_of_key_points_does_not_reach_the_curve():
    line = np.array([[0, 0], [40.0, 0]])
    clean = scene([line, line + [0, 2.5]])
    points = clean.key_points
    xy = points.get_coordinates().to_numpy() + np.random.default_rng(1).normal(0, 0.1, (len(points), 2))
    rows, _ = fit(clean._replace(key_points=points.set_geometry(gpd.points_from_xy(*xy.T), crs=UTM)))
    y = shapely.get_coordinates(rows.geometry.iloc[0])[:, 1]
    assert np.abs(y).max() < 0.03


def test_no_courses():
    empty = scene([np.array([[0, 0], [10.0, 0]])])
    courses = trace_rows(empty.key_points.iloc[:0], empty.cover)
    rows, gaps = fit_to(courses, empty)
    assert len(rows) == len(gaps) == 0


def test_what_is_no_row():
    """Too short, too wide, bent like the rim of a bush, alone and short, or a second trace of one row."""
    long = np.array([[0, 0], [30.0, 0]])
    short = np.array([[0, 10], [2.5, 10.0]])
    alone = np.array([[0, 20], [6.0, 20]])
    rim = np.column_stack([1.5 * np.cos(np.linspace(0, 4, 80)), 30 + 1.5 * np.sin(np.linspace(0, 4, 80))])
    clutter = scene([long, short, alone, rim, long + [0, 0.2]])
    assert len(trace_rows(clutter.key_points, clutter.cover)) == 1
    wide = scene([long], width=3.0)
    assert len(trace_rows(wide.key_points, wide.cover)) == 0


def test_ordering_with_gaps_and_any_sense_of_direction():
    rng = np.random.default_rng(0)
    line = arc(15, 3.0)
    keep = np.hypot(*(line - line[100]).T) > 2.0
    xy = rng.permutation(line[keep])
    t = np.arctan2(xy[:, 0], 15 - xy[:, 1])
    direction = t + np.pi * rng.integers(0, 2, len(xy))
    ordered = order_key_points(xy, direction)
    turn = np.diff(np.arctan2(ordered[:, 0], 15 - ordered[:, 1]))
    assert (turn > 0).all() or (turn < 0).all()
    step = np.hypot(*np.diff(ordered, axis=0).T)
    assert step[1:-1].min() >= 2.0
    assert np.median(step) < 2.4
    ends = {tuple(p) for p in ordered[[0, -1]]}
    assert ends == {tuple(line[0]), tuple(line[-1])}


@pytest.mark.parametrize("radius", [3.0, 8.0])
def test_key_points_are_ordered_around_a_bend_that_the_field_smooths(radius):
    turn = np.linspace(0, 1.4, 60)
    arc = radius * np.column_stack([np.sin(turn), 1 - np.cos(turn)])
    way = np.array([np.cos(turn[-1]), np.sin(turn[-1])])
    line = np.vstack(
        [np.column_stack([np.arange(-15, 0, 0.3), np.zeros(50)]), arc, arc[-1] + np.outer(np.arange(1, 15, 0.3), way)]
    )
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    smooth = 1.4 / (1 + np.exp(-(along - along[80]) / 4))
    ordered = order_key_points(line, smooth)
    assert {tuple(p) for p in ordered[[0, -1]]} == {tuple(line[0]), tuple(line[-1])}


def test_a_bush_as_long_as_a_row_is_none():
    """A row has free ground beside it."""
    bush = scene([np.array([[0, 0], [12.0, 0]])], width=1.5)
    courses = gpd.GeoDataFrame(
        {"spacing_m": [4.5], "curtains_m": [0.0], "alone": [True]},
        geometry=[shapely.LineString([(0.2, 0.1), (11.8, 0.1)])],
        crs=UTM,
    )
    assert len(fit_to(courses, bush)[0]) == 0
    row = scene([np.array([[0, 0], [12.0, 0]])], width=0.7)
    assert len(fit_to(courses, row)[0]) == 1


def test_a_row_goes_on_where_it_is_faint():
    """As where only its ridge counts: for ten metres its cover is a third."""
    found = scene([np.array([[0.0, y], [40.0, y]]) for y in (0.0, 2.5, 5.0)])
    x, _ = found.cover.grid.centres()
    found.cover.values[:, x > 30] *= 0.35
    courses = trace_rows(found.key_points, found.cover)
    assert shapely.bounds(courses.geometry.to_numpy())[:, 2] == pytest.approx(40.0, abs=0.3)
