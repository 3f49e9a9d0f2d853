"""Key points to rows: density-based clusters in an elliptic region of interest, then joined end to end.

The ellipse (thesis, section 2.3.2) is narrow here, so that it never reaches over to the next row; what it leaves
apart (runs of missing vines, up to ``max_gap``) is joined by a second step that looks at whole pieces of a row:
ends are paired, the best fitting first, if each lies where the other's course leads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.compute.arrays import Flags, Ints, Values

TANGENT_LENGTH = 5.0
"""Metres of a piece's end that tell its tangent."""
BEND_LENGTH = 10.0
"""Metres of a piece's end that tell how it bends."""
KINK = 0.2
"""Radians that a gap may turn a row beyond what the pieces on both sides do."""
SHORT = 2.5
"""Metres below which a piece is too short to tell its own direction: the row field does."""
FLANK = 4.0
"""Metres before and after a gap in which the rows stand that must end there for it to be a track."""
ACROSS = 6
"""Rows on each side of a gap that are looked at for a track."""
OPEN = 0.62
"""Spacings from the nearest key point from which ground is open: half a one is the middle of an alley."""
STRIDE = 0.5
"""Metres between the places at which ground is looked at."""
MARGIN = 0.5
"""Spacings by which a row must be crossed."""
OVERLAP = 0.5
"""Metres by which two pieces of a row may lie side by side at their ends."""


def cluster_rows(
    key_points: gpd.GeoDataFrame,
    *,
    method: str = "pieces",
    along: float = 1.0,
    across: float = 0.12,
    min_points: int = 6,
    max_gap: float = 20.0,
    track_width: float = 3.5,
) -> gpd.GeoDataFrame:
    """Label the key points of each row.

    Parameters
    ----------
    key_points : GeoDataFrame
        Points with ``direction_deg`` and ``spacing_m``.
    method : str
        "pieces" as described above; "ellipse" is the thesis's, for comparison: semi-axes of √(3 d) and √(0.5 d)
        metres (Eq. 4) and nothing joined.
    along, across : float
        Semi-axes of the elliptic region of interest, in inter-row spacings.
    min_points : int
        Points that a piece of a row has at the least.
    max_gap : float
        Metres of missing vines that a row may bridge; 0 joins nothing.
    track_width : float
        Metres from which a gap that all rows beside it share is a track or a headland, where rows end.

    Returns
    -------
    GeoDataFrame
        The points that belong to a row, with column ``cluster`` (0, 1, …).
    """
    xy = key_points.get_coordinates().to_numpy()
    direction = np.radians(key_points["direction_deg"].to_numpy())
    spacing = key_points["spacing_m"].to_numpy()
    thesis = method == "ellipse"
    semi_axes = (np.sqrt(3 * spacing), np.sqrt(0.5 * spacing)) if thesis else (along * spacing, across * spacing)
    graph = ellipse_graph(xy, direction, along=semi_axes[0], across=semi_axes[1])
    pieces = _components(graph)
    kept = np.bincount(pieces, minlength=1)[pieces] >= min_points
    out = key_points[kept].reset_index(drop=True)
    if len(out) == 0:
        return out.assign(cluster=np.empty(0, dtype=np.int64))
    pieces = np.unique(pieces[kept], return_inverse=True)[1]
    if thesis:
        return out.assign(cluster=pieces)
    position = _position_along(np.flatnonzero(kept), pieces, graph)
    ends = _ends(xy[kept], direction[kept], spacing[kept], pieces, position)
    pairs = _candidates(ends, max_gap)
    pairs = pairs[~_over_track_or_headland(ends, pairs, xy[kept], track_width)]
    return out.assign(cluster=_join(pairs, len(ends.spacing))[pieces])


