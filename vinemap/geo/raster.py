"""North-up rasters: their grids, cells of points, and sampling."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches
from vinemap.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from pyproj import CRS

S = TypeVar("S", bound=np.generic)

MAX_CELLS = 80_000_000
"""Cells of the finest raster, 0.8 km² at 0.1 m."""


class Grid(NamedTuple):
    """Square cells of a north-up raster: row ``i`` counts from the north, column ``j`` from the west.

    ``west`` and ``north`` are the outer corner in metres of the CRS, ``resolution`` the cell size in metres.
    """

    west: float
    north: float
    resolution: float
    ny: int
    nx: int

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of cells (ny, nx)."""
        return self.ny, self.nx

    def centres(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Coordinates of cell centres: x (nx,) eastwards and y (ny,) southwards."""
        x = self.west + (np.arange(self.nx) + 0.5) * self.resolution
        y = self.north - (np.arange(self.ny) + 0.5) * self.resolution
        return x, y


@dataclass(frozen=True)
class Raster:
    """Values (ny, nx) on a grid; NaN is nodata."""

    values: NDArray[np.floating]
    grid: Grid
    crs: CRS


def grid_over(low: ArrayLike, high: ArrayLike, *, resolution: float, multiple: int = 1) -> Grid:
    """Smallest grid over an extent (≥2,), (≥2,), its edges at multiples of the cell size, or of several cells'.

    Raises
    ------
    InputError
        If it would have more than ``MAX_CELLS`` cells.
    """
    (west, south), (east, north) = (np.asarray(corner, dtype=float)[:2] for corner in (low, high))
    step = multiple * resolution
    columns, rows = squares([(west, south), (east, north)], step)
    left, bottom = columns[0] * step, rows[0] * step
    nx = int(columns[1] - columns[0] + 1) * multiple
    reach = int(np.ceil((north - np.floor(south / step) * step) / step)) + 1
    ny = max(reach, int(rows[1] - rows[0]) + 1) * multiple
    if nx * ny > MAX_CELLS:
        raise InputError(
            f"the cloud spans {east - west:.0f} m by {north - south:.0f} m, too much for one parcel at "
            f"{resolution} m: clip it with --boundary"
        )
    return Grid(float(left), float(bottom + ny * resolution), resolution, ny, nx)


def squares(xy: ArrayLike, side: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows (…,), counted to the east and north, of the squares at multiples of a side that hold points.

    Points (…, ≥2) on an edge are the eastern or southern square's, as in the cells of a grid.
    """
    points = np.asarray(xy, dtype=float)
    return np.floor(points[..., 0] / side).astype(np.int64), np.ceil(points[..., 1] / side).astype(np.int64) - 1


def window(grid: Grid, low: ArrayLike, high: ArrayLike, *, multiple: int = 1) -> tuple[Grid, tuple[slice, slice]]:
    """Part of a grid that covers an extent (≥2,), (≥2,), in whole blocks of several cells, and where it lies in it.

    The grid's edges are at multiples of the blocks, as those of :func:`grid_over`. Which block holds a point is told
    as by :func:`squares`, to the last bit, so that parts of a cloud that share no square share no block.
    """
    step = multiple * grid.resolution
    columns_held, rows_held = squares([np.asarray(corner, dtype=float)[:2] for corner in (low, high)], step)
    i = (round(grid.north / step) - 1 - rows_held[::-1]) * multiple
    j = (columns_held - round(grid.west / step)) * multiple
    rows, columns = (
        slice(min(max(int(first), 0), n), min(max(int(last), 0) + multiple, n))
        for (first, last), n in zip((i, j), grid.shape, strict=True)
    )
    part = Grid(
        grid.west + columns.start * grid.resolution,
        grid.north - rows.start * grid.resolution,
        grid.resolution,
        rows.stop - rows.start,
        columns.stop - columns.start,
    )
    return part, (rows, columns)


def extent(points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and greatest coordinates (k,) of points (n, k)."""
    table = _plain(points)
    bounds = np.array(in_threads(lambda part: _bounds(*part, table), stretches(len(table))))
    return bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)


def coarser(grid: Grid, *, resolution: float) -> Grid:
    """Grid of another cell size that covers the same area from the same corner."""
    ny, nx = (int(np.ceil(n * grid.resolution / resolution - 1e-9)) for n in grid.shape)
    return Grid(grid.west, grid.north, resolution, ny, nx)


def cell_of(xy: NDArray[np.floating], grid: Grid) -> NDArray[np.int32]:
    """Flat index (n,) of the cell that holds each point (n, ≥2); points outside go to the nearest cell."""
    points = _plain(xy)
    out = np.empty(len(points), dtype=np.int32)
    in_threads(lambda part: _cells(*part, points, grid, out), stretches(len(points)))
    return out


def cells_in(coarse: Grid, fine: Grid) -> NDArray[np.int64]:
    """Index (ny, nx) of the coarse cell in which each fine one lies."""
    i, j = _lines_in(coarse, fine)
    out: NDArray[np.int64] = i[:, None] * coarse.nx + j
    return out


def spread(values: NDArray[S], coarse: Grid, fine: Grid) -> NDArray[S]:
    """Values of coarse cells at the fine ones (ny, nx) that lie in them."""
    return values[np.ix_(*_lines_in(coarse, fine))]


def _lines_in(coarse: Grid, fine: Grid) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (ny,) and columns (nx,) of a coarse raster in which those of a fine one lie."""
    x, y = fine.centres()
    i = np.clip(((coarse.north - y) / coarse.resolution).astype(int), 0, coarse.ny - 1)
    j = np.clip(((x - coarse.west) / coarse.resolution).astype(int), 0, coarse.nx - 1)
    return i, j


def block_sum(values: NDArray[np.floating] | NDArray[np.uint16] | NDArray[np.bool_], k: int) -> NDArray[np.float64]:
    """Sums over blocks of k x k cells, (ceil(ny / k), ceil(nx / k)), or flags in them; beyond the edge is nothing."""
    ny, nx = (-(-n // k) for n in values.shape)
    out = np.zeros((ny, nx))
    cells = values.astype(np.uint16) if values.dtype == bool else values
    in_threads(lambda part: _block_sums(*part, cells, k, out), stretches(ny))
    return out


def sample(raster: Raster, xy: ArrayLike) -> NDArray[np.float64]:
    """Bilinear values (…,) at points (…, ≥2); beyond the outer cell centres the border's value holds."""
    points = np.asarray(xy, dtype=float)
    flat = _plain(points.reshape(-1, points.shape[-1]))
    values, out = np.ascontiguousarray(raster.values), np.empty(len(flat))
    in_threads(lambda part: _bilinear(*part, values, raster.grid, flat, out), stretches(len(flat)))
    return out.reshape(points.shape[:-1])


def above(raster: Raster, xyz: NDArray[np.floating]) -> NDArray[np.float32]:
    """Metres (n,) that points (n, 3) lie above a raster of elevations, as it is sampled."""
    points, values = _plain(xyz), np.ascontiguousarray(raster.values)
    out = np.empty(len(points), dtype=np.float32)
    in_threads(lambda part: _above(*part, values, raster.grid, points, out), stretches(len(points)))
    return out


def sample_across(
    raster: Raster, origin: NDArray[np.floating], normal: NDArray[np.floating], offsets: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Bilinear values (n, m) at offsets (m,) from origins (n, 2) along unit vectors (n, 2)."""
    values = np.ascontiguousarray(raster.values)
    starts, ways, at = (_plain(v) for v in (origin, normal, offsets))
    out = np.empty((len(origin), len(offsets)))
    in_threads(lambda part: _bilinear_across(*part, values, raster.grid, starts, ways, at, out), stretches(len(origin)))
    return out


def _plain(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Values of any shape as compiled code wants them: of double precision, in one piece."""
    return np.ascontiguousarray(values, dtype=np.float64)


@compiled
def _block_sums(first: int, last: int, values: NDArray[np.generic], k: int, out: NDArray[np.float64]) -> None:
    for i in range(first * k, min(last * k, values.shape[0])):
        for j in range(values.shape[1]):
            out[i // k, j // k] += values[i, j]


@compiled
def _bounds(first: int, last: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.empty((2, points.shape[1]))
    for k in range(points.shape[1]):
        out[0, k], out[1, k] = np.inf, -np.inf
        for p in range(first, last):
            out[0, k] = min(out[0, k], points[p, k])
            out[1, k] = max(out[1, k], points[p, k])
    return out


@compiled
def cell_at(grid: Grid, x: float, y: float) -> tuple[int, int]:
    """Row and column of the cell that holds a point; beyond the grid's edges they go on."""
    scale = 1 / grid.resolution
    return math.floor((grid.north - y) * scale), math.floor((x - grid.west) * scale)


@compiled
def nearest_cell(grid: Grid, x: float, y: float) -> tuple[int, int]:
    """Row and column of the grid's cell that holds a point or is nearest to it."""
    i, j = cell_at(grid, x, y)
    return min(max(i, 0), grid.ny - 1), min(max(j, 0), grid.nx - 1)


@compiled
def _cells(first: int, last: int, xy: NDArray[np.float64], grid: Grid, out: NDArray[np.int32]) -> None:
    for p in range(first, last):
        i, j = nearest_cell(grid, xy[p, 0], xy[p, 1])
        out[p] = i * grid.nx + j


@compiled
def _value(values: NDArray[np.float64], grid: Grid, x: float, y: float) -> float:
    ny, nx = values.shape
    j = min(max((x - grid.west) / grid.resolution - 0.5, 0.0), nx - 1.0)
    i = min(max((grid.north - y) / grid.resolution - 0.5, 0.0), ny - 1.0)
    west, north = min(int(j), max(nx - 2, 0)), min(int(i), max(ny - 2, 0))
    east, south = min(west + 1, nx - 1), min(north + 1, ny - 1)
    j -= west
    i -= north
    upper = values[north, west] * (1 - j) + values[north, east] * j
    lower = values[south, west] * (1 - j) + values[south, east] * j
    return float(upper * (1 - i) + lower * i)


@compiled
def _bilinear(
    first: int, last: int, values: NDArray[np.float64], grid: Grid, xy: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    for p in range(first, last):
        out[p] = _value(values, grid, xy[p, 0], xy[p, 1])


@compiled
def _above(
    first: int, last: int, values: NDArray[np.float64], grid: Grid, xyz: NDArray[np.float64], out: NDArray[np.float32]
) -> None:
    for p in range(first, last):
        out[p] = xyz[p, 2] - _value(values, grid, xyz[p, 0], xyz[p, 1])


@compiled
def _bilinear_across(
    first: int,
    last: int,
    values: NDArray[np.float64],
    grid: Grid,
    origin: NDArray[np.float64],
    normal: NDArray[np.float64],
    offsets: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    for p in range(first, last):
        for k in range(len(offsets)):
            x, y = origin[p, 0] + offsets[k] * normal[p, 0], origin[p, 1] + offsets[k] * normal[p, 1]
            out[p, k] = _value(values, grid, x, y)
