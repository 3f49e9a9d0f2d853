"""Where rows end that are known: where they are said to, or where canopy is seen to near there."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.geo.curve import between, way_along
from vinemap.rows.standing.canopy import ACROSS, SHORTEST, Standing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Values

NEAR, SPREAD = 0.25, 4.0
"""Metres, and times that known ends are off in the median, by which one may be."""


class Known(NamedTuple):
    """What is known of a row."""

    start: float
    """Metres at which it begins, along the curve on which it is looked for."""
    end: float
    """Metres at which it ends."""
    slack: float
    """Metres by which either may be off."""
    moves: bool
    """Whether its course may be off."""
    least: float
    """Metres of full cover across it, below which there is no canopy."""


def cut_as_known(rows: Sequence[Standing], known: Sequence[Known]) -> list[Standing]:
    """Cut rows to where they are known to begin and end, or to canopy that is seen to do so near there.

    How near is told by all: where most known ends lie by canopy's, a row's missing vines don't shorten it.
    """
    bounds = np.array([(one.start, one.end) for one in known])
    seen = np.array([_ends_near(row, one) for row, one in zip(rows, known, strict=True)])
    off = np.abs(seen - bounds)
    most = NEAR + SPREAD * float(np.median(off[np.isfinite(off)])) if np.isfinite(off).any() else 0.0
    places = np.where(off <= most, seen, bounds)
    whole = np.diff(places) > 0
    places = np.where(whole, places, bounds)
    out = []
    for row, (start, end), (first, last) in zip(rows, places, (off <= most) & whole, strict=True):
        runs = np.clip(row.runs, start, end)
        runs = runs[np.diff(runs, axis=1)[:, 0] > 0]
        curve = between(row.curve, start, end)
        out.append(Standing(curve, runs - start, row.contrast, told=(bool(first), bool(last))))
    return out


def _ends_near(row: Standing, known: Known) -> tuple[float, float]:
    """Metres at which a row's canopy is seen to begin and end near where it is known to; NaN where it isn't."""
    whole = float(way_along(row.curve)[-1])
    first = _end_near(whole - row.runs[::-1, ::-1], row.sides[::-1], whole - known.start, whole, known.slack)
    return whole - first, _end_near(row.runs, row.sides, known.end, whole, known.slack)


def _end_near(runs: Values, sides: Values, known: float, whole: float, slack: float) -> float:
    """Metres at which the last run of canopy near a known end ends, and no hedge or row across; NaN where none does.

    What is looked at ends far beyond, or half way to another row.
    """
    ends = (runs[:, 1] <= whole - SHORTEST) | (whole - known < slack)
    near = (np.abs(runs[:, 1] - known) <= slack) & ends
    own = np.flatnonzero(near & ((runs[:, 0] < known) | (sides <= ACROSS)))
    return float(runs[own[-1], 1]) if len(own) else np.nan
