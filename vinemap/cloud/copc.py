"""COPC files: what lies in a box, found by the file's index where that can be trusted."""

from __future__ import annotations

from typing import IO, TYPE_CHECKING, Any

import numpy as np

from vinemap.cloud.las_end import OURS

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.cloud.formats.box import Box
    from vinemap.cloud.layout import Layout

MOST_FOUND = 20_000_000
"""Points of nodes that are held at once, about 2 GB."""
WIDEST = 1.1
"""Half the index's cube, as a share of the widest side of the box that the header states, at the most."""


def is_copc(header: Any) -> bool:
    """Whether a header is that of a COPC file."""
    return any(record.user_id == "copc" for record in header.vlrs)


def points_about(path: Path, layout: Layout, box: Box, selection: Any) -> Any | None:
    """Points of a COPC file's nodes that meet a box, as laspy gives them.

    None where the index can't be read, isn't that of the points, or has too many there: then the file is to be read
    through, and what that says is clearer.

    Parameters
    ----------
    path : Path
        The file.
    layout : Layout
        As its header and its table of chunks have it.
    box : (array (3,), array (3,))
        Least and greatest coordinates in the file's CRS.
    selection : laspy.DecompressionSelection
        What is unpacked of a point.
    """
    from laspy.copc import Bounds, CopcReader, load_octree_for_query

    try:
        with path.open("rb") as stream:
            size = path.stat().st_size
            if not _has_root(stream, size):
                return None
            reader = CopcReader(stream, decompression_selection=selection)
            info, page = reader.copc_info, reader.root_page
            if not (_complete(page, stream, size) and _is_of(page, layout) and _fits(info, reader.header)):
                return None
            nodes = load_octree_for_query(stream, info, page)
            if sum(node.point_count for node in nodes) != layout.head.n:
                return None
            near = [node for node in load_octree_for_query(stream, info, page, Bounds(*box)) if node.point_count]
            if sum(node.point_count for node in near) > MOST_FOUND:
                return None
            points = unpacked(_packed(stream, near), reader, near)
            return points if _in_place(points, near) else None
    except OURS:
        raise
    except BaseException:  # noqa: BLE001 - as said
        return None


def _has_root(stream: IO[bytes], size: int) -> bool:
    """Whether the index's first page, whose place stands in the first record, lies in the file."""
    stream.seek(375 + 54 + 40)
    at, length = np.frombuffer(stream.read(16), "<u8").tolist()
    stream.seek(0)
    return bool(at + length <= size)


def _complete(page: Any, stream: IO[bytes], size: int) -> bool:
    """Bring all pages of an index into its first; False where they lead in circles or out of the file."""
    waiting, seen = list(page.entries.values()), set()
    while waiting:
        entry = waiting.pop()
        if entry.point_count != -1:
            continue
        if entry.offset in seen or entry.byte_size < 0 or entry.offset + entry.byte_size > size:
            return False
        seen.add(entry.offset)
        stream.seek(entry.offset)
        more = type(page).from_bytes(stream.read(entry.byte_size)).entries
        page.entries.update(more)
        waiting += more.values()
    return all(entry.point_count != -1 for entry in page.entries.values())


def _is_of(page: Any, layout: Layout) -> bool:
    """Whether the nodes of an index are the chunks of a file."""
    nodes = [(e.offset, e.byte_size, e.point_count) for e in page.entries.values() if e.point_count > 0]
    return sorted(nodes) == sorted(tuple(chunk) for chunk in layout.chunks)


def _fits(info: Any, header: Any) -> bool:
    """Whether an index's cube is one about the box that the header states."""
    sides = header.maxs - header.mins
    beyond = np.maximum(info.center - info.halfsize - header.mins, header.maxs - info.center - info.halfsize)
    return bool(info.halfsize <= WIDEST * sides.max() and (beyond <= 2 * header.scales).all())


def near_file(box: Box, header: Any) -> Box:
    """A box without what is farther from a file's extent than that is wide: laspy's query counts in whole numbers."""
    reach = header.maxs - header.mins
    low, high = (np.clip(corner, header.mins - reach, header.maxs + reach) for corner in box)
    return low, high


def _packed(stream: IO[bytes], nodes: list[Any]) -> bytearray:
    packed = bytearray()
    for node in nodes:
        stream.seek(node.offset)
        packed += stream.read(node.byte_size)
    return packed


def unpacked(packed: bytes | bytearray, reader: Any, nodes: list[Any]) -> Any:
    """Points of nodes, whose packed bytes stand one behind the other, as laspy gives them."""
    import lazrs
    from laspy.point.record import PackedPointRecord, ScaleAwarePointRecord

    header = reader.header
    out = np.zeros(sum(node.point_count for node in nodes) * header.point_format.size, np.uint8)
    table = [(node.point_count, node.byte_size) for node in nodes]
    packing = reader.laszip_vlr.record_data
    lazrs.decompress_points_with_chunk_table(packed, packing, out, table, reader.decompression_selection)
    record = PackedPointRecord.from_buffer(out, header.point_format)
    return ScaleAwarePointRecord(record.array, record.point_format, header.scales, header.offsets)


def _in_place(points: Any, nodes: list[Any]) -> bool:
    """Whether the points of every node lie where the index has it."""
    starts = np.cumsum([0, *(node.point_count for node in nodes[:-1])])
    low, high = (np.array([getattr(node.bounds, side) for node in nodes]) for side in ("mins", "maxs"))
    for k, column in enumerate((points.x, points.y, points.z) if nodes else ()):
        values, slack = np.asarray(column), 2 * points.scales[k]
        least, most = (ends.reduceat(values, starts) for ends in (np.minimum, np.maximum))
        if (least < low[:, k] - slack).any() or (most > high[:, k] + slack).any():
            return False
    return True
