"""Sections across the rows: the points around stations of γ, in the station's own frame (thesis, section 3.2.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from vinemap.cloud import Sections
from vinemap.compiled import compiled, in_threads
from vinemap.raster import sample
from vinemap.row_frame import at, row_coordinates, tangents

if TYPE_CHECKING:
    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.cloud import PointCloud
    from vinemap.raster import Raster

    Values = NDArray[np.floating]


HALF = 0.9
"""Metres to both sides of a row within which points are taken for canopy."""


def cut_sections(
    cloud: PointCloud,
    heights: Values,
    rows: gpd.GeoDataFrame,
    gaps: gpd.GeoDataFrame,
    dtm: Raster,
    *,
    width: float = 0.4,
    step: float = 0.25,
    min_points: int = 45,
    max_width: float = 1.0,
    low: float = 0.5,
    high: float = 2.9,
) -> Sections:
    """Cut sections along every row, except where it has no canopy (Eq. 2–3).

    Parameters
    ----------
    cloud : PointCloud
        The parcel's points.
    heights : (n,) array
        Their heights above ground in metres.
    rows : GeoDataFrame
        LineStringZ with ``row_id`` and ``spacing_m``.
    gaps : GeoDataFrame
        Stretches without canopy: ``row_id``, ``start_m``, ``end_m``.
    dtm : Raster
        Terrain, for the sections' origins.
    width, step : float
        Extent a of a section along γ, and distance b of sections along γ, in metres.
    min_points, max_width : int, float
        Points of canopy that sections of a row are widened for, and metres to which they may be.
    low, high : float
        Heights in metres between which points count as canopy.
    """
    if len(rows) == 0:
        none = np.empty(0)
        pairs = np.empty((0, 2))
        number = np.empty(0, dtype=np.int64)
        start = np.zeros(1, dtype=np.int64)
        return Sections(number, none, np.empty((0, 3)), pairs, none, start, pairs, none, number)
    lines = [shapely.force_2d(line) for line in rows.geometry]
    curves = [shapely.get_coordinates(line) for line in lines]
    near = row_coordinates(cloud.xyz, curves, 0.5 * rows["spacing_m"].to_numpy())
    parts = [_stations(line, gaps[gaps["row_id"] == i], step) for line, i in zip(lines, rows["row_id"], strict=True)]
    station_row = np.concatenate([np.full(len(p), k) for k, p in enumerate(parts)])
    position = np.concatenate(parts)
    bounds = np.concatenate([[0], np.cumsum([len(p) for p in parts])])

    def find(k: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        mine = slice(near.start[k], near.start[k + 1])
        height = heights[near.member[mine]]
        canopy = (height >= low) & (height <= high) & (np.abs(near.left[mine]) < HALF)
        per_metre = max(float(canopy.sum()), 1.0) / max(len(parts[k]) * step, step)
        a = max(width, min(max_width, min_points / per_metre))
        return _members(near.along[mine], parts[k], a / 2)

    found = in_threads(find, range(len(lines)))
    start = np.concatenate([[0], np.cumsum(np.concatenate([n for n, _ in found]))])
    here = np.concatenate([at(curve, p) for curve, p in zip(curves, parts, strict=True)])
    tangent = np.concatenate([tangents(curve, p) for curve, p in zip(curves, parts, strict=True)])
    origin = np.column_stack([here, sample(dtm, here)])
    points, height, member = np.empty((start[-1], 2)), np.empty(start[-1]), np.empty(start[-1], dtype=np.int64)

    def fill(k: int) -> None:
        mine, into = slice(near.start[k], near.start[k + 1]), start[bounds[k] : bounds[k + 1] + 1]
        level = origin[bounds[k] : bounds[k + 1], 2]
        _fill(found[k][1], near.left[mine], near.member[mine], into, level, cloud.xyz, heights, points, height, member)

    in_threads(fill, range(len(lines)))
    return Sections(
        rows["row_id"].to_numpy()[station_row],
        position,
        origin,
        tangent,
        rows["spacing_m"].to_numpy()[station_row],
        start,
        points,
        height,
        member,
    )


@compiled
def _members(along: Values, position: Values, reach: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many points (m,) lie within reach of each position along a row, and which, section after section."""
    m = len(position)
    n = np.zeros(m, dtype=np.int64)
    if m == 0:
        return n, np.empty(0, dtype=np.int64)
    step = (position[-1] - position[0]) / m + reach
    table = np.searchsorted(position, position[0] + step * np.arange(int((position[-1] - position[0]) / step) + 2))
    first = np.empty(len(along), dtype=np.int64)
    for p in range(len(along)):
        bin_ = int((along[p] - reach - position[0]) / step)
        k = table[min(max(bin_, 0), len(table) - 1)]
        while k < m and position[k] < along[p] - reach:
            k += 1
        first[p] = k
        while k < m and position[k] <= along[p] + reach:
            n[k] += 1
            k += 1
    place = np.cumsum(n) - n
    out = np.empty(n.sum(), dtype=np.int64)
    for p in range(len(along)):
        k = first[p]
        while k < m and position[k] <= along[p] + reach:
            out[place[k]] = p
            place[k] += 1
            k += 1
    return n, out


@compiled
def _fill(
    index: NDArray[np.int64],
    left: Values,
    member: NDArray[np.int64],
    start: NDArray[np.int64],
    level: Values,
    xyz: Values,
    heights: Values,
    points: Values,
    height: Values,
    chosen: NDArray[np.int64],
) -> None:
    """Write the points, heights and members of a row's sections, whose soil lies at ``level`` (m,)."""
    for k in range(len(level)):
        for i in range(start[k], start[k + 1]):
            p = index[i - start[0]]
            points[i, 0] = left[p]
            points[i, 1] = xyz[member[p], 2] - level[k]
            height[i] = heights[member[p]]
            chosen[i] = member[p]


def _stations(line: shapely.LineString, gaps: gpd.GeoDataFrame, step: float) -> Values:
    """Positions along a row at equal steps from end to end, but for those in gaps."""
    position = np.linspace(0, line.length, max(2, round(line.length / step) + 1))
    for start, end in zip(gaps["start_m"], gaps["end_m"], strict=True):
        position = position[(position <= start) | (position >= end)]
    return position
