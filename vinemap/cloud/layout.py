"""How a LAS, LAZ or COPC file says that it is laid out, checked before anything of it is trusted.

Decoders take a file at its word: where that counts wrongly, they ask for more memory than there is, which ends the
process, go round for hours, or read half of the points. What is checked is LAS 1.4 R15 of ASPRS, and LASzip's chunks
and layers as in its specification (M. Isenburg, 2013).
"""

from __future__ import annotations

import io
import struct
from itertools import accumulate
from typing import IO, TYPE_CHECKING, NamedTuple

from vinemap.cloud.las_end import (
    OURS,
    RECORD,
    chunk_table_at,
    examine,
    packing_of,
)
from vinemap.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vinemap.cloud.las_end import Head

ITEMS = {
    0: (6,),
    1: (6, 7),
    2: (6, 8),
    3: (6, 7, 8),
    4: (6, 7, 9),
    5: (6, 7, 8, 9),
    6: (10,),
    7: (10, 11),
    8: (10, 12),
    9: (10, 13),
    10: (10, 12, 13),
}
"""Kinds of items that LASzip packs, of each point format of LAS."""
LENGTHS = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
"""Bytes of each kind."""
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers of each kind; extra bytes have one each."""
EXTRA = {0, 14}
"""Kinds that are extra bytes, as many as the item says."""
POINTWISE, LAYERED = 2, 3
"""Ways of packing, in chunks."""
VARIABLE = 0xFFFF_FFFF
"""Points in a chunk where each says itself how many."""
INNER_WAVES = 2
"""Bit of the header that tells of waveforms behind the points."""
LARGEST_LAST = 200_000
"""Points of a last chunk that is unpacked to see whether it has more."""
SLACK = 16
"""Points, and bytes of points, that an unpacker makes up behind the last one."""


class Flaw(Exception):  # noqa: N818 - it becomes an InputError
    """What is wrong with a file."""


class Chunk(NamedTuple):
    """Where points lie that are packed together."""

    at: int
    length: int
    n: int


class Layout(NamedTuple):
    """What a file says of itself, and its chunks, of which LAS has none."""

    head: Head
    chunks: list[Chunk]
    widest: int = 0
    """Points for which whoever unpacks whole chunks makes room: of the last as of the others."""


def read_layout(path: Path) -> Layout:
    """Read how a LAS, LAZ or COPC file is laid out, and make sure that its parts agree.

    Raises
    ------
    InputError
        If they don't.
    OSError
        If it can't be read.
    """
    try:
        return _read(path)
    except Flaw as flaw:
        raise InputError(f"{path}: {flaw}: copy or download it again") from flaw


def _read(path: Path) -> Layout:
    size = path.stat().st_size
    with path.open("rb") as stream:
        head, table, lacks = examine(stream, size)
        if lacks:
            raise Flaw(lacks)
        if head is None:
            raise InputError(f"{path}: can't be read as LAS or LAZ: it doesn't begin as such a file")
        _check_head(stream, head)
        if head.compressed:
            return _packed(stream, head, size, table)
        _check_count(head, size)
        return Layout(head, [])


def _check_head(stream: IO[bytes], head: Head) -> None:
    """Make sure that header and records end before the points begin, and that the points have room for their format."""
    form = head.kind & 0x3F
    if form not in ITEMS:
        raise Flaw(f"its header states point format {form}, which there isn't")
    least = sum(LENGTHS[kind] for kind in ITEMS[form])
    if head.point_length < least:
        raise Flaw(f"its header states points of {head.point_length} bytes, and those of format {form} have {least}")
    at = head.length
    if at + head.n_records * RECORD > head.points_at:
        raise Flaw(f"its header states {head.n_records:,} records, for which there is no room")
    for _ in range(head.n_records):
        stream.seek(at)
        at += RECORD + int.from_bytes(stream.read(RECORD)[20:22], "little")
        if at > head.points_at:
            raise Flaw("the records behind its header reach into the points")


def _check_count(head: Head, size: int) -> None:
    """Make sure that behind the points of LAS there are no more of them."""
    end = head.points_at + head.n * head.point_length
    if head.encoding & INNER_WAVES:
        return
    spare = (head.late_at if head.n_late and head.late_at >= end else size) - end
    if spare and spare % head.point_length == 0:
        raise _other_count(head, head.n + spare // head.point_length)


def _other_count(head: Head, n: int) -> Flaw:
    return Flaw(f"its header counts {head.n:,} points, but {n:,} are in it")


def _packed(stream: IO[bytes], head: Head, size: int, table: Sequence[tuple[int, int]]) -> Layout:
    """Layout of LAZ, the lengths and counts of whose chunks must agree with the file's."""
    packing = packing_of(stream, head.points_at)
    way, items = _items(packing, head)
    if way == 1:  # all points in one, as LASzip did at first
        return Layout(head, [])
    each = int.from_bytes(packing[12:16], "little")
    lengths = [length for _, length in table]
    starts = list(accumulate(lengths, initial=head.points_at + 8))
    if starts[-1] != chunk_table_at(stream, head, size):
        raise Flaw("its table of chunks doesn't fit its points")
    if each == VARIABLE:
        counts = [n for n, _ in table]
    elif each * (len(table) - 1) < head.n <= each * len(table):
        counts = [each] * (len(table) - 1) + [head.n - each * (len(table) - 1)] if table else []
    else:
        counts = [each] * len(table)
    chunks = [Chunk(*chunk) for chunk in zip(starts[:-1], lengths, counts, strict=True)]
    if way == LAYERED:
        chunks = [_layered(stream, head, chunk, items) for chunk in chunks]
        if [chunk.n for chunk in chunks[:-1]] != counts[:-1] or (chunks and chunks[-1].n > each):
            raise Flaw("its chunks have other numbers of points than its table of chunks says")
    if (n := sum(chunk.n for chunk in chunks)) != head.n:
        raise _other_count(head, n)
    if way == POINTWISE and each != VARIABLE and chunks:
        _check_last(stream, head, chunks[-1], each, packing)
    return Layout(head, chunks, max(counts, default=0) if each == VARIABLE else each)


