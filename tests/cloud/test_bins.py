"""Points in cells: counts and quantiles, against NumPy's of each cell's points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vinemap.cloud.bins import bin_points, quantiles_in
from vinemap.geo.raster import Grid, cell_of

GRID = Grid(414_700.0, 4_940_710.0, 0.5, 13, 17)
"""Neither a whole number of blocks long nor wide."""


def cloud(n, *, seed=0, margin=0.0):
    low = [GRID.west - margin, GRID.north - GRID.ny * 0.5 - margin]
    high = [GRID.west + GRID.nx * 0.5 + margin, GRID.north + margin]
    return np.random.default_rng(seed).uniform(low, high, (n, 2))


def assert_quantiles(xy, values, quantiles, blocks):
    """Compare with the values of each block that NumPy sorts."""
    n, found = quantiles_in(bin_points(xy, GRID), values, quantiles, blocks=blocks)
    ny, nx = -(-GRID.ny // blocks), -(-GRID.nx // blocks)
    assert n.shape == (ny, nx)
    assert found.shape == (len(quantiles), ny, nx)
    i, j = np.divmod(cell_of(xy, GRID), GRID.nx)
    for a in range(ny):
        for b in range(nx):
            mine = np.sort(values[(i // blocks == a) & (j // blocks == b)])
            assert n[a, b] == len(mine)
            ranks = [max(int(np.ceil(q * len(mine))) - 1, 0) for q in quantiles]
            assert found[:, a, b].tolist() == ([float(mine[r]) for r in ranks] if len(mine) else [0.0] * len(ranks))


def test_points_of_a_cell_are_together_and_in_their_order():
    xy = cloud(3000, margin=2)
    bins = bin_points(xy, GRID)
    cells = cell_of(xy, GRID)
    assert len(bins.start) == GRID.ny * GRID.nx + 1
    for c in range(GRID.ny * GRID.nx):
        assert bins.member[bins.start[c] : bins.start[c + 1]].tolist() == np.flatnonzero(cells == c).tolist()


@given(
    st.integers(0, 10_000),
    st.sampled_from([0, 1, 15, 17, 400, 5000]),
    st.sampled_from([1, 2, 4, 5, 20]),
    st.lists(st.sampled_from([0.0, 0.05, 0.1, 0.5, 0.9, 0.98, 1.0]), min_size=1, max_size=4).map(sorted),
    st.sampled_from([np.float32, np.float64]),
    st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_counts_and_quantiles(seed, n, blocks, quantiles, kind, ties):
    rng = np.random.default_rng(seed)
    values = (rng.integers(-3, 3, n) if ties else rng.normal(300, 5, n)).astype(kind)
    assert_quantiles(cloud(n, seed=seed, margin=1.0), values, quantiles, blocks)


@pytest.mark.parametrize("order", ["climbing", "falling", "equal", "organ pipe"])
def test_quantiles_of_many_points_in_any_order(order):
    """Choosing a rank must end, and end right, where all points of a cell come sorted or are the same."""
    values = np.arange(4001.0)
    values = {
        "climbing": values,
        "falling": values[::-1],
        "equal": np.ones(4001),
        "organ pipe": np.concatenate([values[::2], values[1::2][::-1]]),
    }[order]
    xy = np.tile([GRID.west + 3.2, GRID.north - 3.3], (4001, 1))
    assert_quantiles(xy, values, (0.1, 0.1, 0.5, 0.9, 1.0), 1)


def test_points_outside_count_in_the_nearest_cell():
    xy = np.array([[GRID.west - 1e6, GRID.north + 1e6], [GRID.west + 1e6, GRID.north - 1e6]])
    n, (lowest,) = quantiles_in(bin_points(xy, GRID), np.array([3.0, 4.0]), (0.5,))
    assert n.sum() == 2
    assert (n[0, 0], n[-1, -1]) == (1, 1)
    assert (lowest[0, 0], lowest[-1, -1]) == (3, 4)


def test_cells_of_a_block_beyond_the_edge_are_empty():
    n, _ = quantiles_in(bin_points(cloud(5000), GRID), np.zeros(5000), (0.5,), blocks=4)
    assert n.shape == (4, 5)
    assert n.sum() == 5000
    assert n[0, 0] > 2.5 * n[-1, 0] > 0


def test_values_are_left_as_they_are():
    values = np.random.default_rng(0).normal(size=500)
    before = values.copy()
    quantiles_in(bin_points(cloud(500), GRID), values, (0.1, 0.5), blocks=5)
    assert np.array_equal(values, before)
