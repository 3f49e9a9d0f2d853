"""Ends and gaps of a row: where the canopy along it begins and stops, and how many vines are missing between."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from vinemap.geo.curve import between, way_along
from vinemap.rows.centre_line import CELL, runs_above

if TYPE_CHECKING:
    import geopandas as gpd

    from vinemap.compute.arrays import Values

AROUND = 0.3
"""Metres, a standard deviation, of the surroundings with which the canopy of an end is compared."""
CORE, NARROW = 0.5, 0.5
"""Share of a canopy's half width, and metres to both sides at the least, within which it tells where it ends."""
SHORTEST = 0.35
"""Metres of canopy along a row, below which it is a stray shoot or weed and no vine."""
NARROWEST, WIDEST = 0.7, 1.6
"""Metres between vines of a row, at the least and at the most."""
USUAL = 1.0
"""Metres between vines that are taken where nothing tells."""


class Standing(NamedTuple):
    """Curve (n, 2) between a row's ends, its runs of canopy (k, 2) in metres along it, and the canopy's contrast.

    ``goes_on`` tells of either end whether it may go on: what it was cut from ends no vine's distance beyond it.
    """

    curve: Values
    runs: Values
    contrast: float
    goes_on: tuple[bool, bool]


def cut_to_canopy(curve: Values, image: Values, ridge: Values, end_share: float) -> Standing | None:
    """Cut a curve to where its canopy begins and ends; None where there is none.

    Images (stations, cells across) are of the canopy's cover along it; its ridge tells how it stands out.
    """
    profile = _core(image).sum(axis=1) * CELL
    present = profile[profile > 0.3 * np.quantile(profile, 0.95)]
    if len(present) == 0:
        return None
    typical = float(np.median(present))
    # The last vine may be a weak one: what counts is the cover thereabouts, where there is canopy at all.
    living = np.clip((profile / typical - 0.2) / 0.2, 0, 1)
    near, weight = (gaussian_filter1d(v, AROUND / CELL, mode="constant") for v in (profile * living, living))
    profile *= typical / ((near + 0.1 * typical) / (weight + 0.1))
    edge = end_share * typical
    # Thin canopies have holes: what a weaker trace joins is one run, from its first to its last full edge.
    weak = runs_above(profile, 0.5 * edge)
    full = runs_above(profile, edge)
    runs = [(f[0, 0], f[-1, 1]) for a, b in weak if len(f := full[(full[:, 0] >= a) & (full[:, 1] <= b)])]
    metres = np.interp(np.reshape(runs, (-1, 2)), np.arange(len(curve)), way_along(curve))
    metres = metres[np.diff(metres, axis=1)[:, 0] >= SHORTEST]
    if len(metres) == 0:
        return None
    canopy = ridge[profile > edge]
    aside = max(1, canopy.shape[1] // 8)
    beside = np.concatenate([canopy[:, :aside], canopy[:, -aside:]], axis=1).mean()
    contrast = float(np.clip(1 - beside / canopy.max(axis=1).mean(), 0, 1))
    first, last = metres[0, 0], metres[-1, 1]
    goes_on = bool(first < USUAL), bool(last > way_along(curve)[-1] - USUAL)
    return Standing(between(curve, first, last), metres - first, contrast, goes_on)


def _core(image: Values) -> Values:
    """Middle of a straightened row (stations, cells across): wide canopies end round, there last.

    All of it, where the row is narrow or its middle hollow.
    """
    across, middle = image.mean(axis=0), image.shape[1] // 2
    if across[middle] < 0.5 * across.max():
        return image
    half = 0.5 * CELL * np.count_nonzero(across >= 0.5 * across.max())
    reach = round(max(CORE * half, NARROW) / CELL)
    return image[:, max(middle - reach, 0) : middle + reach + 1]


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
