"""What a cloud's file states of its coordinates: their CRS, in WKT or in GeoTIFF keys, and how finely they are stored.

It is told as laspy tells it of LAS; what other formats tell is brought to that (:mod:`vinemap.cloud.formats.told`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from pyproj import CRS
from pyproj.crs import CompoundCRS, Datum  # type: ignore[attr-defined]  # stubs have it in a private module
from pyproj.database import get_units_map
from pyproj.exceptions import CRSError, ProjError

from vinemap.errors import InputError
from vinemap.geo.crs import (
    ELLIPSOIDAL,
    UNKNOWN,
    check_horizontal,
    horizontal,
    is_local,
    stated,
    transformer,
    vertical,
    vertical_name,
    vertical_unit,
)
from vinemap.geo.place import (
    GLOBE,
    OTHER_PLACE,
    apart,
    check_place,
    doubts_of_cloud,
    doubts_of_given,
    doubts_of_heights,
)

if TYPE_CHECKING:
    from pathlib import PurePath

    from vinemap.compute.arrays import Floats
    from vinemap.geo.place import Place

VERTICAL, CITATION, DATUM, VERTICAL_UNIT = 4096, 4097, 4098, 4099
"""GeoTIFF's keys of a vertical CRS, of what it is called, of its datum, and of the unit of heights."""
MODEL, PROJECTED, CITATIONS = 1024, 1, (3073, 1026)
"""GeoTIFF's key of the kind of coordinates, its value for projected ones, and keys of what their CRS is called."""
ESRI = "ESRI PE String = "
"""What stands before WKT in the place of a name."""
ELLIPSOIDS, DATUMS = range(5001, 5100), range(5101, 5200)
"""Codes that GeoTIFF 1.0 has for heights above an ellipsoid, and above a datum whose CRS has a code 600 higher."""
HEIGHTS = 'VERTCRS["{}",VDATUM["{}"],CS[vertical,1],AXIS["up",up],LENGTHUNIT["unit",{!r}]]'
SPAN_OF_DEGREES = 1.0
"""Degrees that no survey spans."""
FINE = 0.05
"""Metres of a step in coordinates that does no harm, however close the points."""
SAMPLE = 50_000
FEW = 0.25
"""Share of a sample that has values of its own, below which the steps between them are those of their storage."""
LEAST = 0.1
"""Order of the differences between values that is their step; others are some steps."""
ALIKE = 0.1
"""Share by which steps of eastings and northings that were rounded alike may differ."""
DEGREE = float(np.radians(GLOBE))
"""Metres of a degree of latitude."""


def crs_of(header: Any, given: CRS | None, path: PurePath) -> CRS:
    """The CRS of a file's coordinates: what is given, or what its header states.

    Heights are what the header states of them, where what is given tells nothing of heights.

    Raises
    ------
    InputError
        If there is none, or it can't be used.
    """
    try:
        plain = given or _horizontal(header, path)
        up = _vertical(header)
    except InputError:
        raise
    except Exception as error:
        if given:
            return check_horizontal(given)
        reason = str(error).rpartition("(Internal Proj Error: ")[2][:120].strip(" )")
        raise InputError(f"{path}: its CRS can't be understood ({reason}): give it with --crs EPSG:n") from error
    if plain is None:
        raise InputError(f"{path}: states no CRS for its coordinates: give it with {_hint(header)}")
    plain = check_horizontal(plain, f"{path}: ")
    if up is None or plain.is_compound or len(plain.axis_info) > 2 or is_local(plain):
        return plain
    return check_horizontal(CompoundCRS(f"{plain.name} + {up.name}", [stated(plain), up]), f"{path}: ")


def _horizontal(header: Any, path: PurePath) -> CRS | None:
    """The CRS that a header states, in WKT or in GeoTIFF keys; where it does both, they must lead to one place."""
    text: CRS | None = header.parse_crs()
    codes: CRS | None = header.parse_crs(prefer_wkt=False)
    records = _records(header)
    if (codes is None or codes.is_geographic) and MODEL in (keys := _keys(records)):
        own = keys[MODEL].value_offset == PROJECTED
        text, codes = (_named(records, keys) if own and crs == codes else crs for crs in (text, codes))
    if text is None or codes is None or text == codes or is_local(text):
        return codes or text
    x, y = ((header.mins + header.maxs)[:2] / 2).tolist()
    if OTHER_PLACE < (metres := apart(text, codes, x, y)) < np.inf:
        raise InputError(
            f"{path}: states two CRSs that lie {metres:,.0f} m apart, {text.name} in WKT and {codes.name} in GeoTIFF "
            "keys: say with --crs EPSG:n which is right"
        )
    return text


