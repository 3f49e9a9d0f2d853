"""PCD, of the Point Cloud Library: a header of words, then points, as text, packed, or compressed field by field.

The format is that of https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

from typing import IO, TYPE_CHECKING, Any

import numpy as np

from vinemap.cloud.formats.told import (
    CHUNK,
    Header,
    Points,
    axes_in,
    packed_records,
    reading,
    text_records,
    usable,
    whole_steps,
)
from vinemap.compute.extras import load
from vinemap.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from vinemap.compute.arrays import Floats

TYPES = {"F": "f", "I": "i", "U": "u"}
LONGEST = 100
"""Lines of a header."""


def read_pcd(path: Path) -> Points:
    """Open a PCD file.

    Raises
    ------
    InputError
        If it is none, or holds no points that can be read.
    DependencyError
        If it is compressed, and Open3D, which unpacks it, can't be loaded.
    """
    with reading(path, "PCD"), path.open("rb") as stream:
        words = _header(stream, path)
        start = stream.tell()
        n, dtype = int(words["POINTS"][0]), _dtype(words)
    names = axes_in(dtype.names or (), path)
    form = words["DATA"][0].lower()
    if form == "ascii":
        chunks = text_records(path, start, n, _columns(dtype))
    elif form == "binary":
        chunks = packed_records(path, start, n, dtype)
    else:
        chunks = _unpacked(path, n, single=dtype[names[0]].itemsize == 4)
    return Points(Header(point_count=n), chunks)


def _header(stream: IO[bytes], path: Path) -> dict[str, list[str]]:
    words: dict[str, list[str]] = {}
    for _ in range(LONGEST):
        key, *values = stream.readline(4096).decode("latin-1").split() or [""]
        if key.startswith("#"):
            continue
        words[key.upper()] = values
        if key.upper() == "DATA":
            break
    if {"FIELDS", "SIZE", "TYPE", "POINTS", "DATA"} - set(words):
        raise InputError(f"{path}: can't be read as PCD: it doesn't begin as such a file")
    return words


def _dtype(words: dict[str, list[str]]) -> np.dtype[Any]:
    counts = words.get("COUNT") or ["1"] * len(words["FIELDS"])
    fields = []
    for k, (name, kind, size, count) in enumerate(
        zip(words["FIELDS"], words["TYPE"], words["SIZE"], counts, strict=True)
    ):
        own = f"{name}{k}" if name == "_" else name  # padding has no name
        one = f"<{TYPES[kind.upper()]}{size}"
        fields.append((own, one, (int(count),)) if int(count) != 1 else (own, one))
    return np.dtype(fields)


def _columns(dtype: np.dtype[Any]) -> list[str]:
    """Names of the numbers on a line."""
    return [name if k == 0 else f"{name}_{k}" for name in dtype.names or () for k in range(_width(dtype[name]))]


def _width(field: np.dtype[Any]) -> int:
    return int(np.prod(field.shape, dtype=int))


def _unpacked(path: Path, n: int, *, single: bool) -> Generator[Floats]:
    """Points of a compressed file, whole, as Open3D unpacks it."""
    open3d = load("open3d")
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        xyz = np.asarray(open3d.io.read_point_cloud(str(path), format="pcd").points)
    if len(xyz) == 0 < n:
        raise InputError(f"{path}: its packed points are damaged: copy or download it again")
    for first in range(0, len(xyz), CHUNK):
        part = usable(xyz[first : first + CHUNK].copy())
        yield whole_steps(part) if single else part
