"""Rows with their gaps: what wasn't seen, what of a row the parcel's polygon leaves, what lies beyond its ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import shapely

from vinemap.geo.curve import between, extend, resample, way_along
from vinemap.geo.raster import sample
from vinemap.rows.centre_line import CELL
from vinemap.rows.standing.canopy import NARROW

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vinemap.compute.arrays import Values
    from vinemap.geo.raster import Raster
    from vinemap.rows.standing.canopy import Standing
    from vinemap.surfaces.seen import Seen

MISSING, UNSEEN = "missing", "unseen"
"""States of a gap: no vine stands there, or nothing tells whether one does."""
SEEN, OUTSIDE = "seen", "outside"
"""What is told, beside ``UNSEEN``, of the place beyond an end where the next vine would be."""

VERTEX = 0.5
"""Metres between the vertices of a curve."""


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
        of the length that was seen with canopy), ``contrast``, and ``start_told`` and ``end_told``, whether canopy
        tells where the row ends; LineStringZ with ``row`` (position in rows),
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
            support = float(np.diff(row.runs, axis=1).sum() / max(row.length - hidden, CELL))
            line = _line(resample(row.curve, VERTEX), dtm)
            rows.append((spacing, float(bare), float(hidden), support, row.contrast, *row.told, line))
    return (
        _frame(rows, ["spacing_m", "gap_m", "unseen_m", "support", "contrast", "start_told", "end_told"], dtm),
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
    for whole in np.split(row.runs, cuts):
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
