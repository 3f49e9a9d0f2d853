"""Where {Main} begins: by default at the terrain's corner, and never far from the cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.errors import InputError
from vinemap.geo.crs import Corner, Origin, is_local, to_main, to_wgs84

if TYPE_CHECKING:
    from pyproj import CRS

    from vinemap.compute.arrays import Floats
    from vinemap.geo.raster import Raster

FARTHEST = 50_000.0
"""Metres from the origin of {Main}, a plane that the globe leaves by then."""


def corner_of(dtm: Raster) -> Origin | Corner:
    """Origin of {Main} where none is given: the south-western corner of the terrain, at its lowest elevation."""
    grid = dtm.grid
    south = grid.north - grid.ny * grid.resolution
    corner = Corner(grid.west, south, float(np.floor(np.nanmin(dtm.values))))
    if is_local(dtm.crs):
        return corner
    lat, lon, alt = to_wgs84(corner, dtm.crs)[0]
    return Origin(round(float(lat), 9), round(float(lon), 9), float(alt))


def check_near(origin: Origin, point: Floats, crs: CRS) -> None:
    """Make sure that an origin of {Main} lies near the cloud, one point (3,) of which is given.

    Raises
    ------
    InputError
        If it doesn't.
    """
    if is_local(crs):
        raise InputError("local coordinates have no latitude and longitude: leave the origin out")
    if np.abs(to_main(point[None], crs, origin)[0, :2]).max() > FARTHEST:
        raise InputError(f"origin {origin.lat:g}, {origin.lon:g} is over 50 km from the cloud: latitude comes first")
