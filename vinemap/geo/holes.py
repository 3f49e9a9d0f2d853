"""Holes and notches of polygons, and the ways that lead into them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vinemap.compute.arrays import Flags, Values

TOUCHING = 0.01
"""Metres from a polygon within which a place is on its outline."""


def comes_back(lines: NDArray[np.object_], polygon: shapely.Geometry) -> Flags:
    """Whether lines (n,) leave a polygon and come back into it, as through a hole or a notch."""
    out = np.zeros(len(lines), dtype=bool)
    shapely.prepare(polygon)
    for k in np.flatnonzero(~shapely.covers(polygon, lines)).tolist():
        ends = np.asarray(shapely.points(shapely.get_coordinates(lines[k])[[0, -1]]))
        ends = ends[shapely.distance(ends, polygon) > TOUCHING]
        parts = shapely.get_parts(shapely.difference(lines[k], polygon))
        out[k] = (shapely.distance(parts[:, None], ends) > 0).all(axis=1).any()
    return out


def room_before(place: Values, way: Values, polygon: shapely.Geometry) -> float:
    """Metres from a place (2,) along a unit vector (2,) to a hole or notch of the polygon, of several the nearest."""
    point, parts = shapely.Point(place), shapely.get_parts(polygon)
    part = parts[int(np.argmin(shapely.distance(parts, point)))]
    far = place + (way_out(part) + float(shapely.distance(part, point))) * way
    outside = shapely.get_parts(shapely.difference(shapely.LineString([place, far]), part))
    holes = outside[shapely.distance(outside, shapely.Point(far)) > 0]
    return float(np.min(shapely.distance(holes, point), initial=np.inf))


def way_out(polygon: shapely.Geometry) -> float:
    """Metres that lead out of a polygon from any place in it."""
    west, south, east, north = shapely.bounds(polygon).tolist()
    return float(np.hypot(east - west, north - south)) + 1
