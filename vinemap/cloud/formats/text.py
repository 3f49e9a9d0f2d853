"""Points as text: XYZ, PTS, CSV and the like, a point a line, with or without a line of names."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, NamedTuple

from vinemap.cloud.formats.told import CHUNK, Header, Points, is_class, reading, usable
from vinemap.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence
    from pathlib import Path

    from vinemap.compute.arrays import Floats

BEGINNING = 65_536
"""Bytes that tell how a file is written."""
COMMENTS = ("#", "//", ";", "%")
NAMES = (
    {"x", "e", "east", "easting", "lon", "long", "longitude"},
    {"y", "n", "north", "northing", "lat", "latitude"},
    {"z", "h", "height", "elevation", "alt", "altitude"},
)
"""What columns of x, y and z are called."""
NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)


class _Form(NamedTuple):
    """How a file is written."""

    skip: int
    """Lines before the first point."""
    sep: str
    decimal: str
    columns: tuple[int, int, int]
    classes: int | None = None


def read_text(path: Path) -> Points:
    """Open a file of points as text.

    Raises
    ------
    InputError
        If no x, y and z can be told.
    """
    with reading(path, "text"), path.open("rb") as stream:
        beginning = stream.read(BEGINNING)
        if b"\0" in beginning:
            raise InputError(f"{path}: can't be read as text: it is packed: which program wrote it, and as what?")
        lines = beginning.decode("utf-8-sig", "replace").splitlines()
    return Points(Header(), _read(path, _form(lines[:-1] if len(beginning) == BEGINNING else lines, path)))


def _form(lines: Sequence[str], path: Path) -> _Form:
    names: list[str] = []
    for skip, line in enumerate(lines):
        bare = line.strip().lstrip("#/;% ") if line.strip().startswith(COMMENTS) else line.strip()
        for sep in (";", "\t", ",", r"\s+"):
            words = re.split(sep, bare)
            if len(words) < 3 or (sep == "," and re.fullmatch(r"[-+]?\d+,\d+(\s.*)?", bare)):
                continue
            cleaned = [word.strip(" \"'").lower() for word in words]
            if line.strip().startswith(COMMENTS) or not all(map(NUMBER.fullmatch, cleaned[:3])):
                if len(_axes(cleaned)) == 3:
                    names = cleaned
                continue
            columns = _axes(names) if len(names) == len(cleaned) else [0, 1, 2]
            classes = next((k for k, name in enumerate(names) if is_class(name)), None)
            decimal = "," if sep != "," and any("," in word for word in cleaned[:3]) else "."
            return _Form(skip, sep, decimal, (columns[0], columns[1], columns[2]), classes)
    raise InputError(f"{path}: no line of it begins with x, y and z, nor do names say which columns they are")


def _axes(names: Sequence[str]) -> list[int]:
    """Columns of x, y and z, as far as their names tell: with or without a unit, as ``X(m)``."""
    plain = [re.split(r"[\[(_ ]", name)[0] for name in names]
    found = [next((k for k, name in enumerate(plain) if name in axis), -1) for axis in NAMES]
    return [k for k in found if k >= 0]


def _read(path: Path, form: _Form) -> Generator[Floats]:
    import pandas as pd

    wanted = [*form.columns, *([] if form.classes is None else [form.classes])]
    how: dict[str, Any] = {"sep": form.sep, "header": None, "skiprows": form.skip, "decimal": form.decimal}
    how |= {"usecols": sorted(set(wanted)), "encoding": "latin-1", "dtype": "float64", "comment": "#"}
    with pd.read_csv(path, **how, chunksize=CHUNK) as tables:
        for table in tables:
            classes = None if form.classes is None else table[form.classes].to_numpy()
            yield usable(table[list(form.columns)].to_numpy(), classes)