def _items(packing: bytes, head: Head) -> tuple[int, list[tuple[int, int]]]:
    """The way of packing, and kind and length of every item, which must be those of the points."""
    if len(packing) < 34:
        raise Flaw("doesn't say how its points are packed")
    way, n = struct.unpack("<H30xH", packing[:34])
    if len(packing) < 34 + 6 * n:
        raise Flaw("doesn't say how its points are packed")
    items = [struct.unpack_from("<HH", packing, 34 + 6 * k) for k in range(n)]
    plain = [(kind, length) for kind, length in items if kind not in EXTRA]
    form = head.kind & 0x3F
    ways = {LAYERED} if form > 5 else {1, POINTWISE}
    fit = plain == [(kind, LENGTHS[kind]) for kind in ITEMS[form]] and way in ways
    if not fit or sum(length for _, length in items) != head.point_length:
        raise Flaw(f"its points are packed in another way than those of its point format {form}")
    return way, [(kind, length) for kind, length in items]


def _layered(stream: IO[bytes], head: Head, chunk: Chunk, items: list[tuple[int, int]]) -> Chunk:
    """A chunk with the number of points that it says itself; its layers must fill it."""
    n_layers = sum(LAYERS.get(kind, length) for kind, length in items)
    stream.seek(chunk.at + head.point_length)
    words = stream.read(4 + 4 * n_layers)
    n, *layers = struct.unpack(f"<{1 + n_layers}I", words.ljust(4 + 4 * n_layers, b"\0"))
    if head.point_length + len(words) + sum(layers) != chunk.length:
        raise Flaw("the layers of its points don't fit its table of chunks")
    return chunk._replace(n=n)


def _check_last(stream: IO[bytes], head: Head, chunk: Chunk, each: int, packing: bytes) -> None:
    """Make sure that a last chunk, which doesn't say how many points it has, has no more than the header counts."""
    import lazrs

    made_up = SLACK + SLACK * chunk.n // max(1, chunk.length)
    if not chunk.n + made_up < each <= LARGEST_LAST:
        return
    stream.seek(chunk.at)
    alone = struct.pack("<q", 8 + chunk.length) + stream.read(chunk.length) + bytes(8)
    out = bytearray((chunk.n + made_up) * head.point_length)
    try:
        lazrs.LasZipDecompressor(io.BytesIO(alone), packing).decompress_many(out)
    except OURS:
        raise
    except BaseException:  # noqa: BLE001 - it ends where it should, or is damaged, which reading it will tell
        return
    raise Flaw(f"its header counts {head.n:,} points, but more are in it, or they are damaged")
