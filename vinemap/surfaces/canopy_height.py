"""Canopy height model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import maximum_filter

from vinemap.cloud.bins import cells_a_block
from vinemap.geo.raster import Raster, grid_over
from vinemap.surfaces.statistics import order_statistics

if TYPE_CHECKING:
    from vinemap.cloud.tiles import Cloud

SPIKE = 0.3
"""Metres by which a cell of the canopy height model may stand out."""


def canopy_height_model(cloud: Cloud, *, resolution: float = 0.25) -> Raster:
    """Canopy height model: the 98% height in metres of each cell's points, NaN where there is none.

    A cell stands no higher than the highest of its eight neighbours by more than ``SPIKE``, so that a point in the
    air doesn't make a tower. The cloud has its heights, and the resolution is that of its terrain model.
    """
    grid = grid_over(*cloud.extent, resolution=resolution, multiple=cells_a_block(resolution))
    n, found = order_statistics(cloud, None, grid, (0.98,))
    height = np.maximum(found[0], 0)
    around = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    height = np.minimum(height, maximum_filter(height, footprint=around) + SPIKE)
    return Raster(np.where(n > 0, height, np.nan), grid, cloud.crs)
