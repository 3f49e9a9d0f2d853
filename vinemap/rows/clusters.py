"""Key points to rows: density-based clusters in an elliptic region of interest, then joined end to end.

The ellipse (thesis, section 2.3.2) is narrow here, so that it never reaches over to the next row; what it leaves
apart (runs of missing vines, up to ``max_gap``) is joined by a second step that looks at whole pieces of a row:
ends are paired, the best fitting first, if each lies where the other's course leads.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches
from vinemap.rows.pieces.joins import candidates, ends_of, join
from vinemap.rows.pieces.kinks import pieces_beside, torn_at_kinks

if TYPE_CHECKING:
    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.compute.arrays import Ints, Values
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.seen import Seen

FEW = 2
"""Points of a piece that may be a row's last vine, but no row."""
ALIGNED = 0.87
"""Cosine of the angle between two key points' rows up to which they may belong to one."""


def cluster_rows(
    key_points: gpd.GeoDataFrame,
    cover: Raster | None = None,
    chm: Raster | None = None,
    seen: Seen | None = None,
    *,
    method: str = "pieces",
    along: float = 1.0,
    across: float = 0.2,
    min_points: int = 6,
    max_gap: float = 20.0,
    track_width: float = 2.5,
    high: float = 3.6,
) -> gpd.GeoDataFrame:
    """Label the key points of each row.

    Parameters
    ----------
    key_points : GeoDataFrame
        Points with ``direction_deg`` and ``spacing_m``.
    cover : Raster, optional
        Canopy cover 0–1, in which posts show that rows go on where all of them lack vines.
    chm : Raster, optional
        Canopy height in metres, which shows houses between rows.
    seen : Seen, optional
        What the cloud shows: a void across rows is no track.
    method : str
        "pieces" as described above; "ellipse" is the thesis's, for comparison: semi-axes of √(3 d) and √(0.5 d)
        metres (Eq. 4) and nothing joined.
    along, across : float
        Semi-axes of the elliptic region of interest, in inter-row spacings.
    min_points : int
        Points that a piece of a row has at the least, but for a last vine beyond a gap at its end.
    max_gap : float
        Metres of missing vines that a row may bridge; 0 joins nothing.
    track_width : float
        Metres from which a gap that all rows beside it share is a track or a headland, where rows end.
    high : float
        Height in metres above which there are no vines.

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
    graph = ellipse_graph(xy, direction, along=semi_axes[0], across=semi_axes[1], mutual=not thesis)
    pieces = _components(graph)
    members = np.bincount(pieces, minlength=1)[pieces]
    whole, few = np.flatnonzero(members >= min_points), np.flatnonzero((members < min_points) & (members >= FEW))
    out = key_points.iloc[whole].reset_index(drop=True)
    own = np.unique(pieces[whole], return_inverse=True)[1]
    if thesis or len(whole) == 0:
        return out.assign(cluster=own)
    points = np.concatenate([whole, few])
    xy, direction, spacing = xy[points], direction[points], spacing[points]
    tree, n = cKDTree(xy[: len(whole)]), len(whole)
    position = _position_along(points, np.unique(pieces[points], return_inverse=True)[1], graph)
    own, position[:n] = torn_at_kinks(tree, spacing[:n], own, position[:n])
    pieces = np.concatenate([own, own.max() + 1 + np.unique(pieces[few], return_inverse=True)[1]])
    ends = ends_of(xy, direction, spacing, pieces, position)
    beside = partial(pieces_beside, tree, pieces=own, spacing=spacing[:n])
    pairs = candidates(ends, max_gap, beside, whole=int(own.max()) + 1)
    rows = join(ends, pairs, tree, track_width=track_width, high=high, cover=cover, chm=chm, seen=seen)[pieces]
    held = np.isin(rows, rows[:n])
    return key_points.iloc[points[held]].reset_index(drop=True).assign(cluster=rows[held])


def ellipse_graph(xy: Values, direction: Values, *, along: Values, across: Values, mutual: bool = False) -> csr_array:
    """Distances in metres (n, n, sparse) from each point (n, 2) to those in its elliptic region of interest.

    Cases A, B and C of the thesis give the points of an ellipse to one cluster and merge the clusters that it
    touches. Whatever the order in which points are taken, the clusters that remain are this graph's components.

    Parameters
    ----------
    xy : (n, 2) array
        Points in metres.
    direction, along, across : (n,) array
        Direction of the row at each point in radians, semi-axes of its ellipse in metres (Eq. 4–5).
    mutual : bool
        Whether each of two points must lie in the other's ellipse and have its direction, so that where two blocks meet
        those of one don't link rows of the other.
    """
    n = len(xy)
    cell = max(float(along.max(initial=0)), float(across.max(initial=0)), 1e-6)
    column = np.floor((xy - xy.min(axis=0, initial=np.inf)) / cell).astype(np.int64) + 1
    wide = int(column[:, 1].max(initial=0)) + 2
    key = column[:, 0] * wide + column[:, 1]
    order = np.argsort(key, kind="stable")
    first = np.searchsorted(key[order], np.arange((int(column[:, 0].max(initial=0)) + 2) * wide + 1))
    axis = np.column_stack([np.cos(direction), np.sin(direction)])
    found = in_threads(
        lambda part: _linked(*part, xy, axis, along, across, 1 + mutual, key, wide, order, first), stretches(n)
    )
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
    least: int,
    key: Ints,
    wide: int,
    order: Ints,
    first: Ints,
) -> tuple[Ints, NDArray[np.int32], Values]:
    """Numbers of points j > i for each point i that lie in at least so many of both ellipses, those, and distances.

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
                inside = 0
                for k, p in enumerate((i, j)):
                    if k > inside and least > 1:
                        break
                    u = x * axis[p, 0] + y * axis[p, 1]
                    v = y * axis[p, 0] - x * axis[p, 1]
                    inside += (u / along[p]) ** 2 + (v / across[p]) ** 2 <= 1
                if inside >= least and (least == 1 or abs(axis[i, 0] * axis[j, 0] + axis[i, 1] * axis[j, 1]) > ALIGNED):
                    links[i - begin] += 1
                    others.append(np.int32(j))
                    # A graph's zero is no edge, so that points on one spot need a length.
                    distances.append(max(np.hypot(x, y), 1e-6))
    return links, np.array(others)[1:], np.array(distances)[1:]


def _components(graph: csr_array) -> Ints:
    labels: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels


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
