"""Entwine Point Tiles: a folder of small files, one a cube of an octree, listed by ``ept.json`` and its hierarchy.

The format is that of https://entwine.io/en/latest/entwine-point-tile.html.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap import paths
from vinemap.cloud.formats.box import EVERYWHERE, box_about, meet
from vinemap.cloud.formats.told import Header, Points, columns_of, needed, reading, usable_records
from vinemap.cloud.layout import read_layout
from vinemap.errors import InputError
from vinemap.geo.stated import crs_of

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from pyproj import CRS

    from vinemap.cloud.formats.box import Box
    from vinemap.compute.arrays import Floats
    from vinemap.geo.boundaries import Boundary

TYPES = {"signed": "<i", "unsigned": "<u", "float": "<f", "floating": "<f"}
AXES = ("X", "Y", "Z")


class _Key(NamedTuple):
    """A cube of the octree: depth, and place in each direction."""

    depth: int
    x: int
    y: int
    z: int

    def name(self) -> str:
        return "-".join(map(str, self))

    def box(self, bounds: Floats) -> Box:
        """Corners (3,) of the cube, within the bounds (2, 3) of all."""
        side = (bounds[1] - bounds[0]) / 2**self.depth
        low = bounds[0] + side * self[1:]
        return low, low + side

    def inner(self) -> list[_Key]:
        """The eight cubes in it."""
        return [_Key(self.depth + 1, *(2 * at + (k >> axis & 1) for axis, at in enumerate(self[1:]))) for k in range(8)]


class _Packing(NamedTuple):
    """How points are laid out where they aren't LAZ."""

    dtype: np.dtype[Any]
    scale: Floats
    offset: Floats


def read_ept(path: Path, crs: CRS | None, around: Boundary | None) -> Points:
    """Open the Entwine Point Tiles that an ``ept.json`` describes, or those that lie about a polygon.

    Raises
    ------
    InputError
        If it can't be read, or its points are packed in a way that isn't known.
    """
    with reading(path, "EPT"):
        about = json.loads(path.read_text(encoding="utf-8"))
        bounds = np.reshape(about["bounds"], (2, 3)).astype(float)
        tight = np.reshape(about.get("boundsConforming", about["bounds"]), (2, 3)).astype(float)
        scales = {one["name"]: float(one.get("scale", 0)) for one in about["schema"]}
        header = Header(
            _stated(about.get("srs") or {}),
            tight[0],
            tight[1],
            np.array([scales.get(axis, 0.0) for axis in AXES]),
            int(about["points"]),
        )
        kind = str(about["dataType"])
        dtype = np.dtype([(one["name"], f"{TYPES[one['type']]}{one['size']}") for one in about["schema"]])
        stored = {one["name"]: (float(one.get("scale", 1)), float(one.get("offset", 0))) for one in about["schema"]}
    if kind not in {"laszip", "binary"}:
        raise InputError(f"{path}: its points are packed as {kind}: export them as LAZ or COPC")
    box = box_about(around, crs_of(header, crs, path)) if around else EVERYWHERE
    packed = None if kind == "laszip" else _Packing(dtype, *np.transpose([stored[axis] for axis in AXES]))
    return Points(header, _read(path, bounds, box, packed, None if around else header.point_count))


def _stated(srs: dict[str, Any]) -> str:
    """CRS in WKT, or by its codes."""
    if srs.get("wkt"):
        return str(srs["wkt"])
    codes = [str(srs[key]) for key in ("horizontal", "vertical") if srs.get(key)]
    return f"{srs.get('authority', 'EPSG')}:{'+'.join(codes)}" if codes else ""


def _read(path: Path, bounds: Floats, box: Box, packed: _Packing | None, n: int | None) -> Generator[Floats]:
    done = 0
    for key, count in _nodes(path, bounds, box):
        done += count
        node = paths.ept_node(path.parent, key.name(), "bin" if packed else "laz")
        yield _packed(node, count, packed) if packed else _laz(node, count)
    if n is not None and done != n:
        raise InputError(f"{path}: counts {n:,} points, but its hierarchy {done:,}: copy or download it again")


def _nodes(path: Path, bounds: Floats, box: Box) -> Generator[tuple[_Key, int]]:
    """Cubes that meet a box and hold points, with their number, the coarsest first."""
    waiting = [_Key(0, 0, 0, 0)]
    counts = _page(path, waiting[0])
    while waiting:
        key = waiting.pop(0)
        if not meet(*key.box(bounds), box) or key.name() not in counts:
            continue
        if counts[key.name()] == -1:
            counts |= _page(path, key)
        if counts.get(key.name(), 0) > 0:
            yield key, counts[key.name()]
        waiting += key.inner()


def _page(path: Path, key: _Key) -> dict[str, int]:
    """Numbers of points by names of cubes, from one of the files of the hierarchy."""
    page = paths.ept_page(path.parent, key.name())
    with reading(page, "EPT"):
        return {str(name): int(n) for name, n in json.loads(page.read_text(encoding="utf-8")).items()}


def _laz(node: Path, n: int) -> Floats:
    import laspy

    with reading(node, "LAZ"):
        read_layout(node)
        with laspy.open(node, decompression_selection=needed()) as reader:
            _check(node, reader.header.point_count, n)
            return usable_records(reader.read_points(-1))


def _packed(node: Path, n: int, packing: _Packing) -> Floats:
    with reading(node, "EPT"):
        records = np.fromfile(node, packing.dtype)
    _check(node, len(records), n)
    xyz: Floats = columns_of(records, AXES) * packing.scale + packing.offset
    return xyz


def _check(node: Path, found: int, n: int) -> None:
    if found != n:
        raise InputError(f"{node}: holds {found:,} points, and the hierarchy counts {n:,}: copy or download it again")
