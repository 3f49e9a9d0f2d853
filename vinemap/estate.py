"""Surveys that arrive in a folder: which are there, whole, and need work."""

from __future__ import annotations

import os
import struct
import time
from typing import TYPE_CHECKING, NamedTuple

from vinemap import paths
from vinemap.config import check_name
from vinemap.errors import InputError, VinemapError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import IO

    from vinemap.config import EstateConfig, SurveyConfig

CLOUDS = (".las", ".laz")
POLYGONS = (".gpkg", ".geojson", ".shp")
OWN = "survey.yaml"
"""File in a survey's folder that says what is otherwise in it."""
USUAL = ("parcels", "boundaries", "boundary")
"""What the file of the parcels' polygons is called where there are others."""
HEADER, OLDEST_HEADER = 375, 227
"""Bytes of the header of LAS 1.4, and of the oldest."""
RECORD, LATE_RECORD = 54, 60
"""Bytes before what a record holds, before the points and behind them."""
LATE = 86_400
"""Seconds after which what isn't whole is no upload any more."""
COMPRESSED = 0x80
"""Bit of a point format that is LAZ's."""
LEAST_CHUNK = 20
"""Bytes of points in a chunk of LAZ."""


class Arrival(NamedTuple):
    """A survey that has arrived, or is arriving."""

    name: str
    config: SurveyConfig | None
    """None if it can't be worked."""
    reason: str = ""
    """Why not."""
    waits: bool = False
    """Whether it only isn't there as a whole yet."""


def arrivals(estate: EstateConfig, *, now: float | None = None) -> Iterator[Arrival]:
    """Look through an estate's folder: each LAS, LAZ or COPC file in it is a survey, and each folder that holds one.

    Names that begin with a dot are left out, as tools of upload choose them for what isn't whole.

    Parameters
    ----------
    estate : EstateConfig
        Names the folder, and for how long the files of a survey must have stayed as they are.
    now : float, optional
        Seconds since 1970.

    Raises
    ------
    InputError
        If the folder can't be read.
    """
    seen: dict[str, Path] = {}
    try:
        found = sorted(estate.surveys.iterdir())
    except OSError as error:
        raise InputError(f"{estate.surveys}: can't be read ({error.strerror}): make it, or name another") from error
    for path in found:
        if path.name.startswith(".") or not (path.is_dir() or path.suffix.lower() in CLOUDS):
            continue
        name = path.name if path.is_dir() else path.stem.removesuffix(".copc")
        try:
            name = check_name(name)
            if name in seen:
                yield Arrival(path.name, None, f"{path} has the name of {seen[name]}: give it another")
                continue
            seen[name] = path
            if arrival := _arrival(name, path, estate, now or time.time()):
                yield arrival
            else:
                del seen[name]
        except VinemapError as error:
            yield Arrival(paths.shown(path.name), None, str(error))
        except OSError as error:
            yield Arrival(path.name, None, f"{path}: can't be read ({error.strerror})")


def _arrival(name: str, path: Path, estate: EstateConfig, now: float) -> Arrival | None:
    """The survey of a folder or file; None if a folder holds nothing of one yet."""
    files = [path] if path.is_file() else [p for p in path.iterdir() if p.is_file() and not p.name.startswith(".")]
    clouds = [p for p in files if p.suffix.lower() in CLOUDS]
    polygons = [p for p in files if p.suffix.lower() in POLYGONS]
    if len(polygons) > 1:
        polygons = [p for p in polygons if p.stem.lower() in USUAL] or polygons
    own = path / OWN if path.is_dir() and (path / OWN).is_file() else None
    if not clouds and not own:
        return None
    config = estate.of_survey(name, own, cloud=_only(clouds), boundaries=_only(polygons))
    for found, kind, chosen in ((clouds, "clouds", config.cloud), (polygons, "files of polygons", config.boundaries)):
        if len(found) > 1 and not chosen:
            key = "cloud" if found is clouds else "boundaries"
            raise InputError(f"{path}: holds {len(found)} {kind}: name one in its {OWN}, as '{key}: FILE'")
    if not config.cloud:
        raise InputError(f"{path}: holds no cloud, and its {OWN} names none")
    used = [p for p in (config.cloud, config.boundaries, own) if p]
    for file in used:
        _check(file)
    age = now - max(p.stat().st_mtime for p in used)
    if 0 <= age < estate.settle:
        return Arrival(name, None, f"changed {age:.0f} s ago, waits until {estate.settle:.0f} s", waits=True)
    if lacks := unfinished(config.cloud):
        return Arrival(name, None, f"{config.cloud}: {lacks}: is its upload over?", waits=age < LATE)
    return Arrival(name, config)


