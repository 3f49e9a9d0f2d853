"""Whether a LAS or LAZ file is there to its end, told without reading its points."""

from __future__ import annotations

import os
import struct
from typing import IO, TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

HEADER, OLDEST_HEADER = 375, 227
"""Bytes of the header of LAS 1.4, and of the oldest."""
BOX = slice(179, 227)
"""Where it tells of greatest and least coordinates, in turn."""
RECORD, LATE_RECORD = 54, 60
"""Bytes before what a record holds, before the points and behind them."""
COMPRESSED = 0x80
"""Bit of a point format that is LAZ's."""
LEAST_CHUNK = 20
"""Bytes of points in a chunk of LAZ."""
OURS = (KeyboardInterrupt, SystemExit, GeneratorExit)
"""What isn't raised by laspy and lazrs, which raise many kinds: a Rust panic isn't even an Exception."""


class Head(NamedTuple):
    """What the header of a file says of its layout: places and lengths in bytes, and numbers."""

    encoding: int
    length: int
    """Of the header."""
    points_at: int
    n_records: int
    kind: int
    """Point format, with LAZ's bit."""
    point_length: int
    n: int
    """Points."""
    late_at: int
    n_late: int
    """Records behind the points."""
    box: bytes
    """Greatest and least x, y and z, in turn: six doubles."""

    @property
    def compressed(self) -> bool:
        """Whether the points are LAZ."""
        return bool(self.kind & COMPRESSED)


class Seen(NamedTuple):
    """What is seen of a file before its points are read."""

    head: Head | None = None
    """None if it doesn't begin as LAS, or its header isn't whole."""
    table: Sequence[tuple[int, int]] = ()
    """Points and bytes of every chunk of LAZ; where chunks have as many points each, the last is said to have, too."""
    lacks: str = ""
    """What it lacks at its end, in words."""


def unfinished(cloud: Path) -> str:
    """What a LAS or LAZ file lacks at its end, by its own header; nothing if it lacks nothing.

    Of LAZ the points begin with the place of the table of chunks, which is written last; where that couldn't be told
    yet, it is the last number of the file.

    Raises
    ------
    OSError
        If the file can't be read.
    """
    with cloud.open("rb") as stream:
        return examine(stream, cloud.stat().st_size).lacks


def examine(stream: IO[bytes], size: int) -> Seen:
    """What a file of a size (bytes) says of its layout, and lacks by that."""
    if not begins_as_las(stream):
        return Seen()  # no such file at all, as reading it will tell
    head = read_head(stream)
    if head is None:
        return Seen(lacks="its header isn't whole")
    if not _has_records(stream, head, size):
        return Seen(head, lacks="ends before the last of its records")
    if not head.compressed:
        whole = size >= head.points_at + head.n * head.point_length
        return Seen(head, lacks="" if whole else f"ends before the last of its {head.n:,} points")
    table = _read_chunks(stream, head, size)
    return Seen(head, lacks="ends before its table of chunks") if table is None else Seen(head, table)


def begins_as_las(stream: IO[bytes]) -> bool:
    """Whether a file begins as one of LAS, or could if it were longer."""
    mark = stream.read(4)
    return mark == b"LASF"[: len(mark)]


def read_head(stream: IO[bytes]) -> Head | None:
    """What a file's header says; None if it isn't there as a whole."""
    stream.seek(0)
    head = stream.read(HEADER)
    if len(head) < (HEADER if head[25:26] >= b"\x04" else OLDEST_HEADER):
        return None
    (encoding,) = struct.unpack("<H", head[6:8])
    length, points_at, n_records, kind, point_length, n = struct.unpack("<HIIBHI", head[94:111])
    late_at, n_late = 0, 0
    if head[25] >= 4:
        late_at, n_late, n = struct.unpack("<QIQ", head[235:255])
    return Head(encoding, length, points_at, n_records, kind, point_length, n, late_at, n_late, head[BOX])


def _has_records(stream: IO[bytes], head: Head, size: int) -> bool:
    """Whether the records are there that stand one behind the other, after the points."""
    at = head.late_at
    for _ in range(head.n_late):
        if at + LATE_RECORD > size:
            return False
        stream.seek(at)
        at += LATE_RECORD + int.from_bytes(stream.read(LATE_RECORD)[20:28], "little")
    return head.n_late == 0 or at <= size


def _read_chunks(stream: IO[bytes], head: Head, size: int) -> list[tuple[int, int]] | None:
    """Points and bytes of every chunk of LAZ, by the table of chunks; None if that isn't there to its end.

    How many chunks there are is checked before the table is read: whoever reads it asks for the memory first.
    """
    import lazrs

    table = chunk_table_at(stream, head, size)
    if not head.points_at < table <= size - 8:
        return None
    stream.seek(table + 4)
    n_chunks = int.from_bytes(stream.read(4), "little")
    if (n_chunks == 0) != (head.n == 0) or n_chunks * LEAST_CHUNK > table - head.points_at:
        return None
    try:
        packing = lazrs.LazVlr(packing_of(stream, head.points_at))
        stream.seek(head.points_at)
        chunks: list[tuple[int, int]] = lazrs.read_chunk_table(stream, packing)
    except OURS:
        raise
    except BaseException:  # noqa: BLE001 - as said of OURS
        return None
    return chunks


def chunk_table_at(stream: IO[bytes], head: Head, size: int) -> int:
    """Where the table of chunks stands."""
    stream.seek(head.points_at)
    table = _number(stream.read(8))
    if table == -1 and size >= 8:
        stream.seek(-8, os.SEEK_END)
        table = _number(stream.read(8))
    return table


def packing_of(stream: IO[bytes], end: int) -> bytes:
    """What stands before the points of LAZ about how they are packed; nothing if it isn't there."""
    stream.seek(94)
    at = int.from_bytes(stream.read(2), "little")
    while at < end:
        stream.seek(at)
        record = stream.read(RECORD)
        if len(record) < RECORD:
            break
        length = int.from_bytes(record[20:22], "little")
        if record[2:16] == b"laszip encoded":
            return stream.read(length)
        at += RECORD + length
    return b""


def _number(word: bytes) -> int:
    return int.from_bytes(word, "little", signed=True) if len(word) == 8 else 0
