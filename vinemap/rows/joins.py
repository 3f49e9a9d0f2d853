"""Pieces of rows joined end to end: over missing vines, but not over tracks, headlands or kinks."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import label, maximum_filter1d
from scipy.spatial import cKDTree

from vinemap.geo.raster import sample_across

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Raster

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
FLANK = 4.0
"""Metres before and after a gap in which the rows stand that must end there for it to be a track."""
ACROSS = 6
"""Rows on each side of a gap that are looked at for a track."""
MOST = 0.8
"""Share of those rows that end there at a track."""
OPEN = 0.62
"""Spacings from the nearest key point from which ground is open: half a one is the middle of an alley."""
STRIDE = 0.5
"""Metres between the places at which ground is looked at."""
BESIDE, ASLANT, STRETCH = 4, 2.5, 6.0
"""Rows on each side of a kink that are looked at, from so many metres before and after it up to so many."""
MARGIN = 0.5
"""Spacings by which a row must be crossed."""
POST, THICK, SPOTS, CLEAR = 0.25, 0.6, 0.15, 1.2
"""Cover of a post between two rows' ends, metres that one takes at the most, share of the way that several do, and
metres from an end within which one is the row's last."""
POSTED = 0.25
"""Share of the gaps side by side with posts in them from which it is no track."""
OVERLAP = 0.5
"""Metres by which two pieces of a row may lie side by side at their ends."""


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


def torn(xy: Values, spacing: Values, pieces: Ints, position: Values) -> tuple[Ints, Values]:
    """Pieces (n,) of key points (n, 2) and their places along them, torn at kinks where more rows end than go on.

    There two blocks abut, at a track that narrows to nothing, and rows of both touch.
    """
    pieces, position = pieces.copy(), position.copy()
    order = np.argsort(pieces, kind="stable")
    first = np.searchsorted(pieces[order], np.arange(pieces.max() + 2))
    tree = None
    for p in np.flatnonzero(np.diff(first)):
        members = order[first[p] : first[p + 1]]
        for s in reversed(_kinks(xy[members], position[members])):
            tree = tree or cKDTree(xy)
            middle, before, after = (
                xy[members[np.abs(position[members] - at).argmin()]]
                for at in (s, s - TANGENT_LENGTH, s + TANGENT_LENGTH)
            )
            if _end_beside(tree, pieces, middle, after - before, float(np.median(spacing[members]))):
                beyond = members[position[members] > s]
                pieces[beyond] = pieces.max() + 1
                position[beyond] -= position[beyond].min()
                members = members[position[members] <= s]
    return pieces, position


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


