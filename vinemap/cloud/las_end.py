"""Whether a LAS or LAZ file is there to its end, told without reading its points."""

from __future__ import annotations

import os
import struct
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

HEADER, OLDEST_HEADER = 375, 227
"""Bytes of the header of LAS 1.4, and of the oldest."""
RECORD, LATE_RECORD = 54, 60
"""Bytes before what a record holds, before the points and behind them."""
COMPRESSED = 0x80
"""Bit of a point format that is LAZ's."""
LEAST_CHUNK = 20
"""Bytes of points in a chunk of LAZ."""


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
