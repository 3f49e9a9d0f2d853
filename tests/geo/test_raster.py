"""Grids, binning, sampling and GeoTIFF."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS

from vinemap.errors import InputError
from vinemap.geo.raster import (
    Grid,
    Raster,
    above,
    block_sum,
    cell_of,
    coarser,
    extent,
    grid_over,
    sample,
    squares,
    window,
)

UTM = CRS.from_epsg(32632)


def test_grid_holds_its_points():
    xy = np.random.default_rng(0).uniform([1000.3, 2000.7], [1010.9, 2005.2], (500, 2))
    grid = grid_over(*extent(xy), resolution=0.5)
    cells = cell_of(xy, grid)
    assert cells.max() < grid.ny * grid.nx
    x, y = grid.centres()
    i, j = np.divmod(cells, grid.nx)
    assert np.abs(x[j] - xy[:, 0]).max() <= 0.25 + 1e-9
    assert np.abs(y[i] - xy[:, 1]).max() <= 0.25 + 1e-9


def test_grid_of_a_single_point():
    assert grid_over([5.0, 7.0], [5.0, 7.0], resolution=0.25).shape == (1, 1)


@pytest.mark.parametrize("multiple", [1, 4, 5])
@pytest.mark.parametrize("resolution", [0.05, 0.25, 0.3, 2.0])
def test_grid_of_whole_blocks(resolution, multiple):
    low, high = [414_700.3, 4_940_700.7], [414_719.9, 4_940_731.2]
    grid = grid_over(low, high, resolution=resolution, multiple=multiple)
    step = multiple * resolution
    assert grid.resolution == resolution
    assert [n % multiple for n in grid.shape] == [0, 0]
    for edge in (grid.west, grid.north):
        assert edge / step == pytest.approx(round(edge / step), abs=1e-6)
    assert -1e-6 < low[0] - grid.west < step
    assert -1e-6 < low[1] - (grid.north - grid.ny * resolution) < step + 1e-6
    assert -1e-6 < grid.west + grid.nx * resolution - high[0] < step + 1e-6
    assert -1e-6 < grid.north - high[1] < 2 * step


def test_grid_of_points_on_edges_holds_their_squares():
    grid = grid_over([3.0, 5.0], [4.0, 6.0], resolution=0.5)
    assert (grid.west, grid.west + grid.nx * 0.5) == (3.0, 4.5)
    assert (grid.north - grid.ny * 0.5, grid.north) == (4.5, 6.0)
    assert cell_of(np.array([[3.0, 5.0], [4.0, 5.0], [3.0, 6.0]]), grid).tolist() == [6, 8, 0]


def test_squares_on_edges_are_the_eastern_and_the_southern():
    xy = [[0.0, 0.0], [0.5, 0.5], [1.0, 1.0], [-1e-9, 1e-9], [-0.5, -0.5], [63.9, 63.9]]
    columns, rows = squares(xy, 1.0)
    assert columns.tolist() == [0, 0, 1, -1, -1, 63]
    assert rows.tolist() == [-1, 0, 0, 0, -1, 63]


GRID = Grid(100.0, 50.0, 0.25, 40, 60)
"""From 100, 40 to 115, 50."""


@pytest.mark.parametrize(
    ("low", "high", "multiple", "rows", "columns"),
    [
        ([100, 40.1], [114.9, 50], 1, (0, 40), (0, 60)),
        ([101.1, 42.1], [103.1, 44.9], 1, (20, 32), (4, 13)),
        ([101.1, 42.1], [103.1, 44.9], 4, (20, 32), (4, 16)),
        ([101.1, 42.1], [103.1, 44.9], 8, (16, 32), (0, 16)),
        # On edges: the eastern and the southern block.
        ([101, 43], [103, 45], 4, (20, 32), (4, 16)),
        ([101, 45], [101, 45], 4, (20, 24), (4, 8)),
        # Beyond the grid's edges.
        ([90, 30], [101.1, 44.9], 4, (20, 40), (0, 8)),
        ([101.1, 44.9], [190, 90], 4, (0, 24), (4, 60)),
        ([0, 0], [1000, 1000], 4, (0, 40), (0, 60)),
    ],
)
def test_window_covers_an_extent_in_whole_blocks(low, high, multiple, rows, columns):
    part, where = window(GRID, low, high, multiple=multiple)
    assert where == (slice(*rows), slice(*columns))
    x, y = GRID.centres()
    assert np.allclose(part.centres()[0], x[where[1]])
    assert np.allclose(part.centres()[1], y[where[0]])


def test_window_at_the_edge_of_a_grid_that_is_no_whole_number_of_blocks():
    part, where = window(Grid(100.0, 50.0, 0.25, 39, 58), [101, 40.3], [114.4, 49.9], multiple=4)
    assert where == (slice(0, 39), slice(4, 58))
    assert part.shape == (39, 54)


@given(
    st.sampled_from([0.05, 0.07, 0.15, 0.25, 0.3, 0.45, 1.3, 2.0]),
    st.integers(0, 1000),
    st.integers(1, 6),
)
@settings(deadline=None)
def test_window_holds_the_blocks_of_its_points(resolution, seed, multiple):
    rng = np.random.default_rng(seed)
    step = multiple * resolution
    whole = np.round(rng.uniform([414_700, 4_940_700], [414_760, 4_940_750], (50, 2)) / step) * step
    xy = np.concatenate([whole.round(3), whole])
    grid = grid_over(*extent(xy), resolution=resolution, multiple=multiple)
    part, (rows, columns) = window(grid, *extent(xy[:5]), multiple=multiple)
    east, north = squares(xy[:5], step)
    i = round(grid.north / step) - 1 - north
    j = east - round(grid.west / step)
    assert (i.min() * multiple, (i.max() + 1) * multiple) == (rows.start, rows.stop)
    assert (j.min() * multiple, (j.max() + 1) * multiple) == (columns.start, columns.stop)
    assert part.shape == (rows.stop - rows.start, columns.stop - columns.start)


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 1000])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_extent(n, kind):
    points = np.random.default_rng(n).normal(0, 1e6, (n, 3)).astype(kind)
    low, high = extent(points)
    assert np.array_equal(low, points.min(axis=0))
    assert np.array_equal(high, points.max(axis=0))
    assert np.array_equal(extent(points[:, ::-1])[0], low[::-1])


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, np.uint16, np.bool_])
@pytest.mark.parametrize("shape", [(1, 1), (40, 60), (41, 59), (3, 200), (200, 3)])
@pytest.mark.parametrize("k", [1, 2, 3, 7, 50])
def test_block_sums(kind, shape, k):
    values = np.random.default_rng(0).integers(0, 2 if kind == np.bool_ else 60_000, shape).astype(kind)
    padded = np.zeros([-(-n // k) * k for n in shape])
    padded[: shape[0], : shape[1]] = values
    expected = padded.reshape(padded.shape[0] // k, k, padded.shape[1] // k, k).sum(axis=(1, 3))
    assert np.array_equal(block_sum(values, k), expected)


def test_heights_above_a_raster():
    rng = np.random.default_rng(1)
    raster = Raster(rng.normal(300, 5, GRID.shape), GRID, UTM)
    # Beyond the raster's edges the border's values hold.
    xyz = rng.uniform([95, 35, 290], [120, 55, 320], (3000, 3))
    heights = above(raster, xyz)
    assert heights.dtype == np.float32
    assert np.allclose(heights, xyz[:, 2] - sample(raster, xyz), atol=1e-5)
    assert len(above(raster, np.empty((0, 3)))) == 0


def test_too_large_a_grid_says_what_to_do():
    with pytest.raises(InputError, match="--boundary"):
        grid_over([0.0, 0.0], [1e5, 1e5], resolution=0.1)


def test_coarser_grid_covers_the_same_area():
    fine = Grid(10.0, 20.0, 0.1, 101, 57)
    wide = coarser(fine, resolution=0.5)
    assert wide.shape == (21, 12)
    assert (wide.west, wide.north) == (10.0, 20.0)


def test_bilinear_sampling_is_exact_on_a_plane():
    grid = Grid(100.0, 50.0, 0.5, 40, 60)
    x, y = np.meshgrid(*grid.centres())
    raster = Raster(2 * x - 3 * y + 1, grid, UTM)
    xy = np.random.default_rng(1).uniform([101, 32], [129, 49], (200, 2))
    assert np.allclose(sample(raster, xy), 2 * xy[:, 0] - 3 * xy[:, 1] + 1)