def candidates(ends: Ends, max_gap: float) -> Ints:
    """Pairs of ends (k, 2) that may belong together, the best first.

    The lateral mismatch is that of the ends from the tangents of both (the mean of the two vanishes on an arc) or that
    of the middles of their last metres from the row field's direction; the smaller counts. It stays below 0.25 m + 5%
    of the gap and 0.36 spacings.
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
    facing = (ahead >= 0.7 * length - OVERLAP) & ((ends.field[a] * ends.field[b]).sum(axis=1) < -0.7)
    gate = np.minimum(0.25 + 0.05 * length, 0.36 * np.minimum(ends.spacing[a], ends.spacing[b]))
    fits = facing & (lateral <= gate) & ~_kinked(ends, a, b, length)
    cost = length[fits] + 10 * lateral[fits]
    out: Ints = pairs[fits][np.argsort(cost, kind="stable")]
    return out


def over_track_or_headland(ends: Ends, pairs: Ints, xy: Values, track_width: float) -> Flags:
    """Whether the gap between two ends (k, 2) is part of a track or a headland, where the rows beside it end, too.

    What lies farther than half a track from all key points is open ground. The gap lies on a track if the open ground
    about its middle goes on across ``MOST`` of the rows that stand beside its ends, up to ``ACROSS`` on each side:
    missing vines of some neighbours may line up, those of all don't, but something may stand at a track's side.
    """
    tree = cKDTree(xy)
    out = np.zeros(len(pairs), dtype=bool)
    for k, (a, b) in enumerate(pairs):
        gap = ends.xy[b] - ends.xy[a]
        length = float(np.hypot(*gap))
        if length < track_width:
            continue
        spacing = float(ends.spacing[[a, b]].mean())
        middle, along = (ends.xy[a] + ends.xy[b]) / 2, gap / length
        around = np.hypot(length / 2 + FLANK, (ACROSS + 1) * spacing)
        near = xy[tree.query_ball_point(middle, around)] - middle
        x, y = near @ along, (along[0] * near[:, 1] - along[1] * near[:, 0]) / spacing
        beside = (np.abs(x) > length / 2) & (np.abs(x) < length / 2 + FLANK)
        standing = np.unique(np.rint(y[beside]).astype(int))
        sides = [side[(side >= 1) & (side <= ACROSS)] for side in (standing, -standing)]
        if sum(map(len, sides)) > 1:
            open_to = _open_across(tree, middle, along, length, spacing, min(track_width / 2, OPEN * spacing))
            crossed = sum(np.count_nonzero(side <= far) for side, far in zip(sides, open_to, strict=True))
            out[k] = crossed >= MOST * sum(map(len, sides))
    return out


def with_posts(ends: Ends, pairs: Ints, cover: Raster) -> Flags:
    """Whether posts stand in a gap between two ends (k, 2), or in several beside it: there rows go on without vines.

    A post is a spot of canopy in line with the ends, with less half a spacing beside them.
    """
    a, b = ends.xy[pairs[:, 0]], ends.xy[pairs[:, 1]]
    spacing = ends.spacing[pairs].mean(axis=1)
    length = np.hypot(*(b - a).T)
    step = cover.grid.resolution
    own = np.zeros(len(pairs), dtype=bool)
    for k in np.flatnonzero(length > 2 * CLEAR + STRIDE):
        along = (b[k] - a[k]) / length[k]
        line = a[k] + np.arange(CLEAR, length[k] - CLEAR, step)[:, None] * along
        offsets = np.concatenate([np.linspace(-0.1, 0.1, 3), np.linspace(-0.5, -0.3, 3), np.linspace(0.3, 0.5, 3)])
        normal = np.broadcast_to([-along[1], along[0]], line.shape)
        seen = sample_across(cover, line, normal, offsets * spacing[k])
        on, beside = seen[:, :3].max(axis=1), seen[:, 3:].max()
        thick = np.count_nonzero(on > POST / 2) * step
        own[k] = on.max() > max(POST, 2 * beside) and thick < max(THICK, SPOTS * length[k])
    out = own.copy()
    middle = (a + b) / 2
    for k in np.flatnonzero(~own):
        beside = np.hypot(*(middle - middle[k]).T) <= ACROSS * spacing[k]
        out[k] = np.count_nonzero(own[beside]) >= max(2, POSTED * np.count_nonzero(beside))
    return out


def join(pairs: Ints, n_ends: int) -> Ints:
    """Row (m,) of each piece: ends are paired in the order of ``pairs`` (k, 2), each end once."""
    rows = np.arange(n_ends // 2)
    taken = np.zeros(n_ends, dtype=bool)
    for a, b in pairs:
        one, other = rows[a // 2], rows[b // 2]
        if not (taken[a] or taken[b] or one == other):
            taken[[a, b]] = True
            rows[rows == other] = one
    out: Ints = np.unique(rows, return_inverse=True)[1]
    return out


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


def _kinks(xy: Values, position: Values) -> Values:
    """Metres along a piece (n, 2) at which it turns more than it bends before and after."""
    k, least = round(TANGENT_LENGTH / STRIDE), round(SHORT / STRIDE)
    order = np.argsort(position)
    along = np.arange(0, position[order[-1]], STRIDE)
    if len(along) <= 2 * least:
        return np.empty(0)
    curve = np.column_stack([np.interp(along, position[order], xy[order, axis]) for axis in (0, 1)])
    here = np.arange(least, len(along) - least)
    before, after = (
        curve[here] - curve[np.maximum(here - k, 0)],
        curve[np.minimum(here + k, len(along) - 1)] - curve[here],
    )
    turn = np.zeros(len(along))
    turn[here] = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))
    padded = np.pad(turn, k)
    sides = np.stack([padded[: -2 * k], padded[2 * k :]])
    bend = sides.sum(axis=0) / np.maximum(np.count_nonzero(sides, axis=0), 1)
    # Beside a kink it is a bend, and what is straight there no kink.
    kink = np.minimum(np.abs(turn), np.abs(turn - bend))
    out: Values = along[(kink > KINK) & (kink == maximum_filter1d(kink, 4 * k - 1))]
    return out


def _end_beside(tree: cKDTree, pieces: Ints, middle: Values, along: Values, spacing: float) -> bool:
    """Whether more of the rows beside a kink end there than go on through it."""
    near = np.array(tree.query_ball_point(middle, np.hypot(STRETCH, BESIDE * spacing)))
    x = (tree.data[near] - middle) @ along / np.hypot(*along)
    before, after = (set(pieces[near[(way * x >= ASLANT) & (way * x <= STRETCH)]]) for way in (-1, 1))
    # The row itself goes on; a row that ends here and another that begins count as one.
    return len(before ^ after) > 2 * (len(before & after) - 1)


def _open_across(
    tree: cKDTree, middle: Values, along: Values, length: float, spacing: float, radius: float
) -> tuple[float, float]:
    """Rows to the left and to the right up to which the open ground about the middle of a gap goes on."""
    cells = int(np.ceil((ACROSS + 1) * spacing / STRIDE))
    across = np.arange(-cells, cells + 1) * STRIDE
    reach = int(np.ceil((length / 2 + (ACROSS + 1) * spacing) / STRIDE))
    on = np.arange(-reach, reach + 1) * STRIDE
    # A track may run aslant, at 45° at the most.
    inside = np.abs(on) <= length / 2 + np.abs(across)[:, None]
    normal = np.array([-along[1], along[0]])
    places = middle + on[None, :, None] * along + across[:, None, None] * normal
    distance = tree.query(places[inside], distance_upper_bound=radius)[0]
    free = np.zeros(inside.shape, dtype=bool)
    free[inside] = np.isinf(distance)
    ground = label(free)[0]
    here = ground[cells - 1 : cells + 2, np.abs(on) <= max(length / 2 - radius, 0) + STRIDE]
    mine = across[np.isin(ground, here[here > 0]).any(axis=1)]
    left, right = (max(0.0, float(side.max(initial=0.0))) for side in (mine, -mine))
    # Open ground keeps a radius from rows: the last that it crosses lies that much nearer.
    return (left + radius) / spacing - MARGIN, (right + radius) / spacing - MARGIN
