"""What was seen: the ground on which a cloud has points, and the holes between them that are no wider than usual."""

from __future__ import annotations

from functools import partial
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion

from vinemap.compute.threads import in_threads, stretches
from vinemap.geo.curve import across, resample, way_along
from vinemap.geo.raster import Grid, block_sum, cell_of, spread

if TYPE_CHECKING:
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Values

SQUARE = 8
"""Cells a side of the squares of which it is asked whether points leave holes in them."""
USUAL = 0.25
"""Share of such squares with holes up to which holes aren't what is usual."""
LONG, MOSTLY = 5.0, 0.9
"""How much longer a stretch without points is than such stretches mostly are, and how often that is: of points that lie
anyhow, and on bare ground half as densely as in canopies, 1 in 10,000 is so long."""
ROOM = 1.5
"""Cells in which holes are told by those in which they are usual: of points that lie anyhow, 1 in 10,000 is a hole."""


class Seen(NamedTuple):
    """What a cloud shows: the ground on which it has points, and holes between them that are no wider than usual."""

    cells: Flags
    """Cells (ny, nx) of ``grid`` that were seen."""
    grid: Grid
    points: Flags
    """Cells of ``fine`` that have points."""
    fine: Grid

    def at(self, xy: Values) -> Flags:
        """Whether points (n, ≥2) lie where something was seen; beyond the grid nothing was."""
        out: Flags = self.cells.ravel()[cell_of(xy, self.grid)]
        return out

    def without(self, cells: Flags, grid: Grid) -> Seen:
        """What a cloud shows but for what lies beneath cells (ny, nx) of a grid."""
        here, of_points = (~spread(cells, grid, own) for own in (self.grid, self.fine))
        return self._replace(cells=self.cells & here, points=self.points & of_points)

    def hidden(self, curve: Values, half: float) -> Values:
        """Stretches (k, 2), in metres along a curve (n, 2), that show nothing within ``half`` metres of it.

        They are longer than such stretches are along it by themselves.
        """
        step = self.fine.resolution
        curve = resample(curve, step)
        way = way_along(curve)
        offsets = np.arange(-half, half + step / 2, step)
        xy = across(curve, offsets, smoothing=1.0)
        shown = self.points.ravel()[cell_of(xy.reshape(-1, 2), self.fine)].reshape(xy.shape[:2]).any(axis=1)
        known = way[shown]
        ends = np.concatenate([way[:1], known, way[-1:]])
        out: Values = np.column_stack([ends[:-1], ends[1:]])
        return out[np.diff(ends) > LONG * np.quantile(np.diff(known), MOSTLY)] if len(known) > 1 else out


def seen_cells(cloud: Cloud, grid: Grid) -> Seen:
    """Cells that a cloud shows: all but those of holes, which hold two by two cells without points.

    Cells are as many of a grid's wide as it takes for points to leave no such holes by themselves, however few they
    are or unevenly they lie. That is told by how it is in most places, so that voids don't count.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        The parcel's points.
    grid : Grid
        Over the cloud; its cells are the smallest that are tried.
    """
    shown = np.zeros(grid.shape, dtype=bool)
    for part in cloud.parts():
        in_threads(partial(_show, shown.ravel(), part.xyz, grid), stretches(part.size))
    widest = 0
    for k in count(1):
        cells = block_sum(shown, k) > 0
        if not _usual(cells):
            break
        widest = k
    k = 1 + int(ROOM * widest)
    # The outermost cells are empty, and what lies beyond them is as they are.
    cells, side = np.pad(block_sum(shown, k) > 0, 2), k * grid.resolution
    around = Grid(grid.west - 2 * side, grid.north + 2 * side, side, *cells.shape)
    fine = Grid(
        grid.west - grid.resolution, grid.north + grid.resolution, grid.resolution, *(n + 2 for n in grid.shape)
    )
    return Seen(~_holes(cells), around, np.pad(shown, 1), fine)


def _holes(shown: Flags) -> Flags:
    """Cells of two by two that are all empty."""
    empty = ~shown
    corner = empty[:-1, :-1] & empty[1:, :-1] & empty[:-1, 1:] & empty[1:, 1:]
    out: Flags = np.zeros_like(empty)
    for i in (slice(None, -1), slice(1, None)):
        for j in (slice(None, -1), slice(1, None)):
            out[i, j] |= corner
    return out


def _show(shown: Flags, xyz: Values, grid: Grid, some: tuple[int, int]) -> None:
    """Mark the cells of a grid, one after the other, in which some of the points (n, 3) lie."""
    shown[cell_of(xyz[slice(*some)], grid)] = True


def _usual(shown: Flags) -> bool:
    """Whether holes are usual in squares of cells that lie amid such as hold points."""
    points, holes = (block_sum(cells, SQUARE) > 0 for cells in (shown, _holes(shown)))
    amid = binary_erosion(points, np.ones((3, 3)))
    return bool(amid.any() and holes[amid].mean() > USUAL)
