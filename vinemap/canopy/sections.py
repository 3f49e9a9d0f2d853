"""Sections across the rows: the points around stations of γ, in the station's own frame (thesis, section 3.2.1)."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import shapely

from vinemap.canopy.points import MARGIN, USUAL_AREA, Sections, above_weeds, canopy_area, canopy_floor, canopy_size
from vinemap.cloud.frame import points_of_rows
from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches
from vinemap.geo.curve import at, tangents
from vinemap.geo.raster import sample

if TYPE_CHECKING:
    from collections.abc import Callable

    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.cloud.frame import Taken
    from vinemap.cloud.points import PointCloud
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Raster

T = TypeVar("T")

SOIL, SOIL_POINTS = 0.3, 200
"""Metres from the terrain within which points are the soil's, where no low canopy begins below, and how many of them,
about, a section needs: dense clouds have many more, which would tell no more of the inter-row's elevation."""
OWN, LEAST, BETWEEN = 1 / 3, 0.15, 1.0
"""Share of the points that widened sections are to have that shows whether a station has canopy itself; share of the
median station's that it then has, at the least; and metres up to which so many must lie, as between two bushes."""
FOOT = 0.4
"""Share of a row's height from which points are taken for canopy, where that is less than is asked for."""


def cut_sections(
    cloud: Cloud,
    rows: gpd.GeoDataFrame,
    gaps: gpd.GeoDataFrame,
    dtm: Raster,
    then: Callable[[Sections], T],
    *,
    width: float = 0.4,
    step: float = 0.25,
    min_points: int = 45,
    max_width: float = 10.0,
    low: float = 0.5,
    high: float = 3.6,
    margin: float = MARGIN,
) -> list[T]:
    """Cut sections along every row, except where it has no canopy (Eq. 2–3), and hand each row's to a function.

    All sections together would hold more points than the cloud, as they overlap. So they are handed over row by row,
    on all cores, and only what ``then`` makes of them is kept. Of the soil's points a section has but some.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        The parcel's points with their heights above ground.
    rows : GeoDataFrame
        LineStringZ with ``row_id`` and ``spacing_m``.
    gaps : GeoDataFrame
        Stretches without canopy: ``row_id``, ``start_m``, ``end_m``.
    dtm : Raster
        Terrain, for the sections' origins.
    then : callable
        Is called with each row's Sections.
    width, step : float
        Extent a of a section along γ, and distance b of sections along γ, in metres.
    min_points, max_width : int, float
        Sections with fewer points of canopy than the first are widened along the row, up to the second in metres. Of
        canopies of more than a square metre they need as many more.
    low, high : float
        Heights in metres between which points count as canopy; the lower is less in rows that are low.
    margin : float
        As of :func:`vinemap.canopy.points.canopy_floor`.

    Returns
    -------
    list
        What ``then`` has returned for each row, in their order.
    """
    lines = [shapely.force_2d(line) for line in rows.geometry]
    curves = [shapely.get_coordinates(line) for line in lines]
    numbers, spacing = rows["row_id"].to_numpy(), rows["spacing_m"].to_numpy()
    bare, bare_rows = gaps[["start_m", "end_m"]].to_numpy(dtype=float), gaps["row_id"].to_numpy()

    def cut(one: tuple[Any, ...]) -> T:
        row, along, left, member, elevation, height = one
        stations = np.linspace(0, lines[row].length, max(2, round(lines[row].length / step) + 1))
        soil_line = sample(dtm, at(curves[row], stations))
        canopied = _outside(bare[bare_rows == numbers[row]], stations)
        top, half = size = canopy_size(left, height, float(spacing[row]), high)
        floor = canopy_floor(left, height, size, float(spacing[row]), margin)
        below = min(SOIL, floor)
        levels = below, min(low, FOOT * top), high
        canopy, soil = _count(left, height, half, levels)
        length = max(canopied.sum() * step, step)
        needed = min_points * max(1.0, canopy_area(size, max(floor, float(above_weeds(top)))) / USUAL_AREA)
        wanted = needed * length / max(canopy, 1)
        if width < wanted <= BETWEEN / OWN and canopied.any():
            leaves = along[(levels[1] <= height) & (height <= high) & (np.abs(left) < half)]
            canopied &= _has_own(leaves, stations, canopied, max(width, OWN * wanted))
            length = max(canopied.sum() * step, step)
            wanted = needed * length / max(canopy, 1)
        position, level = stations[canopied], soil_line[canopied]
        a = max(width, min(max_width, wanted))
        every = max(1, int(soil * a / length / SOIL_POINTS))
        n, index = _members(along, height, position, a / 2, (below, every))
        start = np.concatenate([[0], np.cumsum(n)])
        every_step = (soil_line, stations[1])
        points, heights, members = _take_each(index, along, left, elevation, height, member, every_step)
        return then(
            Sections(
                np.full(len(position), numbers[row]),
                position,
                np.column_stack([at(curves[row], position), level]),
                tangents(curves[row], position),
                np.full(len(position), spacing[row]),
                np.full(len(position), a),
                start,
                points,
                heights,
                members,
            )
        )

    found: dict[int, T] = {}
    for group, near, taken in points_of_rows(cloud, curves, 0.5 * spacing, _elevations):
        columns = (near.along, near.left, near.member, *taken)
        mine = [slice(a, b) for a, b in pairwise(near.start)]
        each = [(int(row), *(column[part] for column in columns)) for row, part in zip(group, mine, strict=True)]
        found |= dict(zip(group.tolist(), in_threads(cut, each), strict=True))
    return [found[row] for row in range(len(rows))]