def ellipse_graph(xy: Values, direction: Values, *, along: Values, across: Values) -> csr_array:
    """Distances in metres (n, n, sparse) from each point (n, 2) to those in its elliptic region of interest.

    Cases A, B and C of the thesis give the points of an ellipse to one cluster and merge the clusters that it
    touches. Whatever the order in which points are taken, the clusters that remain are this graph's components.

    Parameters
    ----------
    xy : (n, 2) array
        Points in metres.
    direction, along, across : (n,) array
        Direction of the row at each point in radians, semi-axes of its ellipse in metres (Eq. 4–5).
    """
    n = len(xy)
    cell = max(float(along.max(initial=0)), float(across.max(initial=0)), 1e-6)
    column = np.floor((xy - xy.min(axis=0, initial=np.inf)) / cell).astype(np.int64) + 1
    wide = int(column[:, 1].max(initial=0)) + 2
    key = column[:, 0] * wide + column[:, 1]
    order = np.argsort(key, kind="stable")
    first = np.searchsorted(key[order], np.arange((int(column[:, 0].max(initial=0)) + 2) * wide + 1))
    axis = np.column_stack([np.cos(direction), np.sin(direction)])
    found = in_threads(lambda part: _linked(*part, xy, axis, along, across, key, wide, order, first), stretches(n))
    links, others, distance = (np.concatenate(column) for column in zip(*found, strict=True))
    start = np.concatenate([[0], np.cumsum(links)])
    return csr_array((distance, others, start.astype(np.int32)), shape=(n, n))


@compiled
def _linked(
    begin: int,
    end: int,
    xy: Values,
    axis: Values,
    along: Values,
    across: Values,
    key: Ints,
    wide: int,
    order: Ints,
    first: Ints,
) -> tuple[Ints, NDArray[np.int32], Values]:
    """Numbers of points j > i for each point i of which one lies in the other's ellipse, those points, and distances.

    Points are sorted (``order``) into the cells of a grid ``wide`` columns wide, no smaller than the ellipses; those
    of a cell start at ``first``.
    """
    links = np.zeros(end - begin, dtype=np.int64)
    others, distances = [np.int32(0)], [0.0]
    for i in range(begin, end):
        for c in range(9):
            cell = key[i] + (c // 3 - 1) * wide + c % 3 - 1
            for j in order[first[cell] : first[cell + 1]]:
                if j <= i:
                    continue
                x, y = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
                for p in (i, j):
                    u = x * axis[p, 0] + y * axis[p, 1]
                    v = y * axis[p, 0] - x * axis[p, 1]
                    if (u / along[p]) ** 2 + (v / across[p]) ** 2 <= 1:
                        links[i - begin] += 1
                        others.append(np.int32(j))
                        # A graph's zero is no edge, so that points on one spot need a length.
                        distances.append(max(np.hypot(x, y), 1e-6))
                        break
    return links, np.array(others)[1:], np.array(distances)[1:]


class _Ends(NamedTuple):
    """Both ends of every piece; ends 2 p and 2 p + 1 are those of piece p."""

    xy: Values
    tangent: Values
    """Outward unit vectors (2 m, 2) of the piece's last metres."""
    field: Values
    """Outward unit vectors (2 m, 2) of the row field there."""
    spacing: Values
    bend: Values
    """Curvature (2 m,) in 1/m on the way out, positive to the left; NaN where a piece is too short to tell."""


def _components(graph: csr_array) -> Ints:
    labels: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels


def _ends(xy: Values, direction: Values, spacing: Values, pieces: Ints, position: Values) -> _Ends:
    order = np.lexsort((position, pieces))
    first = np.searchsorted(pieces[order], np.arange(pieces.max() + 2))
    n = 2 * (len(first) - 1)
    out = _Ends(np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.full(n, np.nan))
    for p in range(len(first) - 1):
        members = order[first[p] : first[p + 1]]
        s = position[members]
        for end, depth in ((2 * p, s), (2 * p + 1, s[-1] - s)):
            near = members[depth <= TANGENT_LENGTH]
            middle = xy[near].mean(axis=0)
            half = np.angle(np.exp(2j * direction[near]).sum()) / 2
            outward = xy[members[depth.argmin()]] - middle
            out.field[end] = _like(np.array([np.cos(half), np.sin(half)]), outward)
            axis = np.linalg.svd(xy[near] - middle, full_matrices=False)[2][0]
            tangent = _like(axis, outward) if s[-1] > SHORT else out.field[end]
            out.tangent[end] = tangent
            # An end lies on its piece's axis rather than on the outermost point.
            out.xy[end] = middle + ((xy[near] - middle) @ tangent).max() * tangent
            out.spacing[end] = np.median(spacing[near])
            if s[-1] >= BEND_LENGTH:
                offset = xy[members[depth <= BEND_LENGTH]] - middle
                left = tangent[0] * offset[:, 1] - tangent[1] * offset[:, 0]
                out.bend[end] = 2 * np.polyfit(offset @ tangent, left, 2)[0]
    return out


def _position_along(points: Ints, pieces: Ints, graph: csr_array) -> Values:
    """Way in metres (n,) from one end of its piece to each point, along the piece, however it bends.

    ``points`` (n,) are the indices of those in the graph that belong to ``pieces`` (n,), all of each piece.
    """

    def way_from(starts: Ints) -> Values:
        found: Values = dijkstra(graph, directed=False, indices=points[starts], min_only=True)[points]
        return found

    way = way_from(np.unique(pieces, return_index=True)[1])
    order = np.lexsort((way, pieces))
    last = np.searchsorted(pieces[order], np.arange(pieces.max() + 1), side="right") - 1
    return way_from(order[last])


def _like(axis: Values, way: Values) -> Values:
    return axis if axis @ way >= 0 else -axis


def _join(pairs: Ints, n_ends: int) -> Ints:
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


def _candidates(ends: _Ends, max_gap: float) -> Ints:
    """Pairs of ends (k, 2) that may belong together, the best first.

    The lateral mismatch is measured from the tangents of both ends (the mean of the two vanishes on an arc) and
    from the row field's direction; the smaller counts. It stays below 0.25 m + 5% of the gap and 0.36 spacings.
    """
    pairs = cKDTree(ends.xy).query_pairs(max_gap, output_type="ndarray")
    pairs = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2]
    a, b = pairs.T
    gap = ends.xy[b] - ends.xy[a]
    length = np.hypot(*gap.T)

    def mismatch(outward: Values) -> Values:
        turn = outward[a] - outward[b]
        out: Values = np.abs(turn[:, 0] * gap[:, 1] - turn[:, 1] * gap[:, 0]) / 2
        return out

    lateral = np.minimum(mismatch(ends.tangent), mismatch(ends.field))
    ahead = np.minimum((ends.field[a] * gap).sum(axis=1), -(ends.field[b] * gap).sum(axis=1))
    facing = (ahead >= 0.7 * length - OVERLAP) & ((ends.field[a] * ends.field[b]).sum(axis=1) < -0.7)
    gate = np.minimum(0.25 + 0.05 * length, 0.36 * np.minimum(ends.spacing[a], ends.spacing[b]))
    fits = facing & (lateral <= gate) & ~_kinked(ends, a, b, length)
    cost = length[fits] + 10 * lateral[fits]
    out: Ints = pairs[fits][np.argsort(cost, kind="stable")]
    return out


