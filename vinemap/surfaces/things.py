"""Compact things that are no vines, however narrow they may be: flat ones, as cars and pallets are, and trees.

Leaves are rough, but the tops of trimmed vines may be flat, too: what is as long as a row is left, and everything where
much is flat.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_dilation, label

from vinemap.compute.filters import distance_to
from vinemap.compute.threads import in_threads, strips
from vinemap.geo.raster import coarser, spread
from vinemap.surfaces.statistics import LOWEST, usual_height

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.compute.threads import Strip
    from vinemap.geo.raster import Raster

EVEN, AS_GROUND, EACH = 0.1, 2.0, 4
"""How far what is flat lies off a plane through 3 x 3 cells at the most, in what is usual of all that stands there, and
of the ground, of which every so manyth row and column tells."""
LEAST, MOST = 0.25, 0.5
"""Square metres that are flat in one piece, and share of a thing that such pieces are."""
EDGE = 2.0
"""Metres about what is flat that may be of the same thing, as windscreens are: vines that touch it reach farther."""
LONG, FEW = 3.5, 0.5
"""Length of a thing in its own widths from which on it may be vines, and share of what stands that is flat, at most."""
TALL, TALLER, TALLEST, TRUNK = 1.2, 1.5, 0.7, 1.0
"""Heights in that of the vines thereabouts from which on a place belongs to a tree and from which it tells one, which
is that much at the least of the height above which there are no vines: old vines among young ones are no trees. Square
metres of a tree that tell it."""
ROUND, FULL = 2.0, 0.85
"""Length of a tree in its own widths, at most, and share of its outline that it fills, at least."""
BESIDE = np.ones((3, 3))
"""A cell and those beside it."""


def flat_things(chm: Raster, high: float) -> Flags:
    """Cells (ny, nx) of things that are flat, far evener than the canopies, and compact.

    Parameters
    ----------
    chm : Raster
        Canopy height.
    high : float
        Height in metres above which there are no vines.
    """
    around, ground = around_cells(chm)
    heights = around[:, :, 1, 1]
    out: Flags = np.zeros(heights.shape, dtype=bool)
    standing = heights >= LOWEST
    canopy = standing & (heights <= high)
    if not canopy.any():
        return out
    rough = roughness(around, standing | ground)
    usual = AS_GROUND * np.median(rough[ground]) if ground.any() else np.inf
    even = standing & (rough <= min(EVEN * np.median(rough[canopy]), usual))
    even[even] = around[even].min(axis=(1, 2)) >= LOWEST
    places = label(even)[0]
    area = np.bincount(places.ravel()) * chm.grid.resolution**2
    area[0] = 0.0
    if area.max() < LEAST:
        return out
    pieces = (area >= LEAST)[places]
    smooth = binary_dilation(pieces, BESIDE)[standing]
    of = label(standing, BESIDE)[0][standing] - 1
    size = np.bincount(of)
    flat = np.bincount(of, smooth) >= MOST * size
    flat &= _shape(of, size, *np.nonzero(standing))[0] < LONG
    if size[flat].sum() <= FEW * len(of):
        out[standing] = flat[of]
        out &= distance_to(pieces) * chm.grid.resolution <= EDGE
    return out


def trees(chm: Raster, high: float) -> Flags:
    """Cells (ny, nx) of compact things that are far taller than the vines thereabouts, as trees among them are.

    Parameters are as of :func:`flat_things`.
    """
    heights = np.nan_to_num(chm.values)
    usual = spread(usual_height(chm, high), coarser(chm.grid, resolution=1.0), chm.grid)
    above: Flags = (heights >= TALL * usual) & (usual >= LOWEST)
    places, n = label(above, BESIDE)
    if n == 0:
        return above
    of = places[above] - 1
    size = np.bincount(of)
    tells = heights >= np.maximum(TALLER * usual, TALLEST * high)
    trunk = np.bincount(of, tells[above]) * chm.grid.resolution**2
    length, full = _shape(of, size, *np.nonzero(above))
    above[above] = ((trunk >= TRUNK) & (length < ROUND) & (full >= FULL))[of]
    return above


def _shape(of: Ints, size: Ints, y: Ints, x: Ints) -> tuple[Values, Values]:
    """How many times as long as wide things are (m,), of which cells (n,) at rows and columns belong to each.

    And which share of an ellipse of the same second moments they fill: rows that touch have alleys between them.
    """

    def mean(values: Values | Ints) -> Values:
        return np.bincount(of, values) / size

    columns, rows = mean(x), mean(y)
    xx, yy, xy = mean(x * x) - columns**2, mean(y * y) - rows**2, mean(x * y) - columns * rows
    half, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    cell = 1 / 12  # the second moment of one cell
    most, least = half + apart + cell, np.maximum(half - apart + cell, cell)
    return np.sqrt(most / least), size / (4 * np.pi * np.sqrt(most * least))


def around_cells(chm: Raster) -> tuple[Values, Flags]:
    """Heights (ny, nx, 3, 3) of a height model's cells and those beside them, and some (ny, nx) that are ground."""
    around = sliding_window_view(np.pad(np.nan_to_num(chm.values).astype(np.float32), 1), (3, 3))
    ground = np.zeros(chm.grid.shape, dtype=bool)
    known = np.isfinite(chm.values[::EACH, ::EACH])
    ground[::EACH, ::EACH] = known & (around[::EACH, ::EACH].max(axis=(2, 3)) < LOWEST / 2)
    return around, ground


def roughness(around: Values, where: Flags) -> Values:
    """Root mean square in metres by which heights (ny, nx, 3, 3) lie off a plane, where asked for; 0 elsewhere."""
    i, j = np.mgrid[-1:2, -1:2]
    plane = np.column_stack([np.ones(9), i.ravel(), j.ravel()])
    off = (np.eye(9) - plane @ np.linalg.pinv(plane)).astype(np.float32)
    out = np.zeros(where.shape, dtype=np.float32)

    def rough(strip: Strip) -> None:
        here = where[strip.own]
        heights = around[strip.own][here].reshape(-1, 9) @ off
        out[strip.own][here] = np.sqrt(np.einsum("kn,kn->k", heights, heights) / 9)

    in_threads(rough, strips(where.shape, beside=0))
    return out
