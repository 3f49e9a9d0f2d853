"""Rows that run into one another where blocks abut are parted, and what runs across rows is told from one."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from numpy.lib.stride_tricks import sliding_window_view

from vinemap.geo.curve import across, at, between, cross, resample, unit, way_along
from vinemap.geo.raster import sample
from vinemap.rows.centre_line import CELL, smooth_course

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from vinemap.compute.arrays import Ints, Values
    from vinemap.geo.raster import Raster
    from vinemap.rows.standing.canopy import Standing

SHORT, STRIDE = 2.5, 0.5
"""Metres of a row that stand free at the least, and in which it is carried on."""
NEAR = 0.5
"""Spacings from another row's line within which none stands, and along a row over which it must be free of others."""
GROUND = 0.35
"""Share of rows' usual cover up to which there is more ground than canopy."""
MOST, ASLANT = 0.5, 0.5
"""Share of what stands along a line that is others' canopy from which it is no row, and sine of the angle from which
these run across it."""
ENDS = (False, True)
"""A row's first end and its last."""


class Parted(NamedTuple):
    """A row that ran into others."""

    course: Values
    """Its course (n, 2), carried on from where it stands free of them."""
    theirs: shapely.Geometry
    """Their canopies."""
    beside: list[Values]
    """Curves (m, 2) of the rows beside it into which it didn't run."""


class _Tip(NamedTuple):
    """Metres from a row's end to where it stands free of others, and in whose canopies it ends."""

    past: float
    others: Ints


def own_rows(rows: Mapping[int, Standing]) -> dict[int, Standing]:
    """Rows but those of which most canopy is that of others across them, as along the ends of a block, shortest first.

    Else these would lose their ends to what is no row.
    """
    standing, held = list(rows.values()), np.ones(len(rows), dtype=bool)
    lines = np.array([shapely.LineString(row.curve) for row in standing], dtype=object)
    chord = unit(np.array([row.curve[-1] - row.curve[0] for row in standing]).reshape(-1, 2))
    canopies = shapely.buffer(lines, [row.half[1] for row in standing], cap_style="flat")
    one, other = shapely.STRtree(canopies).query(lines, predicate="intersects")
    aslant = np.abs(cross(chord[one], chord[other])) > ASLANT
    one, other = one[aslant], other[aslant]
    for k in sorted(set(one.tolist()), key=lambda k: standing[k].length):
        own = shapely.union_all([shapely.LineString(between(standing[k].curve, *run)) for run in standing[k].runs])
        theirs = shapely.union_all(canopies[other[(one == k) & held[other]]])
        held[k] = shapely.intersection(own, theirs).length < MOST * own.length
    return {k: row for (k, row), own in zip(rows.items(), held, strict=True) if own}


def part_rows(rows: Sequence[Standing], spacing: Values, cover: Raster, *, margin: float) -> dict[int, Parted]:
    """Rows that end in the canopies of others, and what of these isn't theirs.

    Where blocks abut a row's course leads on into a row of another, and often that one's into it. Each is carried on
    from where it stands free, and of two such ends those are held that together tell best what canopy there is.

    Parameters
    ----------
    rows : sequence of Standing
        Rows as their canopies were found.
    spacing : (n,) array
        Their spacing in metres.
    cover : Raster
        Canopy cover 0–1.
    margin : float
        Metres by which courses go on beyond an end that lies in no other's canopy.
    """
    lines = np.array([shapely.LineString(row.curve) for row in rows])
    tips = _tips(rows, lines, spacing)
    courses = {
        k: course for k in {row for row, _ in tips} if (course := _carried_on(rows[k], k, tips, margin)) is not None
    }
    beyond = {(k, end): 0.0 if (k, end) in tips else margin for k in courses for end in ENDS}
    for one, other in _facing(tips):
        if one[0] in courses and other[0] in courses:
            tails = [_tail(courses[k], tips[k, end].past, end) for k, end in (one, other)]
            lengths = _held_of(tails, [rows[k] for k, _ in (one, other)], cover)
            for tip, length in zip((one, other), lengths, strict=True):
                beyond[tip] = max(beyond[tip], tips[tip].past - length)

    def canopy(k: int, *, held: bool) -> shapely.Geometry:
        curve = courses.get(k, rows[k].curve)
        cut = [beyond.get((k, end), 0.0) if held else 0.0 for end in ENDS]
        line = shapely.LineString(between(curve, cut[0], way_along(curve)[-1] - cut[1]))
        return shapely.buffer(line, rows[k].half[1], cap_style="flat")

    def parted(k: int) -> Parted:
        others = np.unique([o for end in ENDS if (k, end) in tips for o in tips[k, end].others])
        held, all_of_them = (shapely.union_all([canopy(o, held=h) for o in others]) for h in (True, False))
        # What neither holds isn't this one's, either.
        theirs = shapely.union(held, shapely.difference(all_of_them, canopy(k, held=True)))
        near = np.flatnonzero(shapely.dwithin(shapely.LineString(courses[k]), lines, 2 * spacing[k]))
        return Parted(courses[k], theirs, [rows[o].curve for o in np.setdiff1d(near, [*others, k])])

    return {k: parted(k) for k in courses}


