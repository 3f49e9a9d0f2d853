"""Things that are flat, as cars, pallets and roofs are and leaves never are: no vines, however narrow they may be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_dilation, label

from vinemap.compute.threads import in_threads, strips
from vinemap.surfaces.statistics import LOWEST

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Values
    from vinemap.compute.threads import Strip
    from vinemap.geo.raster import Raster

EVEN = 0.1
"""How far what is flat lies off a plane through 3 x 3 cells, in what is usual of all that stands there."""
SMALL, LARGE = 0.25, 0.5
"""Square metres that are flat of a thing, most of which is; and of one that may hang together with others."""
MOST = 0.5
"""Share of a thing that is flat."""
AROUND = np.ones((3, 3))
"""A cell and those beside it."""


def flat_things(chm: Raster, high: float) -> Flags:
    """Cells (ny, nx) of things that are flat, or flat in part: far evener than the canopies thereabouts.

    Parameters
    ----------
    chm : Raster
        Canopy height.
    high : float
        Height in metres above which there are no vines.
    """
    heights = np.nan_to_num(chm.values).astype(np.float32)
    out: Flags = np.zeros(heights.shape, dtype=bool)
    standing = heights >= LOWEST
    canopy = standing & (heights <= high)
    if not canopy.any():
        return out
    around = sliding_window_view(np.pad(heights, 1), (3, 3))
    rough = _roughness(around, standing)
    even = standing & (rough <= EVEN * np.median(rough[canopy]))
    even[even] = around[even].min(axis=(1, 2)) >= LOWEST
    if even.any():
        places, things = label(even)[0], label(standing, AROUND)[0]
        area = np.bincount(places.ravel()) * chm.grid.resolution**2
        area[0] = 0.0
        small, large = (binary_dilation((area >= least)[places], AROUND) for least in (SMALL, LARGE))
        share = np.bincount(things.ravel(), small.ravel()) / np.maximum(np.bincount(things.ravel()), 1)
        out |= large | (standing & (share >= MOST)[things])
    return out


def _roughness(around: Values, where: Flags) -> Values:
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
