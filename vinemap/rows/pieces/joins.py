"""Where rows go on: pieces are joined end to end, over missing vines, but not over tracks, headlands or kinks."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vinemap.compute.links import parts_of
from vinemap.geo.curve import cross
from vinemap.rows.pieces.kinks import KINK, SHORT, TANGENT_LENGTH
from vinemap.rows.pieces.tracks import blocked, gaps_between, on_tracks

if TYPE_CHECKING:
    from collections.abc import Callable

    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.seen import Seen

BEND_LENGTH = 10.0
"""Metres of a piece's end that tell how it bends."""
THEREABOUTS, SEVERAL = 25.0, 5
"""Metres within which pieces, and so many of them, tell how rows bend."""
STRAIGHT, BENT = 0.7, 0.4
"""Cosines of the angles by which two ends may look past each other, and may where rows beside them bend alike."""
LAST = 6.0
"""Metres without vines beyond which a single one is none of the row's."""
OVERLAP = 0.5
"""Metres by which two pieces of a row may lie side by side at their ends."""


class Ends(NamedTuple):
    """Both ends of every piece; ends 2 p and 2 p + 1 are those of piece p."""

    xy: Values
    """Places (2 m, 2) of the ends, on the axes of their pieces."""
    middle: Values
    """Middles (2 m, 2) of the piece's last metres."""
    tangent: Values
    """Outward unit vectors (2 m, 2) of the piece's last metres."""
    field: Values
    """Outward unit vectors (2 m, 2) of the row field there."""
    spacing: Values
    """Inter-row spacing (2 m,) in metres."""
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
        for end, depth, outer, inner in ((2 * p, s, 0, -1), (2 * p + 1, s[-1] - s, -1, 0)):
            near = members[depth <= TANGENT_LENGTH]
            middle = out.middle[end] = xy[near].mean(axis=0)
            x, y = (xy[near] - middle).T
            outward = xy[near[outer]] - xy[near[inner]]
            out.field[end] = _like(_axis(np.cos(2 * direction[near]).sum(), np.sin(2 * direction[near]).sum()), outward)
            axis = _axis(x @ x - y @ y, 2 * x @ y)
            tangent = _like(axis, outward) if s[-1] > SHORT else out.field[end]
            out.tangent[end] = tangent
            # An end lies on its piece's axis rather than on the outermost point.
            out.xy[end] = middle + ((xy[near] - middle) @ tangent).max() * tangent
            out.spacing[end] = np.median(spacing[near])
            if s[-1] >= BEND_LENGTH:
                offset = xy[members[depth <= BEND_LENGTH]] - middle
                out.bend[end] = 2 * np.linalg.lstsq(np.vander(offset @ tangent, 3), cross(tangent, offset))[0][0]
    return out


def candidates(ends: Ends, max_gap: float, beside: Callable[..., tuple[int, int]], *, whole: int) -> Ints:
    """Pairs of ends (k, 2) that may belong together, the best first.

    The lateral mismatch is that of the ends from the tangents of both (the mean of the two vanishes on an arc) or that
    of the middles of their last metres from the row field's direction; the smaller counts. It stays below 0.25 m + 5%
    of the gap and 0.36 spacings.

    Where the rows beside it go on through the same bend, a gap may turn more than its row does before and after: then
    its ends' tangents meet within it. ``beside(pieces, middle, way, length)`` tells how many go on, and how many don't.

    Pieces from the one numbered ``whole`` on are single vines: no row goes on in them, but one may end, up to ``LAST``
    metres away, where it goes on in nothing else.
    """
    pairs = cKDTree(ends.xy).query_pairs(max_gap, output_type="ndarray")
    gap = ends.xy[pairs[:, 1]] - ends.xy[pairs[:, 0]]
    length = np.hypot(*gap.T)
    single = np.count_nonzero(pairs // 2 >= whole, axis=1)
    held = (pairs[:, 0] // 2 != pairs[:, 1] // 2) & ((single == 0) | (single == 1) & (length <= LAST))
    pairs, gap, length, single = pairs[held], gap[held], length[held], single[held]
    a, b = pairs.T

    def mismatch(at: Values, outward: Values) -> Values:
        way, turn = at[b] - at[a], outward[a] - outward[b]
        return np.abs(cross(turn, way)) / 2

    lateral = np.minimum(mismatch(ends.xy, ends.tangent), mismatch(ends.middle, ends.field))
    ahead = np.minimum((ends.field[a] * gap).sum(axis=1), -(ends.field[b] * gap).sum(axis=1))
    against = -(ends.field[a] * ends.field[b]).sum(axis=1)
    facing = (ahead >= STRAIGHT * length - OVERLAP) & (against > STRAIGHT)
    gate = np.minimum(0.25 + 0.05 * length, 0.36 * np.minimum(ends.spacing[a], ends.spacing[b]))
    fits = facing & (lateral <= gate) & ~_kinked(ends, a, b, length)
    aside = np.stack([cross(ends.tangent[a], gap), cross(gap, -ends.tangent[b])])
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
    out: Ints = pairs[fits][np.lexsort((cost, single[fits]))]
    return out


def join(
    ends: Ends,
    pairs: Ints,
    tree: cKDTree,
    *,
    track_width: float,
    high: float,
    cover: Raster | None,
    chm: Raster | None,
    seen: Seen | None,
) -> Ints:
    """Row (m,) of each piece of a tree of key points: ends are paired in the order of ``pairs`` (k, 2).

    Each end is paired once, and none over a track, or through what is taller than vines and longer than a tree.
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
    apart = on_tracks(gaps, tree, track_width=track_width, cover=cover, seen=seen)
    if chm is not None:
        apart |= blocked(gaps, chm, high=high)
    one, other = (pairs[~apart] // 2).T
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
