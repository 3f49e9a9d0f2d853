"""Where rows go on and where they don't: pieces are joined end to end, and rows part that run into one another.

Pieces are joined over missing vines, but not over tracks, headlands or kinks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from vinemap.compute.links import parts_of
from vinemap.geo.curve import across, at, between, resample, way_along
from vinemap.geo.raster import sample
from vinemap.rows.centre_line import CELL, smooth_course
from vinemap.rows.tracks import gaps_between, on_tracks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Raster
    from vinemap.rows.ends import Standing

TANGENT_LENGTH = 5.0
"""Metres of a piece's end that tell its tangent."""
BEND_LENGTH = 10.0
"""Metres of a piece's end that tell how it bends."""
KINK = 0.16
"""Radians that a gap may turn a row beyond what the pieces on both sides do."""
THEREABOUTS, SEVERAL = 25.0, 5
"""Metres within which pieces, and so many of them, tell how rows bend."""
SHORT = 2.5
"""Metres below which a piece is too short to tell its own direction: the row field does."""
STRIDE = 0.5
"""Metres between the places of a piece at which it is asked whether it turns."""
STRAIGHT, BENT = 0.7, 0.4
"""Cosines of the angles by which two ends may look past each other, and may where rows beside them bend alike."""
OVERLAP = 0.5
"""Metres by which two pieces of a row may lie side by side at their ends."""
NEAR = 0.5
"""Spacings from another row's line within which none stands, and along a row over which it must be free of others."""
GROUND = 0.35
"""Share of rows' usual cover up to which there is more ground than canopy."""
ENDS = (False, True)
"""A row's first end and its last."""


class Ends(NamedTuple):
    """Both ends of every piece; ends 2 p and 2 p + 1 are those of piece p."""

    xy: Values
    middle: Values
    """Middles (2 m, 2) of the piece's last metres."""
    tangent: Values
    """Outward unit vectors (2 m, 2) of the piece's last metres."""
    field: Values
    """Outward unit vectors (2 m, 2) of the row field there."""
    spacing: Values
    bend: Values
    """Curvature (2 m,) in 1/m on the way out, positive to the left; NaN where a piece is too short to tell."""


def ends_of(xy: Values, direction: Values, spacing: Values, pieces: Ints, position: Values) -> Ends:
    """Ends of pieces of key points (n, 2), whose place along their piece is ``position`` (n,) in metres."""
    order = np.lexsort((position, pieces))
    first = np.searchsorted(pieces[order], np.arange(pieces.max() + 2))
    n = 2 * (len(first) - 1)
    at, middles, tangents, field = np.zeros((4, n, 2))
    out = Ends(at, middles, tangents, field, np.zeros(n), np.full(n, np.nan))
    for p in range(len(first) - 1):
        members = order[first[p] : first[p + 1]]
        s = position[members]
        for end, depth in ((2 * p, s), (2 * p + 1, s[-1] - s)):
            near = members[depth <= TANGENT_LENGTH]
            middle = out.middle[end] = xy[near].mean(axis=0)
            x, y = (xy[near] - middle).T
            outward = xy[members[depth.argmin()]] - middle
            out.field[end] = _like(_axis(np.cos(2 * direction[near]).sum(), np.sin(2 * direction[near]).sum()), outward)
            axis = _axis(x @ x - y @ y, 2 * x @ y)
            tangent = _like(axis, outward) if s[-1] > SHORT else out.field[end]
            out.tangent[end] = tangent
            # An end lies on its piece's axis rather than on the outermost point.
            out.xy[end] = middle + ((xy[near] - middle) @ tangent).max() * tangent
            out.spacing[end] = np.median(spacing[near])
            if s[-1] >= BEND_LENGTH:
                offset = xy[members[depth <= BEND_LENGTH]] - middle
                left = tangent[0] * offset[:, 1] - tangent[1] * offset[:, 0]
                out.bend[end] = 2 * np.linalg.lstsq(np.vander(offset @ tangent, 3), left)[0][0]
    return out


