"""What lies beside the points of lines, in compiled code."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    from vinemap.compute.arrays import Ints, Values


def nearest_beside(
    xy: Values, way: Values, line: Ints, reach: Values, *, along: float, apart: float = 0.0, parallel: float = 0.0
) -> tuple[Values, Ints]:
    """The nearest points of other lines to the left and to the right of points of lines.

    Parameters
    ----------
    xy, way : array (n, 2)
        Points, and the unit vectors in which their lines run there; what has NaN is beside nothing.
    line : array (n,)
        Whose point it is.
    reach : array (n,)
        Metres within which others count.
    along : float
        Metres by which they may lie before or behind.
    apart : float
        Metres to the side from which they count.
    parallel : float
        Cosine of the angle, either sense, within which their lines run alike.

    Returns
    -------
    away : array (n, 2)
        Metres to the left and to the right; inf where there is none.
    which : array (n, 2)
        The other points; −1 where there is none.
    """
    away, which = np.full((len(xy), 2), np.inf), np.full((len(xy), 2), -1)
    if len(xy) == 0:
        return away, which
    low, size = xy.min(axis=0), np.ptp(xy, axis=0)
    side = max(float(reach.max()), float(np.sqrt(size[0] * size[1] / len(xy))), 1e-3)
    column, row = ((xy - low) / side).astype(np.int64).T
    n_columns, n_rows = int(column.max()) + 1, int(row.max()) + 1
    cell = row * n_columns + column
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(n_columns * n_rows + 1))
    cells = order, first, row, column
    limits = along, apart, parallel
    in_threads(
        lambda part: _find_beside(*part, xy, way, line, reach, cells, n_columns, limits, away, which),
        stretches(len(xy)),
    )
    return away, which


@compiled
def _find_beside(
    start: int,
    end: int,
    xy: Values,
    way: Values,
    line: Ints,
    reach: Values,
    cells: tuple[Ints, Ints, Ints, Ints],
    n_columns: int,
    limits: tuple[float, float, float],
    away: Values,
    which: Ints,
) -> None:
    """Nearest beside the points from start to end - 1, by the cells that list them, each as wide as the reach."""
    order, first, row, column = cells
    along, apart, parallel = limits
    n_rows = (len(first) - 1) // n_columns
    for i in range(start, end):
        x, y = way[i]
        for band in range(max(row[i] - 1, 0), min(row[i] + 2, n_rows)):
            here = band * n_columns
            for k in range(first[here + max(column[i] - 1, 0)], first[here + min(column[i] + 2, n_columns)]):
                j = order[k]
                if line[j] == line[i]:
                    continue
                dx, dy = xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
                if not (dx * dx + dy * dy <= reach[i] ** 2 and abs(dx * x + dy * y) <= along):
                    continue
                left = x * dy - y * dx
                side = 0 if left > 0 else 1
                if apart < abs(left) < away[i, side] and abs(x * way[j, 0] + y * way[j, 1]) >= parallel:
                    away[i, side], which[i, side] = abs(left), j
