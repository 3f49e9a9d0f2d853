"""What a cloud shows of the ground: voids are told from the holes that its points leave anyhow."""

import numpy as np
import pytest
import shapely

from vinemap.cloud.points import PointCloud
from vinemap.cloud.tiles import Collector
from vinemap.geo.raster import grid_over
from vinemap.surfaces.seen import seen_cells

SIDE = 40.0
ELSEWHERE = np.random.default_rng(1).uniform(1.5, SIDE - 1.5, (4000, 2))


def anyhow(density, seed=0):
    """Points (n, 3) that lie anyhow on a square."""
    n = int(density * SIDE**2)
    return np.column_stack([np.random.default_rng(seed).uniform(0, SIDE, (n, 2)), np.zeros(n)])


def uneven():
    """Two flights on one half, one thin one on the other."""
    xyz = anyhow(48)
    return xyz[(xyz[:, 0] < SIDE / 2) | (np.arange(len(xyz)) % 6 == 0)]


def lines_of_a_scanner():
    """A point every 4 cm on lines that lie 60 cm apart."""
    x, y = np.meshgrid(np.arange(0, SIDE, 0.6), np.arange(0, SIDE, 0.04))
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    xy = (np.column_stack([x.ravel(), y.ravel()]) - SIDE / 2) @ turn.T * 1.5 + SIDE / 2
    return np.column_stack([xy, np.zeros(len(xy))])[((xy > 0) & (xy < SIDE)).all(axis=1)]


def shadows():
    """A dense cloud that shows nothing in strips of 40 cm, one beside each row."""
    xyz = anyhow(300)
    return xyz[xyz[:, 1] % 2.5 > 0.4]


def shown(xyz):
    cloud = PointCloud(xyz, None)
    return seen_cells(cloud, grid_over(*cloud.extent, resolution=0.1))


@pytest.mark.parametrize("points", [anyhow(3), anyhow(10), anyhow(60), anyhow(400), uneven(), lines_of_a_scanner()])
def test_voids_are_told_from_holes_that_are_usual(points):
    whole = shown(points)
    cell = whole.grid.resolution
    assert whole.at(ELSEWHERE).mean() > 0.998
    middle, radius = np.array([10.0, 27.0]), 3.2 * cell
    void = shown(points[np.hypot(*(points[:, :2] - middle).T) > radius])
    away = np.hypot(*(ELSEWHERE - middle).T)
    assert void.grid == whole.grid
    assert not void.at(middle[None] + [[0.0, 0.0], [cell / 2, 0], [0, -cell / 2]]).any()
    assert void.at(ELSEWHERE[away > radius + cell]).mean() > 0.998


@pytest.mark.parametrize(("density", "coarsest"), [(3, 1.2), (10, 0.6), (60, 0.3), (400, 0.1)])
def test_cells_are_as_small_as_the_points_allow(density, coarsest):
    assert 0.1 <= shown(anyhow(density)).grid.resolution <= coarsest


def test_shadows_beside_all_rows_are_usual():
    assert shown(shadows()).at(ELSEWHERE).mean() > 0.998


def test_a_quarter_without_points_and_all_beyond_the_cloud_was_not_seen():
    xyz = anyhow(100)
    seen = shown(xyz[(xyz[:, :2] > SIDE / 2).any(axis=1)])
    x, y = ELSEWHERE.T
    assert not seen.at(ELSEWHERE[(x < 19.5) & (y < 19.5)]).any()
    assert seen.at(ELSEWHERE[(x > 20.5) | (y > 20.5)]).mean() > 0.998
    assert not seen.at(np.array([[-0.5, 30.0], [-500, 30], [30, SIDE + 0.5], [1e6, 1e6]])).any()


def test_a_cloud_in_tiles_shows_the_same(tmp_path):
    xyz = anyhow(20)
    xyz = xyz[~shapely.contains_xy(shapely.box(12, 12, 17, 16), xyz[:, :2])]
    collector = Collector(tmp_path, most=1000)
    collector.add(xyz)
    tiled = collector.cloud(None, None, *np.array([[-1e3] * 3, [1e3] * 3]))
    seen, same = seen_cells(tiled, grid_over(*tiled.extent, resolution=0.1)), shown(xyz)
    assert seen.grid == same.grid
    assert np.array_equal(seen.cells, same.cells)


def test_a_handful_of_points():
    xyz = np.array([[0.01, 0.02, 0], [0.25, 0.12, 0], [3.1, 4.2, 0]])
    seen = shown(xyz)
    assert seen.at(xyz).all()
    assert not seen.at(np.array([[1.5, 2.0]])).any()
