"""What tells whether a cloud is still the same: of a file, of a folder of tiles, of a file on a web server."""

from __future__ import annotations

import hashlib
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING

from vinemap import naming, paths
from vinemap.cloud.formats.kinds import kind_of
from vinemap.cloud.formats.remote import Ranges

if TYPE_CHECKING:
    from pathlib import Path


def stamp_of(path: Path) -> tuple[int, ...]:
    """Bytes, times of change (ns), and a number, which stay while a cloud does; of all files of EPT.

    Raises
    ------
    OSError
        If it can't be read.
    VinemapError
        If a server doesn't give it.
    """
    if naming.url_of(path):
        file = Ranges(path)
        number = int.from_bytes(hashlib.sha256(file.tag.encode() + file.beginning).digest()[:7], "big")
        return file.size, _time_of(file.modified), 0, number
    stats = [part.stat() for part in files_of(path)]
    return (
        sum(stat.st_size for stat in stats),
        max(stat.st_mtime_ns for stat in stats),
        max(stat.st_ctime_ns for stat in stats),
        stats[0].st_ino if len(stats) == 1 else len(stats),
    )


def _time_of(told: str) -> int:
    """Time (ns) that a server tells; 0 if it tells none, or what is no date."""
    try:
        return int(parsedate_to_datetime(told).timestamp() * 1e9)
    except (ValueError, OverflowError):
        return 0


def digest_of(path: Path) -> str:
    """SHA-256 of a cloud's content; of a file on a server, of what it tells of it, and of its beginning.

    Raises
    ------
    OSError
        If it can't be read.
    VinemapError
        If a server doesn't give it.
    """
    if naming.url_of(path):
        file = Ranges(path)
        place = file.url.partition("?")[0]  # behind it may stand who asks, and until when
        told = f"{place} {file.size} {file.tag} {file.modified}".encode()
        return hashlib.sha256(told + file.beginning).hexdigest()
    first, *others = files_of(path)
    digests = [_sha256(first), *(f"{part.relative_to(path.parent).as_posix()} {_sha256(part)}" for part in others)]
    return hashlib.sha256("\n".join(digests).encode()).hexdigest() if others else digests[0]


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def files_of(path: Path) -> list[Path]:
    """Files of a cloud, of which EPT has many."""
    if kind_of(path) != "ept":
        return [path]
    folders = (paths.ept_folder(path.parent, kind) for kind in ("data", "hierarchy"))
    return [path, *(part for folder in folders for part in sorted(folder.glob("*")) if part.is_file())]
