"""Sections across the rows: the points around stations of γ, in the station's own frame (thesis, section 3.2.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely
from scipy.spatial import cKDTree

from vinemap.cloud import Sections
from vinemap.raster import cell_of, grid_over, sample

if TYPE_CHECKING:
    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.cloud import PointCloud
    from vinemap.raster import Raster

    Values = NDArray[np.float64]

GUIDE = 0.25
"""Metres between the points of γ to which cloud points are referred, and the cells of their lookup."""


def cut_sections(
    cloud: PointCloud,
    heights: Values,
    rows: gpd.GeoDataFrame,
    gaps: gpd.GeoDataFrame,
    dtm: Raster,
    *,
    width: float = 0.4,
    step: float = 0.25,
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
    """
    if len(rows) == 0:
        none = np.empty(0)
        pairs = np.empty((0, 2))
        number = np.empty(0, dtype=np.int64)
        start = np.zeros(1, dtype=np.int64)
        return Sections(number, none, np.empty((0, 3)), pairs, none, start, pairs, none)
    lines = [shapely.force_2d(line) for line in rows.geometry]
    row, along, across, members = _row_coordinates(cloud.xyz, lines, 0.5 * rows["spacing_m"].to_numpy())
    order = np.lexsort((along, row))
    row, along, across, members = row[order], along[order], across[order], members[order]

    parts = [
        _stations(line, k, gaps[gaps["row_id"] == i], step)
        for k, (line, i) in enumerate(zip(lines, rows["row_id"], strict=True))
    ]
    station_row = np.concatenate([np.full(len(p), k) for k, p in enumerate(parts)])
    position = np.concatenate(parts)
    # Rows are laid one behind the other so that one search finds the points of every section.
    stride = max(line.length for line in lines) + 10 * width + 10
    key = row * stride + along
    low = np.searchsorted(key, station_row * stride + position - width / 2, side="left")
    high = np.searchsorted(key, station_row * stride + position + width / 2, side="right")
    start = np.concatenate([[0], np.cumsum(high - low)])
    index = np.arange(start[-1]) - np.repeat(start[:-1] - low, high - low)

    geometry = np.array(lines)[station_row]
    here = shapely.get_coordinates(shapely.line_interpolate_point(geometry, position))
    tangent = _tangents(geometry, position)
    origin = np.column_stack([here, sample(dtm, here)])
    z = cloud.xyz[members[index], 2] - np.repeat(origin[:, 2], high - low)
    return Sections(
        rows["row_id"].to_numpy()[station_row],
        position,
        origin,
        tangent,
        rows["spacing_m"].to_numpy()[station_row],
        start,
        np.column_stack([across[index], z]),
        heights[members[index]],
    )


def _row_coordinates(
    xyz: Values, lines: list[shapely.LineString], reach: Values
) -> tuple[NDArray[np.int64], Values, Values, NDArray[np.int64]]:
    """Row, metres along it and to its left, and index of the points within ``reach`` (rows,) of their nearest row."""
    guides = [np.linspace(0, line.length, max(2, round(line.length / GUIDE) + 1)) for line in lines]
    row = np.concatenate([np.full(len(g), k) for k, g in enumerate(guides)])
    position = np.concatenate(guides)
    geometry = np.array(lines)[row]
    guide = shapely.get_coordinates(shapely.line_interpolate_point(geometry, position))
    tangent = _tangents(geometry, position)
    # The nearest guide of a cell is near enough to the nearest of its points: both are projected on its tangent.
    grid = grid_over(xyz, resolution=GUIDE)
    x, y = grid.centres()
    centres = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    distance, nearest = cKDTree(guide).query(centres, distance_upper_bound=float(reach.max()) + GUIDE, workers=-1)
    near = np.isfinite(distance)
    cells = cell_of(xyz, grid)
    members = np.flatnonzero(near[cells])
    g = nearest[cells[members]]
    offset = xyz[members, :2] - guide[g]
    ahead = (offset * tangent[g]).sum(axis=1)
    left = tangent[g, 0] * offset[:, 1] - tangent[g, 1] * offset[:, 0]
    inside = np.abs(left) <= reach[row[g]]
    return row[g][inside], (position[g] + ahead)[inside], left[inside], members[inside]


def _tangents(lines: NDArray[np.object_], position: Values) -> Values:
    """Unit tangents (n, 2) of lines at metres along them, over half a metre."""
    length = shapely.length(lines)
    a = shapely.get_coordinates(shapely.line_interpolate_point(lines, np.clip(position - 0.25, 0, None)))
    b = shapely.get_coordinates(shapely.line_interpolate_point(lines, np.minimum(position + 0.25, length)))
    out: Values = (b - a) / np.hypot(*(b - a).T)[:, None]
    return out


def _stations(line: shapely.LineString, row: int, gaps: gpd.GeoDataFrame, step: float) -> Values:
    """Positions along a row at equal steps, its ends and the edges of gaps included as far as a step allows."""
    del row
    position = np.linspace(0, line.length, max(2, round(line.length / step) + 1))
    for start, end in zip(gaps["start_m"], gaps["end_m"], strict=True):
        position = position[(position <= start) | (position >= end)]
    return position