def _named(records: list[Any], keys: dict[int, Any]) -> CRS | None:
    """The projected CRS that GeoTIFF keys tell in words alone: by its name, or in the WKT of Esri."""
    for key in CITATIONS:
        words = _citation(records, keys, key)
        try:
            crs = CRS.from_user_input(words.removeprefix(ESRI))
        except CRSError:
            continue
        if crs.is_projected and (crs.name == words or words.startswith(ESRI)):
            return crs
    return None


def _hint(header: Any) -> str:
    low, high = header.mins[:2], header.maxs[:2]
    degrees = (np.abs([low, high]) <= [180, 90]).all() and (high - low).max() < SPAN_OF_DEGREES
    return f"--crs {'EPSG:4326, as they look like degrees' if degrees else 'EPSG:n, or local if they are local metres'}"


def _records(header: Any) -> list[Any]:
    """Records of a header that tell of coordinates."""
    return [*header.vlrs.get_by_id("LASF_Projection"), *(header.evlrs or ())]


def _keys(records: list[Any]) -> dict[int, Any]:
    """GeoTIFF keys by their numbers."""
    return {key.id: key for record in records for key in getattr(record, "geo_keys", ())}


def _vertical(header: Any) -> CRS | None:
    """The vertical CRS that a header states, in WKT or in GeoTIFF keys."""
    records = _records(header)
    for text in filter(None, (getattr(record, "string", "") for record in records)):
        try:
            if up := vertical(CRS.from_wkt(text)):
                return up
        except CRSError:
            continue  # of a file whose CRS is given
    keys = _keys(records)
    code, datum, unit = (keys[key].value_offset if key in keys else 0 for key in (VERTICAL, DATUM, VERTICAL_UNIT))
    metres = _units().get(unit) or getattr(header, "axis_units", {}).get("z")
    if code in ELLIPSOIDS or _is_geographic(code):
        return CRS.from_wkt(HEIGHTS.format(ELLIPSOIDAL, ELLIPSOIDAL, metres or 1.0))
    known = _vertical_of(code + 600 if code in DATUMS else code)
    if known and metres in (None, known.axis_info[0].unit_conversion_factor):
        return known
    name = known.name if known else _citation(records, keys, CITATION) or _datum(datum) or UNKNOWN
    return CRS.from_wkt(HEIGHTS.format(name, name, metres or 1.0)) if metres or name != UNKNOWN else None


def _vertical_of(code: int) -> CRS | None:
    try:
        crs = CRS.from_epsg(code)
    except CRSError:
        return None
    return crs if crs.is_vertical and not crs.is_compound else None


def _is_geographic(code: int) -> bool:
    """Whether a code is one of latitude, longitude and height above an ellipsoid."""
    try:
        return len(CRS.from_epsg(code).axis_info) > 2
    except CRSError:
        return False


def _datum(code: int) -> str:
    """Name of a vertical datum; nothing if it is none."""
    try:
        return Datum.from_epsg(code).name.replace('"', "")
    except CRSError:
        return ""


def _citation(records: list[Any], keys: dict[int, Any], number: int) -> str:
    """What GeoTIFF keys call something in words; nothing if they don't."""
    words = b"".join(record.record_data_bytes() for record in records if getattr(record, "strings", None))
    if (key := keys.get(number)) is None:
        return ""
    text = words[key.value_offset : key.value_offset + key.count].decode("ascii", "ignore").strip("|\0 ")
    return text.replace('"', "") if number == CITATION else text


@lru_cache(maxsize=1)
def _units() -> dict[int, float]:
    """Metres of units of length by their EPSG codes."""
    return {int(unit.code): unit.conv_factor for unit in get_units_map("EPSG", category="linear").values()}


def check_together(source: CRS, place: Place, path: PurePath, first: PurePath) -> None:
    """Make sure that a file's points can be brought to the place of the first.

    Raises
    ------
    InputError
        If there is no way from one's CRS to the other's, or their heights aren't above the same datum, as far as both
        files tell.
    """
    flat, target = horizontal(source), place.crs
    try:
        if flat != target:
            transformer(flat, target)
    except ProjError as error:
        own = stated(source).name
        raise InputError(f"{path}: {own} can't be brought to {target.name}, that of {first.name}") from error
    if (datum := vertical_name(source)) != place.vertical:
        raise InputError(
            f"{path}: its heights are above {datum or 'no datum that it states'}, those of {first.name} above "
            f"{place.vertical or 'none'}: say with --crs EPSG:n+m what all are"
        )


