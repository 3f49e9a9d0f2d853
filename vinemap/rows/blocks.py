"""Vineyard blocks: rows that stand together in one direction and at one spacing, and the ground that they take."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

SAME_DIRECTION = np.radians(20)
"""Radians by which neighbouring rows of one block may differ."""
SAME_SPACING = 1.2
"""Ratio of their spacings."""
NEIGHBOURS = 1.6
"""Spacings within which rows are neighbours."""


def group_blocks(rows: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Give rows their ``block``: neighbours of about one direction and spacing belong together.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``spacing_m``.

    Returns
    -------
    GeoDataFrame
        With ``block`` (1 … n, from west to east).
    """
    n = len(rows)
    if n == 0:
        return rows.assign(block=np.empty(0, dtype=np.int64))
    lines, spacing = shapely.simplify(rows.geometry.to_numpy(), 0.02), rows["spacing_m"].to_numpy()
    ends = np.array([shapely.get_coordinates(line)[[0, -1]] for line in lines])
    angle = np.arctan2(*(ends[:, 1] - ends[:, 0]).T[::-1])
    i, j = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=NEIGHBOURS * spacing)
    alike = np.abs(np.angle(np.exp(2j * (angle[i] - angle[j])))) / 2 < SAME_DIRECTION
    alike &= np.abs(np.log(spacing[i] / spacing[j])) < np.log(SAME_SPACING)
    graph = coo_array((np.ones(alike.sum()), (i[alike], j[alike])), shape=(n, n))
    labels = connected_components(graph, directed=False)[1]
    west = np.bincount(labels, weights=ends[:, :, 0].mean(axis=1)) / np.bincount(labels)
    rank = np.empty(len(west), dtype=np.int64)
    rank[np.argsort(west)] = np.arange(1, len(west) + 1)
    return rows.assign(block=rank[labels])


def outline_blocks(rows: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Polygon of each block: strips half a spacing wide on both sides of its rows, and what lies between them.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``block`` and ``spacing_m``.

    Returns
    -------
    GeoDataFrame
        MultiPolygon with ``block``.
    """
    polygons, blocks = [], []
    for block, members in rows.groupby("block"):
        half = 0.5 * members["spacing_m"].to_numpy()
        strips = shapely.buffer(shapely.force_2d(members.geometry.to_numpy()), half, cap_style="flat")
        closed = shapely.buffer(shapely.union_all(strips), half.max(), join_style="mitre")
        closed = shapely.buffer(closed, -half.max())
        parts = [shapely.Polygon(part.exterior) for part in shapely.get_parts(closed)]
        polygons.append(shapely.multipolygons(parts))
        blocks.append(block)
    return gpd.GeoDataFrame({"block": np.array(blocks, dtype=np.int64)}, geometry=polygons, crs=rows.crs)
