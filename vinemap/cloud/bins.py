"""Points sorted into the cells of a raster, once, for all that is asked of the cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches
from vinemap.geo.raster import cell_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.compute.arrays import Ints, Values
    from vinemap.geo.raster import Grid

    Indices = NDArray[np.int32]


class Bins(NamedTuple):
    """Points of cell c, from the grid's north-western corner eastwards, are ``member[start[c]:start[c + 1]]``."""

    grid: Grid
    start: Ints
    """First entry (ny · nx + 1,) of each cell."""
    member: Indices
    """Points (n,) cell by cell, in their order within each."""


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
def _select(values: Values, first: int, last: int, rank: int) -> None:
    """Put the value of a rank where it belongs among those from first to last - 1, and none larger before it."""
    low, high = first, last - 1
    while low < high:
        a, b, c = values[low], values[(low + high) // 2], values[high]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            return


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
    held = np.empty(64, dtype=values.dtype)
    for i in range(first, last):
        for j in range(n.shape[1]):
            size = 0
            for a in range(i * blocks, min((i + 1) * blocks, ny)):
                # Cells beside each other in a row of the grid lie one after the other.
                low, high = start[a * nx + j * blocks], start[a * nx + min((j + 1) * blocks, nx)]
                if size + high - low > len(held):
                    larger = np.empty(2 * (size + high - low), dtype=values.dtype)
                    larger[:size] = held[:size]
                    held = larger
                for k in range(low, high):
                    held[size] = values[index[k]]
                    size += 1
            n[i, j] = size
            if size:
                first_left = 0
                for q in range(len(quantiles)):
                    rank = max(int(np.ceil(quantiles[q] * size)) - 1, 0)
                    _select(held, first_left, size, rank)
                    out[q, i, j] = held[rank]
                    first_left = rank
