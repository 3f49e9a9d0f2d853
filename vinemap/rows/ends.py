"""Ends and gaps of a row: where canopy begins and stops along it, what wasn't seen, how many vines are missing."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d

from vinemap.geo.curve import between, extend, resample, way_along
from vinemap.geo.raster import sample
from vinemap.rows.centre_line import CELL, runs_above

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vinemap.compute.arrays import Values
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.seen import Seen

MISSING, UNSEEN = "missing", "unseen"
"""States of a gap: no vine stands there, or nothing tells whether one does."""
SEEN, OUTSIDE = "seen", "outside"
"""What is told, beside ``UNSEEN``, of the place beyond an end where the next vine would be."""

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
VERTEX = 0.5
"""Metres between the vertices of a curve."""


class Standing(NamedTuple):
    """Curve (n, 2) between a row's ends, its runs of canopy (k, 2) in metres along it, and the canopy's contrast.

    ``goes_on`` tells of either end whether it may go on: what it was cut from ends no vine's distance beyond it.
    """

    curve: Values
    runs: Values
    contrast: float
    goes_on: tuple[bool, bool]

    @property
    def length(self) -> float:
        """Metres from end to end."""
        return float(self.runs[-1, 1])

    @property
    def empty(self) -> Values:
        """Stretches (k - 1, 2) between the runs, in metres along the curve."""
        return np.column_stack([self.runs[:-1, 1], self.runs[1:, 0]])


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


def lay_out(
    standing: Iterable[tuple[float, Standing]],
    seen: Seen,
    dtm: Raster,
    *,
    within: shapely.Geometry | None = None,
    min_gap: float = 0.8,
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Tables of rows and of their gaps.

    Rows end where the parcel does: one that goes on beyond a hole or a notch of its polygon is two. Gaps are parted
    into what was seen, where vines are missing, and what wasn't.

    Parameters
    ----------
    standing : iterable of (float, Standing)
        Rows, with their spacing in metres.
    seen : Seen
        What the cloud shows.
    dtm : Raster
        Terrain, which gives curves their elevation.
    within : Geometry, optional
        The parcel's polygon; by default all that there is.
    min_gap : float
        Metres without canopy that make a gap, of which a part is one, too.

    Returns
    -------
    rows, gaps : GeoDataFrame
        LineStringZ with ``spacing_m``, ``gap_m`` and ``unseen_m`` (length of gaps of either state), ``support`` (share
        of the length that was seen with canopy) and ``contrast``; LineStringZ with ``row`` (position in rows),
        ``start_m``, ``end_m``, ``length_m`` along γ and ``state`` ("missing", "unseen").
    """
    rows: list[tuple[object, ...]] = []
    gaps: list[tuple[object, ...]] = []
    if within is not None:
        shapely.prepare(within)
    for spacing, whole in standing:
        for row in _parted(whole, within, min_gap):
            found = _gaps_of(row, seen, min_gap)
            gaps += [(len(rows), a, b, b - a, state, _line(between(row.curve, a, b), dtm)) for a, b, state in found]
            bare, hidden = (sum(b - a for a, b, state in found if state == one) for one in (MISSING, UNSEEN))
            support = float((row.length - np.diff(row.empty, axis=1).sum()) / (row.length - hidden))
            line = _line(resample(row.curve, VERTEX), dtm)
            rows.append((spacing, float(bare), float(hidden), support, row.contrast, line))
    return (
        _frame(rows, ["spacing_m", "gap_m", "unseen_m", "support", "contrast"], dtm),
        _frame(gaps, ["row", "start_m", "end_m", "length_m", "state"], dtm),
    )


def _parted(row: Standing, within: shapely.Geometry | None, least: float) -> list[Standing]:
    """A row in the parts that a polygon leaves of it: what stands on both sides of a gap that is outside for metres."""
    inside = np.ones(len(row.curve), dtype=bool) if within is None else shapely.contains_xy(within, row.curve)
    if inside.all():
        return [row]
    way, parts = way_along(row.curve), []
    outside = np.cumsum(np.append(~inside[:-1] * np.diff(way), 0.0))
    cuts = np.flatnonzero(np.diff(np.interp(row.empty, way, outside), axis=1)[:, 0] >= least)
    for whole in np.split(row.runs, cuts + 1):
        own = way[inside & (way >= whole[0, 0]) & (way <= whole[-1, 1])]
        held = np.clip(whole, *own[[0, -1]]) if len(own) else whole[:0]
        held = held[held[:, 1] > held[:, 0]]  # canopy may have seemed to reach a little beyond
        runs = held if len(held) else whole
        first, last = runs[0, 0], runs[-1, 1]
        parts.append(row._replace(curve=between(row.curve, first, last), runs=runs - first))
    return parts


def _gaps_of(row: Standing, seen: Seen, least: float) -> list[tuple[float, float, str]]:
    """Start, end and state of a row's gaps of so many metres at the least."""
    gaps = row.empty[np.diff(row.empty, axis=1)[:, 0] >= least]
    if len(gaps) == 0:
        return []
    hidden = seen.hidden(row.curve, max(NARROW / 2, seen.grid.resolution))
    return [part for a, b in gaps for part in _in_states(a, b, np.clip(hidden, a, b), least)]


