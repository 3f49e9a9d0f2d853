"""Clouds of all formats read in chunks into metres of one projected CRS, LAS, LAZ and COPC by laspy."""

from __future__ import annotations

from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap import naming
from vinemap.cloud.aside import watched
from vinemap.cloud.copc import is_copc, near_file, points_about
from vinemap.cloud.files import listed, worded
from vinemap.cloud.formats.box import box_about, check_outside, most_strays, n_outside, stated_box
from vinemap.cloud.formats.chunks import other_chunks
from vinemap.cloud.formats.kinds import kind_of
from vinemap.cloud.formats.told import CHUNK, needed, usable_among
from vinemap.cloud.las_end import OURS as NOT_THEIRS
from vinemap.cloud.layout import read_layout
from vinemap.cloud.tiles import Collector
from vinemap.compute.threads import ahead
from vinemap.errors import PASSING, BusyError, EmptyError, InputError, OutsideError
from vinemap.geo.boundaries import Boundary, boundary_in
from vinemap.geo.crs import metric_crs, vertical_name
from vinemap.geo.place import Place
from vinemap.geo.stated import crs_of, examined, to_place
from vinemap.geo.zones import deal, zones_of

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator, Sequence
    from pathlib import Path, PurePath

    from pyproj import CRS

    from vinemap.cloud.formats.box import Box
    from vinemap.cloud.layout import Layout
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Floats

MOST_BYTES = 256_000_000
"""Of points that are held at once as they are in the file."""
SMALL = 0.25
"""Share of a COPC file's extent up to which a query by box is faster than reading it through."""
LARGEST_RELIEF = 2_000.0
"""Metres of height in one survey, at the most."""
LARGEST_SPAN = 50_000.0
"""Metres: what is wider isn't one survey but broken coordinates."""
FARTHEST, FINEST = 1e9, 1e-15
"""Metres, feet or degrees beyond which no place lies, and below which no step is stored."""
WHOLE = 0.01
"""Steps of the scale by which the box that a header states may miss whole numbers of them."""

DISK = "Failed to use read"
"""What lazrs says of any fault in reading bytes."""
RAN_OUT = "failed to fill whole buffer"
"""What it says where packed points end too early."""
OURS = (InputError, MemoryError, *NOT_THEIRS)
"""What says nothing of a file that laspy and lazrs can't read."""


def read_cloud(
    clouds: Path | Sequence[Path],
    *,
    crs: CRS | None = None,
    boundary: Boundary | None = None,
    collector: Collector | None = None,
    engine: str = "vinemap",
) -> Cloud:
    """Read clouds of any format in chunks into one metric projected CRS, clipped to a polygon.

    They are LAS, LAZ and COPC, COPC on web servers, and what :mod:`vinemap.cloud.formats` reads: EPT, E57, PLY, PCD,
    text, surface models. Points flagged as withheld and points of ASPRS class 7 or 18 (noise) are left out. Of COPC,
    EPT and surface models only what lies about the polygon is read.

    Parameters
    ----------
    clouds : Path or sequence of Path
        The file or address, or several that are read as one: tiles, flights.
    crs : CRS, optional
        CRS of the files' coordinates; needed where they state none, and preferred to what they state.
    boundary : (Geometry, CRS), optional
        Polygon to clip to.
    collector : Collector, optional
        Takes the points; by default in memory.
    engine : str
        What reads the files: "vinemap", or "pdal".

    Raises
    ------
    InputError
        If a file can't be read whole, has no points, no CRS, or coordinates that can't be right.
    """
    points, files = collector or Collector(), listed(clouds)
    with open_cloud(files, crs=crs, around=boundary, engine=engine) as (place, chunks):
        zones = zones_of([boundary_in(boundary, place.crs, naming.named(files[0]))]) if boundary else None
        for xyz in chunks:
            points.add(deal(xyz, zones)[0] if zones else xyz)
    return collected(points, place, files)


def collected(points: Collector, place: Place, files: Sequence[Path]) -> Cloud:
    """The cloud that was collected from files, without the few points that lie absurdly far from the rest.

    Raises
    ------
    InputError
        If there are no points, or no survey could have them.
    """
    if points.size == 0:
        raise _none_inside(files)
    cloud = points.cloud(place.crs, place.vertical, *_plausible(points.sample(100_000), worded(files)))
    return replace(cloud, remarks=tuple(dict.fromkeys(place.remarks)))


