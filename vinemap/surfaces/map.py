"""The first stage as a whole: terrain, heights above it, and what was seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vinemap.geo.raster import grid_over
from vinemap.surfaces.ceiling import heights_of_vines
from vinemap.surfaces.ground import terrain_model
from vinemap.surfaces.seen import seen_cells

if TYPE_CHECKING:
    from vinemap.cloud.tiles import Cloud
    from vinemap.config.settings import Settings
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.seen import Seen

PDALS = {"filter", "smrf", "csf", "pmf", "pipeline"}
"""Settings of PDAL, which has classified the points before."""


def map_surfaces(points: Cloud, settings: Settings) -> tuple[Cloud, Raster, Raster, Seen]:
    """Find a cloud's terrain.

    Returns
    -------
    cloud : PointCloud or TiledCloud
        With its heights above it.
    dtm, chm : Raster
        The terrain, and the canopies' height.
    seen : Seen
        What the cloud shows.
    """
    dtm = terrain_model(points, **settings.ground.model_dump(exclude=PDALS))
    cloud, chm = heights_of_vines(points, dtm, resolution=settings.ground.resolution, high=settings.cover.high)
    seen = seen_cells(points, grid_over(*points.extent, resolution=settings.cover.resolution))
    return cloud, dtm, chm, seen
