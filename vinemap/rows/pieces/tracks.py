"""Tracks, headlands and houses told from missing vines: the gaps of neighbouring rows are judged as one."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import find_objects, label
from scipy.spatial import cKDTree

from vinemap.compute.links import parts_of
from vinemap.compute.threads import in_threads
from vinemap.geo.curve import cross
from vinemap.geo.raster import sample, sample_across
from vinemap.rows.centre_line import runs_above

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.seen import Seen

FLANK = 4.0
"""Metres before and after a gap in which the rows stand that must end there for it to be a track."""
ACROSS = 6
"""Rows on each side of a gap that are looked at for a track."""
MOST = 0.8
"""Share of the rows that a track crosses, of those from where it comes into the field to where it leaves it."""
EDGE = 1
"""Rows beyond gaps side by side that may go on: the field goes on where more do, but a hedge may stand along it."""
APART = 1.2
"""Spacings to the next row beyond which a field ends."""
NEXT, PARALLEL = 3.5, 0.9
"""Spacings, and cosine of the angle, within which gaps are side by side: in a row between them something may stand on a
track."""
COVERED, LONGER = 0.7, 3.0
"""Share of a gap that another beside it has in common with it, and how much longer than it that may be, to be judged
with it."""
ASKEW = 3.0
"""Metres by which a track at 45° to rows must be wider than one straight across them."""
SLANTS = np.concatenate([[0.0], np.arange(-1, 1.01, 0.1)])[:, None]
"""Tangents of the angle at which a track may cross rows."""
ASLANT, SEVERAL = (-1.0, -0.75, -0.5, -0.25, 0.25, 0.5, 0.75, 1.0), 5
"""Tangents of the angles at which gaps are looked for that lie side by side, and rows that must have one each."""
OPEN = 0.62
"""Spacings from the nearest key point from which ground is open: half a one is the middle of an alley."""
MARGIN = 0.5
"""Spacings by which a row must be crossed."""
POST, THICK, SPOTS, CLEAR = 0.25, 0.6, 0.15, 1.0
"""Cover of a post between two rows' ends, metres that one takes at the most, share of the way that several do, and
metres from an end within which one is the row's last."""
LAST = 0.75
"""Metres beside a track within which a row's last post stands, and ``CLEAR`` inside."""
POSTED = 0.2
"""Share of the gaps side by side with posts in them from which it is no track."""
HOUSE = 7.0
"""Metres along a row over which what is taller than vines is no crown of a tree."""
STRIDE = 0.5
"""Metres between the places at which ground is looked at."""


class Gaps(NamedTuple):
    """Gaps between two ends of rows."""

    middle: Values
    """Places (k, 2) midway between the ends."""
    along: Values
    """Unit vectors (k, 2) from one end to the other."""
    length: Values
    """Metres (k,) between them."""
    spacing: Values
    """Inter-row spacing (k,) in metres."""


def gaps_between(a: Values, b: Values, spacing: Values) -> Gaps:
    """Gaps between ends of rows a and b (k, 2)."""
    length = np.hypot(*(b - a).T)
    return Gaps((a + b) / 2, (b - a) / np.maximum(length, 1e-9)[:, None], length, spacing)


def on_tracks(gaps: Gaps, tree: cKDTree, *, track_width: float, cover: Raster | None, seen: Seen | None) -> Flags:
    """Whether the gap between two ends (k, 2) is part of a track or a headland, where the rows beside it end, too.

    Gaps of neighbouring rows that lie side by side are judged as one, those on a line aslant, too. What lies farther
    than half a track from all key points is open ground. They are a track if it leads out of the field on both sides of
    them and through ``MOST`` of its rows, and if no posts stand in it: missing vines of some neighbours may line up,
    those of all don't, but something may stand on a track. Where nothing was ``seen`` there is a void in the cloud.
    """
    shown = gaps.length if seen is None else _shown(gaps, seen)
    wide = np.flatnonzero(shown >= track_width)
    out = np.zeros(len(gaps.length), dtype=bool)
    if len(wide) == 0:
        return out
    gaps = Gaps(*(values[wide] for values in gaps))

    def on_track(lane: Ints) -> Ints:
        if not _leads_out(tree, gaps, lane, track_width):
            return lane[:0]
        posts = _with_posts(gaps, lane, cover) if cover is not None else 0
        return lane if posts < max(min(2, len(lane)), POSTED * len(lane)) else lane[:0]

    lanes = [*_lanes(gaps)]
    lanes += [lane for aslant in ASLANT for lane in _lanes(gaps, aslant) if _in_line(gaps, lane, track_width)]
    out[wide[np.concatenate(in_threads(on_track, lanes))]] = True
    return out


