"""Clouds too large for memory: tiles on disk, worked one after the other with the same result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from vinemap import paths
from vinemap.cloud.points import PointCloud
from vinemap.geo.raster import extent, squares

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.compute.arrays import Floats, Values
    from vinemap.geo.raster import Raster

CHUNK = 1_000_000
"""Points that are moved to tiles at once."""
SIDE = 64.0
"""Metres, about, of a tile's side."""
FARTHEST = 1e9
"""Metres from zero beyond which all points go to the same tiles."""


class Tile(NamedTuple):
    """A file of points (n, 3) as float64, their extent, and the index of the first in the cloud.

    Points that have classes are (n, 4).
    """

    path: Path
    low: Floats
    high: Floats
    size: int
    first: int = 0
    columns: int = 3

    def points(self) -> Floats:
        """What the file holds."""
        return np.fromfile(self.path).reshape(-1, self.columns)


@dataclass(frozen=True)
class TiledCloud:
    """Points in tiles on disk: parts of a cloud, used as a :class:`vinemap.cloud.points.PointCloud` is.

    The edges of tiles are those of the rasters' cells, so that statistics of cells are the same as of the cloud whole.
    """

    tiles: Sequence[Tile]
    crs: CRS
    vertical: str | None = None
    dtm: Raster | None = None
    ceiling: Raster | None = None
    remarks: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of points."""
        return sum(tile.size for tile in self.tiles)

    @property
    def extent(self) -> tuple[Floats, Floats]:
        """Least and greatest coordinates (3,)."""
        low, high = (np.array([tile[k] for tile in self.tiles]) for k in (1, 2))
        return low.min(axis=0), high.max(axis=0)

    def parts(self, near: shapely.Geometry | None = None, reach: float = 0.0) -> Iterator[PointCloud]:
        """The cloud in parts that fit in memory, or those within metres of a geometry."""
        for tile in self.tiles:
            box = shapely.box(*tile.low[:2], *tile.high[:2])
            if near is None or shapely.dwithin(box, near, reach):
                xyz, classes = _parted(tile.points())
                part = PointCloud(xyz, self.crs, self.vertical, first=tile.first, classification=classes)
                yield part.above(self.dtm, self.ceiling) if self.dtm else part

    def forget(self) -> None:
        """Nothing is kept of the cells."""

    def above(self, dtm: Raster, ceiling: Raster | None = None) -> TiledCloud:
        """The cloud with its heights above a terrain model; what is higher than a ceiling is hidden."""
        return replace(self, dtm=dtm, ceiling=ceiling)


Cloud = PointCloud | TiledCloud


class Collector:
    """Takes points chunk by chunk: in memory up to a number of them, in tiles in a folder beyond it."""

    def __init__(self, folder: Path = Path("tiles"), *, most: float = np.inf, block: float = 1.0) -> None:
        """``folder`` is made where it is needed; ``block`` is the side in metres of squares that no tile divides."""
        self.folder, self.most, self.block = folder, most, block
        self.xyz = np.empty((0, 3))
        self.tiles: dict[Path, Tile] = {}
        self.size, self.columns = 0, 3

    def add(self, xyz: Floats) -> None:
        """Take points (n, 3), or (n, 4) with their classes: the first ones tell which all are."""
        if self.size == 0:
            self.columns = xyz.shape[1]
        before, self.size = self.size, self.size + len(xyz)
        if self.size <= self.most:
            # Grown in place: a list of chunks joined at the end would take twice the memory.
            self.xyz.resize((self.size, self.columns), refcheck=False)
            self.xyz[before:] = xyz
            return
        for k in range(0, len(self.xyz), CHUNK):
            self._to_tiles(self.xyz[k : k + CHUNK])
        self.xyz = np.empty((0, 3))
        self._to_tiles(xyz)

    def cloud(
        self, crs: CRS, vertical: str | None, least: Floats | float = -np.inf, most: Floats | float = np.inf
    ) -> Cloud:
        """What was taken and lies between two corners (3,)."""
        if not self.tiles:
            xyz, classes = _parted(self.xyz)
            low, high = extent(xyz)
            if (low < least).any() or (high > most).any():
                self.xyz = self.xyz[((xyz >= least) & (xyz <= most)).all(axis=1)]
                xyz, classes = _parted(self.xyz)
            return PointCloud(xyz, crs, vertical, classification=classes)
        tiles, first = [], 0
        for tile in sorted(self.tiles.values()):
            kept = _between(tile, least, most)
            if kept.size:
                tiles.append(kept._replace(first=first))
                first += kept.size
        return TiledCloud(tiles, crs, vertical)

    def sample(self, n: int) -> Floats:
        """About n of the points, evenly."""
        step = max(1, self.size // n)
        if not self.tiles:
            return self.xyz[::step, :3]
        parts, passed = [], 0
        for tile in self.tiles.values():
            parts.append(tile.points()[-passed % step :: step, :3])
            passed += tile.size
        return np.concatenate(parts)

    def _to_tiles(self, xyz: Floats) -> None:
        if len(xyz) == 0:
            return
        self.folder.mkdir(exist_ok=True)
        blocks = max(1, round(SIDE / self.block))
        column, row = (held // blocks for held in squares(np.clip(xyz[:, :2], -FARTHEST, FARTHEST), self.block))
        tile = (column - column.min()) * (np.ptp(row) + 1) + row - row.min()
        if tile.max() > np.iinfo(np.uint16).max:  # strays
            tile = np.unique(tile, return_inverse=True)[1]
        order = np.argsort(tile.astype(np.min_scalar_type(tile.max())), kind="stable")
        for member in np.split(order, np.flatnonzero(np.diff(tile[order])) + 1):
            points = xyz[member]
            path = paths.tile(self.folder, int(column[member[0]]), int(row[member[0]]))
            with path.open("ab") as stream:
                stream.write(points.data)
            low, high = extent(_parted(points)[0])
            old = self.tiles.get(path, Tile(path, low, high, 0, columns=self.columns))
            low, high = np.minimum(low, old.low), np.maximum(high, old.high)
            self.tiles[path] = old._replace(low=low, high=high, size=old.size + len(points))


def moved(cloud: Cloud, by: Values, collector: Collector) -> Cloud:
    """A cloud, without heights, moved by metres (2,) to the east and north.

    Tiles are dealt anew to a collector, as their edges are those of the rasters' cells, which stay.
    """
    way = np.append(by, 0.0)
    if isinstance(cloud, PointCloud):
        return replace(cloud, xyz=cloud.xyz + way, _kept={})
    for part in cloud.parts():
        there = part.xyz + way
        collector.add(there if part.classification is None else np.column_stack([there, part.classification]))
    return replace(collector.cloud(cloud.crs, cloud.vertical), remarks=cloud.remarks)


def _between(tile: Tile, least: Floats | float, most: Floats | float) -> Tile:
    """A tile, on disk too, with no points but those between two corners (3,)."""
    if (tile.low >= least).all() and (tile.high <= most).all():
        return tile
    points = tile.points()
    xyz = points[:, :3]
    points = points[((xyz >= least) & (xyz <= most)).all(axis=1)]
    points.tofile(tile.path)
    low, high = extent(_parted(points)[0])
    return tile._replace(low=low, high=high, size=len(points))


def _parted(points: Floats) -> tuple[Floats, NDArray[np.uint8] | None]:
    """Coordinates (n, 3) of points, and their classes, if they have some."""
    if points.shape[1] == 3:
        return points, None
    return np.ascontiguousarray(points[:, :3]), points[:, 3].astype(np.uint8)
