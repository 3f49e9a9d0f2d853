"""How sure a row is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.evaluate.evidence import evidence

if TYPE_CHECKING:
    import geopandas as gpd

    from vinemap.geo.raster import Raster
    from vinemap.surfaces.seen import Seen
    from vinemap.surfaces.waves import RowField

EVIDENCE = {
    "company": 3.0,
    "whole": 3.0,
    "alike": 3.0,
    "claimed": 2.0,
    "support": 2.0,
    "contrast": 4.0,
    "length": 4.0,
    "wave": 4.0,
    "smooth": 4.0,
    "rough": 4.0,
}
"""Logarithm of the odds by which each ingredient, from 0 to 1, makes a row more sure."""
DOUBT = 3.3 - sum(EVIDENCE.values())
"""Logarithm of the odds of a row for which nothing speaks; 3.3, or 96%, is that of one for which everything does."""
DOUBTFUL = 0.5
"""Confidence, of a row or of its canopy, below which it is worth a look."""
CUT = 2.0
"""Logarithm of the odds by which a row is less sure all of whose canopy is cut."""


def judge_rows(
    rows: gpd.GeoDataFrame, cover: Raster, chm: Raster, field: RowField, seen: Seen, *, high: float = 3.6
) -> gpd.GeoDataFrame:
    """Give rows a ``confidence`` in 0–1, and the share of their canopy's length that is ``cut`` at a side.

    Confidence is the share of rows like it that are right, as far as a logistic model of what speaks for it tells it:
    :func:`vinemap.evaluate.evidence.evidence` names that, ``EVIDENCE`` its weights. Canopy is cut where what was seen
    ends within it, at a boundary or at the cloud's own edge.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``block``, ``spacing_m``, ``support`` and ``contrast``.
    cover : Raster
        Canopy cover 0–1.
    chm : Raster
        Canopy height in metres, NaN where there are no points.
    field : RowField
        As it was before rows were found.
    seen : Seen
        What the cloud shows.
    high : float
        Height in metres above which there are no vines.
    """
    if len(rows) == 0:
        return rows.assign(confidence=np.empty(0), cut=np.empty(0))
    found = evidence(rows, cover, chm, field, seen, high=high)
    odds = DOUBT + sum(weight * found[name].to_numpy() for name, weight in EVIDENCE.items())
    return rows.assign(confidence=1 / (1 + np.exp(-odds)), cut=found["cut"].to_numpy())


def believed(
    rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame, *, min_confidence: float = 0.45
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Rows that are at least so sure, and their gaps: less sure ones are more often none than not.

    Those whose canopy is cut become less sure, but no less than that: what was seen of them says that they are rows.

    Parameters
    ----------
    rows : GeoDataFrame
        With ``confidence``, ``cut`` and ``block``; blocks that are left are numbered anew, in their order.
    gaps : GeoDataFrame
        With ``row`` (position in rows).
    min_confidence : float
        Confidence of a row.
    """
    held = (rows["confidence"] >= min_confidence).to_numpy(dtype=bool)
    theirs = held[gaps["row"].to_numpy(dtype=np.int64)]
    rows, gaps = rows[held].reset_index(drop=True), gaps[theirs].reset_index(drop=True)
    position = (np.cumsum(held) - 1)[gaps["row"].to_numpy(dtype=np.int64)]
    block = np.unique(rows["block"], return_inverse=True)[1].astype(np.int64) + 1
    sure, cut = (rows[name].to_numpy(dtype=float) for name in ("confidence", "cut"))
    less = np.maximum(sure / (sure + (1 - sure) * np.exp(CUT * cut)), min_confidence)
    return rows.assign(block=block, confidence=np.where(cut > 0, less, sure)), gaps.assign(row=position)
