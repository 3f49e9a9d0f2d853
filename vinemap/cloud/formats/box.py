"""The box about a polygon, in the CRS of a file that is read only there."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from vinemap.geo.crs import horizontal, project
from vinemap.geo.stated import crs_of

if TYPE_CHECKING:
    from pathlib import Path

    from pyproj import CRS

    from vinemap.compute.arrays import Floats
    from vinemap.geo.boundaries import Boundary

    Box = tuple[Floats, Floats]

MARGIN = 0.001
"""Share of its wider side that is added all around, as straight lines of one CRS bend in another."""


def box_about(boundary: Boundary | None, header: Any, crs: CRS | None, path: Path) -> Box:
    """Corners (3,) about a polygon in the CRS that is given or that a file's header states; of all heights.

    Without a polygon it is all of space.
    """
    if boundary is None:
        return np.full(3, -np.inf), np.full(3, np.inf)
    west, south, east, north = shapely.bounds(project(*boundary, horizontal(crs_of(header, crs, path)))).tolist()
    margin = MARGIN * max(east - west, north - south)
    return np.array([west - margin, south - margin, -np.inf]), np.array([east + margin, north + margin, np.inf])


def meet(low: Floats, high: Floats, box: Box) -> bool:
    """Whether what lies between two corners (3,) has something in common with a box."""
    return bool((low <= box[1]).all() and (high >= box[0]).all())
