"""What an agronomist should know of a product before trusting it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely
from scipy.ndimage import binary_opening
from scipy.spatial import cKDTree

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
LOWEST, HIGHEST = 0.45, 3.6
"""Metres of height from which what stands there is no grass, and up to which it may be vines."""
HALF = 0.5
"""Share of the rows' height below which what stands between them is no vine; and of a square that plants fill."""
STEP = 0.5
"""Metres between the points of rows."""
ROOF = 3.0
"""Metres across which plants are closed that are no rows."""
MOST_LEFT = 0.02
"""Share of a parcel on which vines may stand that are in no row."""


def notices(rows: gpd.GeoDataFrame, chm: Raster, parcel: gpd.GeoDataFrame, n_points: int) -> list[str]:
    """Remarks, a sentence each: how far points cover a parcel, how densely, doubtful rows, and plants in no row.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``confidence``, ``spacing_m`` and ``height_m``.
    chm : Raster
        Canopy height, NaN where there are no points.
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
    return [remark for remark, holds in remarks.items() if holds] + _plants_in_no_row(rows, chm, polygon)


def _plants_in_no_row(rows: gpd.GeoDataFrame, chm: Raster, polygon: shapely.Geometry) -> list[str]:
    """What stands at the height of vines in a parcel, and in none of its rows."""
    grid = chm.grid
    heights = rows["height_m"].dropna()
    low = max(LOWEST, HALF * float(heights.median())) if len(heights) else LOWEST
    plants = (chm.values >= low) & (chm.values <= HIGHEST)
    i, j = np.nonzero(plants)
    x, y = grid.west + (j + 0.5) * grid.resolution, grid.north - (i + 0.5) * grid.resolution
    left = shapely.contains_xy(polygon, x, y)
    if len(rows):
        lines = shapely.segmentize(shapely.force_2d(rows.geometry.to_numpy()), STEP)
        points, row = shapely.get_coordinates(lines, return_index=True)
        half = 0.5 * rows["spacing_m"].to_numpy()[row]
        distance, nearest = cKDTree(points).query(
            np.column_stack([x, y]), distance_upper_bound=float(half.max()) + STEP, workers=-1
        )
        left &= ~(distance <= half[np.minimum(nearest, len(half) - 1)])
    plants[i, j] = left
    n = max(1, round(1 / grid.resolution))
    squares = block_sum(plants.astype(np.uint16), n) >= HALF * n**2
    area = float(np.count_nonzero(squares)) * (n * grid.resolution) ** 2
    share = area / max(float(shapely.area(polygon)), 1.0)
    if share <= MOST_LEFT:
        return []
    side = max(1, round(ROOF / (n * grid.resolution)))
    roof = np.count_nonzero(binary_opening(squares, np.ones((side, side)))) > HALF * np.count_nonzero(squares)
    why = f"closed over {ROOF:g} m and more, so that no rows can be told" if roof else "no rows were seen in them"
    return [
        f"plants of {low:.1f} to {HIGHEST:g} m stand in no row on {area:,.0f} m² ({share:.0%} of the parcel): {why}"
    ]


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
