"""Blocks of rows of one direction and spacing, and what is odd about a row in its block."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import shapely

from vinemap.compute.links import parts_of
from vinemap.geo.curve import turn_between

SAME_DIRECTION = np.radians(20)
"""Radians by which neighbouring rows of one block may differ."""
SAME_SPACING = 1.2
"""Ratio of their spacings."""
NEIGHBOURS = 1.6
"""Spacings within which rows are neighbours; where a whole row is missing, nothing tells what stands there."""
SLACK = 0.02
"""Metres to which distances of rows are needed."""
ODD_SPACING = 1.5
"""Ratio of a row's distance from its nearest neighbour to the block's, or its inverse, that is odd."""
SHORT = 0.5
"""Share of the block's median length below which a row is short."""
SPARSE = 0.5
"""Share of what is usual in the block, or of all, that a row must have of canopy along it not to be sparse."""
BOW = 0.5
"""Metres by which a row's bow may differ from its neighbours'."""
CUT = 0.05
"""Share of a row's canopy that is cut at a side from which it is at an edge."""


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
    lines, spacing = shapely.simplify(rows.geometry.to_numpy(), SLACK), rows["spacing_m"].to_numpy()
    ends = np.array([shapely.get_coordinates(line)[[0, -1]] for line in lines])
    angle = np.arctan2(*(ends[:, 1] - ends[:, 0]).T[::-1])
    i, j = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=NEIGHBOURS * spacing)
    alike = turn_between(angle[i], angle[j]) < SAME_DIRECTION
    alike &= np.abs(np.log(spacing[i] / spacing[j])) < np.log(SAME_SPACING)
    labels = parts_of(n, i[alike], j[alike])
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
        lines = shapely.simplify(shapely.force_2d(members.geometry.to_numpy()), SLACK)
        strips = shapely.buffer(lines, half, cap_style="flat")
        closed = shapely.buffer(shapely.union_all(strips), half.max(), join_style="mitre")
        closed = shapely.buffer(closed, -half.max())
        parts = [shapely.Polygon(part.exterior) for part in shapely.get_parts(closed)]
        polygons.append(shapely.multipolygons(parts))
        blocks.append(block)
    return gpd.GeoDataFrame({"block": np.array(blocks, dtype=np.int64)}, geometry=polygons, crs=rows.crs)


def flag_rows(rows: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Give rows ``flags``, what is odd about each, in words separated by commas.

    They are ``spacing`` (its nearest neighbour is half as far again as is usual in the block, or two thirds as far),
    ``short`` (less than half the block's median length), ``sparse`` (less than half of the block's median share of its
    length has canopy; of all of it, in blocks of one or two), ``curved`` (its bow differs from its neighbours') and
    ``edge`` (what was seen ends within its canopy, along 5% of it or more).

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``block``, ``support`` and ``cut``.
    """
    lines = shapely.force_2d(rows.geometry.to_numpy())
    length = shapely.length(lines)
    support = rows["support"]
    usual = support.groupby(rows["block"]).transform(lambda own: own.median() if len(own) > 2 else 1.0)
    odd = {"edge": rows["cut"].to_numpy() >= CUT, "sparse": (support < SPARSE * usual).to_numpy()}
    flags: list[list[str]] = [[name for name in odd if odd[name][i]] for i in range(len(rows))]
    for _, members in rows.reset_index(drop=True).groupby("block"):
        index = members.index.to_numpy()
        if len(index) < 3:
            continue
        mine = lines[index]
        simple = shapely.simplify(mine, SLACK)
        away = shapely.distance(simple[:, None], simple[None, :])
        np.fill_diagonal(away, np.inf)
        nearest = away.min(axis=1)
        ratio = nearest / max(float(np.median(nearest)), 1e-9)
        bow = np.array([_bow(line) for line in mine])
        beside = np.argsort(away, axis=1)[:, :4]
        expected = np.median(bow[beside] * (length[index, None] / length[index][beside]) ** 2, axis=1)
        for k, i in enumerate(index):
            if not 1 / ODD_SPACING < ratio[k] < ODD_SPACING:
                flags[i].append("spacing")
            if length[i] < SHORT * np.median(length[index]):
                flags[i].append("short")
            if abs(bow[k] - expected[k]) > BOW:
                flags[i].append("curved")
    return rows.assign(flags=[",".join(words) for words in flags])


def _bow(line: shapely.LineString) -> float:
    """Signed distance in metres of a line's middle from its chord, positive to the left."""
    (ax, ay), (bx, by) = shapely.get_coordinates(line)[[0, -1]]
    mx, my = shapely.get_coordinates(shapely.line_interpolate_point(line, 0.5, normalized=True))[0]
    return float(((bx - ax) * (my - ay) - (by - ay) * (mx - ax)) / max(np.hypot(bx - ax, by - ay), 1e-9))