def _kinked(ends: _Ends, a: Ints, b: Ints, length: Values) -> Flags:
    """Whether two ends (k,) could only be joined by a bend that neither of their pieces, where long enough, has."""
    (ax, ay), (bx, by) = ends.tangent[a].T, -ends.tangent[b].T
    turn = np.arctan2(ax * by - ay * bx, ax * bx + ay * by)
    bends = np.stack([ends.bend[a], -ends.bend[b]])
    known = np.isfinite(bends)
    bend = np.where(known, bends, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    # Tangents are those of the middle of the pieces' last metres.
    out: Flags = known.any(axis=0) & (np.abs(turn - bend * (length + TANGENT_LENGTH)) > KINK)
    return out


def _over_track_or_headland(ends: _Ends, pairs: Ints, xy: Values, track_width: float) -> Flags:
    """Whether the gap between two ends (k, 2) is part of a track or a headland, where the rows beside it end, too.

    What lies farther than half a track from all key points is open ground. The gap lies on a track if the open ground
    about its middle goes on across all the rows that stand beside its ends, up to ``ACROSS`` on each side: missing
    vines of some neighbours may line up, those of all don't.
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
        open_to = _open_across(tree, middle, along, length, spacing, min(track_width / 2, OPEN * spacing))
        sides = [side[(side >= 1) & (side <= ACROSS)] for side in (standing, -standing)]
        out[k] = sum(map(len, sides)) > 1 and all((s <= far).all() for s, far in zip(sides, open_to, strict=True))
    return out


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
    # Open ground keeps a radius from rows: the last that it crosses lies that much nearer.
    left, right = (max(0.0, float(side.max(initial=0.0))) for side in (mine, -mine))
    return tuple((side + radius) / spacing - MARGIN if side > 0 else 0.0 for side in (left, right))  # type: ignore[return-value]