@contextmanager
def open_cloud(
    clouds: Path | Sequence[Path],
    *,
    crs: CRS | None = None,
    around: Boundary | None = None,
    engine: str = "vinemap",
) -> Iterator[tuple[Place, Iterator[Floats]]]:
    """Open clouds of any format: gives the place of the first in a metric CRS, and chunks of points (n, 3) of all.

    Of COPC, EPT and surface models only what lies about the polygon ``around`` is read; of COPC on a disk, where that
    is a small part. Formats and errors are those of :func:`read_cloud`.
    """
    files, remarks = listed(clouds), list[str]()
    with closing(_chunks_of(files, crs, around, remarks, engine)) as chunks:
        first = next(chunks, None)
        if first is None:
            raise _none_inside(files)
        try:
            target = metric_crs(first.source, *np.median(first.xyz[:, :2], axis=0))
        except InputError as error:
            raise InputError(f"{first.path}: {error}") from error
        place = Place(target, vertical_name(first.source), remarks)
        there = ((to_place(xyz, source, path, place, files[0]), path) for xyz, source, path in chain([first], chunks))
        points = watched(there, remarks) if len(files) > 1 else (xyz for xyz, _ in there)
        with ahead(points) as prepared:
            yield place, prepared


class _Chunk(NamedTuple):
    """Points (n, 3) of a file in its own CRS."""

    xyz: Floats
    source: CRS
    path: PurePath


def _chunks_of(
    files: Sequence[Path], crs: CRS | None, around: Boundary | None, remarks: list[str], engine: str
) -> Generator[_Chunk]:
    """Usable points of files, one after the other, once their first ones were found to be where they can be.

    Of several those without any are left out, as tiles may be.
    """
    empty = 0
    for path in files:
        try:
            yield from _chunks_in(path, crs, around, remarks, engine)
        except EmptyError:
            empty += 1
            if empty == len(files):
                raise
            remarks.append(f"{path.name} holds no usable points, and is left out")


def _chunks_in(
    path: Path, crs: CRS | None, around: Boundary | None, remarks: list[str], engine: str
) -> Generator[_Chunk]:
    """Usable points of a file."""
    if kind_of(path) or engine == "pdal":
        for xyz, source in other_chunks(path, crs, around, remarks, engine=engine):
            yield _Chunk(xyz, source, naming.named(path))
        return
    with opened(path, crs=crs) as (reader, source, layout):
        box = _small_box(reader.header, source, around) if around else None
        found = points_about(path, layout, box, needed()) if box else None
        chunks = _usable_chunks(reader, path, found)
        first = next(chunks, None)
        if first is None and found is None:
            raise EmptyError(f"{path}: holds no usable points (all are flagged as noise or have no number)")
        if first is not None:
            remarks += examined(first, reader.header, source, path, given=crs is not None)
            for xyz in chain([first], chunks):
                yield _Chunk(xyz, source, path)


@contextmanager
def opened(path: Path, *, crs: CRS | None = None) -> Iterator[tuple[Any, CRS, Layout]]:
    """Open a LAS, LAZ or COPC file: gives laspy's reader, the CRS of its coordinates, and its layout, all checked.

    Raises
    ------
    InputError
        If it can't be opened, or its header tells of nothing that could be read.
    """
    import laspy  # 0.4 s of start-up

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        layout = read_layout(path)
        reader = laspy.open(path, laz_backend=_backends(layout), decompression_selection=needed())
    except OURS:
        raise
    except BaseException as error:
        raise unreadable(path, error) from error
    with reader:
        if reader.header.point_count == 0:
            raise EmptyError(f"{path}: holds no points")
        source = crs_of(reader.header, crs, path)
        _check_header(reader.header, source, path)
        yield reader, source, layout


def _backends(layout: Layout) -> Any:
    """What unpacks a file: on all cores, whole chunks at once, where those fit in memory."""
    import laspy

    whole = layout.chunks and layout.widest * layout.head.point_length <= MOST_BYTES
    return laspy.LazBackend.LazrsParallel if whole else laspy.LazBackend.Lazrs