def _elevations(cloud: PointCloud, member: NDArray[np.int32]) -> Taken:
    """Elevation and height above ground (n,) of a cloud's members."""
    elevation, height = np.empty((2, len(member)), dtype=np.float32)
    in_threads(lambda part: _take(*part, cloud.xyz, cloud.heights, member, elevation, height), stretches(len(member)))
    return elevation, height


@compiled
def _take(
    first: int,
    last: int,
    xyz: Values,
    heights: Values,
    member: NDArray[np.int32],
    elevation: NDArray[np.float32],
    height: NDArray[np.float32],
) -> None:
    for k in range(first, last):
        elevation[k], height[k] = xyz[member[k], 2], heights[member[k]]


@compiled
def _count(left: Values, height: Values, half: float, levels: tuple[float, float, float]) -> tuple[int, int]:
    """Points (n,) of the canopy, so many metres to both sides between two heights, and of the soil, below another."""
    canopy, soil = 0, 0
    below, low, high = levels
    for p in range(len(left)):
        canopy += low <= height[p] <= high and abs(left[p]) < half
        soil += abs(height[p]) < below
    return canopy, soil


def _members(
    along: Values, height: Values, position: Values, reach: float, soil: tuple[float, int]
) -> tuple[Ints, NDArray[np.int32]]:
    """How many points (m,) lie within reach of each position along a row, and which, section after section.

    Of the soil's, below a height, one in so many: chosen by its place, so that the points' order doesn't matter.
    """
    m = len(position)
    n = np.zeros(m, dtype=np.int64)
    if m == 0:
        return n, np.empty(0, dtype=np.int32)
    step = (position[-1] - position[0]) / m + reach
    table = np.searchsorted(position, position[0] + step * np.arange(int((position[-1] - position[0]) / step) + 2))
    out = _list_members(along, height, position, reach, soil, table, step, n)
    return n, out


@compiled
def _list_members(
    along: Values,
    height: Values,
    position: Values,
    reach: float,
    soil: tuple[float, int],
    table: Ints,
    step: float,
    n: Ints,
) -> NDArray[np.int32]:
    """Count the points of each position, and list them; ``table`` tells of equal steps which position follows."""
    below, every = soil
    m = len(position)
    first = np.empty(len(along), dtype=np.int32)
    for p in range(len(along)):
        if abs(height[p]) < below and int(1000 * along[p]) % every != 0:
            first[p] = m
            continue
        bin_ = int((along[p] - reach - position[0]) / step)
        k = table[min(max(bin_, 0), len(table) - 1)]
        while k < m and position[k] < along[p] - reach:
            k += 1
        first[p] = k
        while k < m and position[k] <= along[p] + reach:
            n[k] += 1
            k += 1
    place, total = np.empty(m, dtype=np.int64), 0
    for k in range(m):
        place[k] = total
        total += n[k]
    out = np.empty(total, dtype=np.int32)
    for p in range(len(along)):
        k = first[p]
        while k < m and position[k] <= along[p] + reach:
            out[place[k]] = p
            place[k] += 1
            k += 1
    return out


@compiled
def _take_each(
    index: NDArray[np.int32],
    along: Values,
    left: Values,
    elevation: Values,
    height: Values,
    member: NDArray[np.int32],
    soil: tuple[Values, float],
) -> tuple[NDArray[np.float32], Values, NDArray[np.int32]]:
    """Points (n, 2) of sections, metres above the row's soil beside them, their heights, and which of the cloud's.

    ``soil`` is the soil's elevation (k,) along the row, and the metres between these.
    """
    n = len(index)
    points, heights, members = np.empty((n, 2), np.float32), np.empty(n, height.dtype), np.empty(n, member.dtype)
    levels, step = soil
    for i in range(n):
        p = index[i]
        at_step = min(max(along[p] / step, 0.0), len(levels) - 1.0)
        k = min(int(at_step), len(levels) - 2)
        points[i, 0] = left[p]
        points[i, 1] = elevation[p] - levels[k] - (at_step - k) * (levels[k + 1] - levels[k])
        heights[i], members[i] = height[p], member[p]
    return points, heights, members


def _has_own(leaves: Values, stations: Values, canopied: Flags, within: float) -> Flags:
    """Whether stations (m,) have canopy within so many metres, of points (n,) along the row, as those that may have it.

    Bushes stand apart, and what lies between two has no canopy where points are so few that sections reach both.
    """
    leaves = np.sort(leaves)
    n = np.searchsorted(leaves, stations + within / 2) - np.searchsorted(leaves, stations - within / 2)
    out: Flags = n >= LEAST * np.median(n[canopied])
    return out


def _outside(bare: Values, position: Values) -> Flags:
    """Whether positions (m,) along a row lie in none of its bare stretches (n, 2), ends aside."""
    starts, ends = bare.T[..., None]
    return np.asarray(((position <= starts) | (position >= ends)).all(axis=0))
