"""Points sorted into the cells of a raster, once, for all that is asked of the cells."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.compute.compiled import compiled
from vinemap.compute.order import select
from vinemap.compute.threads import in_threads, stretches
from vinemap.geo.raster import cell_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.compute.arrays import Ints, Values
    from vinemap.geo.raster import Grid

    Indices = NDArray[np.int32]

COARSE = 1.0
"""Metres, about: side of the blocks of cells that are looked at first."""


class Bins(NamedTuple):
    """Points of cell c, from the grid's north-western corner eastwards, are ``member[start[c]:start[c + 1]]``."""

    grid: Grid
    start: Ints
    """First entry (ny · nx + 1,) of each cell."""
    member: Indices
    """Points (n,) cell by cell, in their order within each."""


def cells_a_block(resolution: float) -> int:
    """Cells a side of a block."""
    return max(1, round(COARSE / resolution))


def block_side(resolution: float) -> float:
    """Side in metres of a block of cells, which a cloud in tiles must not divide."""
    return cells_a_block(resolution) * resolution


def bin_points(xyz: Values, grid: Grid) -> Bins:
    """Sort points (n, ≥2) into cells; those outside the grid go to the nearest cell."""
    cell = cell_of(xyz, grid)
    parts = stretches(len(cell))
    counts = np.array(in_threads(lambda part: _count(*part, cell, grid.ny * grid.nx), parts))
    start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    place = start[:-1] + np.cumsum(counts, axis=0) - counts
    index = np.empty(len(cell), dtype=np.int32)
    in_threads(lambda k: _place(*parts[k], cell, place[k], index), range(len(parts)))
    return Bins(grid, start, index)


def quantiles_in(bins: Bins, values: Values, quantiles: Sequence[float], *, blocks: int = 1) -> tuple[Values, Values]:
    """Numbers of points and quantiles, in climbing order, of their values (n,) in blocks of so many cells a side.

    Returns
    -------
    n : (ny, nx) array
        Points; beyond the grid's edge there are none.
    quantiles : (q, ny, nx) array
        The value of rank ceil(q · n), 0 where there is no point.
    """
    ny, nx = (-(-side // blocks) for side in bins.grid.shape)
    n, out = np.zeros((ny, nx), dtype=np.int64), np.zeros((len(quantiles), ny, nx))
    wanted = np.asarray(quantiles, dtype=float)
    in_threads(
        lambda part: _quantiles(*part, bins.start, bins.member, values, bins.grid.shape, blocks, wanted, n, out),
        stretches(ny),
    )
    return n.astype(float), out


@compiled
def _count(first: int, last: int, cell: Indices, cells: int) -> Ints:
    n = np.zeros(cells, dtype=np.int64)
    for p in range(first, last):
        n[cell[p]] += 1
    return n


@compiled
def _place(first: int, last: int, cell: Indices, place: Ints, index: Indices) -> None:
    for p in range(first, last):
        index[place[cell[p]]] = p
        place[cell[p]] += 1


@compiled
def _quantiles(
    first: int,
    last: int,
    start: Ints,
    index: Indices,
    values: Values,
    shape: tuple[int, int],
    blocks: int,
    quantiles: Values,
    n: Ints,
    out: Values,
) -> None:
    ny, nx = shape
    held = np.empty(64)
    for i in range(first, last):
        for j in range(n.shape[1]):
            # Cells beside each other in a row of the grid lie one after the other.
            west, east = j * blocks, min((j + 1) * blocks, nx)
            for a in range(i * blocks, min((i + 1) * blocks, ny)):
                n[i, j] += start[a * nx + east] - start[a * nx + west]
            if n[i, j] > len(held):
                held = np.empty(2 * n[i, j])
            size, before = 0, int(np.int64(0))  # a plain 0 would have `select` compiled twice
            for a in range(i * blocks, min((i + 1) * blocks, ny)):
                for k in range(start[a * nx + west], start[a * nx + east]):
                    held[size] = values[index[k]]
                    size += 1
            if size:
                for q in range(len(quantiles)):
                    rank = max(math.ceil(quantiles[q] * size) - 1, 0)
                    select(held, before, n[i, j], rank)
                    out[q, i, j] = held[rank]
                    before = rank