def _in_states(start: float, end: float, hidden: Values, least: float) -> list[tuple[float, float, str]]:
    """A gap in what was seen of it and what wasn't, in stretches (k, 2) that may lie beside it.

    What is too short for a vine to show, or to hide, is as what lies about it.
    """
    length = np.diff(hidden, axis=1)[:, 0]
    parts: list[tuple[float, float, str]] = []
    at = start
    for a, b in hidden[(length >= least) | (length > (end - start) / 2)]:
        if a - at >= least:
            parts.append((at, a, MISSING))
            at = a
        elif parts:
            at = parts.pop()[0]
        parts.append((at, b, UNSEEN))
        at = b
    if end - at >= least or not parts:
        parts.append((at, end, MISSING))
    else:
        parts[-1] = (parts[-1][0], end, UNSEEN)
    return parts


def beyond_ends(rows: gpd.GeoDataFrame, seen: Seen, within: shapely.Geometry | None = None) -> list[str]:
    """What there is to see where the next vine would stand beyond both ends of rows, one row after the other.

    It is "seen", "unseen", or "outside" the parcel; where it isn't seen the row may go on.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``vine_spacing_m``.
    seen, within
        As of :func:`lay_out`.
    """
    curves = [shapely.get_coordinates(line) for line in rows.geometry]
    ends = [extend(c, by)[[0, -1]] for c, by in zip(curves, rows["vine_spacing_m"], strict=True)]
    xy = np.concatenate([np.empty((0, 2)), *ends])
    inside = np.ones(len(xy), dtype=bool) if within is None else shapely.contains_xy(within, xy)
    told: list[str] = np.where(inside, np.where(seen.at(xy), SEEN, UNSEEN), OUTSIDE).tolist()
    return told


def _line(curve: Values, dtm: Raster) -> shapely.LineString:
    return shapely.LineString(np.column_stack([curve, sample(dtm, curve)]))


def _frame(records: list[tuple[object, ...]], columns: list[str], dtm: Raster) -> gpd.GeoDataFrame:
    data = {name: [r[k] for r in records] for k, name in enumerate(columns)}
    return gpd.GeoDataFrame(data, geometry=[r[-1] for r in records], crs=dtm.crs)


def count_missing(
    rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame, *, vine_spacing: float | None = None
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Count the vines missing in every gap, but for those of which nothing was seen.

    Parameters
    ----------
    rows, gaps : GeoDataFrame
        With ``row_id``; gaps with ``start_m``, ``end_m``, ``length_m`` and ``state``.
    vine_spacing : float, optional
        Metres between vines in a row; by default estimated from the gaps, and 1 m where they tell nothing.

    Returns
    -------
    rows, gaps : GeoDataFrame
        With ``n_missing``; rows with ``vine_spacing_m`` too.
    """
    spacing = vine_spacing or estimate_vine_spacing(gaps) or USUAL
    n = np.maximum(1, np.rint(gaps["length_m"].to_numpy(dtype=float) / spacing)).astype(np.int64)
    gaps = gaps.assign(n_missing=np.where(gaps["state"] == UNSEEN, 0, n))
    missing = gaps.groupby("row_id")["n_missing"].sum().reindex(rows["row_id"], fill_value=0)
    return rows.assign(n_missing=missing.to_numpy(), vine_spacing_m=spacing), gaps


def estimate_vine_spacing(gaps: gpd.GeoDataFrame) -> float | None:
    """Distance of vines in metres, from where gaps begin and end along their rows.

    Vines stand at equal distances, so the beginnings of a row's gaps lie whole numbers of vines apart, and so do
    their ends, but for what wasn't seen. The spacing is where the sum of the rows' periodograms peaks; None where the
    peak isn't clear.
    """
    frequency = np.arange(1 / WIDEST, 1 / NARROWEST, 0.0005)
    power, spread = np.zeros(len(frequency)), 0.0
    row, hidden = gaps["row_id"].to_numpy(), (gaps["state"] == UNSEEN).to_numpy(dtype=bool)
    # A number for each place of each row.
    start, end = (row + 1j * gaps[edge].to_numpy(dtype=float) for edge in ("start_m", "end_m"))
    for edge, other in ((start, end), (end, start)):
        told = np.sort_complex(edge[~hidden & ~np.isin(edge, other[hidden])])
        for at in np.split(told.imag, np.flatnonzero(np.diff(told.real)) + 1):
            power += np.abs(np.exp(2j * np.pi * frequency[:, None] * at).sum(axis=1)) ** 2 - len(at)
            spread += len(at) * (len(at) - 1)
    # Edges without any order give sums around zero, with the square root of the number of pairs as deviation.
    clear = spread > 0 and power.max() > 5 * np.sqrt(spread)
    return float(1 / frequency[power.argmax()]) if clear else None
