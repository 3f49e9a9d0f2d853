"""Ends and gaps of a row: where the canopy along it begins and stops."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from vinemap.geo.curve import between, way_along
from vinemap.rows.centre_line import CELL, runs_above

if TYPE_CHECKING:
    from vinemap.compute.arrays import Values

AROUND = 0.3
"""Metres, a standard deviation, of the surroundings with which the canopy of an end is compared."""
SHORTEST = 0.35
"""Metres of canopy along a row, below which it is a stray shoot or weed and no vine."""


class Standing(NamedTuple):
    """Curve (n, 2) between a row's ends, its runs of canopy (k, 2) in metres along it, and the canopy's contrast."""

    curve: Values
    runs: Values
    contrast: float


def cut_to_canopy(curve: Values, image: Values, end_share: float) -> Standing | None:
    """Cut a curve to where its canopy begins and ends; None where there is none."""
    profile = image.sum(axis=1) * CELL
    present = profile[profile > 0.3 * np.quantile(profile, 0.95)]
    if len(present) == 0:
        return None
    typical = float(np.median(present))
    # The last vine may be a weak one: what counts is the cover thereabouts, where there is canopy at all.
    living = np.clip((profile / typical - 0.2) / 0.2, 0, 1)
    near, weight = (gaussian_filter1d(v, AROUND / CELL, mode="constant") for v in (profile * living, living))
    profile *= typical / ((near + 0.1 * typical) / (weight + 0.1))
    edge = end_share * typical
    # Thin canopies have holes: what a weaker trace joins is one run, from its first to its last full edge.
    weak = runs_above(profile, 0.5 * edge)
    full = runs_above(profile, edge)
    runs = [(f[0, 0], f[-1, 1]) for a, b in weak if len(f := full[(full[:, 0] >= a) & (full[:, 1] <= b)])]
    metres = np.interp(np.reshape(runs, (-1, 2)), np.arange(len(curve)), way_along(curve))
    metres = metres[np.diff(metres, axis=1)[:, 0] >= SHORTEST]
    if len(metres) == 0:
        return None
    canopy = image[profile > edge]
    aside = max(1, canopy.shape[1] // 8)
    beside = np.concatenate([canopy[:, :aside], canopy[:, -aside:]], axis=1).mean()
    contrast = float(np.clip(1 - beside / canopy.max(axis=1).mean(), 0, 1))
    return Standing(between(curve, metres[0, 0], metres[-1, 1]), metres - metres[0, 0], contrast)
