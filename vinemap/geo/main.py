"""The local frame {Main}: its origin, by default at the terrain's corner and never far from the cloud, and its axes."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pyproj import Transformer

from vinemap.errors import ConfigError, InputError
from vinemap.geo.crs import is_local, to_wgs84

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from pyproj import CRS

    from vinemap.compute.arrays import Floats
    from vinemap.geo.raster import Raster

FARTHEST = 50_000.0
"""Metres from the origin of {Main}, a plane that the globe leaves by then."""


class Origin(NamedTuple):
    """Origin of {Main}: WGS84 latitude and longitude in degrees, altitude in metres."""

    lat: float
    lon: float
    alt: float


class Corner(NamedTuple):
    """Origin of {Main} in local coordinates, in metres; there {Main} is their own frame, shifted."""

    x: float
    y: float
    z: float

    @property
    def alt(self) -> float:
        """Height in metres, by the name that it has in an :class:`Origin`."""
        return self.z


def origin_of(numbers: dict[str, float]) -> Origin | Corner:
    """Origin of {Main} as a product's record has it; TypeError if it is none."""
    return Corner(**numbers) if "x" in numbers else Origin(**numbers)


def check_origin(origin: Origin) -> Origin:
    """Return an origin that lies on the globe.

    Raises
    ------
    ConfigError
        If it doesn't.
    """
    if not (abs(origin.lat) <= 90 and abs(origin.lon) <= 180 and abs(origin.alt) < 10_000):
        raise ConfigError(
            f"origin {origin.lat:g}, {origin.lon:g}, {origin.alt:g} lies nowhere: give latitude and longitude in "
            "degrees and altitude in metres"
        )
    return origin


@lru_cache(maxsize=32)
def _topocentric(origin: Origin) -> Transformer:
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={origin.lat!r} +lon_0={origin.lon!r} +h_0={origin.alt!r}"
    )


def wgs84_to_main(lat_lon_alt: ArrayLike, origin: Origin) -> NDArray[np.float64]:
    """Points (n, 3) in {Main}: the topocentric frame (east, north, up) at ``origin``, in metres.

    Table 2.1's two halves agree in this frame to 3 mm.
    """
    points = np.atleast_2d(np.asarray(lat_lon_alt, dtype=float))
    return np.column_stack(_topocentric(origin).transform(points[:, 1], points[:, 0], points[:, 2]))


def main_to_wgs84(xyz: ArrayLike, origin: Origin) -> NDArray[np.float64]:
    """Latitude, longitude (degrees) and altitude (m) of points (n, 3) in {Main}."""
    points = np.atleast_2d(np.asarray(xyz, dtype=float))
    x, y, z = points.T
    lon, lat, alt = _topocentric(origin).transform(x, y, z, direction="INVERSE")
    return np.column_stack([lat, lon, alt])


def to_main(xyz: ArrayLike, crs: CRS, origin: Origin | Corner) -> NDArray[np.float64]:
    """Points (n, 3) of a projected or local CRS in {Main}."""
    if isinstance(origin, Corner):
        moved: NDArray[np.float64] = np.atleast_2d(np.asarray(xyz, dtype=float)) - np.array(origin)
        return moved
    return wgs84_to_main(to_wgs84(xyz, crs), origin)


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
