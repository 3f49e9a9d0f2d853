"""Canopy cover: the raster in which rows are sought."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from scipy.ndimage import (
    binary_dilation,
    binary_erosion,
    binary_opening,
    gaussian_filter,
    label,
    uniform_filter,
)

from vinemap.compute.compiled import compiled
from vinemap.compute.filters import distance_to
from vinemap.compute.threads import in_threads, strips
from vinemap.geo.raster import Grid, Raster, block_sum, cell_of, cells_in, coarser, grid_over, nearest_cell, spread
from vinemap.surfaces.statistics import LOWEST, height_about
from vinemap.surfaces.things import flat_things, trees

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Values
    from vinemap.compute.threads import Strip

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
MARGIN = 0.5
"""Metres about what is no row in which there is none."""
TOUCHING = 1.4
"""Metres of closed canopy from which rows may touch."""
ENOUGH = 8
"""Points of a block that tell what it is; where there are fewer, those beside it help."""
ABOUT = 6.0
"""Metres about rows that touch in which rows are told by where they stand apart, unless they are narrow or lower."""
PLANTS, BROAD, FEW = 0.25, 0.9, 0.2
"""Share of a block's points that are canopy where something grows, metres across which a row isn't narrow, and share of
a row that may be as broad, or as high as those that touch, all the same."""
FOOT, LEAST = 0.4, 0.2
"""Share of the canopies' height, and metres, from which low canopies are told from what grows beneath them."""
FAINT, DOUBLE, SOME = 0.65, 2.0, 0.1
"""Shares of the height from which something is a canopy: low canopies between these are one planting, all of which
counts where at least so much of it reaches that height."""
RIDGE = 0.75
"""Share of the canopies' height above which rows stand apart that touch below it."""
ROOF, FULL, UPPER = 5.0, 0.9, 0.75
"""Metres across which a roof of leaves is closed, share of it that reaches above that share of its height, and order of
the heights thereabouts that is its height: posts and single shoots don't tell it."""


class Levels(NamedTuple):
    """Heights above ground from which points are canopy, in metres, in cells of 1 m; and what hides some."""

    body: Raster
    """Of canopies whole."""
    ridge: Raster
    """Of what stands apart: the same but where rows touch."""
    crowns: Flags
    """Cells (ny, nx) of the height model beneath crowns of trees."""

    @property
    def touching(self) -> Flags:
        """Cells where they differ."""
        out: Flags = self.ridge.values > self.body.values
        return out


