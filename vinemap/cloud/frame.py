"""The frame of a row: a cloud's points in metres along its curve and to its left."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches
from vinemap.geo.curve import at_each, tangents_of_each, way_along
from vinemap.geo.raster import cell_at, grid_over, nearest_cell

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from vinemap.cloud.bins import Bins
    from vinemap.cloud.points import PointCloud
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Ints, Values
    from vinemap.geo.raster import Grid

GUIDE = 0.25
"""Metres between the points of a curve to which cloud points are referred, and the cells of their lookup."""

ROWS_AT_ONCE = 4_000_000
"""Points, about, of the rows that are worked together."""


class RowCoordinates(NamedTuple):
    """Points near rows in the frame of the nearest one, row by row."""

    start: Ints
    """First point (rows + 1,) of each row; ``start[k + 1]`` is past its last."""
    along: NDArray[np.float32]
    """Metres (n,) along the row; negative before its start."""
    left: NDArray[np.float32]
    """Metres (n,) to its left."""
    member: NDArray[np.int32]
    """Index (n,) of the point in the cloud."""


Taken = tuple["Values", ...]
"""What is taken of points beside their coordinates: arrays (n,)."""


class _Guides(NamedTuple):
    """Points on curves to which cloud points are referred: row (g,), metres along it, place and tangent (g, 2)."""

    row: Ints
    along: Values
    xy: Values
    tangent: Values


class _Lookup(NamedTuple):
    """Raster (ny, nx) of the nearest guides."""

    grid: Grid
    nearest: NDArray[np.int32]
    guides: _Guides


def points_of_rows(
    cloud: Cloud, curves: Sequence[Values], reach: Values, take: Callable[[PointCloud, NDArray[np.int32]], Taken]
) -> Iterator[tuple[Ints, RowCoordinates, Taken]]:
    """Refer a cloud's points within ``reach`` (rows,) metres of their nearest curve (k, 2) to it.

    Yields rows (a,), the frame's coordinates of their points row by row, and for each point what ``take`` tells of a
    part of the cloud and its members: arrays (n,). Group by group of rows, so that they don't take the memory of
    another cloud.
    """
    if not curves:
        return
    guides = _guides(curves)
    for rows in _groups(curves, cloud.size):
        lookup = _lookup(guides, np.concatenate([curves[k] for k in rows]), float(reach.max()) + GUIDE)
        within = np.full(len(curves), -1.0)
        within[rows] = reach[rows]
        found = []
        for part in cloud.parts(shapely.MultiLineString([curves[k] for k in rows]), float(reach[rows].max())):
            near = _coordinates(part, lookup, within)
            found.append((near._replace(member=near.member + np.int32(part.first)), take(part, near.member)))
        yield rows, *_joined(found, rows)


def _groups(rows: Sequence[Values], size: int) -> list[Ints]:
    """Indices of rows, as curves (k, 2), that lie beside each other in a cloud of so many points, group by group."""
    middles = np.array([row[len(row) // 2] for row in rows])
    widest = int(np.argmax(np.ptp(middles, axis=0)))
    groups = min(max(1, round(size / ROWS_AT_ONCE)), len(rows))
    return [np.sort(part) for part in np.array_split(np.argsort(middles[:, widest], kind="stable"), groups)]


def _joined(found: Sequence[tuple[RowCoordinates, Taken]], rows: Ints) -> tuple[RowCoordinates, Taken]:
    """Points of some rows, from several parts, row by row."""
    n = np.array([np.diff(near.start)[rows] for near, _ in found])
    start = np.concatenate([[0], np.cumsum(n.sum(axis=0))])
    tables = [(near.along, near.left, near.member, *taken) for near, taken in found]
    if len(tables) > 1:
        order = [(k, near.start[row], near.start[row + 1]) for row in rows for k, (near, _) in enumerate(found)]
        columns = [np.concatenate([tables[k][c][a:b] for k, a, b in order]) for c in range(len(tables[0]))]
    else:
        columns = list(tables[0])
    return RowCoordinates(start, *columns[:3]), tuple(columns[3:])


def _guides(curves: Sequence[Values]) -> _Guides:
    lengths = np.array([way_along(curve)[-1] for curve in curves])
    n = np.maximum(np.round(lengths / GUIDE).astype(int) + 1, 2)
    row = np.repeat(np.arange(len(curves)), n)
    along = (np.arange(len(row)) - (np.cumsum(n) - n)[row]) * (lengths / (n - 1))[row]
    return _Guides(row, along, at_each(curves, row, along), tangents_of_each(curves, row, along))


def _lookup(guides: _Guides, about: Values, reach: float) -> _Lookup:
    """The nearest guides within metres of some points (n, 2)."""
    grid = grid_over(about.min(axis=0) - reach, about.max(axis=0) + reach, resolution=GUIDE)
    return _Lookup(grid, _nearest_guides(guides.xy, grid, reach), guides)


def _coordinates(part: PointCloud, lookup: _Lookup, reach: Values) -> RowCoordinates:
    points = np.ascontiguousarray(part.xyz)
    chosen = (
        _in_cells(part.kept_bins, lookup.grid, lookup.nearest)
        if part.kept_bins
        else np.arange(part.size, dtype=np.int32)
    )
    guide, parts = np.empty(len(chosen), dtype=np.int32), stretches(len(chosen))
    counts = np.array(in_threads(lambda of: _find_guides(*of, points, chosen, lookup, reach, guide), parts))
    start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    place = start[:-1] + np.cumsum(counts, axis=0) - counts
    along, left = np.empty((2, start[-1]), dtype=np.float32)
    out = RowCoordinates(start, along, left, np.empty(start[-1], dtype=np.int32))
    in_threads(lambda k: _refer(*parts[k], points, chosen, guide, lookup.guides, place[k], out), range(len(parts)))
    return out


@compiled
def _in_cells(bins: Bins, grid: Grid, nearest: NDArray[np.int32]) -> NDArray[np.int32]:
    """Points, in their order, in the cells that touch those of a lookup (ny, nx) with a guide."""
    start, member = bins.start, bins.member
    marked, chosen = np.zeros(len(start) - 1, dtype=np.bool_), np.zeros(len(member), dtype=np.bool_)
    n = 0
    for i in range(grid.ny):
        for j in range(grid.nx):
            if nearest[i, j] >= 0:
                x, y, side = grid.west + j * grid.resolution, grid.north - i * grid.resolution, grid.resolution
                top, left = nearest_cell(bins.grid, x, y)
                bottom, right = nearest_cell(bins.grid, x + side, y - side)
                for a in range(top, bottom + 1):
                    for cell in range(a * bins.grid.nx + left, a * bins.grid.nx + right + 1):
                        if not marked[cell]:
                            marked[cell] = True
                            n += start[cell + 1] - start[cell]
                            for k in range(start[cell], start[cell + 1]):
                                chosen[member[k]] = True
    out = np.empty(n, dtype=np.int32)
    n = 0
    for p in range(len(chosen)):
        if chosen[p]:
            out[n] = p
            n += 1
    return out


@compiled
def _nearest_guides(xy: Values, grid: Grid, reach: float) -> NDArray[np.int32]:
    """Guide (ny, nx) nearest to the centre of every cell, -1 where none is within reach.

    It is near enough to the nearest of the cell's points: both project them on about the same tangent.
    """
    nearest, least = np.empty((grid.ny, grid.nx), dtype=np.int32), np.empty((grid.ny, grid.nx))
    nearest.fill(-1)
    least.fill(reach**2)
    cells = math.ceil(reach / grid.resolution)
    for g in range(len(xy)):
        x, y = (xy[g, 0] - grid.west) / grid.resolution - 0.5, (grid.north - xy[g, 1]) / grid.resolution - 0.5
        for i in range(max(int(y) - cells, 0), min(int(y) + cells + 2, grid.ny)):
            for j in range(max(int(x) - cells, 0), min(int(x) + cells + 2, grid.nx)):
                square = ((j - x) ** 2 + (i - y) ** 2) * grid.resolution**2
                if square < least[i, j]:
                    least[i, j] = square
                    nearest[i, j] = g
    return nearest


@compiled
def _find_guides(
    first: int,
    last: int,
    xyz: Values,
    chosen: NDArray[np.int32],
    lookup: _Lookup,
    reach: Values,
    guide: NDArray[np.int32],
) -> Ints:
    """Guide (n,) to which each chosen point is referred, -1 where it is out of its row's reach; points of each row."""
    grid, nearest, guides = lookup
    n = np.zeros(len(reach), dtype=np.int64)
    for k in range(first, last):
        p = chosen[k]
        guide[k] = -1
        i, j = cell_at(grid, xyz[p, 0], xyz[p, 1])
        g = nearest[i, j] if 0 <= i < grid.ny and 0 <= j < grid.nx else -1
        if g < 0:
            continue
        x, y = xyz[p, 0] - guides.xy[g, 0], xyz[p, 1] - guides.xy[g, 1]
        if abs(guides.tangent[g, 0] * y - guides.tangent[g, 1] * x) <= reach[guides.row[g]]:
            guide[k] = g
            n[guides.row[g]] += 1
    return n


@compiled
def _refer(
    first: int,
    last: int,
    xyz: Values,
    chosen: NDArray[np.int32],
    guide: NDArray[np.int32],
    guides: _Guides,
    place: Ints,
    out: RowCoordinates,
) -> None:
    """Write the coordinates of the chosen points (n,) that have a guide, each row's from its place (rows,) on."""
    for c in range(first, last):
        p, g = chosen[c], guide[c]
        if g >= 0:
            x, y = xyz[p, 0] - guides.xy[g, 0], xyz[p, 1] - guides.xy[g, 1]
            k = place[guides.row[g]]
            out.along[k] = guides.along[g] + x * guides.tangent[g, 0] + y * guides.tangent[g, 1]
            out.left[k] = guides.tangent[g, 0] * y - guides.tangent[g, 1] * x
            out.member[k] = p
            place[guides.row[g]] += 1
