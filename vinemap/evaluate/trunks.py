"""Known vines: points, as surveyed by RTK, in the rows in which they stand."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from vinemap.evaluate.planting import Places
from vinemap.geo.crs import project
from vinemap.geo.curve import unit

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.compute.arrays import Ints, Values
    from vinemap.evaluate.shift import Shift

    Lines = NDArray[np.object_]

USUAL = 2.5
"""Metres between rows that are taken where there is but one."""
ASIDE = 0.2
"""Spacings by which most known vines may stand aside of their rows before these are doubtful."""
SURVEYED = 0.02
"""Metres, a standard deviation, by which a surveyed vine is off."""


def vines_in_rows(
    points: gpd.GeoSeries | None, rows: gpd.GeoDataFrame, shift: Shift | None = None
) -> tuple[dict[int, Values], list[str]]:
    """Find in which row each of some known vines stands, and where along it.

    Parameters
    ----------
    points : GeoSeries
        Points in any CRS, or None.
    rows : GeoDataFrame
        LineString in a CRS in metres, with ``spacing_m``.
    shift : Shift, optional
        By which the rows lie off what is known.

    Returns
    -------
    vines : dict of int to array
        By the rows' positions in the table: metres along them, in order.
    remarks : list of str
        How many stand in none: half a spacing or farther aside, or half a vine's distance beyond its ends. That most
        are so far aside that their rows may be others.
    """
    if points is None or len(points) == 0 or len(rows) == 0:
        return {}, []
    xy = shapely.get_coordinates(project(points.to_numpy(), points.crs, rows.crs))
    xy = xy + shift.metres if shift else xy
    row, position, beyond, away = _places(xy, shapely.force_2d(rows.geometry.to_numpy()))
    spacing = rows["spacing_m"].to_numpy(dtype=float)
    share = away / np.where(np.isfinite(spacing), spacing, USUAL)[row]
    stands = share <= 0.5
    near = {k: np.sort(position[stands & (row == k)]) for k in np.unique(row[stands]).tolist()}
    apart = known_spacing(near.values())
    stands &= beyond <= (apart or 0.0) / 2
    vines = {k: np.sort(position[stands & (row == k)]) for k in np.unique(row[stands]).tolist()}
    lost = len(xy) - int(stands.sum())
    off, doubt = (float(np.median(one[stands])) if stands.any() else 0.0 for one in (away, share))
    remarks = {
        f"{lost} of {len(xy)} known vines stand farther than half a spacing from any row, or beyond its ends, and are "
        "left out": lost > 0,
        f"half of the known vines in rows stand {off:.2f} m or more aside of them, and may be the next rows'; give "
        "known rows from the same survey (--rows), or look whether the CRS is right": doubt > ASIDE,
    }
    return vines, [remark for remark, holds in remarks.items() if holds]


def _places(xy: Values, lines: Lines) -> tuple[Ints, Values, Values, Values]:
    """Rows (n,) that are nearest to points (n, 2), metres along them, beyond their ends, and away from them."""
    points = np.asarray(shapely.points(xy))
    row = np.asarray(shapely.STRtree(lines).nearest(points))
    position = shapely.line_locate_point(lines[row], points)
    length = shapely.length(lines)[row]
    inner = np.clip(position + np.where(position <= 0, 1.0, -1.0), 0, length)
    foot, back = (shapely.get_coordinates(shapely.line_interpolate_point(lines[row], p)) for p in (position, inner))
    away = xy - foot
    beyond = np.where((position <= 0) | (position >= length), (away * unit(foot - back)).sum(axis=1), 0.0)
    return row, position, beyond, np.hypot(*away.T)


def known_spacing(rows: Collection[Values]) -> float | None:
    """Metres between vines, the median of known ones that follow each other; None where there are no two."""
    steps = np.concatenate([np.empty(0), *(np.diff(position) for position in rows)])
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else None


def with_known(places: Places, known: Mapping[int, Values]) -> Places:
    """Places of vines, with those that are known in place of others in the rows of which they are."""
    if not known:
        return places
    own = ~np.isin(places.row, list(known))
    row = np.concatenate([places.row[own], *(np.full(len(position), k) for k, position in known.items())])
    position = np.concatenate([places.position[own], *known.values()])
    deviation = np.append(places.deviation[own], np.full(len(position) - int(own.sum()), SURVEYED))
    order = np.lexsort((position, row))
    return Places(row[order], position[order], deviation[order])
