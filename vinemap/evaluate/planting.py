"""How far apart the vines of rows stand, and where, as told by the places at which canopy begins and ends.

Vines of a row stand at equal distances, from its one end to the other. Canopy begins and ends half a vine's extent from
a vine, at gaps and at the row's ends: the rows of a block together tell the distance of vines and their extent along
the row, and each row's own edges where its vines stand.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Ints, Values

NARROWEST, WIDEST = 0.7, 3.0
"""Metres between vines of a row, at the least and at the most."""
CLEAR, ORDERLY = 6.0, 0.3
"""Deviations of what edges without any order give, and share of what perfect order does, that make a spacing clear."""
LOWEST = 0.9
"""Share of the clearest distance's power that a multiple of it has, if that is the one."""
MOST = 1000
"""Gaps that tell the distance of vines: more make it no surer."""
HEDGE = 1.08
"""Vine spacings of row that a vine of a closed hedge fills: its shoots hang into gaps."""
HEADS = 0.8, 1.2
"""Vine spacings: the largest extent of vines that stand apart, and the longest canopy, on average, that they make."""
TOLD = 3.0
"""Deviations of chance from which gaps tell the extent of vines."""
ALONE = 0.4, 0.6
"""Vine spacings: the largest extent of vines that may stand for one more, and how long canopies then seldom are."""
SCATTER, ENDS = 0.08, 3.0
"""Vine spacings, a standard deviation, by which edges of canopy are off; times as much at the row's ends."""
PLANTED = 0.05
"""Vine spacings, a standard deviation, by which vines stand off their places."""
NORMAL = 0.6745
"""Standard deviations that half of all errors are within."""
FAR, STEPS = 2.0, 6
"""Deviations from which edges count less, and steps in which lattices settle."""
OWN = 0.3
"""Vines, a standard deviation, by which the rows' own spacing adds up along them."""


class Edges(NamedTuple):
    """Length of a row in metres, and where along it canopy ends (n,) and begins (n,): at gaps, and last at its ends."""

    length: float
    ends: Values
    begins: Values

    @property
    def gaps(self) -> Values:
        """Lengths (n - 1,) of gaps in metres."""
        out: Values = (self.begins - self.ends)[:-1]
        return out

    @property
    def runs(self) -> Values:
        """Lengths (n,) of stretches with canopy in metres."""
        out: Values = np.sort(self.ends) - np.sort(self.begins)
        return out


class Places(NamedTuple):
    """Places (n,) of vines: the row, metres along it, and their standard deviation in metres."""

    row: Ints
    position: Values
    deviation: Values


