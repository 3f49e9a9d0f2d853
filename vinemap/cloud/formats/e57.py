"""E57 (ASTM E2807) by libE57Format: all scans of a file, brought to its common frame by their poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap.cloud.formats.told import CHUNK, Header, Points, reading, usable, whole_steps
from vinemap.compute.extras import load
from vinemap.errors import EmptyError, InputError

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from vinemap.compute.arrays import Floats

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
FLAGS = {CARTESIAN: "cartesianInvalidState", SPHERICAL: "sphericalInvalidState"}
"""What says of a point that it isn't one."""


def read_e57(path: Path) -> Points:
    """Open an E57 file.

    Raises
    ------
    InputError
        If it is none, or holds no points.
    DependencyError
        If pye57 can't be loaded.
    """
    pye57 = load("pye57")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    with reading(path, "E57"), pye57.E57(str(path)) as file:
        n = sum(file.get_header(k).point_count for k in range(file.scan_count))
        stated = file.root["coordinateMetadata"].value() if file.root.isDefined("coordinateMetadata") else ""
    if n == 0:
        raise EmptyError(f"{path}: holds no points")
    return Points(Header(stated.strip(), point_count=n), _read(path, pye57))


def _read(path: Path, pye57: Any) -> Generator[Floats]:
    with pye57.E57(str(path)) as file:
        for k in range(file.scan_count):
            yield from _scan(file, file.get_header(k), path)


def _scan(file: Any, head: Any, path: Path) -> Generator[Floats]:
    """Points of a scan."""
    there = set(head.point_fields)
    kind = next((kind for kind in (CARTESIAN, SPHERICAL) if there.issuperset(kind)), None)
    if kind is None:
        raise InputError(f"{path}: its points have no x, y and z: export them anew")
    flag = FLAGS[kind] if FLAGS[kind] in there else None
    data, buffers = file.make_buffers([*kind, *([flag] if flag else [])], CHUNK)
    reader = head.points.reader(buffers)
    try:
        while n := reader.read():
            columns = [data[name][:n] for name in kind]
            xyz = np.column_stack(columns if kind is CARTESIAN else _cartesian(*columns))
            if flag:
                xyz = xyz[data[flag][:n] == 0]
            if head.has_pose():
                xyz = file.to_global(xyz, head.rotation, head.translation)
            yield whole_steps(usable(xyz))
    finally:
        reader.close()


def _cartesian(reach: Floats, azimuth: Floats, elevation: Floats) -> tuple[Floats, Floats, Floats]:
    """Coordinates of points by their distance and angles, which are radians from x and from the xy plane."""
    flat = reach * np.cos(elevation)
    return flat * np.cos(azimuth), flat * np.sin(azimuth), reach * np.sin(elevation)
