"""Order statistics of a cloud's heights in cells and blocks of cells, part by part of the cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.cloud.bins import quantiles_in
from vinemap.geo.raster import Grid, Raster, above, window

if TYPE_CHECKING:
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Floats

COARSE = 1.0
"""Cell size in metres of the first, coarse surface."""


def cells_a_block(resolution: float) -> int:
    """Cells a side of the blocks of the coarse surface."""
    return max(1, round(COARSE / resolution))


def block_side(resolution: float) -> float:
    """Side in metres of the terrain model's blocks of cells, which a cloud in tiles must not divide."""
    return cells_a_block(resolution) * resolution


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
