"""Whether coordinates can lie where their CRS says, and how well PROJ knows where that is."""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import AreaOfInterest, TransformerGroup

from vinemap.errors import GridError, InputError
from vinemap.geo.crs import LOCAL, WGS84, code_of, horizontal, is_local, stated, transformer, vertical

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pyproj.aoi import AreaOfUse

MARGIN = 1.0
"""Degrees beyond its area of use in which a CRS still serves: next to its zone, in surveys of a whole country."""
NEAR_ZERO = 0.02
"""Share of the way from (0, 0) to the middle of an area within which coordinates are local ones."""
AMIDST = 0.5
"""Share of the way from the middle of an area to its corner within which a point is amidst it."""
FOOT = 0.3048
ROUGH = 3.0
"""Metres of accuracy, as PROJ states it, up to which a transformation isn't worth a word."""
OTHER_PLACE = 5.0
"""Metres that two realizations of a datum aren't apart."""
SAME = 0.01
"""Metres within which two places are the same."""
GLOBE = 6_371_000.0
"""Metres of its radius."""
VINES = 25.0, 60.0
"""Degrees of latitude between which most vines grow."""
POLAR = 65.0
"""Degrees of latitude beyond which none do."""
UNSURE = "the accuracy of positions in WGS 84 is not known"
GIVE = "give their CRS with --crs EPSG:n"
"""What to do with coordinates of a cloud that aren't of its CRS."""


class Place(NamedTuple):
    """Where the points of files are: their CRS, the vertical datum that is stated, and what is to be known of both."""

    crs: CRS
    vertical: str | None = None
    remarks: Sequence[str] = ()
    """A sentence each; whole when all points were read."""


def check_place(crs: CRS, x: float, y: float, of: str, *, remedy: str = GIVE) -> None:
    """Make sure that a point lies where its CRS is used.

    Parameters
    ----------
    crs : CRS
        CRS of the coordinates.
    x, y : float
        The point, x east.
    of : str
        Whose coordinates they are.
    remedy : str
        What to do if they aren't of that CRS.

    Raises
    ------
    InputError
        If it doesn't, with what the reason may be, or there is no way from that CRS to WGS 84.
    GridError
        If there is one, but for a grid that PROJ lacks.
    """
    flat = horizontal(crs)
    area = _area(flat)
    if is_local(flat):
        return
    try:
        transformer(flat, WGS84).transform(x, y)
    except ProjError as error:
        if lacks := _lacking(flat):
            raise GridError(
                f"{of}: {_called(flat)} can't be brought to WGS 84 without the grid {lacks}: {remedy}"
            ) from error
        raise InputError(f"{of}: {_called(flat)} can't be brought to WGS 84: {remedy}") from error
    if area is None:
        return
    if _is_near_zero(flat, area, x, y):
        reason = f"they seem to be local metres: {remedy}{', or --crs local' if remedy == GIVE else ''}"
    elif _holds(area, *_lon_lat(flat, x, y)):
        if _maybe_swapped(flat, x, y) and abs(y) > POLAR:
            raise InputError(
                f"{of}: coordinates ({x:.4f}, {y:.4f}), taken for longitude and latitude, lie where no vines grow: "
                "export it with longitude first"
            )
        return
    else:
        ways = {
            "x and y seem to be swapped": (y, x),
            "their signs seem to be turned": (-x, -y),
            "x and y seem to be swapped and their signs turned": (-y, -x),
            "the sign of x seems to be turned": (-x, y),
            "the sign of y seems to be turned": (x, -y),
            **_in_other_unit(flat, x, y),
        }
        right = (way for way, other in ways.items() if _holds(area, *_lon_lat(flat, *other), margin=0.0))
        reason = next(right, "perhaps they are swapped, negated, local or in another unit")
        reason = f"{reason}: {remedy}"
    raise InputError(
        f"{of}: coordinates ({x:.2f}, {y:.2f}) lie outside the area of {_called(flat)}, "
        f"{area.west:g} to {area.east:g}° E, {area.south:g} to {area.north:g}° N: {reason}"
    )


