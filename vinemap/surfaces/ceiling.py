"""What grows or hangs among vines and is none: strips of a cover crop, and nets through which the vines are seen.

Both are told from the canopy height model. Points above a ceiling are taken out of sight, and rows are sought in the
others.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import (
    binary_dilation,
    binary_opening,
    distance_transform_edt,
    find_objects,
    label,
    maximum_filter,
    uniform_filter,
)

from vinemap.compute.filters import distance_to
from vinemap.geo.raster import Raster, coarser, spread
from vinemap.surfaces.canopy_height import canopy_height_model
from vinemap.surfaces.statistics import LOWEST, height_about

if TYPE_CHECKING:
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Grid

LOWER, BROADER, LONG = 0.75, 1.65, 2.0
"""Height at the most and width at the least of a strip of a cover crop, in those of the rows on both sides of it, and
its length in its own widths."""
BOTH_SIDES = 0.2
"""Share of its length along which a strip has rows on both sides at the least, as there are gaps in rows."""
NEXT = (1.8, 2.2)
"""Half widths of an alley with a strip, from a row to the next one: between two curtains foliage is lower, too."""
MOST, MUCH = 0.6, 0.1
"""Share of what is lower than rows that strips of a cover crop are, where there are any, and its area in the rows'."""
GRASS = 0.25
"""Metres of height below which there is none."""
ENOUGH = 32
"""Points that tell how high something grows."""
CORNERS = np.ones((3, 3))
"""What touches at a corner hangs together."""
SOIL = 0.2
"""Metres above ground up to which a strip's points are soil's."""
FLAT, AIR, FREE = 0.9, 0.8, 0.1
"""Share of a net's height that all of it reaches, share down to which there is air beneath it, and share of the net
under which there may be something all the same."""
WIDE, CLOSED, MESH = 6.0, 0.35, 1.25
"""Metres across which a net is closed, and share of its cells, in squares of so many metres, that are."""
BENEATH, THROUGH = 0.1, 0.85
"""Share of the ground under a net on which vines stand, at the least and at the most."""


def heights_of_vines(
    points: Cloud, dtm: Raster, *, resolution: float = 0.25, high: float = 3.6
) -> tuple[Cloud, Raster]:
    """Heights of a cloud's points above ground, without cover crops and nets, and the canopy height model of them.

    Parameters
    ----------
    points : PointCloud or TiledCloud
        The parcel's points.
    dtm : Raster
        Terrain.
    resolution : float
        Cell size in metres of the canopy height model, that of the terrain.
    high : float
        Height in metres above which there are no vines.

    Returns
    -------
    cloud : PointCloud or TiledCloud
        The points with their heights; those of nets and of cover crops are below ground.
    chm : Raster
        Canopy height.
    """
    cloud = points.above(dtm)
    chm = canopy_height_model(cloud, resolution=resolution)
    ceiling = np.full(chm.grid.shape, np.inf, dtype=np.float32)

    def below() -> tuple[Cloud, Raster]:
        seen = points.above(dtm, replace(chm, values=ceiling))
        return seen, canopy_height_model(seen, resolution=resolution)

    net = _nets(chm)
    if net.any():
        ceiling = np.where(net > 0, FLAT * net, np.inf).astype(np.float32)
        through, beneath = below()
        under, net = np.nan_to_num(beneath.values[net > 0]), net[net > 0]
        if BENEATH <= np.mean(under >= LOWEST) <= THROUGH and np.mean(under > AIR * net) <= FREE:
            cloud, chm = through, beneath
        else:
            ceiling[:] = np.inf
    crops = _cover_crops(chm, high, cloud.size / max(1, int(np.count_nonzero(np.isfinite(chm.values)))))
    if crops.any():
        ceiling[crops] = SOIL
        cloud, chm = below()
    return cloud, chm


def _nets(chm: Raster) -> Values:
    """Height (ny, nx) of what is flat and closed across some metres, 0 elsewhere."""
    cell = chm.grid.resolution
    height = _in_cells(height_about(chm, np.inf, order=0.5), chm.grid)
    flat = (height >= LOWEST) & (np.abs(np.nan_to_num(chm.values) - height) <= (1 - FLAT) * height)
    if np.count_nonzero(flat) * cell**2 < CLOSED * WIDE**2:
        return np.zeros(chm.grid.shape)
    closed = uniform_filter(flat.astype(np.float32), max(1, round(MESH / cell))) >= CLOSED
    middle = distance_to(~np.pad(closed, 1))[1:-1, 1:-1] * cell > WIDE / 2
    if not middle.any():
        return np.zeros(chm.grid.shape)
    # What is closed ends before the corners and a ragged edge do.
    return np.where(flat & (distance_to(middle) * cell <= WIDE), height, 0.0)


