"""What an agronomist should know of a product before trusting it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from vinemap.geo.raster import block_sum

if TYPE_CHECKING:
    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.geo.raster import Grid, Raster

SIDE = 2.0
"""Metres, about: side of the squares that points cover or don't."""
COVERED = 0.95
"""Share of a parcel that a survey of it covers."""
DENSE = 60.0
"""Points a square metre below which canopies come out poorly."""
SURE = 0.5
"""Confidence of a row that is worth a look."""


def notices(rows: gpd.GeoDataFrame, chm: Raster, parcel: gpd.GeoDataFrame, n_points: int) -> list[str]:
    """Remarks, a sentence each, on how far the points cover a parcel, how densely, and on doubtful rows.

    Parameters
    ----------
    rows : GeoDataFrame
        With ``confidence``.
    chm : Raster
        Any raster that is NaN where there are no points.
    parcel : GeoDataFrame
        Polygons of the parcel.
    n_points : int
        Number of points.
    """
    n = max(1, round(SIDE / chm.grid.resolution))
    seen = block_sum(np.isfinite(chm.values).astype(np.uint16), n) > 0
    side = n * chm.grid.resolution
    polygon = shapely.union_all(parcel.geometry.to_numpy())
    covered = _covered(polygon, seen, chm.grid, side)
    density = n_points / max(np.count_nonzero(seen) * side**2, 1.0)
    doubtful = int((rows["confidence"] < SURE).sum())
    remarks = {
        f"the cloud covers {covered:.0%} of the parcel": covered < COVERED,
        f"{density:.0f} points/m², canopies are poor below {DENSE:.0f}": density < DENSE,
        f"{doubtful} of {len(rows)} rows are doubtful (confidence below {SURE:g})": doubtful > 0,
    }
    return [remark for remark, holds in remarks.items() if holds]


def _covered(polygon: shapely.Geometry, seen: NDArray[np.bool_], grid: Grid, side: float) -> float:
    """Share of the squares with their centres in a polygon that were seen, among those of a raster and beyond it."""
    shapely.prepare(polygon)
    west, south, east, north = shapely.bounds(polygon)
    j = np.arange(np.floor((west - grid.west) / side), np.ceil((east - grid.west) / side))
    i = np.arange(np.floor((grid.north - north) / side), np.ceil((grid.north - south) / side))
    inside = shapely.contains_xy(polygon, *np.meshgrid(grid.west + (j + 0.5) * side, grid.north - (i + 0.5) * side))
    ii, jj = (index.astype(int) for index in np.meshgrid(i, j, indexing="ij"))
    within = inside & (ii >= 0) & (jj >= 0) & (ii < seen.shape[0]) & (jj < seen.shape[1])
    return float(seen[ii[within], jj[within]].sum() / max(np.count_nonzero(inside), 1)) if inside.any() else 1.0
