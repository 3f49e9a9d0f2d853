"""The foot of the foliage: where it begins above the soil, told by the sections around."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vinemap.compute.compiled import compiled

if TYPE_CHECKING:
    from vinemap.canopy.points import Sections
    from vinemap.compute.arrays import Flags, Ints, Values

POOL = 5.0
"""Metres along a row within which sections tell each other's foot."""
FOOT_BIN, HIGHEST = 0.025, 3.0
"""Metres: bins of the histograms that tell the foliage's foot, and up to where they reach."""
FOOT_RANKS = 0.02, 0.1
"""Orders of the heights through which the line is drawn that falls to no points at the foot."""
FOOT_SIDES, FOOT_WIDTH = 0.5, 0.9
"""Share of a canopy's half width from which on its points show its sides, and the quantile that is its half width."""
FOOT_DEPTH, FOOT_STRAYS, FOOT_EDGE = 0.15, 3.0, 0.15
"""Share of a canopy's depth over which sides are looked at above and below a foot, points there that may be strays, and
the order of the heights above that is the foot."""
FOOT_BAND, FOOT_SPREAD = 0.15, 0.5
"""Metres above the foot whose points tell how wide the canopy stands on it, and the quantile of those of a side that is
where it ends."""


def find_feet(canopy: Sections) -> tuple[Sections, Values]:
    """Find where the foliage of every section begins: the c-gon's fixed vertices v1, v2 and vc.

    The thesis sets them at soil level, where the polygon takes in the void under the canopy; here they lie at the
    foliage's foot: v1 under its middle, v2 and vc at its sides. A section's few points seldom show its foot, which
    seen from the air lies in the shade: the points of all sections within ``POOL`` along the row tell it.

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
    near = _window(canopy, POOL)
    foot = _foot(canopy, near)
    canopy = canopy.subset(canopy.points[:, 1] >= np.repeat(foot, np.diff(canopy.start)))
    above = canopy.points[:, 1] <= np.repeat(foot + FOOT_BAND, np.diff(canopy.start))
    right, left = _sides(canopy, above, near)
    feet = np.stack([(left - right) / 2, foot, left, foot, -right, foot], axis=-1).reshape(m, 3, 2)
    return canopy, feet


def _foot(canopy: Sections, near: tuple[Ints, Ints]) -> Values:
    """Heights (m,) where the foliage of sections begins, told by those in each one's window.

    Few of its points lie there, the fewer the wider it is and the more it hides, but next to none below: the foot is
    where points on its sides become most times as many, from below to above, or lower, where all points thin out.
    """
    bins = round(HIGHEST / FOOT_BIN)
    across, height = np.abs(canopy.points[:, 0]), canopy.points[:, 1].copy()
    levels = _pooled(_histograms(height, canopy.start, bins), near)
    half_width = _rank(_pooled(_histograms(across, canopy.start, bins), near), FOOT_WIDTH) * FOOT_BIN
    middle = across < FOOT_SIDES * np.repeat(half_width, np.diff(canopy.start))
    height = np.where(middle, HIGHEST + FOOT_BIN, height)
    sides = _pooled(_histograms(height, canopy.start, bins + 1)[:, :-1], near)
    low, high, half, top = (_rank(levels, q) for q in (*FOOT_RANKS, 0.5, 1 - FOOT_RANKS[0]))
    thins_out = low - FOOT_RANKS[0] / (FOOT_RANKS[1] - FOOT_RANKS[0]) * (high - low)
    reach = FOOT_DEPTH * (top - thins_out)
    return np.maximum(np.minimum(thins_out, _rise(sides, reach, half)), 0) * FOOT_BIN


def _sides(canopy: Sections, at_foot: Flags, near: tuple[Ints, Ints]) -> Values:
    """How far (2, m) to the right and left sections reach at their feet, told by those in each one's window.

    A side of which next to nothing was seen there is as far as the other, but no farther from it than the canopy is
    wide at any height, as the foot of one that leans isn't in its middle. A foot of which nothing was seen is a point.
    """
    across = canopy.points[:, 0]
    bins = math.ceil(float(np.abs(across).max(initial=FOOT_BIN)) / FOOT_BIN) + 1
    beyond = FOOT_BIN * (bins + 1)
    shown = [
        _pooled(_histograms(np.where(at_foot & (away >= 0), away, beyond), canopy.start, bins + 1), near)
        for away in (-across, across)
    ]
    right, left = (side[:, :-1] for side in shown)
    few = [side.sum(axis=1) <= FOOT_STRAYS for side in (right, left)]
    both = right + left
    out = np.array(
        [
            _rank(np.where(one_sided[:, None], both, side), FOOT_SPREAD) * FOOT_BIN
            for side, one_sided in zip((right, left), few, strict=True)
        ]
    )
    if np.any(few[0] != few[1]):
        farthest = _widest(canopy, near) - _rank(both, 1 - FOOT_RANKS[0]) * FOOT_BIN
        for side, one_sided, seen in zip(out, few, few[::-1], strict=True):
            hidden = one_sided & ~seen
            side[hidden] = np.minimum(side, farthest)[hidden]
    return out


def _widest(canopy: Sections, near: tuple[Ints, Ints]) -> Values:
    """Metres (m,) that sections are wide at the height at which they are widest, told by those in each one's window."""
    across, height = (canopy.points[:, k] - canopy.points[:, k].min() for k in (0, 1))
    bins, level = math.ceil(float(across.max()) / FOOT_BIN) + 1, np.floor(height / FOOT_BAND)
    out = np.zeros(len(canopy.row_id))
    for k in range(int(level.max()) + 1):
        shown = _histograms(np.where(level == k, across, FOOT_BIN * (bins + 1)), canopy.start, bins + 1)
        shown = _pooled(shown[:, :-1], near)
        out = np.maximum(out, (_rank(shown, 1 - FOOT_RANKS[0]) - _rank(shown, FOOT_RANKS[0])) * FOOT_BIN)
    return out


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
def _histograms(values: Values, start: Ints, bins: int) -> Values:
    """Histograms (m, bins) of each section's values, by ``FOOT_BIN``; what lies beyond counts in the outer bins."""
    out = np.zeros((len(start) - 1, bins))
    for k in range(len(start) - 1):
        for p in range(start[k], start[k + 1]):
            out[k, min(max(int(values[p] / FOOT_BIN), 0), bins - 1)] += 1
    return out


