"""Coordinate systems: the metric CRS of a parcel, and WGS84.

Heights are never moved between vertical datums: without geoid grids PROJ would leave them unchanged
with no more than a warning, so they stay the cloud's own, and only their unit becomes the metre.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import shapely
from pyproj import CRS, Proj, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError, ProjError

from vinemap.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

G = TypeVar("G", shapely.Geometry, np.ndarray)

WGS84 = CRS.from_epsg(4326)
LOCAL = CRS.from_wkt(
    'ENGCRS["local metres",EDATUM["unknown"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
)
"""Metres about a point that nobody has placed on the globe, x east and y north; ``local`` in words."""
ELLIPSOIDAL = "ellipsoidal height"
"""What stands for the vertical datum of a CRS whose third axis is the height above its ellipsoid."""
UNKNOWN = "unknown"
"""Name of a vertical CRS of which only the unit is stated."""
SAME = 0.001
"""Metres within which coordinates are the same."""
SAME_DEGREES = 1e-7
"""The same, of places: a centimetre."""
LIKELY = 70
"""Confidence, of 100, with which PROJ knows a CRS by its numbers alone."""
SCALE_TOLERANCE = 0.002
"""A projection that stretches lengths by more than this is not used for measuring (Web Mercator, say)."""


def parse_crs(text: str) -> CRS:
    """Read a CRS as a user writes it (``EPSG:32632``, ``32632``, WKT, PROJ, ``local``).

    Raises
    ------
    InputError
        If PROJ doesn't know it.
    """
    if text.strip().lower() == "local":
        return LOCAL
    try:
        crs = CRS.from_user_input(int(text) if text.strip().isdigit() else text)
    except CRSError as error:
        raise InputError(f"unknown CRS {text!r}: give it as EPSG:n, for example EPSG:32632") from error
    return check_horizontal(crs)


def check_horizontal(crs: CRS, of: str = "") -> CRS:
    """Return a CRS that places points on the map: projected, geographic or local, with heights or not.

    Raises
    ------
    InputError
        If it does none of that (geocentric, vertical alone), or can't be used; ``of`` tells whose it is.
    """
    if not (crs.is_projected or crs.is_geographic or is_local(crs)):
        raise InputError(f"{of}{crs.name} is neither projected nor geographic: give the cloud's CRS with --crs EPSG:n")
    if is_local(crs) and crs.axis_info[0].unit_conversion_factor != 1.0:
        raise InputError(f"{of}{crs.name} is local, and not in metres: export the cloud in metres")
    if any(axis.direction == "down" for axis in (vertical(crs) or crs).axis_info):
        raise InputError(f"{of}heights of {crs.name} count downwards: export the cloud with z upwards")
    return crs


def is_local(crs: CRS) -> bool:
    """Whether a CRS has no place on the globe."""
    return crs.is_engineering


@lru_cache(maxsize=32)
def horizontal(crs: CRS) -> CRS:
    """Return the two-dimensional part of a CRS, which is all that GeoPackage and GeoTIFF keep well.

    A shift to WGS 84 that is stated beside it (TOWGS84) counts where the CRS has no code; one that has is kept in files
    by its code, and means there what PROJ makes of it. Local ones in metres, of any name, are ``LOCAL``.
    """
    flat = stated(crs)
    if is_local(flat) and flat.axis_info[0].unit_conversion_factor == 1.0:
        return LOCAL
    code = _stated_code(unbound(flat)) or _code_beside(flat) if flat.is_bound else None
    return CRS.from_authority(*code) if code else flat


@lru_cache(maxsize=32)
def stated(crs: CRS) -> CRS:
    """The two-dimensional part of a CRS, with the shift to WGS 84 that is stated beside it, if there is one."""
    return (crs.sub_crs_list[0] if crs.is_compound and crs.sub_crs_list else crs).to_2d()


def unbound(crs: CRS) -> CRS:
    """A CRS without the shift to another that is stated beside it."""
    return crs.source_crs if crs.is_bound and crs.source_crs else crs


def _stated_code(crs: CRS) -> tuple[str, str] | None:
    """Authority and code that a CRS states itself, if they are those of a CRS that gives the same coordinates."""
    code = [str(part) for part in (crs.to_json_dict().get("id") or {}).values()]
    try:
        known = CRS.from_authority(*code) if len(code) == 2 else None
        if known is None or (middle := _middle(known)) is None:
            return None
        there, here = (transformer(known.geodetic_crs, one).transform(*middle) for one in (known, crs))
    except (CRSError, ProjError):
        return None
    return (code[0], code[1]) if np.allclose(there, here, rtol=0, atol=SAME) else None


def _code_beside(bound: CRS) -> tuple[str, str] | None:
    """Authority and code of the CRS that a shift stands beside, by its name and numbers.

    Numbers alone may be those of several, of different datums: then of the one to which the shift leads, too.
    """
    crs = unbound(bound)
    likely = [(match.auth_name, match.code, match.confidence) for match in crs.list_authority(min_confidence=LIKELY)]
    best = [(authority, code) for authority, code, sure in likely if sure == max(one[2] for one in likely)]
    if len(best) < 2:
        return code_of(crs)
    return next((code for code in best if _leads(bound, CRS.from_authority(*code))), None)


def _leads(bound: CRS, known: CRS) -> bool:
    """Whether a shift leads to where PROJ has a CRS."""
    try:
        middle = _middle(known)
        x, y = transformer(known.geodetic_crs, known).transform(*middle) if middle else (np.nan, np.nan)
        there, here = (transformer(one, WGS84).transform(x, y) for one in (known, bound))
    except ProjError:
        return False
    return bool(np.allclose(there, here, rtol=0, atol=SAME_DEGREES))


def _middle(known: CRS) -> tuple[float, float] | None:
    """Degrees in the middle of where a CRS is used."""
    area = known.area_of_use
    return ((area.west + area.east) / 2, (area.south + area.north) / 2) if area else None


@lru_cache(maxsize=32)
def code_of(crs: CRS) -> tuple[str, str] | None:
    """Authority and code by which a CRS is known, as ("EPSG", "32632")."""
    code: tuple[str, str] | None = crs.to_authority(min_confidence=LIKELY)
    return code


@lru_cache(maxsize=32)
def vertical(crs: CRS) -> CRS | None:
    """The vertical part of a compound CRS, or None."""
    return unbound(crs.sub_crs_list[1]) if crs.is_compound and crs.sub_crs_list else None


def vertical_name(crs: CRS) -> str | None:
    """Name of the vertical datum that a CRS states, as it is called where heights are in metres, or None."""
    if up := vertical(crs):
        return None if up.name == UNKNOWN else _in_metres(up.name)
    return ELLIPSOIDAL if len(crs.axis_info) > 2 and not is_local(crs) else None


@lru_cache(maxsize=32)
def _in_metres(name: str) -> str:
    """Name of a vertical CRS without the feet in it, if it is known by that."""
    plain = name.removesuffix(" (ftUS)").removesuffix(" (ft)")
    try:
        return plain if CRS.from_user_input(plain).is_vertical else name
    except CRSError:
        return name


def is_ellipsoidal(vertical: str) -> bool:
    """Whether a vertical datum, by its name, is the ellipsoid."""
    return "ellipsoid" in vertical.lower()


def with_vertical(flat: CRS, vertical: str | None) -> CRS:
    """A horizontal CRS with heights above a datum by its name; as it is where PROJ knows none of that name."""
    if vertical is None or is_local(flat):
        return flat
    if is_ellipsoidal(vertical):
        return flat.to_3d()
    try:
        datum = CRS.from_user_input(vertical)
    except CRSError:
        return flat
    known = datum.is_vertical and datum.name == vertical
    return CompoundCRS(f"{flat.name} + {vertical}", [flat, datum]) if known else flat


def vertical_unit(crs: CRS) -> float:
    """Metres in one unit of height.

    A CRS without heights of its own is taken to measure them in its horizontal unit (state-plane feet),
    and in metres where that unit is an angle.
    """
    if up := vertical(crs):
        return float(up.axis_info[0].unit_conversion_factor)
    if len(crs.axis_info) > 2:
        return float(crs.axis_info[2].unit_conversion_factor)
    return 1.0 if crs.is_geographic else float(crs.axis_info[0].unit_conversion_factor)


def metric_crs(crs: CRS, x: float, y: float) -> CRS:
    """Choose the projected CRS in metres in which a cloud around (x, y) is worked.

    ``LOCAL`` where the cloud is local; its own horizontal CRS where that is projected, metric, true to scale there, and
    such that files keep it as it is; else the UTM zone of the point.

    Parameters
    ----------
    crs : CRS
        CRS of the coordinates.
    x, y : float
        A point of the cloud, in ``crs``, x east.
    """
    flat = horizontal(crs)
    if is_local(flat):
        return check_horizontal(flat)
    try:
        lon, lat = transformer(flat, WGS84).transform(x, y)
    except ProjError as error:
        raise InputError(f"{flat.name} can't be brought to WGS 84: give another with --crs") from error
    if not (np.isfinite(lon) and np.isfinite(lat)):
        raise InputError(f"coordinates ({x:.1f}, {y:.1f}) don't lie in {flat.name}: give the right one with --crs")
    axes = {axis.direction for axis in flat.axis_info[:2]}
    metric = flat.is_projected and flat.axis_info[0].unit_conversion_factor == 1.0
    if metric and not flat.is_bound and axes == {"east", "north"}:
        factors = Proj(flat).get_factors(lon, lat)
        if max(abs(factors.meridional_scale - 1), abs(factors.parallel_scale - 1)) < SCALE_TOLERANCE:
            kept = transformer(_in_files(flat), WGS84).transform(x, y)
            if max(abs(kept[0] - lon), abs(kept[1] - lat)) < SAME_DEGREES:
                return flat
    zone = int((lon + 180) // 6) % 60 + 1
    return CRS.from_epsg((32600 if lat >= 0 else 32700) + zone)


def _in_files(flat: CRS) -> CRS:
    """What is read of a CRS after it was written: the one of the code by which it goes, or of its name and numbers."""
    code = flat.to_epsg()
    return CRS.from_epsg(code) if code else CRS.from_wkt(flat.to_wkt("WKT1_GDAL"))


@lru_cache(maxsize=32)
def transformer(source: CRS, target: CRS) -> Transformer:
    """Transformer between horizontal CRSs, x east and y north on both sides."""
    return Transformer.from_crs(source, target, always_xy=True)


def project(shapes: G, source: CRS, target: CRS) -> G:
    """Bring a geometry, or an array of such, in two dimensions from one CRS to another.

    Raises
    ------
    InputError
        If nothing leads from one to the other.
    """
    if is_local(source) and is_local(target):
        return shapely.force_2d(shapes)
    try:
        convert = transformer(horizontal(source), target).transform
    except ProjError as error:
        raise InputError(f"shapes in {source.name} can't be brought to {target.name}: check their CRS") from error
    return shapely.transform(shapely.force_2d(shapes), lambda xy: np.column_stack(convert(*xy.T)))


def to_wgs84(xyz: ArrayLike, crs: CRS) -> NDArray[np.float64]:
    """Latitude, longitude (degrees) and altitude (m) of points (n, 3) in a projected CRS; NaN in a local one.

    Between datums the height has its part in the way, by some centimetres a kilometre, as in programs that read layers.
    """
    points = np.atleast_2d(np.asarray(xyz, dtype=float))
    if is_local(crs):
        return np.full(points.shape, np.nan)
    lon, lat, _ = transformer(crs, WGS84).transform(*points.T)
    return np.column_stack([lat, lon, points[:, 2]])


def from_wgs84(lat_lon_alt: ArrayLike, crs: CRS) -> NDArray[np.float64]:
    """Points (n, 3) in a projected CRS from latitude, longitude (degrees) and altitude (m)."""
    points = np.atleast_2d(np.asarray(lat_lon_alt, dtype=float))
    x, y, _ = transformer(WGS84, crs).transform(points[:, 1], points[:, 0], points[:, 2])
    return np.column_stack([x, y, points[:, 2]])
