"""Which files hold a cloud: one or many, tiles or flights, that are worked as one."""

from __future__ import annotations

import struct
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinemap import naming, paths
from vinemap.cloud.formats.kinds import IN_FOLDERS, is_surface, kind_of
from vinemap.cloud.formats.remote import Ranges
from vinemap.cloud.las_end import begins_as_las, read_head
from vinemap.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.cloud.las_end import Head

CLOUDS = (".las", ".laz", *IN_FOLDERS)
"""How files end that are clouds wherever they lie; others, as text and surface models, are if they are named."""
COPC = ".copc.laz"
FIRST_YEAR, AHEAD = 2003, timedelta(days=1)
"""Year since which there is LAS, and how far a day's date may be ahead of the clock, as east of Greenwich."""


def listed(clouds: Path | Sequence[Path]) -> tuple[Path, ...]:
    """One file or several, as several."""
    return (clouds,) if isinstance(clouds, Path) else tuple(clouds)


def cloud_files(clouds: Path | Sequence[Path]) -> tuple[Path, ...]:
    """The files of a cloud, in order: those that are given, those in folders that are given, each of them once.

    A file in two formats side by side (``a.laz`` and ``a.copc.laz``, as programs leave them) is one.

    Raises
    ------
    InputError
        If there is none, or a folder can't be read, or one file of a name has another number of points.
    """
    found: list[Path] = []
    for path in listed(clouds):
        if not path.is_dir() or naming.url_of(path):
            found.append(path)
            continue
        try:
            inside = [p for p in (tiles_in(one) for one in (path, *sorted(path.iterdir()))) if is_cloud(p)]
        except OSError as error:
            raise InputError(f"{path}: can't be read ({error.strerror})") from error
        if not inside:
            raise InputError(f"{path}: holds no cloud: name the file, if it is text or a surface model")
        found += inside
    if not found:
        raise InputError("there is no cloud: name a file, or a folder of such")
    return once(found)


def is_cloud(path: Path) -> bool:
    """Whether something is a cloud by its name, and neither a folder nor hidden."""
    named = path.suffix.lower() in CLOUDS or path.name == paths.EPT
    return named and not path.name.startswith(".") and not path.is_dir()


def tiles_in(path: Path) -> Path:
    """The file that describes Entwine Point Tiles, where a path is their folder; else the path."""
    with suppress(OSError):
        if (inside := path / paths.EPT).is_file():
            return inside
    return path


def shows_tops(clouds: Sequence[Path]) -> bool:
    """Whether something of a cloud was seen from above alone, as in a surface model."""
    return any(map(is_surface, clouds))


def once(files: Sequence[Path]) -> tuple[Path, ...]:
    """Files without those that hold the points of another: by the same name, or by their number and box.

    Of one name in several formats COPC goes before LAZ before LAS before all others.

    Raises
    ------
    InputError
        If what has one name holds another number of points, as far as headers are whole, or something is no file.
    """
    if odd := next((path for path in files if not path.is_file() and (path.exists() or path.is_symlink())), None):
        raise InputError(f"{odd}: can't be read: it is no file")
    groups: dict[tuple[Path, str], list[Path]] = {}
    for path in dict.fromkeys(files):
        groups.setdefault((path.parent, paths.bare(path)), []).append(path)
    for group in groups.values():
        counts = {path: head.n for path in group if (head := _head(path))} if len(group) > 1 else {}
        known = list(counts)
        if other := next((path for path in known if counts[path] != counts[known[0]]), None):
            raise InputError(f"{known[0]} and {other.name} hold another number of points: keep the one that is right")
    best = [max(group, key=_rank) for group in groups.values()]
    alike: dict[object, list[Path]] = {}
    for path in best:
        alike.setdefault((_extent(path) if len(best) > 1 else None) or path, []).append(path)
    return tuple(max(group, key=_rank) for group in alike.values())


def _extent(path: Path) -> tuple[int, bytes] | None:
    """Number of points and box of which a file's header tells; None if it tells of none."""
    head = _head(path)
    if not (head and head.n):
        return None
    sides = np.frombuffer(head.box, "<f8").reshape(3, 2)
    return (head.n, head.box) if (sides[:2, 0] > sides[:2, 1]).all() else None


def _head(path: Path) -> Head | None:
    """What a file's header says; None if it has no whole header."""
    try:
        with path.open("rb") as stream:
            return read_head(stream) if begins_as_las(stream) else None
    except OSError:
        return None


def date_of(path: Path) -> datetime | None:
    """Midnight (UTC) of the day that a file's header states as its date; None if it states none that can be.

    Raises
    ------
    OSError
        If the file can't be read.
    """
    if kind_of(path) == "remote":
        head = Ranges(path).beginning[:94]
    else:
        with path.open("rb") as stream:
            head = stream.read(94)
    if len(head) < 94 or not head.startswith(b"LASF"):
        return None
    day, year = struct.unpack("<HH", head[90:])
    if not (1 <= day <= 366 and FIRST_YEAR <= year < 9999):
        return None
    date = datetime(year, 1, 1, tzinfo=UTC) + timedelta(days=day - 1)
    return date if date < datetime.now(UTC) + AHEAD else None


def _rank(path: Path) -> tuple[bool, bool, bool]:
    kind = path.suffix.lower()
    return path.name.lower().endswith(COPC), kind == ".laz", kind == ".las"


def worded(files: Sequence[Path]) -> str:
    """Files as an error names them."""
    more = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return f"{naming.named(files[0])}{more}"
