"""Sections across the rows: the points around stations of γ, in the station's own frame (thesis, section 3.2.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from vinemap.cloud import Sections
from vinemap.raster import sample
from vinemap.row_frame import at, row_coordinates, tangents

if TYPE_CHECKING:
    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.cloud import PointCloud
    from vinemap.raster import Raster

    Values = NDArray[np.floating]


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
    curves = [shapely.get_coordinates(line) for line in lines]
    near = row_coordinates(cloud.xyz, curves, 0.5 * rows["spacing_m"].to_numpy())
    # Rows are laid one behind the other so that one sort, and one search, finds the points of every section.
    stride = max(line.length for line in lines) + 10 * width + 10
    key = np.repeat(np.arange(len(lines)), np.diff(near.start)) * stride + near.along
    order = np.argsort(key)
    key, left, member = key[order], near.left[order], near.member[order]

    parts = [_stations(line, gaps[gaps["row_id"] == i], step) for line, i in zip(lines, rows["row_id"], strict=True)]
    station_row = np.concatenate([np.full(len(p), k) for k, p in enumerate(parts)])
    position = np.concatenate(parts)
    low = np.searchsorted(key, station_row * stride + position - width / 2, side="left")
    high = np.searchsorted(key, station_row * stride + position + width / 2, side="right")
    start = np.concatenate([[0], np.cumsum(high - low)])
    index = np.arange(start[-1]) - np.repeat(start[:-1] - low, high - low)

    here = np.concatenate([at(curve, p) for curve, p in zip(curves, parts, strict=True)])
    tangent = np.concatenate([tangents(curve, p) for curve, p in zip(curves, parts, strict=True)])
    origin = np.column_stack([here, sample(dtm, here)])
    z = cloud.xyz[member[index], 2] - np.repeat(origin[:, 2], high - low)
    return Sections(
        rows["row_id"].to_numpy()[station_row],
        position,
        origin,
        tangent,
        rows["spacing_m"].to_numpy()[station_row],
        start,
        np.column_stack([left[index], z]),
        heights[member[index]],
    )


def _stations(line: shapely.LineString, gaps: gpd.GeoDataFrame, step: float) -> Values:
    """Positions along a row at equal steps from end to end, but for those in gaps."""
    position = np.linspace(0, line.length, max(2, round(line.length / step) + 1))
    for start, end in zip(gaps["start_m"], gaps["end_m"], strict=True):
        position = position[(position <= start) | (position >= end)]
    return position
