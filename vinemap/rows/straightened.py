"""Rows in frames of their own: their shares of a cloud's points, and cover in cells about their courses."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from vinemap.cloud.frame import points_of_rows
from vinemap.compute.compiled import compiled
from vinemap.compute.filters import blurred
from vinemap.compute.threads import in_threads, stretches
from vinemap.geo.curve import way_along
from vinemap.geo.raster import Raster, nearest_cell, spread
from vinemap.rows.centre_line import CELL

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from vinemap.cloud.frame import Taken
    from vinemap.cloud.points import PointCloud
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Grid
    from vinemap.rows.standing.known_ends import Known
    from vinemap.surfaces.cover import Levels

RAMP = 0.1
"""Metres of height over which a point becomes canopy: a hard edge would follow the terrain model's millimetres."""
REACH = 0.2
"""Metres beyond its half width from which a row's points are taken, as it may still move."""


class Share(NamedTuple):
    """A row's share of a cloud: its course, and the m points near it."""

    curve: Values
    """Stations (n, 2) of the course."""
    half: float
    """Metres to both sides in which its canopy is looked for."""
    curtains: float
    """Metres between the two curtains of its canopy; 0 where it has one."""
    station: Values
    """How many stations (m,) along the course points are."""
    left: Values
    """Metres (m,) to the left of it."""
    body: Values
    """How far (m,) points are canopy, 0–1, by the level of canopies whole."""
    ridge: Values
    """The same by that of what stands apart; ``body`` itself where both are alike."""
    known: Known | None


def where_vines_are(cover: Raster, levels: Levels, half: Values) -> tuple[Flags, Grid]:
    """Cells with cover and, where that is of ridges alone, those beside, as canopies are wider below."""
    vines: Flags = cover.values > 0
    touching = levels.touching
    if touching.any() and len(half):
        wider = maximum_filter(vines, 2 * round(float(np.median(half)) / cover.grid.resolution) + 1)
        vines |= wider & spread(touching, levels.body.grid, cover.grid)
    return vines, cover.grid


def deal(
    cloud: Cloud,
    vines: tuple[Flags, Grid],
    levels: Levels,
    curves: Sequence[Values],
    half: Values,
    curtains: Values,
    known: Sequence[Known | None],
    *,
    high: float,
) -> Iterator[tuple[Ints, list[Share]]]:
    """Deal a cloud's points out to the rows that they are near, group by group of rows.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        Points with their heights above ground.
    vines, levels
        As of :func:`where_vines_are`.
    curves : sequence of (n, 2) array
        Courses of the rows.
    half, curtains, known
        Of each, as of :class:`Share`.
    high : float
        Height in metres above which no point is canopy.

    Yields
    ------
    rows : (k,) array
        Positions of the group's curves.
    shares : list of Share
        Of each.
    """
    touching = bool(levels.touching.any())

    def canopy_of(part: PointCloud, member: NDArray[np.int32]) -> Taken:
        body = np.zeros(len(member), dtype=np.float32)
        ridge = np.zeros(len(member) if touching else 0, dtype=np.float32)
        at = vines, (levels.body.values, levels.ridge.values, levels.body.grid)
        in_threads(
            lambda stretch: _weigh(*stretch, part.xyz, part.heights, member, at, high, body, ridge),
            stretches(len(member)),
        )
        return body, ridge if touching else body

    for rows, near, (body, ridge) in points_of_rows(cloud, curves, half + REACH, canopy_of):
        shares = []
        for k, row in enumerate(rows):
            mine = slice(near.start[k], near.start[k + 1])
            scale = np.float32((len(curves[row]) - 1) / way_along(curves[row])[-1])
            apart = ridge is body or np.array_equal(body[mine], ridge[mine])
            columns = (body[mine],) * 2 if apart else (body[mine], ridge[mine])
            about = float(half[row]), float(curtains[row])
            shares.append(Share(curves[row], *about, near.along[mine] * scale, near.left[mine], *columns, known[row]))
        yield rows, shares


@compiled
def _weigh(
    first: int,
    last: int,
    xyz: Values,
    heights: Values,
    member: NDArray[np.int32],
    at: tuple[tuple[Flags, Grid], tuple[Values, Values, Grid]],
    high: float,
    body: Values,
    ridge: Values,
) -> None:
    """How far members (n,) of a cloud are canopy, 0 to 1: from the levels up to a height, where there are vines."""
    vines, (of_body, of_ridge, grid) = at
    for k in range(first, last):
        p = member[k]
        i, j = nearest_cell(vines[1], xyz[p, 0], xyz[p, 1])
        if vines[0][i, j]:
            a, b = nearest_cell(grid, xyz[p, 0], xyz[p, 1])
            fall = min(max((high - heights[p]) / RAMP + 0.5, 0.0), 1.0)
            body[k] = fall * min(max((heights[p] - of_body[a, b]) / RAMP + 0.5, 0.0), 1.0)
            if len(ridge):
                ridge[k] = fall * min(max((heights[p] - of_ridge[a, b]) / RAMP + 0.5, 0.0), 1.0)


def straighten(share: Share, canopy: Values, shift: Values) -> tuple[Values, Values]:
    """Cover (stations, cells across) about a curve moved to its left by ``shift`` (stations,), and cells' offsets."""
    m = int(np.ceil(share.half / CELL))
    return _cover(share.station, share.left, canopy, shift, m), np.arange(-m, m + 1) * CELL


@compiled
def _cover(station: Values, left: Values, canopy: Values, shift: Values, m: int) -> Values:
    """Share of canopy (stations, 2 m + 1) in cells, smoothed the wider the fewer points there are."""
    leaves, everything = _spread(station, left, canopy, shift, m)
    density = 0.0
    for i in range(len(shift)):
        for j in range(2 * m + 1):
            density += everything[i, j]
    density = max(density / everything.size, 1e-9)
    sigma = max(1.0, density**-0.5)
    leaves, everything = blurred(leaves, sigma), blurred(everything, sigma)
    for i in range(len(shift)):
        for j in range(2 * m + 1):
            leaves[i, j] /= everything[i, j] + 0.1 * density
    return leaves


@compiled
def _spread(station: Values, left: Values, canopy: Values, shift: Values, m: int) -> tuple[Values, Values]:
    """Canopy and points (stations, 2 m + 1) in cells; each point is shared by the four whose centres surround it."""
    n = len(shift)
    leaves, everything = np.zeros((n, 2 * m + 1)), np.zeros((n, 2 * m + 1))
    for p in range(len(station)):
        if not 0 <= station[p] < n - 1:
            continue
        i = int(station[p])
        down = station[p] - i
        across = (left[p] - shift[i] * (1 - down) - shift[i + 1] * down) / CELL + m
        j = int(np.floor(across))
        right = across - j
        for b in range(2):
            if 0 <= j + b <= 2 * m:
                for a in range(2):
                    part = (down if a else 1 - down) * (right if b else 1 - right)
                    everything[i + a, j + b] += part
                    leaves[i + a, j + b] += part * canopy[p]
    return leaves, everything
