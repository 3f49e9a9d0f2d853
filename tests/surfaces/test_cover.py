"""Canopy cover: a share, from a level that follows the canopies' height."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from vinemap.cloud.points import PointCloud
from vinemap.geo.raster import grid_over, sample
from vinemap.simulate.families import family
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import hillside
from vinemap.surfaces.canopy_height import canopy_height_model
from vinemap.surfaces.cover import canopy_cover
from vinemap.surfaces.ground import terrain_model


def test_cover_does_not_follow_density_and_leaves_trees_out(vineyard, cloud):
    cloud = cloud.above(terrain_model(cloud))
    half = np.random.default_rng(0).random(cloud.size) < 0.5
    chm = canopy_height_model(cloud)
    dense, _ = canopy_cover(cloud, chm, smoothing=0.2)
    sparse, _ = canopy_cover(replace(cloud, xyz=cloud.xyz[half], heights=cloud.heights[half]), chm, smoothing=0.2)
    assert np.abs(dense.values.mean() - sparse.values.mean()) < 0.05 * dense.values.mean()

    rows = rows_of(1, length=20)
    x, y = rows[0].mean(axis=0) + [0, 6]
    survey = simulate([Vineyard("A", rows)], hillside(0.1), obstacles=[Obstacle(x, y, 2.0, 2.0, 6.0, 1.0)], seed=1)
    tree = PointCloud(survey.xyz, cloud.crs)
    tree = tree.above(terrain_model(tree))
    cover, _ = canopy_cover(tree, canopy_height_model(tree))
    grid = grid_over(*tree.extent, resolution=0.1)
    gx, gy = np.meshgrid(*grid.centres())
    assert cover.values[np.hypot(gx - x, gy - y) < 1.5].max() < 0.05


@pytest.mark.parametrize(
    ("vines", "spacing", "least", "most"),
    [
        ({}, 2.5, 0.5, 0.5),
        ({"height": 0.6, "half_width": 0.1, "bottom": 0.1, "leafiness": 20}, 2.5, 0.2, 0.3),
        ({"height": 1.7, "half_width": 1.1, "leafiness": 6}, 2.4, 1.2, 1.6),
    ],
)
def test_the_level_follows_the_canopies(cloud, vines, spacing, least, most):
    """Ordinary rows, vines that were planted this year, and canopies that touch below their tops."""
    rows = rows_of(8, length=25, spacing=spacing)
    survey = simulate([Vineyard("A", rows, dead=0, **vines)], hillside(0.05), weeds=0.1, density=300, seed=2)
    points = PointCloud(survey.xyz, cloud.crs)
    points = points.above(terrain_model(points))
    cover, levels = canopy_cover(points, canopy_height_model(points))
    at = [row[len(row) // 4 : 3 * len(row) // 4] for row in rows[2:-2]]
    found = np.concatenate([sample(levels.ridge, xy) for xy in at])
    assert least <= found.min() <= np.median(found) <= most
    beside = np.concatenate([sample(cover, xy + [0, spacing / 2]) for xy in at])
    assert np.median(beside) < 0.5 * np.median(np.concatenate([sample(cover, xy) for xy in at]))


def test_huts_do_not_raise_the_level(cloud):
    """Flat roofs as high as the vines beside them are no rows that touch."""
    rows = rows_of(4, length=25)
    huts = [Obstacle(*(rows[3].mean(axis=0) + [x, 7]), 2.2, 1.5, 2.0, solid=True) for x in (-7, 0, 7)]
    survey = simulate([Vineyard("A", rows)], hillside(0.05), obstacles=huts, density=300, seed=3)
    points = PointCloud(survey.xyz, cloud.crs)
    points = points.above(terrain_model(points))
    _, levels = canopy_cover(points, canopy_height_model(points))
    assert np.array_equal(levels.ridge.values, levels.body.values)


@pytest.mark.parametrize("seed", [3, 14])
def test_nothing_of_a_roof_of_leaves_is_left(cloud, seed):
    """Not where single shoots stand out of it, nor at its edges and corners; but all of it where rows are known."""
    survey = family("pergola", seed)
    points = PointCloud(survey.xyz, cloud.crs)
    points = points.above(terrain_model(points))
    chm = canopy_height_model(points)
    cover, _ = canopy_cover(points, chm)
    assert np.count_nonzero(cover.values > 0.12) * cover.grid.resolution**2 < 1.0
    known, _ = canopy_cover(points, chm, survey.rows.assign(spacing_m=3.0))
    along = shapely.line_interpolate_point(survey.rows.geometry.to_numpy()[:, None], np.arange(2.0, 20))
    assert np.quantile(sample(known, shapely.get_coordinates(along)), 0.1) > 0.5


@pytest.mark.parametrize("resolution", [0.1, 0.3, 0.7, 2.0])
def test_terrain_of_any_resolution_gives_the_same_level(vineyard, cloud, resolution):
    points = cloud.above(terrain_model(cloud, resolution=resolution))
    _, levels = canopy_cover(points, canopy_height_model(points, resolution=resolution), low=1.5)
    assert levels.body.values.shape == levels.body.grid.shape
    at = np.concatenate([np.array(line.coords)[:, :2] for line in vineyard.rows.geometry])
    assert np.median(sample(levels.body, at)) == pytest.approx(0.4 * 2.0, rel=0.1)


@pytest.mark.parametrize("vines", [{"height": 0.7, "half_width": 0.1, "bottom": 0.1, "leafiness": 20}, {}])
def test_nothing_flat_is_left_nor_raises_the_level(cloud, vines):
    """Neither cars nor pallets beside vines, young ones or old, that are narrower than canopies may be."""
    rows = rows_of(6, length=20)
    beside = rows[-1].mean(axis=0) + [0, 3.5]
    sizes = [((0.85, 2.1), 1.5)] * 4 + [((0.6, 0.5), 1.0)] * 3
    things = [Obstacle(*(beside + [2.6 * k - 8, 0]), *size, top, solid=True) for k, (size, top) in enumerate(sizes)]
    survey = simulate(
        [Vineyard("A", rows, dead=0, **vines)], hillside(0.05), obstacles=things, density=200, noise=0.02, seed=3
    )
    points = PointCloud(survey.xyz, cloud.crs)
    points = points.above(terrain_model(points))
    cover, levels = canopy_cover(points, canopy_height_model(points))
    on_rows = np.concatenate([row[4:-4] for row in rows])
    assert np.median(sample(cover, on_rows)) > 0.3
    if vines:
        assert sample(levels.body, on_rows).max() < 0.45  # the most, where cars raise it, is 0.5
    x, y = np.meshgrid(*cover.grid.centres())
    inside = shapely.contains_xy(shapely.box(*(beside - [10, 2]), *(beside + [10, 2.2])), x, y)
    left = np.count_nonzero(cover.values[inside] > 0.12) * cover.grid.resolution**2
    assert left < 0.1 * sum(4 * np.prod(size) for size, _ in sizes)


@pytest.mark.parametrize(("tall", "half_width"), [(2.8, 0.27), (1.6, 0.27), (3.4, 0.45)])
def test_rows_beside_a_hedge_keep_their_level(cloud, tall, half_width):
    """They are lower, narrow, or both."""
    rows = rows_of(5, length=25)
    hedge = Vineyard("", [rows[4] + [0, 2.2]], tall, 0.8, bottom=0.0, dead=0)
    vines = Vineyard("A", rows, height=1.8, half_width=half_width, dead=0)
    survey = simulate([vines], hillside(0.05), beside=[hedge], weeds=0.1, density=300, seed=4)
    points = PointCloud(survey.xyz, cloud.crs)
    points = points.above(terrain_model(points))
    cover, levels = canopy_cover(points, canopy_height_model(points))
    assert levels.touching.any()  # the hedge seems to be rows that touch
    usual, beside = (np.median(sample(cover, rows[k][20:-20])) for k in (1, 4))
    assert beside > 0.9 * usual


@pytest.mark.parametrize("known", [False, True])
def test_a_tree_in_a_row_is_left_out_whether_rows_are_known_or_not(cloud, known):
    rows = rows_of(5, length=25)
    x, y = rows[2][len(rows[2]) // 2]
    tree = Obstacle(x, y, 1.4, 1.4, 3.5, 1.0)
    survey = simulate([Vineyard("A", rows, dead=0)], hillside(0.05), obstacles=[tree], density=300, seed=6)
    points = PointCloud(survey.xyz, cloud.crs)
    points = points.above(terrain_model(points))
    lines = survey.rows.assign(spacing_m=2.5) if known else None
    cover, _ = canopy_cover(points, canopy_height_model(points), lines)
    gx, gy = np.meshgrid(*cover.grid.centres())
    assert cover.values[np.hypot(gx - x, gy - y) < 1.0].max() == 0
    assert np.median(sample(cover, rows[2][:30])) > 0.3