def estimate_spacing(rows: Sequence[Edges]) -> float | None:
    """Metres between the vines of rows; None where nothing tells.

    All edges of a row at which canopy ends lie whole numbers of vines apart, so do those at which it begins, and one
    kind from the other but for the vines' extent. The spacing is where the rows' periodograms together stand out from
    what chance gives: for any extent, or else for a closed hedge, of which the lengths of gaps tell too. If vines would
    stand apart by the first, though canopies are longer, the clearer of both counts: narrow gaps may be hidden.
    """
    told = [row for row in rows if len(row.gaps)]
    told = told[:: 1 + sum(len(row.gaps) for row in told) // MOST]
    if not told:
        return None
    frequency = np.arange(1 / WIDEST, 1 / NARROWEST, 1 / (8 * max(row.length for row in told)))
    power, across, own = np.zeros(len(frequency)), np.zeros(len(frequency), complex), np.zeros(len(frequency), complex)
    for row in told:
        ends, begins, gaps = (_phasors(v, frequency) for v in (row.ends, row.begins, row.gaps))
        power += np.abs(ends) ** 2 + np.abs(begins) ** 2 - 2 * len(row.ends)
        # Rows may be as long as one another for other reasons, and gaps of one vine are, whatever the spacing.
        across += np.conj(ends) * begins - gaps - np.exp(-2j * np.pi * frequency * row.length)
        own += gaps
    n = np.array([len(row.ends) for row in told], dtype=float)
    pairs = float(n @ (n - 1))
    run = float(np.concatenate([row.runs for row in told]).mean())
    spacing, share = _clearest(frequency, power + 2 * np.abs(across), chance=6 * pairs, order=4 * pairs)
    if spacing and (run <= HEADS[1] * spacing or estimate_extent(told, spacing) >= HEADS[0] * spacing):
        return spacing
    hedge = 2 * ((across + own) * np.exp(2j * np.pi * HEDGE)).real
    more = 2 * float((n - 1).sum())
    other, its = _clearest(frequency, power + hedge, chance=4 * pairs + more, order=4 * pairs + more)
    return spacing if other and share > its else other


def _clearest(frequency: Values, power: Values, *, chance: float, order: float) -> tuple[float | None, float]:
    """Spacing of the clearest frequency (n,), or of the lowest that is about as clear, and the order that it has, to 1.

    It is None where all may be chance. Told are the variance of what chance gives, and what perfect order gives.
    """
    clear = power > max(CLEAR * np.sqrt(chance), ORDERLY * order, LOWEST * power.max())
    if not clear.any():
        return None, 0.0
    first = int(clear.argmax())
    last = first + int(np.argmin(np.append(clear[first:], False)))
    best = first + power[first:last].argmax()
    return float(1 / frequency[best]), float(power[best] / order)


def _phasors(position: Values, frequency: Values) -> Values:
    out: Values = np.exp(2j * np.pi * frequency[:, None] * position).sum(axis=1)
    return out


def estimate_extent(rows: Sequence[Edges], spacing: float) -> float:
    """Metres of row that a vine fills; those of a closed hedge where gaps don't tell."""
    cross, pairs, once = 0j, 0, np.array([1 / spacing])
    for row in rows:
        cross += (np.conj(_phasors(row.ends, once)) * _phasors(row.begins, once))[0]
        cross -= np.exp(-2j * np.pi * row.length / spacing)
        pairs += len(row.ends) ** 2 - 1
    if np.abs(cross) <= TOLD * np.sqrt(pairs):
        return HEDGE * spacing
    extent = float(-np.angle(cross) / (2 * np.pi)) % 1.0
    runs = np.concatenate([row.runs for row in rows])
    if extent < ALONE[0] and np.mean(runs < ALONE[1] * spacing) < 0.5:
        extent += 1
    return extent * spacing


class _Fit(NamedTuple):
    """Lattices of m rows, k of each: where their first vines stand and how far apart they are (m, k), in metres.

    ``weights`` (3, m, k) are sums of the edges' weights, times their vines' numbers to the powers 0, 1, 2; ``cost`` is
    twice what the likelihood's logarithm lacks; ``off`` (m, k, n) is how far gaps' edges are off, in metres, or NaN.
    """

    start: Values
    apart: Values
    weights: Values
    cost: Values
    off: Values


def place_vines(rows: Sequence[Edges], spacing: float, extent: float) -> Places:
    """Where the vines of a block's rows stand, as edges of canopy half an extent away from them tell.

    Rows have as many vines as their length holds, or one more or less; how many is told by what edges lie off, and by
    how far the row's own spacing is from the block's. What remains open is part of the deviation.
    """
    length = np.array([row.length for row in rows])
    every, told = np.arange(len(rows)), any(len(row.gaps) for row in rows)
    fit = _fit(rows, length[:, None], spacing, extent, scatter=SCATTER * spacing)
    best = fit.cost.argmin(axis=1)
    if told and (scatter := float(np.nanmedian(np.abs(fit.off[every, best]))) / NORMAL) > SCATTER * spacing:
        fit = _fit(rows, length[:, None], spacing, extent, scatter=scatter)
        best = fit.cost.argmin(axis=1)
    chance = np.exp((fit.cost.min(axis=1, keepdims=True) - fit.cost) / 2)
    chance /= chance.sum(axis=1, keepdims=True)
    start, apart = fit.start[every, best], fit.apart[every, best]
    first, last = (np.rint((end - start) / apart) for end in (extent / 2, length - extent / 2))
    n = np.maximum(last - first, 0).astype(np.int64) + 1
    row = np.repeat(every, n)
    number = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + first[row]
    position = start[row] + number * apart[row]
    a, b, c = fit.weights[:, every, best][:, row]
    variance = (c - 2 * number * b + number**2 * a) / (a * c - b**2)
    away = (position[:, None] - fit.start[row]) / fit.apart[row]
    doubt = (chance[row] * ((away - np.rint(away)) * fit.apart[row]) ** 2).sum(axis=1)
    deviation = np.sqrt(variance + doubt + (PLANTED * spacing) ** 2)
    # A row's ends tell how many vines it has: hedges begin and end anywhere about their first and last.
    alone = np.array([len(edges.gaps) == 0 for edges in rows])[row]
    guess = apart[row] / np.sqrt(12)
    deviation = np.where(alone, guess, np.minimum(deviation, guess))
    return Places(row, np.clip(position, 0, length[row]), deviation)


def _fit(rows: Sequence[Edges], length: Values, spacing: float, extent: float, *, scatter: float) -> _Fit:
    """Lattices of as many vines as rows of such lengths (m, 1) hold, and of one more or less.

    Edges are so many metres off, a standard deviation.
    """
    most = max(len(row.ends) for row in rows)
    told = np.full((len(rows), 1, 2 * most), np.nan)
    sigma, ends = np.full(told.shape, scatter), np.zeros(told.shape, dtype=bool)
    for k, row in enumerate(rows):
        n = len(row.ends)
        told[k, 0, :n], told[k, 0, most : most + n] = row.ends - extent / 2, row.begins + extent / 2
        ends[k, 0, [n - 1, most + n - 1]] = True
    sigma[ends] *= ENDS
    there = np.isfinite(told)
    told = np.where(there, told, 0.0)
    steps = np.maximum((length - extent) / spacing, 0.0)
    loose = (OWN / np.maximum(steps, 1.0) + 0.003) * spacing
    count = np.maximum(np.rint(steps) + np.array([-1, 0, 1]), 0)
    several = (count > 0) & (length > extent)
    apart = np.where(several, (length - extent) / np.maximum(count, 1), spacing)
    start = np.where(several, extent / 2, length / 2)
    for _ in range(STEPS):
        number = np.rint((told - start[..., None]) / apart[..., None])
        off = (told - start[..., None] - number * apart[..., None]) / sigma
        weight = there / sigma**2 / (1 + (off / FAR) ** 2)
        a, b, c = ((weight * number**power).sum(axis=2) for power in range(3))
        c = c + 1 / loose**2
        u, v = (weight * told).sum(axis=2), (weight * number * told).sum(axis=2) + spacing / loose**2
        start, apart = (c * u - b * v) / (a * c - b**2), (a * v - b * u) / (a * c - b**2)
    off = (told - start[..., None]) / apart[..., None]
    off = (off - np.rint(off)) * apart[..., None]
    cost = FAR**2 * (there * np.log1p((off / sigma / FAR) ** 2)).sum(axis=2) + ((apart - spacing) / loose) ** 2
    return _Fit(start, apart, np.stack([a, b, c]), cost, np.where(there & ~ends, off, np.nan))
