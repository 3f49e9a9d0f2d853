"""Points as text: XYZ, PTS, CSV and the like, a point a line, with or without a line of names."""

from __future__ import annotations

import re
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

from vinemap.cloud.formats.told import CHUNK, Header, Points, is_class, reading, unit_of, usable
from vinemap.errors import EmptyError, InputError

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping, Sequence
    from pathlib import Path

    from vinemap.compute.arrays import Floats

BEGINNING = 65_536
"""Bytes that tell how a file is written."""
COMMENTS = ("#", "//", ";", "%")
EASTS = (("x",), ("easting", "east", "e"), ("longitude", "lon", "long"))
NORTHS = (("y",), ("northing", "north", "n"), ("latitude", "lat"))
ELEVATIONS = ("z", "elevation", "elev", "altitude", "alt", "height", "h")
"""What columns of x, y and z are called, the likeliest first; of the former two those of one kind go together."""
ABOVE_GROUND = re.compile(r"h(eight)?[\W_]*above|[\W_]agl\b")
"""Names of heights that are no elevations."""
NUMBER = re.compile(r"[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)


class _Form(NamedTuple):
    """How a file is written."""

    skip: int
    """Lines before the first point."""
    sep: str
    decimal: str
    columns: tuple[int, int, int]
    classes: int | None = None
    units: Mapping[str, float] = {}
    """Metres of the units of x, y and z, as far as names tell them."""


def read_text(path: Path) -> Points:
    """Open a file of points as text.

    Raises
    ------
    InputError
        If it holds no points, no x, y and z can be told, or more than one column may be one of them; if it is a raster.
    """
    with reading(path, "text"), path.open("rb") as stream:
        beginning = stream.read(BEGINNING)
        if b"\0" in beginning:
            raise InputError(f"{path}: can't be read as text: it is packed: which program wrote it, and as what?")
        lines = beginning.decode("utf-8-sig", "replace").splitlines()
    if lines and lines[0].lower().startswith("ncols"):
        raise InputError(f"{path}: is a raster as text: convert it to GeoTIFF, and give that")
    whole = len(beginning) < BEGINNING
    if form := _form(lines if whole else lines[:-1], path):
        return Points(Header(axis_units=form.units), _read(path, form))
    if whole and sum(map(_is_said, lines)) < 2:
        raise EmptyError(f"{path}: holds no points")
    raise InputError(f"{path}: no line of it begins with x, y and z, nor do names say which columns they are")


def _form(lines: Sequence[str], path: Path) -> _Form | None:
    """How a file is written by its first lines; None if none of them is a point."""
    names: list[str] = []
    for skip, line in enumerate(lines):
        bare = line.strip().lstrip("#/;% ") if line.strip().startswith(COMMENTS) else line.strip()
        for sep in (";", "\t", ",", r"\s+"):
            words = [word.strip(" \"'") for word in re.split(sep, _tight(bare) if sep == r"\s+" else bare)]
            while words and not words[-1]:  # as behind a separator at the end
                words.pop()
            if len(words) < 3 or (sep == "," and re.fullmatch(r"[-+]?\d+,\d+(\s.*)?", bare)):
                continue
            if line.strip().startswith(COMMENTS) or not all(map(NUMBER.fullmatch, words[:3])):
                names = max(words, names, key=lambda some: sum(map(bool, _axes(some))))
                continue
            told = names if len(names) == len(words) else []
            if not told and (axes := _axes(names)) != tuple(sorted(axes)):
                raise InputError(
                    f"{path}: it has {len(names)} names ({', '.join(names)}), but {len(words)} numbers a point: give "
                    "each a name"
                )
            classes = next((k for k, name in enumerate(told) if is_class(name)), None)
            decimal = "," if sep != "," and any("," in word for word in words[:3]) else "."
            columns = _columns(told, path)
            units = {axis: unit for axis, k in zip("xyz", columns, strict=True) if told and (unit := _unit(told[k]))}
            return _Form(skip, sep, decimal, columns, classes, units)
    return None


def _tight(line: str) -> str:
    """Names without the spaces within and before brackets, which don't part them."""
    return re.sub(r"\s*([\[(][^\])]*[\])])", lambda unit: "_".join(unit[1].split()), line)


def _is_said(line: str) -> bool:
    """Whether a line holds something beside a comment: a point, names, or how many points follow."""
    return bool(line.strip()) and not line.strip().startswith(COMMENTS)


def _columns(names: Sequence[str], path: Path) -> tuple[int, int, int]:
    """Columns of x, y and z: those that names tell, or else the first three."""
    x, y, z = axes = _axes(names)
    if not x:
        return 0, 1, 2
    if not z:
        raise InputError(f"{path}: its names ({', '.join(names)}) say x and y, but no z: call the elevations' column z")
    for axis, found in zip("xyz", axes, strict=True):
        if len(found) > 1:
            alike = ", ".join(names[k] for k in found)
            raise InputError(f"{path}: any of its columns {alike} may be {axis}: rename what isn't")
    return x[0], y[0], z[0]


def _axes(names: Sequence[str]) -> tuple[list[int], list[int], list[int]]:
    """Columns that may be x, y and z by the likeliest of their names: with or without a unit, or more, behind it."""
    lower = ["" if ABOVE_GROUND.search(name.lower()) else name.lower() for name in names]
    alone, first = ([re.split(end, name)[0] for name in lower] for end in (r"\s*[\[(]", r"[\[(_ ]"))
    kinds = [*zip(EASTS, NORTHS, strict=True), *product(EASTS, NORTHS)]
    plans = ((_called(east, by), _called(north, by)) for by in (alone, first) for east, north in kinds)
    x, y = next((plan for plan in plans if all(plan)), ([], []))
    return x, y, _called(ELEVATIONS, alone) or _called(ELEVATIONS, first)


def _unit(name: str) -> float | None:
    """Metres of the unit that stands behind a column's name, as in "Z [ft]", "height_m" and "Elevation (US ft)"."""
    return unit_of(re.sub(r"^[^a-z]*[a-z]+", "", name.lower()))


def _called(words: Sequence[str], names: Sequence[str]) -> list[int]:
    """Columns with the first of some words that is a name."""
    word = next((word for word in words if word in names), None)
    return [k for k, name in enumerate(names) if name == word]


def _read(path: Path, form: _Form) -> Generator[Floats]:
    import pandas as pd

    wanted = [*form.columns, *([] if form.classes is None else [form.classes])]
    how: dict[str, Any] = {"sep": form.sep, "header": None, "skiprows": form.skip, "decimal": form.decimal}
    how |= {"usecols": sorted(set(wanted)), "encoding": "latin-1", "dtype": "float64", "comment": "#"}
    with pd.read_csv(path, **how, chunksize=CHUNK) as tables:
        for table in tables:
            classes = None if form.classes is None else table[form.classes].to_numpy()
            yield usable(table[list(form.columns)].to_numpy(), classes)
