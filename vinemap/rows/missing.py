"""Missing vines: how many stood in the gaps of a row."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import geopandas as gpd

NARROWEST, WIDEST = 0.7, 1.6
"""Metres between vines of a row, at the least and at the most."""
USUAL = 1.0
"""Metres between vines that are taken where nothing tells."""


def count_missing(
    rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame, *, vine_spacing: float | None = None
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Count the vines missing in every gap.

    Parameters
    ----------
    rows, gaps : GeoDataFrame
        With ``row_id``; gaps with ``start_m``, ``end_m`` and ``length_m``.
    vine_spacing : float, optional
        Metres between vines in a row; by default estimated from the gaps, and 1 m where they tell nothing.

    Returns
    -------
    rows, gaps : GeoDataFrame
        With ``n_missing``; rows with ``vine_spacing_m`` too.
    """
    spacing = vine_spacing or estimate_vine_spacing(gaps) or USUAL
    n = np.maximum(1, np.rint(gaps["length_m"].to_numpy() / spacing)).astype(np.int64)
    gaps = gaps.assign(n_missing=n)
    missing = gaps.groupby("row_id")["n_missing"].sum().reindex(rows["row_id"], fill_value=0)
    return rows.assign(n_missing=missing.to_numpy(), vine_spacing_m=spacing), gaps


def estimate_vine_spacing(gaps: gpd.GeoDataFrame) -> float | None:
    """Distance of vines in metres, from where gaps begin and end along their rows.

    Vines stand at equal distances, so the beginnings of a row's gaps lie whole numbers of vines apart, and so do
    their ends. The spacing is where the sum of the rows' periodograms peaks; None where the peak isn't clear.
    """
    frequency = np.arange(1 / WIDEST, 1 / NARROWEST, 0.0005)
    power, spread = np.zeros(len(frequency)), 0.0
    for _, row in gaps.groupby("row_id"):
        for edge in ("start_m", "end_m"):
            at = row[edge].to_numpy()
            power += np.abs(np.exp(2j * np.pi * frequency[:, None] * at).sum(axis=1)) ** 2 - len(at)
            spread += len(at) * (len(at) - 1)
    # Edges without any order give sums around zero, with the square root of the number of pairs as deviation.
    clear = spread > 0 and power.max() > 5 * np.sqrt(spread)
    return float(1 / frequency[power.argmax()]) if clear else None
