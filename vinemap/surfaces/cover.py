"""Canopy cover: the raster in which rows are sought."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, gaussian_filter, maximum_filter, uniform_filter

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads
from vinemap.geo.raster import Raster, block_sum, cell_of, coarser, grid_over, nearest_cell

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Values
    from vinemap.geo.raster import Grid

    Counts = NDArray[np.uint16]

BATCH = 1_000_000
"""Points whose cells are looked up at once."""
MOST = 65_535
"""Points that a cell counts."""
BLOCK = 0.25
"""Metres, about: side of the blocks of cells in which tall and wide objects are sought."""
TALLEST = 40.0
"""Metres above which nothing stands: points there are birds and noise."""
WIDEST = 2.0
"""Metres across which no canopy of a row is closed near its top."""
TOUCHING = 1.4
"""Metres of closed canopy from which rows may touch."""
ENOUGH = 8
"""Points of a block that tell what it is; where there are fewer, those beside it help."""
AROUND = 4.0
"""Metres, about: side of the squares in which the canopies' height is told, from theirs and from those beside them."""
TOP = 0.97
"""Order of a square's heights that is its canopies'."""
FOOT, LEAST = 0.4, 0.2
"""Share of the canopies' height, and metres, from which low canopies are told from what grows beneath them."""
LOWEST = 0.45
"""Metres of height below which there is grass and no canopy."""
RIDGE = 0.75
"""Share of the canopies' height above which rows stand apart that touch below it."""


class Levels(NamedTuple):
    """Heights above ground from which points are canopy, in metres, in cells of 1 m."""

    body: Raster
    """Of canopies whole."""
    ridge: Raster
    """Of what stands apart: the same but where rows touch."""


def canopy_cover(
    cloud: Cloud,
    chm: Raster,
    *,
    resolution: float = 0.1,
    low: float = 0.5,
    high: float = 3.6,
    smoothing: float | None = None,
) -> tuple[Raster, Levels]:
    """Share of a cell's points that are canopy: between two heights above ground, and under nothing taller.

    A ratio, so that neither the cloud's density nor its unevenness between flight lines matters. The lower height
    follows the canopies': it is less where all are low, and where rows touch it rises to where they stand apart.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        The parcel's points with their heights above ground.
    chm : Raster
        Canopy height.
    resolution : float
        Cell size in metres.
    low, high : float
        Heights in metres between which points count as canopy, the lower at the most where rows stand apart. What is
        taller (trees, houses) or wider than a row of vines (huts, hedges, bushes) is left out.
    smoothing : float, optional
        Standard deviation in metres of the Gaussian that smooths both counts; by default the cloud's mean distance
        between points, and half a cell at the least.

    Returns
    -------
    cover : Raster
        0–1.
    levels : Levels
        Heights from which points count as canopy.
    """
    grid = grid_over(*cloud.extent, resolution=resolution)
    top = _canopy_height(chm, high)
    foot = np.where(top >= LOWEST, np.clip(FOOT * top, LEAST, low), low)
    body = level = Raster(foot.astype(np.float32), coarser(chm.grid, resolution=1.0), cloud.crs)
    counts = _counts(cloud, grid, level, high)
    wide = _closed(counts, resolution, TOUCHING)
    if wide.any():
        ridge = np.where(_in_cells_of(level.grid, wide, grid, resolution), np.maximum(RIDGE * top, foot), foot)
        level = replace(level, values=ridge.astype(np.float32))
        counts = _counts(cloud, grid, level, high)
    everything, canopy, _ = counts
    density = cloud.size / max(1, int(np.count_nonzero(everything)))
    sigma = max(0.5, density**-0.5) if smoothing is None else smoothing / resolution
    cover, blurred = in_threads(lambda layer: gaussian_filter(layer, sigma, output=np.float32), [canopy, everything])
    cover /= blurred + np.float32(0.1 * density)
    cover[_no_vines(counts, resolution)] = 0.0
    return Raster(cover, grid, cloud.crs), Levels(body, level)


