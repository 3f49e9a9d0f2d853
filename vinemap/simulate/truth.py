"""What is true of a simulated survey, as tables of rows, dead vines, gaps and parcels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from vinemap.geo.curve import way_along
from vinemap.simulate.plants import Stations, Vineyard, on_ground, vines_along

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.simulate.terrain import Terrain


def truth_of(
    vineyards: Sequence[Vineyard], dead: Sequence[NDArray[np.bool_]], stations: Stations, terrain: Terrain, crs: str
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame, gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Tables of rows, dead vines, gaps and parcels, as :class:`vinemap.simulate.survey.Survey` has them."""
    rows, spots, gaps = [], [], []
    plots = [(vineyard, i, row) for vineyard in vineyards for i, row in enumerate(vineyard.rows, 1)]
    for k, ((vineyard, i, row), vines) in enumerate(zip(plots, dead, strict=True)):
        name, length = vineyard.name, way_along(row)[-1]
        line = on_ground(row, np.linspace(0, length, math.ceil(length / 0.25) + 1), terrain)
        own = (stations.row == k) & (stations.arc > 0) & (stations.arc < length)
        alive = own & (stations.half_width > 0)
        height, width = stations.top[alive].mean(), 2 * stations.half_width[alive].mean() + (vineyard.curtains or 0)
        rows.append((name, i, way_along(line)[-1], len(vines), vines.sum(), height, width, shapely.LineString(line)))
        gone = np.flatnonzero(vines)
        middles = vines_along(vineyard, length)[gone]
        points = on_ground(row, middles, terrain)
        spots += [(name, i, vine + 1, shapely.Point(point)) for vine, point in zip(gone, points, strict=True)]
        curtains = stations.half_width[own].reshape(1 if vineyard.curtains is None else 2, -1)
        bare = np.flatnonzero(np.diff(np.pad(curtains[0] <= 0, 1).astype(int))).reshape(-1, 2)
        for start, end in bare * stations.step[own][0]:
            piece = on_ground(row, np.linspace(start, end, math.ceil((end - start) / 0.25) + 1), terrain)
            missing = np.count_nonzero((middles > start) & (middles < end))
            if missing:  # else a way between two heads
                gaps.append((name, i, missing, shapely.LineString(piece)))
    outlines = [(v.name, v.outline or shapely.MultiLineString(v.rows).convex_hull.buffer(3.0)) for v in vineyards]
    canopy = ["length_3d", "n_vines", "n_dead", "mean_height", "mean_width"]

    def frame(records: list[Any], columns: list[str]) -> gpd.GeoDataFrame:
        table = pd.DataFrame(records, columns=[*columns, "geometry"])
        return gpd.GeoDataFrame(table, geometry="geometry", crs=crs)

    return (
        frame(rows, ["parcel", "row", *canopy]),
        frame(spots, ["parcel", "row", "vine"]),
        frame(gaps, ["parcel", "row", "n_vines"]),
        frame(outlines, ["name"]),
    )
