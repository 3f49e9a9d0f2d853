"""What a file tells of its points, and what is said of one that can't be read."""

from __future__ import annotations

import re
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from vinemap.errors import PASSING, BusyError, InputError, VinemapError

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Mapping, Sequence
    from pathlib import Path, PurePath

    from numpy.typing import NDArray

    from vinemap.compute.arrays import Floats

CHUNK = 500_000
"""Points that are read at once."""
NOISE = (7, 18)
"""ASPRS classes of points that are none of anything."""
DECIMALS = 4
"""Of coordinates that were kept in single precision: about a point near by, where they are right to so many."""
UNKNOWN = np.full(3, np.nan)
UNITS = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), 0.001),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("usft", "ftus", "sft", "ussft"), 1200 / 3937),
}
"""Metres of units, as people name them."""
SURVEY = ("us", "survey")
"""Words beside feet by which they are those of the US survey."""


@dataclass(frozen=True)
class Header:
    """What is told of coordinates, as laspy tells it of LAS: see :mod:`vinemap.geo.stated`."""

    wkt: str = ""
    """CRS, in WKT or as ``EPSG:n``; empty if none is stated."""
    mins: Floats = field(default_factory=lambda: UNKNOWN)
    maxs: Floats = field(default_factory=lambda: UNKNOWN)
    scales: Floats = field(default_factory=lambda: np.zeros(3))
    point_count: int = 0
    axis_units: Mapping[str, float] = field(default_factory=dict)
    """Metres of the units in which x, y and z are told to be."""
    evlrs: tuple[()] = ()

    @property
    def vlrs(self) -> Header:
        """The records, of which there is one."""
        return self

    @property
    def string(self) -> str:
        """WKT in that record; empty if the CRS can't be understood."""
        crs = self.parse_crs()
        return crs.to_wkt() if crs else ""

    def get_by_id(self, name: str) -> list[Header]:
        """Records that tell of coordinates."""
        del name
        return [self] if self.wkt else []

    def parse_crs(self, *, prefer_wkt: bool = True) -> CRS | None:
        """The CRS that is stated; None if that can't be understood."""
        try:
            return CRS.from_user_input(self.wkt) if self.wkt and prefer_wkt else None
        except CRSError:
            return None


class Points(NamedTuple):
    """Points of a file in its own CRS."""

    header: Header
    chunks: Generator[Floats]
    """Coordinates (n, 3) that are numbers, without noise."""
    remarks: tuple[str, ...] = ()
    steps: bool = True
    """Whether coordinates stored in steps mean that they are stored too coarsely."""


@contextmanager
def reading(path: PurePath, kind: str) -> Iterator[None]:
    """Say in a line what libraries raise of a file that they can't read."""
    try:
        yield
    except (VinemapError, MemoryError):
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except Exception as error:
        reason = str(error).strip().split("\n")[0][:160] or type(error).__name__
        if isinstance(error, OSError) and error.errno in PASSING:
            raise BusyError(f"{path}: can't be read now ({reason}): try again") from error
        raise InputError(f"{path}: can't be read as {kind} ({reason}): is it whole?") from error


def usable(columns: NDArray[Any], classes: NDArray[Any] | None = None) -> Floats:
    """Coordinates (n, 3) that are numbers, of points that aren't classified as noise."""
    xyz = np.ascontiguousarray(columns, dtype=np.float64)
    keep = np.isfinite(xyz).all(axis=1)
    if classes is not None:
        keep &= ~np.isin(classes, NOISE)
    return xyz if keep.all() else xyz[keep]


def whole_steps(xyz: Floats) -> Floats:
    """Coordinates (n, 3) as they were before they were written in single precision, which shifts them by microns.

    Points lie on steps of a millimetre, mostly, and so do the edges of cells that are made of them: points on an edge
    would go to either side.
    """
    return np.round(xyz, DECIMALS)


def is_class(name: str) -> bool:
    """Whether a column of such a name holds classes of points."""
    return name.lower().removeprefix("scalar_") in {"classification", "class"}


def columns_of(records: NDArray[Any], names: tuple[str, ...]) -> Floats:
    """Coordinates (n, 3) of records (n,) with fields for x, y and z, usable ones."""
    classes = next((records[name] for name in records.dtype.names or () if is_class(name)), None)
    xyz = usable(np.column_stack([records[name] for name in names]), classes)
    return whole_steps(xyz) if all(records.dtype[name].itemsize == 4 for name in names) else xyz


def packed_records(path: Path, start: int, n: int, dtype: np.dtype[Any]) -> Generator[Floats]:
    """Coordinates of n records that lie packed in a file from a byte on, chunk by chunk."""
    names, left = axes_in(dtype.names or (), path), n
    with path.open("rb") as stream:
        stream.seek(start)
        while left:
            records = np.fromfile(stream, dtype, min(CHUNK, left))
            if len(records) == 0:
                raise _ends(path, n - left, n)
            left -= len(records)
            yield columns_of(records, names)


def text_records(path: Path, start: int, n: int, columns: Sequence[str], *, skip: int = 0) -> Generator[Floats]:
    """Coordinates of n records, a line each, from a byte on and so many lines further, chunk by chunk."""
    import pandas as pd

    names, done = axes_in(tuple(columns), path), 0
    how: dict[str, Any] = {"sep": r"\s+", "header": None, "names": list(columns), "skiprows": skip, "nrows": n}
    with path.open("rb") as stream:
        stream.seek(start)
        for table in pd.read_csv(stream, **how, index_col=False, chunksize=CHUNK):
            done += len(table)
            yield columns_of(table.to_records(index=False), names)
    if done < n:
        raise _ends(path, done, n)


def _ends(path: Path, done: int, n: int) -> InputError:
    return InputError(f"{path}: ends after {done:,} of {n:,} points: copy or download it again")


def axes_in(names: tuple[str, ...], path: Path) -> tuple[str, str, str]:
    """Which of a file's fields are x, y and z.

    Raises
    ------
    InputError
        If one isn't there.
    """
    lower = {name.lower(): name for name in reversed(names)}
    if lacking := [axis for axis in "xyz" if axis not in lower]:
        raise InputError(f"{path}: its points have no {lacking[0]}: export them with x, y and z")
    return lower["x"], lower["y"], lower["z"]


def needed() -> Any:
    """What is decompressed of a point, where the format lets the rest be: not colours, intensities and times."""
    from laspy import DecompressionSelection as Selection

    return Selection.XY_RETURNS_CHANNEL | Selection.Z | Selection.CLASSIFICATION | Selection.FLAGS


def usable_records(records: Any) -> Floats:
    """Coordinates (n, 3) of laspy's points that are numbers, and neither flagged as noise nor withheld."""
    return usable_among(np.column_stack([np.asarray(column) for column in (records.x, records.y, records.z)]), records)


def usable_among(xyz: Floats, records: Any) -> Floats:
    """Coordinates (m, 3) of laspy's usable points, as :func:`usable_records` gives them, out of those (n, 3) of all."""
    noise = np.isin(np.asarray(records.classification), NOISE) | np.asarray(records.withheld, dtype=bool)
    if noise.any():
        xyz = xyz[~noise]
    if not np.isfinite(xyz.sum()):
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
    return xyz


def unit_of(said: str) -> float | None:
    """Metres of the unit that is among some words, as in "US survey feet" or "foot_us"; None if there is none."""
    words = re.findall(r"[a-z]+", said.lower())
    unit = next((UNITS[word] for word in words if word in UNITS), None)
    return UNITS["usft"] if unit == UNITS["ft"] and any(word in SURVEY for word in words) else unit
