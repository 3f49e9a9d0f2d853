"""A field of AgOpenGPS 6, guidance for tractors of any make: https://github.com/AgOpenGPS-Official/AgOpenGPS.

The files are those that its ``FieldPlaneFiles``, ``BoundaryFiles`` and ``TrackFiles`` read, and the plane that of its
``LocalPlane``.
"""

from __future__ import annotations

from datetime import date
from typing import TYPE_CHECKING

import numpy as np
import shapely

from vinemap import paths

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.compute.arrays import Floats
    from vinemap.export.field import Field

STEP, FEWEST = 1.0, 5
"""Metres between points, as AgOpenGPS itself records them, and how many it wants of a curve."""
CURVE = 4
"""Its ``TrackMode`` of a curve."""


def write_agopengps(field: Field, folder: Path, *, lines: str) -> None:
    """Write a folder with the parcel's name for ``Documents/AgOpenGPS/Fields``: origin, boundary, tracks.

    The boundary is left out where the parcel has several polygons: AgOpenGPS would take the second for a hole.

    Raises
    ------
    InputError
        If coordinates are local.
    OSError
        If it can't be written.
    """
    target = paths.agopengps_field(folder, field.parcel)
    target.mkdir()
    west, south, east, north = field.wgs84("rows").total_bounds
    start = round((south + north) / 2, 7), round((west + east) / 2, 7)
    month = f"{date.fromisoformat(field.flown):%Y-%B-%d}"
    header = [f"{month} 12:00:00 AM", "$FieldDir", target.name, "$Offsets", "0,0", "Convergence", "0", "StartFix"]
    _write(paths.agopengps_file(target, "Field"), [*header, f"{start[0]},{start[1]}"])

    polygons = shapely.get_parts(shapely.force_2d(field.wgs84("outline").geometry.to_numpy()))
    if len(polygons) == 1:
        rings = [polygons[0].exterior, *polygons[0].interiors]
        text = ["$Boundary"]
        for ring in rings:
            points = _on_plane(shapely.get_coordinates(ring), start)
            course = _stepped(points)[:-1]
            text += ["False", str(len(course)), *_points(course)]
        _write(paths.agopengps_file(target, "Boundary"), text)

    text = ["$TrackLines"]
    table = field.guidance(lines)
    for label, kind, line in zip(table["label"], table["kind"], table.to_crs(4326).geometry, strict=True):
        course = _stepped(_on_plane(shapely.get_coordinates(line), start))
        ends = [",".join(map(_number, course[k, :2])) for k in (0, -1)]
        heading = _heading(course[-1, :2] - course[0, :2])
        text += [
            f"{kind} {label}",
            f"{heading:.5f}",
            *ends,
            "0",
            str(CURVE),
            "True",
            str(len(course)),
            *_points(course),
        ]
    _write(paths.agopengps_file(target, "TrackLines"), text)


def _on_plane(lon_lat: Floats, start: tuple[float, float]) -> Floats:
    """Easting and northing of degrees, in AgOpenGPS's plane about a latitude and longitude."""
    lat = np.radians(lon_lat[:, 1])
    origin = np.radians(start[0])
    north = 111132.92 - 559.82 * np.cos(2 * origin) + 1.175 * np.cos(4 * origin) - 0.0023 * np.cos(6 * origin)
    east = 111412.84 * np.cos(lat) - 93.5 * np.cos(3 * lat) + 0.118 * np.cos(5 * lat)
    return np.column_stack([(lon_lat[:, 0] - start[1]) * east, (lon_lat[:, 1] - start[0]) * north])


def _stepped(points: Floats) -> Floats:
    """Points (n, 3) a metre apart or less: easting, northing, heading in radians clockwise from north."""
    line = shapely.LineString(points)
    xy = shapely.get_coordinates(shapely.segmentize(line, min(STEP, line.length / FEWEST)))
    heading = _heading(np.gradient(xy, axis=0).T)
    return np.column_stack([xy, heading])


def _heading(way: Floats) -> Floats:
    out: Floats = np.arctan2(way[0], way[1]) % (2 * np.pi)
    return out


def _points(course: Floats) -> list[str]:
    return [f"{_number(east)},{_number(north)},{heading:.5f}" for east, north, heading in course]


def _number(metres: float) -> str:
    return f"{metres + 0.0:.3f}"


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
