"""COPC files on web servers, of which only what lies about a polygon is fetched, by requests of ranges (RFC 9110)."""

from __future__ import annotations

import io
import time
from http.client import HTTPException, IncompleteRead
from typing import TYPE_CHECKING, Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from vinemap import naming
from vinemap.cloud.copc import is_copc, near_file, unpacked
from vinemap.cloud.formats.box import EVERYWHERE, box_about
from vinemap.cloud.formats.told import CHUNK, Points, needed, reading, usable_records
from vinemap.cloud.las_end import LATE_RECORD
from vinemap.errors import BusyError, InputError
from vinemap.geo.stated import crs_of

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path, PurePath

    from pyproj import CRS

    from vinemap.cloud.formats.box import Box
    from vinemap.compute.arrays import Floats
    from vinemap.geo.boundaries import Boundary

PATIENCE = 20.0
"""Seconds for which a server may send nothing."""
ATTEMPTS = 4
"""How often something is asked for of which little came, with a pause between that grows."""
LITTLE = 65_536
"""Bytes after which an answer that broke off has come some way."""
PAUSE = 0.5
"""Seconds of the first pause."""
BEGINNING = 4_096
"""Bytes that are fetched first: header and records."""
GAP = 0.05
"""Share of a node's bytes that may lie unused before it, if that makes two requests one."""
MOST = 16_000_000
"""Bytes that are fetched at once."""
AGAIN = {408, 425, 429, 500, 502, 503, 504}
"""Answers after which the same may go well."""
REFUSALS = {404: "there is no such file", 410: "there is no such file"} | dict.fromkeys(
    (401, 403), "it may not be read"
)


class Ranges(io.RawIOBase):
    """A file on a web server, of which only what is read is fetched."""

    def __init__(self, path: Path) -> None:
        """Fetch its beginning; errors are those of :meth:`fetch`."""
        self.url = str(naming.url_of(path))
        self.size, self.tag, self.modified, self.at = 0, "", "", 0
        self.beginning = b""
        self.beginning = self.fetch(0, BEGINNING)

    def seekable(self) -> bool:
        """It can be read anywhere."""
        return True

    def readable(self) -> bool:
        """It can be read."""
        return True

    def tell(self) -> int:
        """Where the next byte is read."""
        return self.at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a byte."""
        self.at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self.at, io.SEEK_END: self.size}[whence]
        return self.at

    def read(self, n: int | None = -1) -> bytes:
        """Bytes from here on."""
        end = self.size if n is None or n < 0 else min(self.size, self.at + n)
        held = end <= len(self.beginning)
        found = self.beginning[self.at : end] if held else self.fetch(self.at, end)
        self.at = max(self.at, end)
        return found

    def fetch(self, start: int, end: int) -> bytes:
        """Bytes from one place to another, asked for again where an answer breaks off.

        Raises
        ------
        InputError
            If the server has no such file, doesn't give it to us, or gives no ranges.
        BusyError
            If it doesn't answer, stalls or breaks off again and again, or the file changes meanwhile.
        """
        found, failed, reason = bytearray(), 0, ""
        while start + len(found) < end and failed < ATTEMPTS:
            if failed:
                time.sleep(PAUSE * 2 ** (failed - 1))
            before = len(found)
            try:
                reason = self._ask(start + before, end, found)
            except HTTPError as error:
                with error:
                    reason = self._refused(error)
            except (URLError, HTTPException, OSError) as error:
                reason = str(getattr(error, "reason", error)) or type(error).__name__
            failed = 0 if len(found) > before + LITTLE else failed + 1
            if self.size:
                end = min(end, self.size)
        if start + len(found) < end:
            raise BusyError(f"{self.url}: can't be read now ({reason}), after {ATTEMPTS} attempts: try again")
        return bytes(found)

    def _ask(self, start: int, end: int, found: bytearray) -> str:
        """Take what comes of a range; gives why it isn't all."""
        asked = Request(self.url, headers={"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"})  # noqa: S310
        with urlopen(asked, timeout=PATIENCE) as answer:  # noqa: S310
            if answer.status != 206:
                raise InputError(
                    f"{self.url}: its server gives whole files only, no ranges of bytes: download it, and give the file"
                )
            self._identify(answer.headers)
            try:
                while block := answer.read1(1 << 18):
                    found += block[: end - start]
            except IncompleteRead as error:
                found += error.partial
        return "the answer broke off"

    def _identify(self, headers: Any) -> None:
        """Make sure that all ranges are of one file."""
        size = headers.get("Content-Range", "").rpartition("/")[2]
        known = int(size) if size.isdigit() else 0, headers.get("ETag", ""), headers.get("Last-Modified", "")
        if self.size and known != (self.size, self.tag, self.modified):
            raise BusyError(f"{self.url}: changed while it was read: try again when it stays as it is")
        if not known[0]:
            raise InputError(f"{self.url}: its server doesn't say how large it is: download it, and give the file")
        self.size, self.tag, self.modified = known

    def _refused(self, error: HTTPError) -> str:
        """What an answer says that gives nothing, if asking again may help."""
        if error.code in AGAIN:
            return f"the server says {error.code} {error.reason}"
        what = REFUSALS.get(error.code, "it can't be read")
        raise InputError(f"{self.url}: {what} (the server says {error.code} {error.reason}): check the address")