def canopy_cover(
    cloud: Cloud,
    chm: Raster,
    rows: gpd.GeoDataFrame | None = None,
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
    rows : GeoDataFrame, optional
        LineString with ``spacing_m``: known rows. Between them, and within half a spacing, nothing is too wide or flat.
    resolution : float
        Cell size in metres.
    low, high : float
        Heights in metres between which points count as canopy, the lower at the most where rows stand apart. What is
        taller (trees, houses) or wider than a row of vines (huts, hedges, bushes) is left out, or flat (cars, pallets),
        or far taller than the vines thereabouts and compact (trees).
    smoothing : float, optional
        Standard deviation in metres of the Gaussian that smooths both counts; by default the cloud's mean distance
        between points, and half a cell at the least.

    Returns
    -------
    cover : Raster
        0–1.
    levels : Levels
        Heights from which points count as canopy, and where trees stand.
    """
    grid = grid_over(*cloud.extent, resolution=resolution)
    flat, lone = (_grown(find(chm, high), MARGIN, chm.grid.resolution) for find in (flat_things, trees))
    top = height_about(replace(chm, values=np.where(flat | lone, np.nan, chm.values)), high)
    foot = np.where(_grows(top), np.clip(FOOT * top, LEAST, low), low).astype(np.float32)
    ridge = np.maximum(RIDGE * top, foot).astype(np.float32)
    metres = coarser(chm.grid, resolution=1.0)
    counts = _counts(cloud, grid, metres, (foot, ridge), high)
    everything, body, crown, _ = counts
    k, side = _cells_a_block(resolution), _side(resolution)
    blocks = [block_sum(layer, k).astype(np.float32) for layer in counts]
    squares = Grid(grid.west, grid.north, side, *blocks[0].shape)
    about = _about(rows, squares)
    things = (spread(flat, chm.grid, squares) & ~about) | spread(lone, chm.grid, squares)
    touching = closed = _closed(blocks[0], np.where(things, 0, blocks[1] + blocks[3]), side, TOUCHING)
    if touching.any():
        touching = closed & ~_grown(_closed(blocks[0], blocks[2] + blocks[3], side, WIDEST), WIDEST, side)
    roofs = _roofs(chm, everything, body, grid, high)
    if about.any():
        roofs &= ~spread(about, squares, chm.grid)
    apart = _apart(touching, closed, blocks[:3], squares, metres)
    apart.ravel()[cells_in(metres, chm.grid)[roofs]] = False
    of_body, of_ridge = (Raster(level, metres, cloud.crs) for level in (foot, np.where(apart, ridge, foot)))
    canopy = body
    if apart.any():
        canopy = np.where(spread(apart, metres, grid), crown, body)
        blocks[1] = block_sum(canopy, k).astype(np.float32)
    density = cloud.size / max(1, int(np.count_nonzero(everything)))
    sigma = max(0.5, density**-0.5) if smoothing is None else smoothing / resolution
    cover = _share(canopy, everything, sigma, 0.1 * density)
    no_vines = things | _no_vines(blocks[0], blocks[1], blocks[3], side, about)
    cover[no_vines.repeat(k, axis=0).repeat(k, axis=1)[: grid.ny, : grid.nx]] = 0.0
    if roofs.any():
        cover[spread(_grown(roofs, MARGIN, chm.grid.resolution), chm.grid, grid)] = 0.0
    return Raster(cover, grid, cloud.crs), Levels(of_body, of_ridge, lone)


def _grows(top: Values) -> Flags:
    """Cells (ny, nx) in which canopies grow, by their height, and not grass: of low ones the lowest, too."""
    out: Flags = top >= LOWEST
    part = label((top >= FAINT * LOWEST) & (top < DOUBLE * LOWEST), np.ones((3, 3)))[0]
    share = np.bincount(part[out], minlength=part.max() + 1) / np.maximum(np.bincount(part.ravel()), 1)
    out |= (part > 0) & (share >= SOME)[part]
    return out


def _share(canopy: Counts, everything: Counts, sigma: float, more: float) -> Values:
    """Points (ny, nx) of canopy by all points and so many more, both blurred by a Gaussian of sigma cells."""
    reach, cover = int(4 * sigma + 0.5), np.empty(canopy.shape, dtype=np.float32)

    def share(strip: Strip) -> None:
        blurred = (gaussian_filter(layer[strip.around], sigma, output=np.float32) for layer in (canopy, everything))
        some, of_all = (layer[strip.inner] for layer in blurred)
        np.divide(some, of_all + np.float32(more), out=cover[strip.own])

    in_threads(share, strips(canopy.shape, beside=reach))
    return cover


def _apart(touching: Flags, closed: Flags, counts: Sequence[Values], blocks: Grid, metres: Grid) -> Flags:
    """Cells of 1 m in which rows are told by where they stand apart: those where they touch, and those about them.

    So a row is cut at one level as far as it is as wide. What lies beside those that touch keeps its own level if it is
    narrow, or lower than they are. Counts are of all points in blocks of cells, of canopy, and of those above where
    rows stand apart.
    """
    if not touching.any():
        return np.zeros(metres.shape, dtype=bool)
    cells = cells_in(metres, blocks)

    def any_of(where: Flags) -> Flags:
        out: Flags = np.bincount(cells[where], minlength=metres.ny * metres.nx).reshape(metres.shape) > 0
        return out

    everything, plants, high = counts
    held = _grown(any_of(touching), ABOUT, metres.resolution)
    growing = (plants > PLANTS * everything) & held.ravel()[cells]
    free = growing & ~_grown(closed, MARGIN, blocks.resolution)
    if not free.any():
        return held
    part = label(free, np.ones((3, 3)))[0][free]
    wide = _closed(everything, plants, blocks.resolution, BROAD)
    broad, reaching = (
        np.bincount(part, of[free]) > FEW * np.bincount(part) for of in (wide, high > PLANTS * everything)
    )
    own = np.zeros_like(free)
    own[free] = ~(broad & reaching)[part]
    if own.any():
        held &= distance_to(any_of(growing & ~own)) <= distance_to(any_of(own))
    return held


def _roofs(chm: Raster, everything: Counts, body: Counts, grid: Grid, high: float) -> Flags:
    """Cells (ny, nx) of the height model where canopy is closed across some metres, and no alley shows in its top."""
    metres = coarser(chm.grid, resolution=1.0)
    cells = cells_in(metres, chm.grid)
    level = np.maximum(RIDGE * height_about(chm, high, order=UPPER), LOWEST).ravel()
    top: Flags = (chm.values >= level[cells]) & (chm.values <= high)
    known = np.bincount(cells[np.isfinite(chm.values)], minlength=level.size)

    def closed(where: Flags) -> Flags:
        full = np.bincount(cells[where], minlength=level.size) >= np.maximum(FULL * known, 1)
        out: Flags = binary_opening(full.reshape(metres.shape), _disc(ROOF / 2, metres.resolution)).ravel()[cells]
        return out

    roofs = top & closed(top)
    if roofs.any():
        about = cells_in(chm.grid, grid).ravel()
        points, leaves = (np.bincount(about, n.ravel(), top.size).astype(np.float64) for n in (everything, body))
        share = _around(leaves.reshape(top.shape)) / np.maximum(_around(points.reshape(top.shape)), 1)
        roofs &= closed(top & (share > 0.5))
    if roofs.any():
        # At their edges fewer points are leaves.
        roofs = binary_dilation(roofs, mask=top, iterations=max(1, round(WIDEST / chm.grid.resolution)))
    return roofs


def _counts(cloud: Cloud, grid: Grid, metres: Grid, levels: tuple[Values, Values], high: float) -> Counts:
    """Points (4, ny, nx) in cells: all, those from each of two levels to a height, and those above."""
    counts = np.zeros((4, grid.ny * grid.nx), dtype=np.uint16)
    for part in cloud.parts():
        for start in range(0, part.size, BATCH):
            batch = slice(start, start + BATCH)
            xyz, heights = part.xyz[batch], part.heights[batch]
            _count(cell_of(xyz, grid), xyz, heights, levels, metres, (high, TALLEST), counts)
    return counts.reshape(4, *grid.shape)


@compiled
def _count(
    cells: NDArray[np.int32],
    xyz: Values,
    heights: Values,
    levels: tuple[Values, Values],
    metres: Grid,
    limits: tuple[float, float],
    counts: NDArray[np.uint16],
) -> None:
    """Count points in cells (4, n): all, those from either level there to a height, those from it to a highest."""
    lower, upper = levels
    high, highest = limits
    for p in range(len(cells)):
        cell = cells[p]
        if counts[0, cell] == MOST:
            continue
        counts[0, cell] += 1
        i, j = nearest_cell(metres, xyz[p, 0], xyz[p, 1])
        if lower[i, j] <= heights[p] <= high:
            counts[1, cell] += 1
            if heights[p] >= upper[i, j]:
                counts[2, cell] += 1
        elif high < heights[p] < highest:
            counts[3, cell] += 1


def _closed(total: Values, high: Values, side: float, width: float) -> Flags:
    """Blocks of cells over which canopy is closed across some metres, from the numbers of their points."""
    if np.median(total[total > 0]) < ENOUGH:
        closed = _around(high) > 0.5 * np.maximum(_around(total), 1)
    else:
        closed = uniform_filter((high > 0.5 * np.maximum(total, 1)).astype(np.float32), 3) > 0.5
    return _grown(binary_erosion(closed, _disc(width / 2, side)), width / 2, side)


def _about(rows: gpd.GeoDataFrame | None, blocks: Grid) -> Flags:
    """Blocks of cells between known rows, and within half a spacing of them."""
    if rows is None:
        return np.zeros(blocks.shape, dtype=bool)
    spacing = rows["spacing_m"].to_numpy()
    alleys = shapely.union_all(shapely.buffer(shapely.force_2d(rows.geometry.to_numpy()), spacing))
    inside = shapely.buffer(alleys, -float(np.median(spacing)) / 2)
    out: Flags = np.asarray(shapely.contains_xy(inside, *np.meshgrid(*blocks.centres())))
    return out


def _no_vines(total: Values, canopy: Values, above: Values, side: float, rows: Flags) -> Flags:
    """Blocks of cells of objects taller, or but for known rows wider, than vines, with half a metre around them."""
    tall = _around(above)
    high = binary_opening((tall > 2.5) & (tall > 0.15 * _around(total)), np.ones((3, 3)))
    return _grown(high | (_closed(total, canopy + above, side, WIDEST) & ~rows), MARGIN, side)


def _around(blocks: Values) -> Values:
    """Sums over 3 x 3 blocks, so that a sparse cloud is judged by more than a point or two."""
    out: Values = 9 * uniform_filter(blocks, 3)
    return out


def _cells_a_block(resolution: float) -> int:
    """Cells along a block's side."""
    return max(1, round(BLOCK / resolution))


def _side(resolution: float) -> float:
    """Metres of a block of cells."""
    return _cells_a_block(resolution) * resolution


def _grown(cells: Flags, radius: float, side: float) -> Flags:
    """Cells, and those within some metres of them."""
    if not cells.any():
        return cells
    out: Flags = distance_to(cells) * side <= radius
    return out


def _disc(radius: float, cell: float) -> Flags:
    """Cells whose centre lies within a radius of the middle one's."""
    n = int(radius / cell)
    out: Flags = np.hypot(*np.mgrid[-n : n + 1, -n : n + 1]) * cell <= radius
    return out
