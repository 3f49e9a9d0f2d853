"""How sure a row is, and what is odd about it."""

from __future__ import annotations

import geopandas as gpd  # noqa: TC002  (its type stands in public signatures)
import numpy as np
import shapely

SETTLED = 5.0
"""Metres of row after which its length no longer speaks against it."""
SLACK = 0.02
"""Metres to which distances of rows are needed."""
ODD_SPACING = 1.5
"""Ratio of a row's distance from its nearest neighbour to the block's, or its inverse, that is odd."""
SHORT = 0.5
"""Share of the block's median length below which a row is short."""
SPARSE = 0.5
"""Share of its length with canopy below which a row is sparse."""
BOW = 0.5
"""Metres by which a row's bow may differ from its neighbours'."""


def judge_rows(rows: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Give rows a ``confidence`` in 0–1 and ``flags``.

    Confidence is the root of the share of the length with canopy, times the contrast of the canopy to the ground
    beside it, times 1 − exp(−length / 5 m). Flags, separated by commas, are ``spacing`` (its nearest neighbour is half
    as far again as is usual in the block, or two thirds as far), ``short`` (less than half the block's median
    length), ``sparse`` (canopy on less than half of it) and ``curved`` (its bow differs from its neighbours').

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``block``, ``support`` and ``contrast``.
    """
    lines = shapely.force_2d(rows.geometry.to_numpy())
    length = shapely.length(lines)
    support = rows["support"].to_numpy()
    confidence = np.sqrt(support) * rows["contrast"].to_numpy() * (1 - np.exp(-length / SETTLED))
    flags: list[list[str]] = [["sparse"] if share < SPARSE else [] for share in support]
    for _, members in rows.reset_index(drop=True).groupby("block"):
        index = members.index.to_numpy()
        if len(index) < 3:
            continue
        mine = lines[index]
        simple = shapely.simplify(mine, SLACK)
        away = shapely.distance(simple[:, None], simple[None, :])
        np.fill_diagonal(away, np.inf)
        nearest = away.min(axis=1)
        ratio = nearest / np.median(nearest)
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
    return rows.assign(confidence=np.clip(confidence, 0, 1), flags=[",".join(f) for f in flags])


def _bow(line: shapely.LineString) -> float:
    """Signed distance in metres of a line's middle from its chord, positive to the left."""
    (ax, ay), (bx, by) = shapely.get_coordinates(line)[[0, -1]]
    mx, my = shapely.get_coordinates(shapely.line_interpolate_point(line, 0.5, normalized=True))[0]
    return float(((bx - ax) * (my - ay) - (by - ay) * (mx - ax)) / max(np.hypot(bx - ax, by - ay), 1e-9))