def candidates(ends: Ends, max_gap: float, beside: Callable[..., tuple[int, int]]) -> Ints:
    """Pairs of ends (k, 2) that may belong together, the best first.

    The lateral mismatch is that of the ends from the tangents of both (the mean of the two vanishes on an arc) or that
    of the middles of their last metres from the row field's direction; the smaller counts. It stays below 0.25 m + 5%
    of the gap and 0.36 spacings.

    Where the rows beside it go on through the same bend, a gap may turn more than its row does before and after: then
    its ends' tangents meet within it. ``beside(pieces, middle, way, length)`` tells how many go on, and how many don't.
    """
    pairs = cKDTree(ends.xy).query_pairs(max_gap, output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2]
    a, b = pairs.T
    gap = ends.xy[b] - ends.xy[a]
    length = np.hypot(*gap.T)

    def mismatch(at: Values, outward: Values) -> Values:
        way, turn = at[b] - at[a], outward[a] - outward[b]
        out: Values = np.abs(turn[:, 0] * way[:, 1] - turn[:, 1] * way[:, 0]) / 2
        return out

    lateral = np.minimum(mismatch(ends.xy, ends.tangent), mismatch(ends.middle, ends.field))
    ahead = np.minimum((ends.field[a] * gap).sum(axis=1), -(ends.field[b] * gap).sum(axis=1))
    against = -(ends.field[a] * ends.field[b]).sum(axis=1)
    facing = (ahead >= STRAIGHT * length - OVERLAP) & (against > STRAIGHT)
    gate = np.minimum(0.25 + 0.05 * length, 0.36 * np.minimum(ends.spacing[a], ends.spacing[b]))
    fits = facing & (lateral <= gate) & ~_kinked(ends, a, b, length)
    aside = np.stack([_cross(ends.tangent[a], gap), _cross(gap, -ends.tangent[b])])
    meet = (
        (np.maximum(aside.min(axis=0), -aside.max(axis=0)) >= -gate)
        & (ahead >= BENT * length - OVERLAP)
        & (against > BENT)
    )
    for k in np.flatnonzero(meet & ~fits):
        middle = (ends.xy[a[k]] + ends.xy[b[k]]) / 2
        through, ended = beside(pairs[k] // 2, middle, ends.tangent[a[k]] - ends.tangent[b[k]], length[k])
        fits[k] = through > 1 and ended <= 2 * through
    cost = length[fits] + 10 * lateral[fits]
    out: Ints = pairs[fits][np.argsort(cost, kind="stable")]
    return out


def _cross(one: Values, other: Values) -> Values:
    out: Values = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    return out


def join(ends: Ends, pairs: Ints, tree: cKDTree, *, track_width: float, cover: Raster | None = None) -> Ints:
    """Row (m,) of each piece of a tree of key points: ends are paired in the order of ``pairs`` (k, 2).

    Each end is paired once, and none over a track.
    """
    rows = np.arange(len(ends.spacing) // 2)
    taken, chosen = np.zeros(len(ends.spacing), dtype=bool), np.zeros(len(pairs), dtype=bool)
    for k, (a, b) in enumerate(pairs):
        one, other = rows[a // 2], rows[b // 2]
        if not (taken[a] or taken[b] or one == other):
            chosen[k] = taken[a] = taken[b] = True
            rows[rows == other] = one
    pairs = pairs[chosen]
    gaps = gaps_between(ends.xy[pairs[:, 0]], ends.xy[pairs[:, 1]], ends.spacing[pairs].mean(axis=1))
    one, other = (pairs[~on_tracks(gaps, tree, track_width=track_width, cover=cover)] // 2).T
    return parts_of(len(rows), one, other)


def _axis(cosine: float, sine: float) -> Values:
    """Unit vector (2,) of half the angle with such a cosine and sine, or multiples of them."""
    half = np.arctan2(sine, cosine) / 2
    return np.array([np.cos(half), np.sin(half)])


def _like(axis: Values, way: Values) -> Values:
    return axis if axis @ way >= 0 else -axis


def _kinked(ends: Ends, a: Ints, b: Ints, length: Values) -> Flags:
    """Whether two ends (k,) could only be joined by a bend that rows thereabouts don't have."""
    own = _bends(ends)
    bends = np.stack([own[a], -own[b]])
    known = np.isfinite(bends)
    bend = np.where(known, bends, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)

    def kink(way: Values) -> Values:
        (ax, ay), (bx, by) = way[a].T, -way[b].T
        turn = np.arctan2(ax * by - ay * bx, ax * bx + ay * by)
        # Tangents are those of the middle of the pieces' last metres.
        out: Values = np.abs(turn - bend * (length + TANGENT_LENGTH))
        return out

    out: Flags = known.any(axis=0) & (np.maximum(kink(ends.tangent), kink(ends.field)) > KINK)
    return out


def _bends(ends: Ends) -> Values:
    """Curvature (2 m,) at every end: the median of what the pieces thereabouts have, or its own where there are few."""
    known = np.flatnonzero(np.isfinite(ends.bend))
    out = ends.bend.copy()
    if len(known) < SEVERAL:
        return out
    distance, nearest = cKDTree(ends.xy[known]).query(ends.xy, SEVERAL, distance_upper_bound=THEREABOUTS)
    near = known[np.minimum(nearest, len(known) - 1)]
    # The same bend is to the left on the way out of one end, and to the right out of the other.
    sense = np.sign((ends.tangent[near] * ends.tangent[:, None]).sum(axis=2))
    told = np.isfinite(distance).all(axis=1)
    out[told] = np.median(sense * ends.bend[near], axis=1)[told]
    return out


class Parted(NamedTuple):
    """A row that ran into others: its course (n, 2), carried on from where it stands free, and their canopies.

    Beside it are others' curves, into which it didn't run.
    """

    course: Values
    theirs: shapely.Geometry
    beside: list[Values]


class _Tip(NamedTuple):
    """Metres from a row's end to where it stands free of others, and in whose canopies it ends."""

    past: float
    others: Ints


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
