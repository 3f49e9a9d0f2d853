"""Order statistics of a cloud's heights in cells and blocks of cells, part by part of the cloud, and of a raster's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter

from vinemap.cloud.bins import cells_a_block, quantiles_in
from vinemap.geo.raster import Grid, Raster, above, coarser, spread, window

if TYPE_CHECKING:
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Floats, Values

LOWEST = 0.45
"""Metres of height below which there is grass and no canopy."""
AROUND = 4.0
"""Metres, about: side of the squares in which the canopies' height is told, from theirs and from those beside them."""
TOP = 0.97
"""Order of a square's heights that is its canopies'."""
THEREABOUTS, USUAL = 4, 0.75
"""Squares to each side whose canopies tell what is usual, and the order of their heights that is."""


def order_statistics(
    cloud: Cloud, surface: Raster | None, grid: Grid, quantiles: tuple[float, ...], *, blocks: int = 1
) -> tuple[Floats, Floats]:
    """Counts and quantiles of the heights above a surface, or else above ground, in blocks of a grid's cells."""
    shape = [side // blocks for side in grid.shape]
    n, found = np.zeros(shape), np.zeros((len(quantiles), *shape))
    for part in cloud.parts():
        around, (rows, columns) = window(grid, *part.extent, multiple=cells_a_block(grid.resolution))
        heights = part.heights if surface is None else above(surface, part.xyz)
        here = slice(rows.start // blocks, rows.stop // blocks), slice(columns.start // blocks, columns.stop // blocks)
        n[here], found[:, *here] = quantiles_in(part.bins(around), heights, quantiles, blocks=blocks)
    return n, found


def height_about(chm: Raster, high: float, *, order: float = TOP) -> Values:
    """Height of the canopies in and beside squares of some metres, in cells of 1 m; 0 where there is nothing.

    It is that of an order of a square's heights, up to the greatest that counts.
    """
    top = _tops(chm, high, order)
    return _in_metres(maximum_filter(top, 3), chm.grid)


def usual_height(chm: Raster, high: float) -> Values:
    """Height that most canopies within ``THEREABOUTS`` squares have or fall short of, in cells of 1 m; 0 for none."""
    top = _tops(chm, high, TOP)
    around = np.pad(np.where(top >= LOWEST, top, np.nan), THEREABOUTS, constant_values=np.nan)
    near = sliding_window_view(around, (2 * THEREABOUTS + 1,) * 2).reshape(*top.shape, -1)
    ordered = np.sort(near, axis=2)
    rank = np.maximum(np.ceil(USUAL * np.isfinite(ordered).sum(axis=2)).astype(int) - 1, 0)
    return _in_metres(np.nan_to_num(np.take_along_axis(ordered, rank[:, :, None], axis=2)[:, :, 0]), chm.grid)


def _tops(chm: Raster, high: float, order: float) -> Values:
    """An order of the heights up to a highest in squares (ny, nx) of ``AROUND`` metres; 0 where there is nothing."""
    squares = _squares(chm.grid)
    ny, nx = (-(-n // squares) for n in chm.grid.shape)
    padded = np.full((ny * squares, nx * squares), np.nan, dtype=np.float32)
    padded[: chm.grid.ny, : chm.grid.nx] = np.where(chm.values <= high, chm.values, np.nan)
    inside = padded.reshape(ny, squares, nx, squares).swapaxes(1, 2).reshape(ny, nx, -1)
    ordered = np.sort(inside, axis=2)
    n = np.isfinite(ordered).sum(axis=2)
    rank = np.maximum(np.ceil(order * n).astype(int) - 1, 0)
    out: Values = np.nan_to_num(np.take_along_axis(ordered, rank[:, :, None], axis=2)[:, :, 0])
    return out


def _squares(grid: Grid) -> int:
    """Cells along a square's side."""
    return max(1, round(AROUND / grid.resolution))


def _in_metres(squares: Values, grid: Grid) -> Values:
    """Values of squares (ny, nx) of a grid's cells, in cells of 1 m."""
    coarse = Grid(grid.west, grid.north, _squares(grid) * grid.resolution, *squares.shape)
    out: Values = spread(squares, coarse, coarser(grid, resolution=1.0))
    return out
