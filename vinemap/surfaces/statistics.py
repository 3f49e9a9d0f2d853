"""Order statistics of a cloud's heights in cells and blocks of cells, part by part of the cloud, and of a raster's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
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
    squares = max(1, round(AROUND / chm.grid.resolution))
    ny, nx = (-(-n // squares) for n in chm.grid.shape)
    padded = np.full((ny * squares, nx * squares), np.nan, dtype=np.float32)
    padded[: chm.grid.ny, : chm.grid.nx] = np.where(chm.values <= high, chm.values, np.nan)
    inside = padded.reshape(ny, squares, nx, squares).swapaxes(1, 2).reshape(ny, nx, -1)
    ordered = np.sort(inside, axis=2)
    n = np.isfinite(ordered).sum(axis=2)
    rank = np.maximum(np.ceil(order * n).astype(int) - 1, 0)
    top = np.nan_to_num(np.take_along_axis(ordered, rank[:, :, None], axis=2)[:, :, 0])
    coarse = Grid(chm.grid.west, chm.grid.north, squares * chm.grid.resolution, ny, nx)
    out: Values = spread(maximum_filter(top, 3), coarse, coarser(chm.grid, resolution=1.0))
    return out