def _in_cells(heights: Values, grid: Grid) -> Values:
    """What :func:`vinemap.surfaces.statistics.height_about` gives, in the cells (ny, nx) of the height model."""
    out: Values = spread(heights, coarser(grid, resolution=1.0), grid)
    return out


def _cover_crops(chm: Raster, high: float, density: float) -> Flags:
    """Cells (ny, nx) of long strips that are lower and broader than the rows on both sides of them.

    A row of young vines between old ones is lower, too, but no broader. Where most of what is lower is such strips, all
    of it that is as broad is a cover crop, as at a block's edge. ``density`` is the mean number of points in a cell.
    """
    out: Flags = np.zeros(chm.grid.shape, dtype=bool)
    across = 2 * round((np.sqrt(ENOUGH / density) - 1) / 2) + 1
    tall, low = _tall_and_low(chm, high, across)
    strips, width, length, depth = _parts(low)
    long = (length >= LONG * width) & (width >= BROADER)
    most = MOST * np.count_nonzero(low)
    if np.count_nonzero(low) < MUCH * np.count_nonzero(tall) or np.count_nonzero(long[strips] & low) < most:
        return out
    rows, row_width, row_length, _ = _parts(tall)
    row = tall & (row_length >= LONG * row_width)[rows]  # and no post
    if not row.any():
        return out
    i, j = np.nonzero(low & (depth >= maximum_filter(depth, 3)))
    away, nearest = distance_transform_edt(~row, return_indices=True)
    a, b = nearest[:, i, j]
    half, wide = away[i, j], row_width[rows[a, b]]

    def a_row_stands(beyond: Values) -> Flags:
        """Whether a row stands so many cells beyond the row beside a strip."""
        there = ((q + beyond * (q - p) / half).round().astype(int) for p, q in zip((i, j), (a, b), strict=True))
        at = tuple(np.clip(k, 0, n - 1) for k, n in zip(there, low.shape, strict=True))
        beside: Flags = away[at] <= 0.5 * half
        return beside

    strip = strips[i, j]
    n = np.maximum(np.bincount(strip, minlength=len(width)), 1)
    among = a_row_stands(-2 * half) & np.any([a_row_stands(wide + times * half) for times in NEXT], axis=0)
    between = np.bincount(strip, among, minlength=len(width)) / n
    broader = width >= BROADER * np.bincount(strip, wide, minlength=len(width)) / n
    crops = (long & broader & (between >= BOTH_SIDES))[strips] & low
    if np.count_nonzero(crops) >= most:
        out = low & broader[strips]
        if across == 1:  # what was opened lacks its edges
            out = binary_dilation(out, CORNERS) & ~tall
    return out


def _tall_and_low(chm: Raster, high: float, across: int) -> tuple[Flags, Flags]:
    """Cells (ny, nx) with what is as high as rows thereabouts, and with what is lower, but no grass.

    Where cells have so few points that one shows a single stalk, and the next nothing, those in squares of so many
    cells ``across`` tell what grows in their middle.
    """
    top = _in_cells(height_about(chm, high), chm.grid)
    height = np.where(np.isnan(chm.values), maximum_filter(np.nan_to_num(chm.values), 3), chm.values)
    vines = (top >= LOWEST) & (height >= GRASS) & (height <= high)
    tall = vines & (height >= LOWER * top)
    low = vines & ~tall
    if across > 1:
        # As many as a row has that is one cell wide.
        tall &= _share(tall, across) > 0.9 / across
        low = ~tall & (_share(vines & ~tall, across) > 0.5 * _share(~tall, across))
    return tall, binary_opening(low, CORNERS)


def _share(mask: Flags, across: int) -> Values:
    """Share (ny, nx) of the cells in squares of so many across."""
    out: Values = uniform_filter(mask.astype(np.float32), across)
    return out


def _parts(mask: Flags) -> tuple[Ints, Values, Values, Values]:
    """Numbers (ny, nx) of the parts that hang together, their width and length (n + 1,), and cells' depth, in cells."""
    parts = label(mask, CORNERS)[0]
    depth = distance_to(~np.pad(mask, 1))[1:-1, 1:-1]
    n = np.maximum(np.bincount(parts.ravel()), 1)
    # Cells are 1, 2, …, 2, 1 deep across a part, of which those at both edges are canopy in half.
    width = 4 * np.bincount(parts.ravel(), depth.ravel()) / n - 3
    length = [np.hypot(*(side.stop - side.start for side in box)) for box in find_objects(parts)]
    return parts, width, np.array([0.0, *length]), depth
