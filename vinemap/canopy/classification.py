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
COMPANIONS = 3
"""Points that lie near a point in the air, or it is noise."""


def classify_points(
    cloud: PointCloud,
    leaves: Sequence[Sections],
    *,
    ground: float = 0.1,
    air: float = 0.5,
    reach: float = 0.3,
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Classify the points of a cloud.

    Parameters
    ----------
    cloud : PointCloud
        n points with their heights above ground, the whole cloud's or a part's.
    leaves : sequence of Sections
        Canopy points of the rows' sections.
    ground : float
        Metres above or below the terrain model within which points are ground.
    air : float
        Metres above or below it beyond which a point that is no canopy needs company, or it is noise.
    reach : float
        Metres within which ``COMPANIONS`` other points must lie; further in clouds of less than 100 points/m².

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
    classes[np.abs(heights) <= ground] = GROUND
    aloft = np.flatnonzero(np.abs(heights) > air)
    lone = aloft[~canopy[aloft]]
    if len(lone):
        (west, south, _), (east, north, _) = cloud.extent
        density = cloud.size / max((east - west) * (north - south), 1.0)
        near = reach * max(1.0, (100 / density) ** 0.5)
        distance, _ = cKDTree(cloud.xyz[aloft]).query(cloud.xyz[lone], COMPANIONS + 1, workers=-1)
        classes[lone[distance[:, -1] > near]] = NOISE
    classes[canopy] = CANOPY
    return classes, row_id