def read_remote(path: Path, crs: CRS | None, around: Boundary | None) -> Points:
    """Open a COPC file on a web server, or that part of it which lies about a polygon.

    Raises
    ------
    InputError
        If it can't be had, is no COPC, or isn't whole.
    BusyError
        If the server can't be reached, or is silent.
    """
    from laspy.copc import CopcReader

    stream, named = Ranges(path), naming.named(path)
    if not stream.beginning.startswith(b"LASF") or b"copc" not in stream.beginning[375:600]:
        raise InputError(f"{stream.url}: is no COPC, of which parts can be fetched: download it, and give the file")
    with reading(named, "COPC"):
        reader = CopcReader(stream, decompression_selection=needed())
        if not is_copc(reader.header):
            raise InputError(f"{stream.url}: is no COPC, of which parts can be fetched: download it, and give the file")
        if not reader.header.vlrs.get_by_id("LASF_Projection"):
            reader.header.evlrs = _projections(stream, reader.header)
    box = box_about(around, crs_of(reader.header, crs, named)) if around else EVERYWHERE
    return Points(reader.header, _read(named, stream, reader, box))


def _projections(stream: Ranges, header: Any) -> Any:
    """Records behind the points that tell of the CRS."""
    from laspy.vlrs.vlrlist import VLRList

    found, at = VLRList(), header.start_of_first_evlr
    for _ in range(header.number_of_evlrs):
        head = stream.fetch(at, at + LATE_RECORD)
        length = LATE_RECORD + int.from_bytes(head[20:28], "little")
        if head[2:18].rstrip(b"\0") == b"LASF_Projection":
            found += VLRList.read_from(io.BytesIO(stream.fetch(at, at + length)), 1, extended=True)
        at += length
    return found


def _read(path: PurePath, stream: Ranges, reader: Any, box: Box) -> Generator[Floats]:
    from laspy.copc import Bounds, load_octree_for_query

    near = Bounds(*near_file(box, reader.header))
    with reading(path, "COPC"):
        nodes = load_octree_for_query(stream, reader.copc_info, reader.root_page, near)
        nodes = sorted((node for node in nodes if node.point_count > 0), key=lambda node: node.offset)
        if any(node.offset + node.byte_size > stream.size for node in nodes):
            raise InputError(f"{stream.url}: its index leads out of the file: have it written anew")
    for group in _together(nodes):
        start = group[0].offset
        data = stream.fetch(start, group[-1].offset + group[-1].byte_size)
        with reading(path, "COPC"):
            packed = b"".join(data[node.offset - start : node.offset - start + node.byte_size] for node in group)
            yield usable_records(unpacked(packed, reader, group))


def _together(nodes: list[Any]) -> Generator[list[Any]]:
    """Nodes, in the order of the file, in groups that are fetched at once: those that lie next to each other."""
    group: list[Any] = []
    for node in nodes:
        if group:
            end = group[-1].offset + group[-1].byte_size
            apart = node.offset - end > GAP * node.byte_size
            many = sum(one.point_count for one in group) + node.point_count > CHUNK
            if apart or many or node.offset + node.byte_size - group[0].offset > MOST:
                yield group
                group = []
        group.append(node)
    if group:
        yield group