def _tips(rows: Sequence[Standing], lines: Values, spacing: Values) -> dict[tuple[int, bool], _Tip]:
    """Ends of rows, last ones or first ones, that lie in canopies of others."""
    half = np.array([row.half[1] for row in rows])
    tree, widest = shapely.STRtree(lines), 2 * float(half.max(initial=0.0))

    def touched(row: Ints, xy: Values) -> tuple[Ints, Ints]:
        """Which places (n, 2) of rows (n,) lie in canopies of others, and in whose."""
        here, other = tree.query(shapely.points(xy), predicate="dwithin", distance=widest)
        own = row[here]
        near = np.minimum(half[own] + half[other], NEAR * np.minimum(spacing[own], spacing[other]))
        held = (other != own) & (shapely.distance(shapely.points(xy[here]), lines[other]) < near)
        return here[held], other[held]

    tips = [(k, end) for k in range(len(rows)) for end in ENDS]
    places = np.array([rows[k].curve[-1 if end else 0] for k, end in tips]).reshape(-1, 2)
    out = {}
    for tip in np.unique(touched(np.repeat(np.arange(len(rows)), 2), places)[0]):
        k, end = tips[tip]
        stations = np.arange(0, rows[k].length, CELL)
        curve = rows[k].curve[::-1] if end else rows[k].curve
        here, others = touched(np.full(len(stations), k), at(curve, stations))
        held = np.isin(np.arange(len(stations)), here)
        n = round(NEAR * spacing[k] / CELL)
        free = ~sliding_window_view(held, n).any(axis=1) if len(held) > n else np.zeros(1, dtype=bool)
        first = int(free.argmax()) if free.any() else len(stations)
        out[k, end] = _Tip((first + n) * CELL, np.unique(others[here < first]))
    return out


def _carried_on(row: Standing, k: int, tips: Mapping[tuple[int, bool], _Tip], margin: float) -> Values | None:
    """Course (n, 2) of a row as far as it was found, but from where it stands free; None where it hardly does."""
    past = [tips[k, end].past if (k, end) in tips else 0.0 for end in ENDS]
    if row.length - sum(past) < SHORT:
        return None
    before, after = (length or margin for length in past)
    beyond = STRIDE * float(np.ceil(max(before, after) / STRIDE))
    longer = smooth_course(between(row.curve, past[0], row.length - past[1]), beyond=beyond)
    return resample(between(longer, beyond - before, way_along(longer)[-1] - beyond + after), CELL)


def _facing(tips: Mapping[tuple[int, bool], _Tip]) -> Iterator[tuple[tuple[int, bool], tuple[int, bool]]]:
    """Pairs of ends of which each lies in the other's row."""
    for one, tip in tips.items():
        for k in tip.others.tolist():
            for other in ((k, end) for end in ENDS if one[0] < k):
                if other in tips and one[0] in tips[other].others:
                    yield one, other


def _tail(course: Values, length: float, end: bool) -> Values:
    """The last metres of a course, or its first ones, from inside out."""
    curve = course if end else course[::-1]
    whole = float(way_along(curve)[-1])
    return resample(between(curve, whole - length, whole), CELL)


def _held_of(tails: Sequence[Values], rows: Sequence[Standing], cover: Raster) -> tuple[float, float]:
    """Metres of two rows' tails (n, 2), from inside out, whose canopies together tell best what there is.

    Cells that are more canopy than ground speak for the row that holds them, others against it; to hold one twice is no
    better than to hold ground.
    """
    lines = [shapely.LineString(tail) for tail in tails]
    first, second = (shapely.buffer(line, row.half[0], cap_style="flat") for line, row in zip(lines, rows, strict=True))
    (one, i), (other, j) = (_cells(tail, row.half[0]) for tail, row in zip(tails, rows, strict=True))
    alone = ~shapely.contains_xy(first, *other.T)
    both = shapely.contains_xy(second, *one.T)
    n, m = (len(tail) for tail in tails)
    along = np.full(len(one), m)
    way = shapely.line_locate_point(lines[1], shapely.points(one[both]))
    along[both] = np.minimum(np.rint(way / CELL), m - 1)
    at_first, at_second = np.append(i, np.full(alone.sum(), n)), np.append(along, j[alone])
    usual = max(float(np.mean([np.quantile(sample(cover, row.curve), 0.75) for row in rows])), GROUND)
    full = np.minimum(sample(cover, np.concatenate([one, other[alone]])) / usual, 1) - GROUND
    told, twice = np.zeros((2, n + 1, m + 1))
    np.add.at(told, (at_first, at_second), full)
    np.add.at(twice, (at_first, at_second), full + GROUND)
    total = np.zeros((n + 1, m + 1))
    total[1:] += told.sum(axis=1).cumsum()[:-1, None]
    total[:, 1:] += told.sum(axis=0).cumsum()[:-1]
    total[1:, 1:] -= twice.cumsum(axis=0).cumsum(axis=1)[:-1, :-1]
    best = np.unravel_index(total.argmax(), total.shape)
    return float(best[0] * CELL), float(best[1] * CELL)


def _cells(curve: Values, half: float) -> tuple[Values, Ints]:
    """Cells (m, 2) of a canopy along a curve (n, 2), and which of its points they lie beside."""
    aside = np.arange(-half, half + CELL / 2, CELL)
    return across(curve, aside, smoothing=1 / CELL).reshape(-1, 2), np.repeat(np.arange(len(curve)), len(aside))
