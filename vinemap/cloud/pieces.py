"""A survey read once: the points of each of its parcels, in a file of their own."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from vinemap import naming, paths
from vinemap.cloud.files import listed
from vinemap.cloud.las import collected, open_cloud
from vinemap.errors import InputError
from vinemap.geo.boundaries import boundary_in
from vinemap.geo.zones import deal, zones_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pyproj import CRS

    from vinemap.cloud.tiles import Cloud, Collector
    from vinemap.geo.boundaries import Boundary
    from vinemap.geo.place import Place

CHUNK = 1_000_000
"""Points that are read back at once."""


class Piece(NamedTuple):
    """Points (n, 3) in a file of float64, of which clouds they are, and where."""

    path: Path
    clouds: Sequence[Path]
    place: Place


def split_cloud(
    clouds: Path | Sequence[Path],
    boundaries: Sequence[Boundary],
    folder: Path,
    *,
    crs: CRS | None = None,
    engine: str = "vinemap",
) -> list[Piece | InputError]:
    """Read clouds of any format once, and give every polygon its points; in several polygons' they go to each.

    Parameters
    ----------
    clouds : Path or sequence of Path
        The files or addresses, as of :func:`vinemap.cloud.las.read_cloud`.
    boundaries : sequence of (Geometry, CRS)
        Polygons.
    folder : Path
        Where the files go, 24 bytes a point.
    crs : CRS, optional
        CRS of the files' coordinates, where they state none or a wrong one.
    engine : str
        What reads the files, as of :func:`vinemap.cloud.las.read_cloud`.

    Returns
    -------
    list
        A piece for each polygon, or why it can't be brought to the cloud.

    Raises
    ------
    InputError
        If a file can't be read, as in :func:`vinemap.cloud.las.read_cloud`.
    OSError
        If the folder is full.
    """
    files = listed(clouds)
    around = _all_of(boundaries) if any(map(naming.url_of, files)) else None
    with open_cloud(files, crs=crs, around=around, engine=engine) as (place, chunks):
        pieces: list[Piece | InputError] = []
        polygons, drafts = [], []
        for number, boundary in enumerate(boundaries):
            try:
                polygons.append(boundary_in(boundary, place.crs, naming.named(files[0])))
            except InputError as error:
                pieces.append(error)
            else:
                drafts.append(paths.piece(folder, number))
                pieces.append(Piece(drafts[-1], files, place))
        if not polygons:
            return pieces
        zones = zones_of(polygons)
        for path in drafts:
            path.touch()
        for chunk in chunks:
            xyz, start = deal(chunk, zones)
            for k in np.flatnonzero(np.diff(start)):
                with drafts[k].open("ab") as stream:
                    stream.write(xyz[start[k] : start[k + 1]].data)
    return pieces


def _all_of(boundaries: Sequence[Boundary]) -> Boundary | None:
    """All polygons as one; None where they are in several CRSs."""
    shapes, crs = zip(*boundaries, strict=True)
    return (shapely.MultiPoint(shapely.get_coordinates(shapes)), crs[0]) if len(set(crs)) == 1 else None


def read_piece(piece: Piece, collector: Collector) -> Cloud:
    """The cloud of a piece, as if it had been read from the whole file.

    Raises
    ------
    InputError
        If it has no points, or no survey could have them.
    """
    with piece.path.open("rb") as stream:
        while len(xyz := np.fromfile(stream, count=3 * CHUNK).reshape(-1, 3)):
            collector.add(xyz)
    return collected(collector, piece.place, piece.clouds)
