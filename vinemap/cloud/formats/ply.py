"""PLY: a header that lists elements and their properties, then all vertices, as text or packed one behind the other.

The format is that of G. Turk (1994). Faces, and whatever else stands behind the vertices, are left alone.
"""

from __future__ import annotations

from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap.cloud.formats.told import Header, Points, packed_records, reading, text_records
from vinemap.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path


TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST = 1_000
"""Lines of a header."""


class _Element(NamedTuple):
    name: str
    n: int
    fields: list[tuple[str, str]]


def read_ply(path: Path) -> Points:
    """Open a PLY file.

    Raises
    ------
    InputError
        If it is none, or holds no points that can be read.
    """
    with reading(path, "PLY"), path.open("rb") as stream:
        order, elements = _header(stream, path)
        start = stream.tell()
    before: list[_Element] = []
    for element in elements:
        if element.name == "vertex":
            break
        before.append(element)
    else:
        raise InputError(f"{path}: holds no points: export the cloud, not its mesh alone")
    if any(kind == "list" for one in (*before, element) for _, kind in one.fields):
        raise InputError(f"{path}: lists stand before its points or among them: export it with points alone")
    if order == "=":
        fields = [name for name, _ in element.fields]
        chunks = text_records(path, start, element.n, fields, skip=sum(one.n for one in before))
    else:
        start += sum(one.n * _dtype(one, order).itemsize for one in before)
        chunks = packed_records(path, start, element.n, _dtype(element, order))
    return Points(Header(point_count=element.n), chunks)


def _header(stream: IO[bytes], path: Path) -> tuple[str, list[_Element]]:
    """Order of bytes (= for text), and elements in their order."""
    if stream.readline(8).strip() != b"ply":
        raise InputError(f"{path}: can't be read as PLY: it doesn't begin as such a file")
    order, elements = "", list[_Element]()
    for _ in range(LONGEST):
        words = stream.readline(4096).decode("latin-1").split()
        match words:
            case ["end_header"]:
                break
            case ["format", form, _] if form in ORDERS:
                order = ORDERS[form]
            case ["element", name, n]:
                elements.append(_Element(name, int(n), []))
            case ["property", "list", _, _, name] if elements:
                elements[-1].fields.append((name, "list"))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].fields.append((name, TYPES[kind]))
            case ["comment" | "obj_info", *_]:
                continue
            case _:
                raise InputError(f"{path}: can't be read as PLY: its header has a line {' '.join(words)[:60]!r}")
    if not order:
        raise InputError(f"{path}: can't be read as PLY: its header doesn't end, or tells no format")
    return order, elements


def _dtype(element: _Element, order: str) -> np.dtype[Any]:
    return np.dtype([(name, order + kind) for name, kind in element.fields])