def _canopy_height(chm: Raster, high: float) -> Values:
    """Height of the canopies in and beside squares of some metres, in cells of 1 m; 0 where there is nothing."""
    squares = max(1, round(AROUND / chm.grid.resolution))
    ny, nx = (-(-n // squares) for n in chm.grid.shape)
    padded = np.full((ny * squares, nx * squares), np.nan, dtype=np.float32)
    padded[: chm.grid.ny, : chm.grid.nx] = np.where(chm.values <= high, chm.values, np.nan)
    inside = padded.reshape(ny, squares, nx, squares).swapaxes(1, 2).reshape(ny, nx, -1)
    ordered = np.sort(inside, axis=2)
    n = np.isfinite(ordered).sum(axis=2)
    rank = np.maximum(np.ceil(TOP * n).astype(int) - 1, 0)
    top = np.nan_to_num(np.take_along_axis(ordered, rank[:, :, None], axis=2)[:, :, 0])
    x, y = coarser(chm.grid, resolution=1.0).centres()
    side = squares * chm.grid.resolution
    i = np.minimum(((chm.grid.north - y) / side).astype(int), ny - 1)
    j = np.minimum(((x - chm.grid.west) / side).astype(int), nx - 1)
    out: Values = maximum_filter(top, 3)[np.ix_(i, j)]
    return out


def _in_cells_of(grid: Grid, mask: Flags, fine: Grid, resolution: float) -> Flags:
    """Cells of a grid that have some of a mask (of blocks of a fine grid's cells) in them or beside them."""
    k = max(1, round(BLOCK / resolution))
    i, j = np.nonzero(mask)
    x, y = fine.west + (j + 0.5) * k * resolution, fine.north - (i + 0.5) * k * resolution
    out = np.zeros(grid.ny * grid.nx, dtype=bool)
    out[cell_of(np.column_stack([x, y]), grid)] = True
    held: Flags = binary_dilation(out.reshape(grid.shape), np.ones((3, 3)))
    return held


def _counts(cloud: Cloud, grid: Grid, level: Raster, high: float) -> Counts:
    """Points (3, ny, nx) in cells: all, those of the canopies' heights, and those above."""
    counts = np.zeros((3, grid.ny * grid.nx), dtype=np.uint16)
    for part in cloud.parts():
        for start in range(0, part.size, BATCH):
            batch = slice(start, start + BATCH)
            xyz, heights = part.xyz[batch], part.heights[batch]
            _count(cell_of(xyz, grid), xyz, heights, level.values, level.grid, (high, TALLEST), counts)
    return counts.reshape(3, *grid.shape)


@compiled
def _count(
    cells: NDArray[np.int32],
    xyz: Values,
    heights: Values,
    level: Values,
    levels: Grid,
    limits: tuple[float, float],
    counts: NDArray[np.uint16],
) -> None:
    """Count points in cells (3, n): all, those between the level there and a height, those from that to the highest."""
    high, highest = limits
    for p in range(len(cells)):
        cell = cells[p]
        if counts[0, cell] == MOST:
            continue
        counts[0, cell] += 1
        i, j = nearest_cell(levels, xyz[p, 0], xyz[p, 1])
        if level[i, j] <= heights[p] <= high:
            counts[1, cell] += 1
        elif high < heights[p] < highest:
            counts[2, cell] += 1


def _closed(counts: Counts, resolution: float, width: float) -> Flags:
    """Blocks of cells over which canopy is closed across some metres."""
    k = max(1, round(BLOCK / resolution))
    everything, low, above = (block_sum(layer, k) for layer in counts)
    if np.median(everything[everything > 0]) < ENOUGH:
        everything, low, above = _summed(counts, resolution)
        closed = low + above > 0.5 * np.maximum(everything, 1)
    else:
        closed = uniform_filter((low + above > 0.5 * np.maximum(everything, 1)).astype(np.float32), 3) > 0.5
    out: Flags = binary_opening(closed, _disc(width / 2, _side(resolution)))
    return out


def _no_vines(counts: Counts, resolution: float) -> Flags:
    """Cells (ny, nx) of objects taller or wider than a row of vines, with half a metre around them."""
    k = max(1, round(BLOCK / resolution))
    all_, _, above = _summed(counts, resolution)
    high = binary_opening((above > 2.5) & (above > 0.15 * all_), np.ones((3, 3)))
    out: Flags = binary_dilation(high | _closed(counts, resolution, WIDEST), _disc(0.5, _side(resolution)))
    return out.repeat(k, axis=0).repeat(k, axis=1)[: counts.shape[1], : counts.shape[2]]


def _summed(counts: Counts, resolution: float) -> list[NDArray[np.float64]]:
    """Counts over 3 x 3 blocks of cells, so that a sparse cloud is judged by more than a point or two."""
    k = max(1, round(BLOCK / resolution))
    return [9 * uniform_filter(block_sum(layer, k), 3) for layer in counts]


def _side(resolution: float) -> float:
    """Metres of a block of cells."""
    return max(1, round(BLOCK / resolution)) * resolution


def _disc(radius: float, cell: float) -> Flags:
    """Cells whose centre lies within a radius of the middle one's."""
    n = int(radius / cell)
    out: Flags = np.hypot(*np.mgrid[-n : n + 1, -n : n + 1]) * cell <= radius
    return out