def doubts_of(crs: CRS, x: float, y: float) -> list[str]:
    """What is to be known of the way from a CRS to WGS 84 near a point (x east): a sentence each."""
    own, flat = stated(crs), horizontal(crs)
    if is_local(own):
        known = f"{own.name!r} has no place on the globe, and nothing is told in WGS 84: --crs EPSG:n gives it one"
        return [] if own == LOCAL else [known]
    return [*_roughness(flat, x, y), *_other_shift(own, flat, x, y)]


def _maybe_swapped(flat: CRS, x: float, y: float) -> bool:
    """Whether degrees lie where few vines grow, and would not if latitude came first."""
    return flat.is_geographic and not VINES[0] <= abs(y) <= VINES[1] and VINES[0] <= abs(x) <= VINES[1]


def doubts_of_cloud(crs: CRS, x: float, y: float) -> list[str]:
    """What is to be known of where a cloud is, by one of its points (x east): a sentence each."""
    return [*_order(crs, x, y), *doubts_of(crs, x, y), *_datum(crs, x, y)]


def _order(crs: CRS, x: float, y: float) -> list[str]:
    """Whether degrees may be latitude and longitude."""
    if not _maybe_swapped(horizontal(crs), x, y):
        return []
    known = (
        f"coordinates ({x:.4f}, {y:.4f}) are taken for longitude and latitude: if they are the other way round, export "
        "the cloud with longitude first"
    )
    return [known]


def _datum(crs: CRS, x: float, y: float) -> list[str]:
    """Whether heights are said to be above a datum that isn't used there, as in a CRS of another survey."""
    up, flat = vertical(crs), horizontal(crs)
    area = _area(up) if up and not is_local(flat) else None
    if up is None or area is None or _holds(area, *_lon_lat(flat, x, y)):
        return []
    return [f"heights are said to be above {up.name}, which isn't used there: --crs EPSG:n+m tells what they are above"]


def doubts_of_heights(crs: CRS) -> list[str]:
    """Whether heights are taken to be in a unit that isn't the metre, for want of one that is stated: a sentence."""
    axis = crs.axis_info[0]
    if vertical(crs) or len(crs.axis_info) > 2 or not crs.is_projected or axis.unit_conversion_factor == 1.0:
        return []
    return [f"heights are taken to be in {axis.unit_name}, as x and y are: if they aren't, --crs EPSG:n+m tells it"]


def doubts_of_given(given: CRS, own: CRS, x: float, y: float, of: str) -> list[str]:
    """Whether a CRS that is given leads elsewhere from a point (x east) than that which a file states: a sentence."""
    if not OTHER_PLACE < (metres := apart(given, own, x, y)) < np.inf:
        return []
    return [f"{of} states {own.name}, which leads {metres:,.0f} m from where --crs does; what is given counts"]


def _roughness(flat: CRS, x: float, y: float) -> list[str]:
    """Whether PROJ knows a place in WGS 84 less well than it could, or than matters."""
    lon, lat = _lon_lat(flat, x, y)
    if flat.is_bound:
        lacks = _lacking(flat)
        return [f"{UNSURE}: PROJ lacks the grid {lacks} for {_called(flat)}"] if lacks else []
    if not (np.isfinite(lon) and np.isfinite(lat)):
        return []
    group = _ways(flat, round(lon, 1), round(lat, 1))
    metres = _accuracy(flat, x, y)
    known = UNSURE
    if metres >= 0:
        known = f"positions in WGS 84 are good to {metres:g} m only"
    if not group.best_available and group.unavailable_operations:
        best = group.unavailable_operations[0]
        names = ", ".join(grid.short_name for grid in best.grids if not grid.available)
        better = f", which would make it {best.accuracy:g} m" if 0 <= best.accuracy < metres else ""
        return [f"{known}: PROJ lacks the grid {names} for {_called(flat)}{better}"]
    if metres > ROUGH or metres < 0:
        return [f"{known}: PROJ knows no better way there from {_called(flat)}"]
    return []