def _shown(gaps: Gaps, seen: Seen) -> Values:
    """Metres (k,) of gaps of which something was seen."""
    n = np.ceil(gaps.length / STRIDE).astype(int) + 1
    gap = np.repeat(np.arange(len(n)), n)
    share = (np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + 0.5) / n[gap] - 0.5
    places = gaps.middle[gap] + (share * gaps.length[gap])[:, None] * gaps.along[gap]
    out: Values = gaps.length * np.bincount(gap, seen.at(places), len(n)) / n
    return out


def blocked(gaps: Gaps, chm: Raster, *, high: float) -> Flags:
    """Whether something stands in gaps (k,) that is taller than vines and longer than ``HOUSE``: a tree is shorter."""
    step = chm.grid.resolution
    out = np.zeros(len(gaps.length), dtype=bool)
    for k in np.flatnonzero(gaps.length > HOUSE):
        at = np.arange(-gaps.length[k] / 2, gaps.length[k] / 2, step)
        heights = sample(chm, gaps.middle[k] + at[:, None] * gaps.along[k])
        if not (known := np.isfinite(heights)).any():
            continue
        tall = runs_above(np.interp(at, at[known], heights[known]), high)
        out[k] = np.diff(tall, axis=1).max(initial=0) * step > HOUSE
    return out


def _lanes(gaps: Gaps, aslant: float = 0.0) -> Iterator[Ints]:
    """Gaps that lie side by side, straight across the rows or at an angle of such a tangent."""
    one, other, common = _side_by_side(gaps, aslant)
    covers = common >= COVERED * gaps.length[other]
    linked = covers & (gaps.length[one] <= LONGER * gaps.length[other])
    lanes = parts_of(len(gaps.length), one[linked], other[linked])
    for k in range(lanes.max() + 1):
        yield np.union1d(np.flatnonzero(lanes == k), one[covers & (lanes[other] == k)])


def _in_line(gaps: Gaps, lane: Ints, track_width: float) -> bool:
    """Whether gaps of several rows, and not far longer ones, have a track's width in common on one line across them."""
    x, y = _in_frame(gaps, lane[0], lane)
    if len(np.unique(np.rint(y))) < SEVERAL:
        return False
    off, half = x - np.polyval(np.polyfit(y, x, 1), y), gaps.length[lane] / 2
    common = float((off + half).min() - (off - half).max())
    return common >= max(track_width, float(half.max()))


def _side_by_side(gaps: Gaps, aslant: float) -> tuple[Ints, Ints, Values]:
    """Gaps in rows beside each other, every pair in both orders, and how many metres they have in common."""
    across = NEXT * float(gaps.spacing.max())
    reach = np.hypot(across, abs(aslant) * across + float(gaps.length.max()) / 2)
    pairs = cKDTree(gaps.middle).query_pairs(reach, output_type="ndarray")
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    x, y = _in_frame(gaps, one, other)
    x -= aslant * y * gaps.spacing[one]
    half, its = gaps.length[one] / 2, gaps.length[other] / 2
    common = np.minimum(half, x + its) - np.maximum(-half, x - its)
    parallel = np.abs((gaps.along[one] * gaps.along[other]).sum(axis=1)) > PARALLEL
    beside = parallel & (common > 0) & (np.abs(y) > 0.5) & (np.abs(y) < NEXT)
    return one[beside], other[beside], common[beside]


def _in_frame(gaps: Gaps, one: Ints | np.intp, other: Ints) -> tuple[Values, Values]:
    """Middles of other gaps from one or as many: metres along its row, and spacings to the left."""
    way, along = gaps.middle[other] - gaps.middle[one], gaps.along[one]
    return (way * along).sum(axis=1), cross(along, way) / gaps.spacing[one]


def _leads_out(tree: cKDTree, gaps: Gaps, lane: Ints, track_width: float) -> bool:
    """Whether open ground leads out of the field on both sides of gaps side by side, and through all but a few rows."""
    along, spacing = gaps.along[lane[0]], gaps.spacing[lane[0]]
    x, y = _in_frame(gaps, lane[0], lane)
    right, left = lane[y.argmin()], lane[y.argmax()]
    beyond = {k: _beyond(tree, gaps, k, track_width) for k in {right, left}}
    # Left of the lane may be right of a gap that is told from its other end.
    sides = [beyond[k][side ^ int(gaps.along[k] @ along < 0)] for k, side in ((right, 1), (left, 0))]
    stopped, standing = np.transpose(sides)
    within = round(float(np.ptp(y)))
    others = np.setdiff1d(np.arange(within + 1), np.rint(y - y.min())) + y.min()
    order = np.argsort(y)
    aside = others[:, None] * spacing * [-along[1], along[0]]
    places = gaps.middle[lane[0]] + np.interp(others, y[order], x[order])[:, None] * along + aside
    through = np.count_nonzero(tree.query(places)[0] < _keeps(track_width, spacing)) if len(others) else 0
    rows = standing.sum() + within
    return bool(rows > 1 and stopped.max() <= EDGE and stopped.sum() + through <= (1 - MOST) * rows)


