"""Coordinate systems: the metric CRS of a parcel, the local frame {Main}, and WGS84.

Heights are never moved between vertical datums: without geoid grids PROJ would leave them unchanged
with no more than a warning, so they stay the cloud's own, and only their unit becomes the metre.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from pyproj import CRS, Proj, Transformer
from pyproj.exceptions import CRSError, ProjError

from vinemap.errors import ConfigError, InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from vinemap.compute.arrays import Floats
    from vinemap.geo.raster import Raster

WGS84 = CRS.from_epsg(4326)
ELLIPSOIDAL = "ellipsoidal height"
"""What stands for the vertical datum of a CRS whose third axis is the height above its ellipsoid."""
SCALE_TOLERANCE = 0.002
"""A projection that stretches lengths by more than this is not used for measuring (Web Mercator, say)."""


class Origin(NamedTuple):
    """Origin of {Main}: WGS84 latitude and longitude in degrees, altitude in metres."""

    lat: float
    lon: float
    alt: float


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


def parse_crs(text: str) -> CRS:
    """Read a CRS as a user writes it (``EPSG:32632``, ``32632``, WKT, PROJ).

    Raises
    ------
    InputError
        If PROJ doesn't know it.
    """
    try:
        crs = CRS.from_user_input(int(text) if text.strip().isdigit() else text)
    except CRSError as error:
        raise InputError(f"unknown CRS {text!r}: give it as EPSG:n, for example EPSG:32632") from error
    return check_horizontal(crs)


def check_horizontal(crs: CRS) -> CRS:
    """Return a CRS that places points on the map: projected or geographic, with heights or not.

    Raises
    ------
    InputError
        If it does neither (geocentric, vertical alone).
    """
    if not (crs.is_projected or crs.is_geographic):
        raise InputError(f"{crs.name} is neither projected nor geographic: give the cloud's CRS with --crs EPSG:n")
    return crs


def horizontal(crs: CRS) -> CRS:
    """Return the two-dimensional part of a CRS, which is all that GeoPackage and GeoTIFF keep well."""
    flat = crs.sub_crs_list[0] if crs.is_compound else crs
    return flat.to_2d()


def vertical_name(crs: CRS) -> str | None:
    """Name of the vertical datum that a CRS states, or None."""
    if crs.is_compound:
        return crs.sub_crs_list[1].name
    return ELLIPSOIDAL if len(crs.axis_info) > 2 else None


def is_ellipsoidal(vertical: str) -> bool:
    """Whether a vertical datum, by its name, is the ellipsoid."""
    return "ellipsoid" in vertical.lower()


def vertical_unit(crs: CRS) -> float:
    """Metres in one unit of height.

    A CRS without heights of its own is taken to measure them in its horizontal unit (state-plane feet),
    and in metres where that unit is an angle.
    """
    if crs.is_compound:
        return float(crs.sub_crs_list[1].axis_info[0].unit_conversion_factor)
    if len(crs.axis_info) > 2:
        return float(crs.axis_info[2].unit_conversion_factor)
    return 1.0 if crs.is_geographic else float(crs.axis_info[0].unit_conversion_factor)


def metric_crs(crs: CRS, x: float, y: float) -> CRS:
    """Choose the projected CRS in metres in which a cloud around (x, y) is worked.

    The cloud's own horizontal CRS where it is projected, metric and true to scale there; else the UTM
    zone of the point.

    Parameters
    ----------
    crs : CRS
        CRS of the coordinates.
    x, y : float
        A point of the cloud, in ``crs``, x east.
    """
    flat = horizontal(crs)
    try:
        lon, lat = transformer(flat, WGS84).transform(x, y)
    except ProjError as error:
        raise InputError(f"{flat.name} can't be brought to WGS 84: give another with --crs") from error
    if not (np.isfinite(lon) and np.isfinite(lat)):
        raise InputError(f"coordinates ({x:.1f}, {y:.1f}) don't lie in {flat.name}: give the right one with --crs")
    axes = {axis.direction for axis in flat.axis_info[:2]}
    if flat.is_projected and flat.axis_info[0].unit_conversion_factor == 1.0 and axes == {"east", "north"}:
        factors = Proj(flat).get_factors(lon, lat)
        if max(abs(factors.meridional_scale - 1), abs(factors.parallel_scale - 1)) < SCALE_TOLERANCE:
            return flat
    zone = int((lon + 180) // 6) % 60 + 1
    return CRS.from_epsg((32600 if lat >= 0 else 32700) + zone)


@lru_cache(maxsize=32)
def transformer(source: CRS, target: CRS) -> Transformer:
    """Transformer between horizontal CRSs, x east and y north on both sides."""
    return Transformer.from_crs(source, target, always_xy=True)


@lru_cache(maxsize=32)
def _topocentric(origin: Origin) -> Transformer:
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={origin.lat!r} +lon_0={origin.lon!r} +h_0={origin.alt!r}"
    )


def project(polygon: shapely.Geometry, source: CRS, target: CRS) -> shapely.Geometry:
    """Bring a geometry, in two dimensions, from one CRS to another.

    Raises
    ------
    InputError
        If nothing leads from one to the other.
    """
    try:
        convert = transformer(horizontal(source), target).transform
    except ProjError as error:
        raise InputError(f"polygons in {source.name} can't be brought to {target.name}: check their CRS") from error
    return shapely.transform(shapely.force_2d(polygon), lambda xy: np.column_stack(convert(*xy.T)))


def to_wgs84(xyz: ArrayLike, crs: CRS) -> NDArray[np.float64]:
    """Latitude, longitude (degrees) and altitude (m) of points (n, 3) in a projected CRS."""
    points = np.atleast_2d(np.asarray(xyz, dtype=float))
    lon, lat = transformer(crs, WGS84).transform(points[:, 0], points[:, 1])
    return np.column_stack([lat, lon, points[:, 2]])


def from_wgs84(lat_lon_alt: ArrayLike, crs: CRS) -> NDArray[np.float64]:
    """Points (n, 3) in a projected CRS from latitude, longitude (degrees) and altitude (m)."""
    points = np.atleast_2d(np.asarray(lat_lon_alt, dtype=float))
    x, y = transformer(WGS84, crs).transform(points[:, 1], points[:, 0])
    return np.column_stack([x, y, points[:, 2]])


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


def to_main(xyz: ArrayLike, crs: CRS, origin: Origin) -> NDArray[np.float64]:
    """Points (n, 3) of a projected CRS in {Main}."""
    return wgs84_to_main(to_wgs84(xyz, crs), origin)


FARTHEST = 50_000.0
"""Metres from the origin of {Main}, a plane that the globe leaves by then."""


def corner_of(dtm: Raster) -> Origin:
    """Origin of {Main} where none is given: the south-western corner of the terrain, at its lowest elevation."""
    grid = dtm.grid
    south = grid.north - grid.ny * grid.resolution
    lat, lon, alt = to_wgs84([grid.west, south, float(np.floor(np.nanmin(dtm.values)))], dtm.crs)[0]
    return Origin(round(float(lat), 9), round(float(lon), 9), float(alt))


def check_near(origin: Origin, point: Floats, crs: CRS) -> None:
    """Make sure that an origin of {Main} lies near the cloud, one point (3,) of which is given.

    Raises
    ------
    InputError
        If it doesn't.
    """
    if np.abs(to_main(point[None], crs, origin)[0, :2]).max() > FARTHEST:
        raise InputError(f"origin {origin.lat:g}, {origin.lon:g} is over 50 km from the cloud: latitude comes first")
