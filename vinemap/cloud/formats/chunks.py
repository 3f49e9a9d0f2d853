"""Points of clouds in whatever format, checked as those of LAS are."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vinemap import naming
from vinemap.cloud.formats.e57 import read_e57
from vinemap.cloud.formats.ept import read_ept
from vinemap.cloud.formats.kinds import kind_of
from vinemap.cloud.formats.pcd import read_pcd
from vinemap.cloud.formats.ply import read_ply
from vinemap.cloud.formats.remote import read_remote
from vinemap.cloud.formats.surface import read_surface
from vinemap.cloud.formats.text import read_text
from vinemap.cloud.formats.told import Header, reading
from vinemap.cloud.pdal.reader import read_pdal
from vinemap.errors import EmptyError, InputError
from vinemap.geo.crs import horizontal, vertical_unit
from vinemap.geo.place import check_place, doubts_of_cloud
from vinemap.geo.stated import crs_of, examined

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path, PurePath

    from pyproj import CRS

    from vinemap.cloud.formats.told import Points
    from vinemap.compute.arrays import Floats
    from vinemap.geo.boundaries import Boundary

WHOLE = {"e57": read_e57, "ply": read_ply, "pcd": read_pcd, "text": read_text}
PARTS = {"ept": read_ept, "surface": read_surface, "remote": read_remote}
"""Formats of which only what lies about a polygon is read."""
WORDS = {"text": "text", "surface": "GeoTIFF", "remote": "COPC"}
"""What formats are called whose names aren't those of files."""

ALIKE = 1e-5
"""Share by which units of one name may differ, as both kinds of feet do."""


def other_chunks(
    path: Path, crs: CRS | None, around: Boundary | None, remarks: list[str], *, engine: str
) -> Generator[tuple[Floats, CRS]]:
    """Coordinates (n, 3) of a file's usable points, chunk by chunk, and their CRS; what is to be known is added.

    Raises
    ------
    InputError
        If the file can't be read whole, has no CRS, or coordinates that can't be right.
    BusyError
        If it can't be read now.
    """
    kind, named = kind_of(path) or "", naming.named(path)
    points = _opened(path, kind, crs, around, engine)
    with closing(points.chunks) as chunks, reading(named, WORDS.get(kind, kind.upper())):
        first = next((chunk for chunk in chunks if len(chunk)), None)
        if first is None and (around is None or kind in WHOLE):
            raise EmptyError(f"{named}: holds no usable points (all are flagged as noise or have no number)")
        if first is None:
            return
        header = _with_box(points, first)
        source = crs_of(header, crs, named)
        _check_units(header, source, named)
        remarks += [*_checked(first, points, header, source, named, given=crs is not None), *points.remarks]
        yield first, source
        for chunk in chunks:
            if len(chunk):
                yield chunk, source


def _opened(path: Path, kind: str, crs: CRS | None, around: Boundary | None, engine: str) -> Points:
    if engine == "pdal" and kind != "surface":  # of which PDAL has bands, and no points
        return read_pdal(path, crs, around)
    if kind in PARTS:
        return PARTS[kind](path, crs, around)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    return WHOLE[kind](path)


def _with_box(points: Points, first: Floats) -> Header:
    """What a file tells of itself, with the box of its first points where it states none: whose CRS is asked for."""
    header = points.header
    if not isinstance(header, Header) or np.isfinite(header.mins[:2]).all():
        return header
    return replace(header, mins=first.min(axis=0), maxs=first.max(axis=0), point_count=len(first))


def _check_units(header: Header, source: CRS, path: PurePath) -> None:
    """Make sure that coordinates are in the units of their CRS, where a file tells units of its own."""
    flat = horizontal(source)
    units = [(axis, flat.axis_info[0].unit_name, flat.axis_info[0].unit_conversion_factor) for axis in "xy"]
    for axis, name, metres in (*units, ("z", f"{vertical_unit(source):g} m", vertical_unit(source))):
        told = getattr(header, "axis_units", {}).get(axis, metres)
        if not np.isclose(told, metres, rtol=ALIKE):
            raise InputError(
                f"{path}: the name of its {axis} tells a unit of {told:g} m, but {source.name} has {name}: give the "
                "CRS that the coordinates have with --crs, or rename the column"
            )


def _checked(first: Floats, points: Points, header: Header, source: CRS, path: PurePath, *, given: bool) -> list[str]:
    """What is to be known of where points are, in a sentence each."""
    if points.steps:
        return examined(first, header, source, path, given=given)
    x, y = np.median(first[:, :2], axis=0).tolist()
    check_place(source, x, y, str(path))
    return doubts_of_cloud(source, x, y)