def _keeps(track_width: float, spacing: float) -> float:
    """Metres that open ground keeps from key points."""
    return min(track_width / 2, OPEN * spacing)


def _beyond(tree: cKDTree, gaps: Gaps, k: np.intp, track_width: float) -> list[tuple[int, int]]:
    """Rows to the left of a gap, and to its right, that stand where open ground doesn't lead, and all there."""
    middle, along, length, spacing = gaps.middle[k], gaps.along[k], float(gaps.length[k]), float(gaps.spacing[k])
    around = np.hypot(length / 2 + FLANK, (ACROSS + 1) * spacing)
    near = tree.data[tree.query_ball_point(middle, around)] - middle
    x, y = near @ along, cross(along, near) / spacing
    y = y[(np.abs(x) > length / 2) & (np.abs(x) < length / 2 + FLANK)]
    far = _open_across(tree, middle, along, length, spacing, _keeps(track_width, spacing))
    out = []
    for aside, open_to in zip((y, -y), far, strict=True):
        there = np.sort(aside[(aside > 0.5) & (aside < ACROSS + 0.5)])
        # The field ends at what is farther away than the next row.
        rows = np.unique(np.rint(there[: np.append(np.diff(there, prepend=0) > APART, True).argmax()]))
        out.append((int(np.count_nonzero(rows > open_to)), len(rows)))
    return out


def _with_posts(gaps: Gaps, lane: Ints, cover: Raster) -> int:
    """In how many of the gaps side by side posts stand that end no row.

    Where the rows' last vines are missing, their last posts stand in a gap, but at the edge of what it has in common
    with those thereabouts.
    """
    n = 0
    for k in lane:
        if not len(at := _posts(gaps, k, cover)):
            continue
        x, y = _in_frame(gaps, k, lane)
        near = np.abs(y) <= ACROSS
        low, high = _corridor(x[near], y[near] * gaps.spacing[k], gaps.length[lane[near]] / 2)
        sides = at - low, high - at
        alone = any((side < -LAST).any() and not ((side >= -LAST) & (side <= CLEAR)).any() for side in sides)
        n += bool(alone or (np.minimum(*sides) > CLEAR).any())
    return n


def _corridor(x: Values, y: Values, half: Values) -> tuple[float, float]:
    """The widest stretch along a row, in metres from its gap's middle, that the gaps thereabouts have in common.

    A few may lack a part of it, and it may run aslant.
    """
    middle = x - SLANTS * y
    low, high = np.quantile(middle - half, MOST, axis=1), np.quantile(middle + half, 1 - MOST, axis=1)
    widest = np.argmax(high - low - ASKEW * np.abs(SLANTS[:, 0]))
    return float(low[widest]), float(high[widest])


def _posts(gaps: Gaps, k: int, cover: Raster) -> Values:
    """Places (n,) in metres from its middle of posts in a gap: spots of canopy in line with its ends.

    There is less half a spacing beside them.
    """
    length, along = gaps.length[k], gaps.along[k]
    step = cover.grid.resolution
    at = np.arange(CLEAR - length / 2, length / 2 - CLEAR, step)
    if len(at) < 3:
        return np.empty(0)
    line = gaps.middle[k] + at[:, None] * along
    offsets = np.concatenate([np.linspace(-0.1, 0.1, 3), np.linspace(-0.5, -0.3, 3), np.linspace(0.3, 0.5, 3)])
    seen = sample_across(cover, line, np.broadcast_to([-along[1], along[0]], line.shape), offsets * gaps.spacing[k])
    on, beside = seen[:, :3].max(axis=1), seen[:, 3:].max()
    if np.count_nonzero(on > POST / 2) * step >= max(THICK, SPOTS * length):
        return np.empty(0)
    spots = find_objects(label(on > POST / 2)[0])
    out = [at[spot].mean() for (spot,) in spots if on[spot].max() > max(POST, 2 * beside)]
    return np.array(out)


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