@lru_cache(maxsize=32)
def _ways(flat: CRS, lon: float, lat: float) -> TransformerGroup:
    """All ways to WGS 84 near a place in degrees."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of grids that are missing
        near = AreaOfInterest(lon, lat, lon, lat)
        return TransformerGroup(flat, WGS84, always_xy=True, area_of_interest=near)


def _lacking(flat: CRS) -> str:
    """Which grids a CRS names itself for its way to WGS 84, and PROJ lacks."""
    grids = flat.coordinate_operation.grids if flat.is_bound and flat.coordinate_operation else []
    lacking = (grid.short_name.lstrip("@") for grid in grids if not grid.available)
    return ", ".join(name for name in lacking if name != "null")


def _accuracy(flat: CRS, x: float, y: float) -> float:
    """Metres that PROJ states for the way it takes from a point to WGS 84; negative where it knows none."""
    convert = transformer(flat, WGS84)
    convert.transform(x, y)
    try:
        return float(convert.get_last_used_operation().accuracy)
    except ProjError:
        return float(convert.accuracy)


def _other_shift(bound: CRS, flat: CRS, x: float, y: float) -> list[str]:
    """Whether a shift that is stated beside a CRS, and doesn't count, leads elsewhere."""
    if bound == flat or _lacking(bound) or not (metres := apart(flat, bound, x, y)) > SAME:
        return []
    return [f"the TOWGS84 beside {_called(flat)} leads {metres:.2f} m elsewhere; what PROJ knows of that CRS counts"]


def apart(one: CRS, other: CRS, x: float, y: float) -> float:
    """Metres between the places to which two CRSs lead from a point (x east); NaN where one has none."""
    (lon, lon2), (lat, lat2) = zip(_lon_lat(horizontal(one), x, y), _lon_lat(stated(other), x, y), strict=True)
    with np.errstate(invalid="ignore"):
        way = np.radians([((lon2 - lon + 180) % 360 - 180) * np.cos(np.radians(lat)), lat2 - lat])
        return float(GLOBE * np.hypot(*way))


def _in_other_unit(flat: CRS, x: float, y: float) -> dict[str, tuple[float, float]]:
    """A point as it would be if its numbers were metres for feet, or feet for metres."""
    unit = flat.axis_info[0].unit_conversion_factor
    if not flat.is_projected:
        return {}
    if unit == 1:
        return {"they seem to be in feet": (FOOT * x, FOOT * y)}
    return {"they seem to be in metres": (x / unit, y / unit)}


def _called(flat: CRS) -> str:
    code = code_of(flat)
    return f"{':'.join(code)} ({flat.name})" if code else flat.name


def _area(flat: CRS) -> AreaOfUse | None:
    """Where a CRS is used, stated by itself or known by its code."""
    code = code_of(flat)
    try:
        area = flat.area_of_use or (CRS.from_authority(*code).area_of_use if code else None)
    except CRSError:
        return None
    return cast("AreaOfUse | None", area)  # stubs have it in a private module


def _lon_lat(flat: CRS, x: float, y: float) -> tuple[float, float]:
    """Degrees east and north; infinite where there are none."""
    try:
        lon, lat = transformer(flat, WGS84).transform(x, y)
    except ProjError:
        return np.inf, np.inf
    return float(lon), float(lat)


def _holds(area: AreaOfUse, lon: float, lat: float, *, margin: float = MARGIN) -> bool:
    """Whether an area, which may reach over the antimeridian, holds a place, with a margin in degrees."""
    if not (abs(lon) <= 360 and area.south - margin <= lat <= area.north + margin):
        return False
    width = (area.east - area.west) % 360 or 360.0
    return bool((lon - area.west + margin) % 360 <= width + 2 * margin)


def _is_near_zero(flat: CRS, area: AreaOfUse, x: float, y: float) -> bool:
    """Whether a point lies as near to the zero of a projected CRS as to be one of local coordinates.

    Where zero is amidst the area, nothing can be told.
    """
    if not flat.is_projected:
        return False
    lon, lat = area.west + (area.east - area.west) % 360 / 2, (area.south + area.north) / 2
    ways = transformer(WGS84, flat).transform([lon, area.west], [lat, area.south])
    (middle, corner) = np.transpose(ways)
    far = np.hypot(*middle)
    return bool(np.hypot(x, y) < NEAR_ZERO * far and far > AMIDST * np.hypot(*(middle - corner)))