def to_place(xyz: Floats, source: CRS, path: PurePath, place: Place, first: PurePath) -> Floats:
    """Points (n, 3) of a file, which are changed, in metres of the place of the first; without those that have none.

    Raises
    ------
    InputError
        If they can't be brought there.
    """
    check_together(source, place, path, first)
    flat, target = horizontal(source), place.crs
    if flat != target:
        xyz[:, 0], xyz[:, 1] = transformer(flat, target).transform(xyz[:, 0], xyz[:, 1])
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
    xyz[:, 2] *= vertical_unit(source)
    return xyz


def examined(xyz: Floats, header: Any, source: CRS, path: PurePath, *, given: bool) -> list[str]:
    """What is to be known of where a file's points are: a sentence each.

    Of the points some (n, 3) are looked at, in the file's CRS, which may be ``given`` instead of stated by it.

    Raises
    ------
    InputError
        If they can't be there, or are stored too coarsely.
    """
    sample = xyz[:: max(1, len(xyz) // SAMPLE)]
    x, y = np.median(sample[:, :2], axis=0).tolist()
    check_place(source, x, y, str(path))
    check_steps(sample, len(xyz), header, source, path)
    doubts = [*doubts_of_cloud(source, x, y), *doubts_of_heights(source)]
    return [*_overridden(header, source, x, y, path), *doubts] if given else doubts


def _overridden(header: Any, given: CRS, x: float, y: float, path: PurePath) -> list[str]:
    """Whether a file states a CRS that leads elsewhere than the one that is given for it, and perhaps for others."""
    try:
        own = _horizontal(header, path)
    except Exception:  # noqa: BLE001 - what it states can't be understood, which is why another is given
        return []
    return doubts_of_given(given, own, x, y, path.name) if own else []


def check_steps(sample: Floats, n: int, header: Any, crs: CRS, path: PurePath) -> None:
    """Make sure that points of a file aren't stored more coarsely than they lie apart.

    The steps are those that the file's scale states, or greater ones that the coordinates show: they may have been
    rounded before, or kept in single precision.

    Parameters
    ----------
    sample : ndarray (m, 3)
        Some of n points of the file, evenly.
    n : int
        How many points those are taken from.
    header : laspy.LasHeader or Header
        Of the file.
    crs : CRS
        CRS of the coordinates.
    path : Path
        The file.

    Raises
    ------
    InputError
        If they are.
    """
    flat = horizontal(crs)
    metres = np.full(2, flat.axis_info[0].unit_conversion_factor)
    if flat.is_geographic:
        metres = DEGREE * np.array([np.cos(np.radians(np.median(sample[:, 1]))), 1.0])
    with np.errstate(over="ignore"):  # of a box that was never set
        whole, part = np.ptp([header.mins[:2], header.maxs[:2]], axis=0), np.ptp(sample[:, :2], axis=0)
        areas = [(np.prod(side * metres), n) for side, n in ((whole, header.point_count), (part, n))]
    gap = min((float(np.sqrt(area / n)) for area, n in areas if area > 0), default=0.0)
    sizes = [*metres, vertical_unit(crs)]
    shown_steps = _shown_steps(sample, header.scales)
    for axis, shown, scale, size in zip("xyz", shown_steps, header.scales, sizes, strict=True):
        step = max(float(scale), shown)
        if step * size > max(FINE, gap):
            lie = f"lie {gap:.2f} m apart" if gap else "all lie in one place"
            known = f"{step:g} (scale {scale:g}), {float(f'{step * size:.2g}'):g} m"
            raise InputError(
                f"{path}: its {axis} is stored in steps of {known}, but its points {lie}: "
                "export the cloud anew, with a finer scale"
            )


def _shown_steps(sample: Floats, scales: Floats) -> list[float]:
    """Steps (3,) in which coordinates (n, 3) were rounded before, or kept in single precision; 0 where they weren't.

    A scanner that drives along an axis leaves profiles at even steps of it alone, which is no rounding. Steps of single
    precision are powers of two, to the scales (3,) in which they were stored since.
    """
    x, y, z = (step_of(column) for column in sample.T)
    if not np.isclose(x, y, rtol=ALIKE):
        x, y = (
            step if step > 0 and abs(step - 2.0 ** np.rint(np.log2(step))) <= scale else 0.0
            for step, scale in zip((x, y), scales[:2], strict=True)
        )
    return [x, y, z]


def step_of(values: Floats) -> float:
    """Steps between values (n,) that many share; 0 where few do."""
    known = np.unique(values)
    return float(np.quantile(np.diff(known), LEAST)) if 2 < len(known) < FEW * len(values) else 0.0
