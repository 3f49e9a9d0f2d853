"""The foot of the foliage: where it begins above the soil, told by the sections around."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vinemap.compute.compiled import compiled

if TYPE_CHECKING:
    from vinemap.canopy.points import Sections
    from vinemap.compute.arrays import Ints, Values

FOOT_BIN = 0.025
"""Metres: bins of the histograms that tell the foliage's foot."""
FOOT_RANKS = 0.02, 0.1
"""Orders of the heights through which the line is drawn that falls to no points at the foot."""
FOOT_BAND, FOOT_SPREAD = 0.15, 0.8
"""Metres above the foot whose points tell how wide the canopy stands on it, and the quantile that is its side."""


def find_feet(canopy: Sections, *, pool: float = 5.0) -> tuple[Sections, Values]:
    """Find where the foliage of every section begins: the c-gon's fixed vertices v1, v2 and vc.

    The thesis sets them at soil level, where the polygon takes in the void under the canopy; here they lie at the
    foliage's foot: v1 under its middle, v2 and vc at its sides. A section's few points seldom show its foot, which
    seen from the air lies in the shade: the points of all sections within ``pool`` metres along the row tell it.

    Returns
    -------
    canopy : Sections
        Without the points below the foot.
    feet : (m, 3, 2) array
        v1, v2 (left of γ, positive y) and vc of every section, in metres of its frame.
    """
    m = len(canopy.row_id)
    if m == 0:
        return canopy, np.empty((0, 3, 2))
    near = _window(canopy, pool)
    levels = _pooled(_histograms(canopy.points[:, 1].copy(), canopy.start, 0.0, FOOT_BIN, round(3 / FOOT_BIN)), near)
    low, high = (_rank(levels, q) * FOOT_BIN for q in FOOT_RANKS)
    foot = low - FOOT_RANKS[0] / (FOOT_RANKS[1] - FOOT_RANKS[0]) * (high - low)
    canopy = canopy.subset(canopy.points[:, 1] >= np.repeat(foot, np.diff(canopy.start)))
    above = canopy.points[:, 1] <= np.repeat(foot + FOOT_BAND, np.diff(canopy.start))
    # Points higher up go to a bin of their own, that doesn't count.
    half = FOOT_BIN * math.ceil(float(np.abs(canopy.points[:, 0]).max(initial=FOOT_BIN)) / FOOT_BIN + 1)
    across = np.where(above, canopy.points[:, 0], 2 * half)
    widths = _pooled(_histograms(across, canopy.start, -half, FOOT_BIN, round(2 * half / FOOT_BIN) + 1)[:, :-1], near)
    right, left = (_rank(widths, q) * FOOT_BIN - half for q in (1 - FOOT_SPREAD, FOOT_SPREAD))
    feet = np.stack([(left + right) / 2, foot, left, foot, right, foot], axis=-1).reshape(m, 3, 2)
    return canopy, feet


def _window(canopy: Sections, reach: float) -> tuple[Ints, Ints]:
    """First and last + 1 of the sections (m,) of the same row within reach of each."""
    row = np.unique(canopy.row_id, return_inverse=True)[1]
    key = row * (canopy.position.max() + 3 * reach) + canopy.position
    return np.searchsorted(key, key - reach), np.searchsorted(key, key + reach, side="right")


def _pooled(histograms: Values, near: tuple[Ints, Ints]) -> Values:
    """Sums (m, bins) of the histograms of the sections in each one's window."""
    before = np.concatenate([np.zeros((1, histograms.shape[1])), np.cumsum(histograms, axis=0)])
    out: Values = before[near[1]] - before[near[0]]
    return out


@compiled
def _histograms(values: Values, start: Ints, low: float, width: float, bins: int) -> Values:
    """Histograms (m, bins) of each section's values; what lies beyond counts in the outer bins."""
    out = np.zeros((len(start) - 1, bins))
    for k in range(len(start) - 1):
        for p in range(start[k], start[k + 1]):
            out[k, min(max(int((values[p] - low) / width), 0), bins - 1)] += 1
    return out


@compiled
def _rank(histograms: Values, q: float) -> Values:
    """Quantile (m,) of histograms (m, bins), in bins."""
    out = np.zeros(len(histograms))
    m, bins = histograms.shape
    for k in range(m):
        total, before, i = 0.0, 0.0, 0
        for j in range(bins):
            total += histograms[k, j]
        wanted = q * total
        while before + histograms[k, i] < wanted:
            before += histograms[k, i]
            i += 1
        out[k] = i + (wanted - before) / max(histograms[k, i], 1e-9) if total else 0.5 * bins
    return out