@compiled
def _rank(histograms: Values, q: float) -> Values:
    """Quantile (m,) of histograms (m, bins), in bins; 0 of empty ones."""
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
        out[k] = i + (wanted - before) / max(histograms[k, i], 1e-9) if total else 0.0
    return out


@compiled
def _rise(histograms: Values, reach: Values, up_to: Values) -> Values:
    """Bin (m,), up to one, from which on histograms (m, bins) of a canopy are most times what they are below it.

    That one itself where they rise nowhere.
    """
    m, bins = histograms.shape
    out = np.zeros(m)
    before = np.zeros(bins + 1)
    for k in range(m):
        for j in range(bins):
            before[j + 1] = before[j] + histograms[k, j]
        away = max(int(reach[k] + 0.5), 2)
        most, at = 1.0, min(int(up_to[k]), bins - 1)
        for j in range(at + 1):
            above, below = before[min(j + away, bins)] - before[j], before[j] - before[max(j - away, 0)]
            rise = (above + FOOT_STRAYS) / (below + FOOT_STRAYS)
            if rise > most:
                most, at = rise, j
        wanted = before[at] + FOOT_EDGE * (before[min(at + away, bins)] - before[at])
        while at < bins - 1 and before[at + 1] < wanted:
            at += 1
        out[k] = at + (wanted - before[at]) / max(histograms[k, at], 1e-9)
    return out
