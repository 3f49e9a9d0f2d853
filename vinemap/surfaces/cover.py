"""Canopy cover: the raster in which rows are sought."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening, gaussian_filter, uniform_filter

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads
from vinemap.geo.raster import Raster, block_sum, cell_of, grid_over

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Values

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
"""Metres across which no canopy of a row is closed."""


def canopy_cover(
    cloud: Cloud,
    *,
    resolution: float = 0.1,
    low: float = 0.5,
    high: float = 2.9,
    smoothing: float | None = None,
) -> Raster:
    """Share of a cell's points that are canopy: between two heights above ground, and under nothing taller.

    A ratio, so that neither the cloud's density nor its unevenness between flight lines matters.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        The parcel's points with their heights above ground.
    resolution : float
        Cell size in metres.
    smoothing : float, optional
        Standard deviation in metres of the Gaussian that smooths both counts; by default the cloud's mean distance
        between points, and half a cell at the least.
    low, high : float
        Heights in metres between which points count as canopy. What is taller (trees, houses) or wider than a row
        of vines (huts, hedges, bushes) is left out.
    """
    grid = grid_over(*cloud.extent, resolution=resolution)
    counts = np.zeros((3, grid.ny * grid.nx), dtype=np.uint16)
    for part in cloud.parts():
        for start in range(0, part.size, BATCH):
            batch = slice(start, start + BATCH)
            _count(cell_of(part.xyz[batch], grid), part.heights[batch], (low, high, TALLEST), counts)
    everything, canopy, tall = counts.reshape(3, *grid.shape)
    density = cloud.size / max(1, int(np.count_nonzero(everything)))
    sigma = max(0.5, density**-0.5) if smoothing is None else smoothing / resolution
    cover, blurred = in_threads(lambda layer: gaussian_filter(layer, sigma, output=np.float32), [canopy, everything])
    cover /= blurred + np.float32(0.1 * density)
    cover[_no_vines(everything, canopy, tall, resolution)] = 0.0
    return Raster(cover, grid, cloud.crs)


@compiled
def _count(
    cells: NDArray[np.int32], heights: Values, limits: tuple[float, float, float], counts: NDArray[np.uint16]
) -> None:
    """Count points in cells (3, n): all, those between the first two heights, those between the last two."""
    low, high, highest = limits
    for p in range(len(cells)):
        cell = cells[p]
        if counts[0, cell] == MOST:
            continue
        counts[0, cell] += 1
        if low <= heights[p] <= high:
            counts[1, cell] += 1
        elif high < heights[p] < highest:
            counts[2, cell] += 1


def _no_vines(everything: Counts, canopy: Counts, tall: Counts, resolution: float) -> Flags:
    """Cells (ny, nx) of objects taller or wider than a row of vines, with half a metre around them.

    Parameters are counts (ny, nx) of all points, of those at the canopy's heights and of those above.
    """
    k = max(1, round(BLOCK / resolution))
    cell = k * resolution
    # Summed over 3 x 3 blocks, so that a sparse cloud is judged by more than a point or two.
    all_, low, above = (9 * uniform_filter(block_sum(v, k), 3) for v in (everything, canopy, tall))
    mass = low + above
    high = binary_opening((above > 2.5) & (above > 0.15 * all_), np.ones((3, 3)))
    wide = binary_opening(mass > 0.5 * np.maximum(all_, 1), _disc(WIDEST / 2, cell))
    out: Flags = binary_dilation(high | wide, _disc(0.5, cell))
    return out.repeat(k, axis=0).repeat(k, axis=1)[: everything.shape[0], : everything.shape[1]]


def _disc(radius: float, cell: float) -> Flags:
    """Cells whose centre lies within a radius of the middle one's."""
    n = int(radius / cell)
    out: Flags = np.hypot(*np.mgrid[-n : n + 1, -n : n + 1]) * cell <= radius
    return out
