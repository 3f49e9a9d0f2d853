"""A class and a row for every point of a cloud, after ASPRS: ground 2, canopy 5, noise 7, other 1."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.canopy.points import Sections
    from vinemap.cloud.points import PointCloud

OTHER, GROUND, CANOPY, NOISE = 1, 2, 5, 7
AT_GROUND, ALOFT = 0.1, 0.5
"""Metres above or below the terrain model: within the first points are ground, beyond the other they need company if
they are no canopy, or are noise."""
COMPANIONS, REACH = 3, 0.3
"""How many other points are company, and within how many metres, or more in clouds of less than 100 points/m²."""


def classify_points(cloud: PointCloud, leaves: Sequence[Sections]) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Classify the points of a cloud.

    Parameters
    ----------
    cloud : PointCloud
        n points with their heights above ground, the whole cloud's or a part's.
    leaves : sequence of Sections
        Canopy points of the rows' sections.

    Returns
    -------
    classes : (n,) array
        ASPRS classes.
    row_id : (n,) array
        Row of the canopy's points, 0 for all others.
    """
    heights = cloud.heights
    row_id = np.zeros(cloud.size, dtype=np.uint16)
    for sections in leaves:
        mine = sections.member - cloud.first
        inside = (mine >= 0) & (mine < cloud.size)
        row_id[mine[inside]] = np.repeat(sections.row_id, np.diff(sections.start))[inside]
    canopy = row_id > 0
    classes = np.full(cloud.size, OTHER, dtype=np.uint8)
    classes[np.abs(heights) <= AT_GROUND] = GROUND
    aloft = np.flatnonzero(np.abs(heights) > ALOFT)
    lone = aloft[~canopy[aloft]]
    if len(lone):
        (west, south, _), (east, north, _) = cloud.extent
        density = cloud.size / max((east - west) * (north - south), 1.0)
        near = REACH * max(1.0, (100 / density) ** 0.5)
        distance, _ = cKDTree(cloud.xyz[aloft]).query(cloud.xyz[lone], COMPANIONS + 1, workers=-1)
        classes[lone[distance[:, -1] > near]] = NOISE
    classes[canopy] = CANOPY
    return classes, row_id