def _check(file: Path) -> None:
    if (shown := paths.shown(file)) != str(file):
        raise InputError(f"{shown}: its name isn't Unicode: rename it")
    if not file.is_file():
        raise InputError(f"{file}: no such file")


def _only(files: list[Path]) -> Path | None:
    return files[0] if len(files) == 1 else None


def unfinished(cloud: Path) -> str:
    """What a LAS or LAZ file lacks at its end, by its own header; nothing if it lacks nothing.

    Of LAZ the points begin with the place of the table of chunks, which is written last; where that couldn't be told
    yet, it is the last number of the file.

    Raises
    ------
    OSError
        If the file can't be read.
    """
    size = cloud.stat().st_size
    with cloud.open("rb") as stream:
        head = stream.read(HEADER)
        if head[:4] != b"LASF"[: len(head)]:
            return ""  # no such file at all, as reading it will tell
        if len(head) < OLDEST_HEADER:
            return "its header isn't whole yet"
        (offset,), kind, (length, n) = struct.unpack("<I", head[96:100]), head[104], struct.unpack("<HI", head[105:111])
        if head[25] >= 4 and len(head) == HEADER:
            at, records, n = struct.unpack("<QIQ", head[235:255])
            if not _has_records(stream, at, records, size):
                return "ends before the last of its records"
        if not kind & COMPRESSED:
            return "" if size >= offset + n * length else f"ends before the last of its {n:,} points"
        return "" if _has_table(stream, offset, n, size) else "ends before its table of chunks"


def _has_records(stream: IO[bytes], at: int, n: int, size: int) -> bool:
    """Whether n records are there that stand one behind the other, after the points."""
    for _ in range(n):
        if at + LATE_RECORD > size:
            return False
        stream.seek(at)
        at += LATE_RECORD + int.from_bytes(stream.read(LATE_RECORD)[20:28], "little")
    return n == 0 or at <= size


def _has_table(stream: IO[bytes], offset: int, n: int, size: int) -> bool:
    """Whether the table of chunks of n points in LAZ is there to its end."""
    import lazrs

    stream.seek(offset)
    table = _number(stream.read(8))
    if table == -1 and size >= 8:
        stream.seek(-8, os.SEEK_END)
        table = _number(stream.read(8))
    if not offset < table <= size - 8:
        return False
    stream.seek(table + 4)
    chunks = int.from_bytes(stream.read(4), "little")
    if (chunks == 0) != (n == 0) or chunks * LEAST_CHUNK > table - offset:
        return False
    try:
        packing = lazrs.LazVlr(_packing(stream, offset))
        stream.seek(offset)
        lazrs.read_chunk_table(stream, packing)
    except lazrs.LazrsError:
        return False
    return True


def _packing(stream: IO[bytes], end: int) -> bytes:
    """What stands before the points of LAZ about how they are packed."""
    stream.seek(94)
    at = int.from_bytes(stream.read(2), "little")
    while at < end:
        stream.seek(at)
        record = stream.read(RECORD)
        length = int.from_bytes(record[20:22], "little")
        if record[2:16] == b"laszip encoded":
            return stream.read(length)
        at += RECORD + length
    return b""


def _number(word: bytes) -> int:
    return int.from_bytes(word, "little", signed=True) if len(word) == 8 else 0