def _check_header(header: Any, crs: CRS, path: Path) -> None:
    numbers = np.concatenate([header.scales, header.offsets])
    if not (np.abs(numbers) < FARTHEST).all() or (np.abs(header.scales) < FINEST).any():
        raise InputError(f"{path}: scale or offset in its header is no number that a place has: write the file again")
    with np.errstate(all="ignore"):
        steps = (np.array([header.mins, header.maxs]) - header.offsets) / header.scales
        odd = (np.abs(steps - np.round(steps)) > WHOLE).any(axis=0)
    if odd.sum() == 1:  # where the box was not taken of the points, all three are
        raise InputError(
            f"{path}: scale, offset and box in its header don't fit each other in {'xyz'[int(odd.argmax())]}, as in "
            "damaged files: copy or download it again"
        )
    box = np.concatenate([header.mins[:2], header.maxs[:2]])
    if not np.isfinite(box).all():
        return
    if crs.is_geographic and (np.abs(box).max() > 360):
        raise InputError(
            f"{path}: x reaches {np.abs(box).max():.0f}, which can't be degrees of {crs.name}: give its CRS with --crs"
        )


def _usable_chunks(reader: Any, path: Path, found: Any | None) -> Iterator[Floats]:
    """Coordinates (n, 3) of a file's usable points, or of those found, in its own CRS, chunk by chunk."""
    total, done = reader.header.point_count if found is None else len(found), 0
    beyond, blank = 0, 0
    size = max(1, min(CHUNK, MOST_BYTES // reader.header.point_format.size))
    box = stated_box(reader.header)
    try:
        for chunk in reader.chunk_iterator(size) if found is None else [found]:
            done += len(chunk)
            blank += _n_blank(chunk)
            columns = [np.asarray(column) for column in (chunk.x, chunk.y, chunk.z)]
            beyond += n_outside(columns, box)
            xyz = usable_among(np.column_stack(columns), chunk)
            if len(xyz):
                yield xyz
    except OURS:
        raise
    except BaseException as error:
        raise unreadable(path, error) from error
    if done < total:
        raise InputError(f"{path}: ends after {done} of {total} points: copy or download it again")
    if blank > most_strays(done):
        raise InputError(f"{path}: {blank:,} of its points hold nothing but zeros: copy or download it again")
    check_outside(beyond, done, path)


def _n_blank(chunk: Any) -> int:
    """How many points of a chunk have the same bit throughout, as where a disk has lost a part of a file."""
    alike = chunk.array[np.flatnonzero(chunk.X == chunk.Y)]
    data = np.frombuffer(alike.tobytes(), np.uint8).reshape(-1, alike.itemsize)
    return int(((data == 0) | (data == 255)).all(axis=1).sum())


def _small_box(header: Any, source: CRS, around: Boundary) -> Box | None:
    """Corners (3,) about a polygon in a file's CRS, if the file is a COPC and they hold little of it."""
    if not is_copc(header):
        return None
    low, high = box_about(around, source)
    small = np.prod((high - low)[:2]) < SMALL * np.prod((header.maxs - header.mins)[:2])
    return near_file((low, high), header) if small else None


def _none_inside(files: Sequence[Path]) -> OutsideError:
    return OutsideError(
        f"{worded(files)}: no point lies inside the boundary: do both show the same place, in the right CRS?"
    )


def unreadable(path: Path, error: BaseException) -> InputError | BusyError:
    """What is said of a file that laspy and lazrs can't read, or its disk can't now."""
    reason = str(error).strip().split("\n")[0] or type(error).__name__
    if DISK in reason or (isinstance(error, OSError) and error.errno in PASSING):
        return BusyError(f"{path}: can't be read now ({reason}): try again")
    if RAN_OUT in reason:
        reason = "its packed points are damaged"
    return InputError(f"{path}: can't be read as LAS or LAZ ({reason}): is it whole?")


def _plausible(sample: Floats, of: str) -> tuple[Floats, Floats]:
    """Corners (3,) beyond which a survey, of whose points there is a sample (n, 3), has only strays.

    Strays are few, but would stretch every raster.
    """
    low, high = np.quantile(sample, [0.002, 0.998], axis=0)
    span = high - low
    if span[2] > LARGEST_RELIEF:
        raise InputError(f"{of}: heights span {span[2]:.0f} m, which is no survey: check scale, offset and units")
    if span[:2].max() > LARGEST_SPAN:
        raise InputError(
            f"{of}: coordinates span {span[:2].max() / 1000:.0f} km, which is no survey: check scale, offset and CRS"
        )
    reach = 0.5 * span + [50.0, 50.0, 100.0]
    return low - reach, high + reach
