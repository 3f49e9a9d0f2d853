"""Writing clouds as LAZ."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.geo.crs import vertical_unit, with_vertical

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime
    from pathlib import Path

    from numpy.typing import NDArray

    from vinemap.cloud.points import PointCloud
    from vinemap.cloud.tiles import Cloud


def write_classified(
    cloud: Cloud,
    classify: Callable[[PointCloud], tuple[NDArray[np.uint8], NDArray[np.uint16]]],
    path: Path,
    *,
    flown: datetime,
) -> None:
    """Write a LAZ file (LAS 1.4) of points with ``Classification``, ``HeightAboveGround`` (m) and ``row_id``.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        Points with their heights above ground.
    classify : callable
        Gives the class and the row (n,) of every point of a part of the cloud.
    path : Path
        The file.
    flown : datetime
        Day of the flight, which its header states.

    Raises
    ------
    OSError
        If it can't be written.
    """
    import laspy
    from lazrs import LazrsError

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.creation_date = flown.date()
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(cloud.extent[0])
    crs = with_vertical(cloud.crs, cloud.vertical)
    header.add_crs(crs if vertical_unit(crs) == 1.0 else cloud.crs)  # as some datums are known in feet alone
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("HeightAboveGround", "float32", "metres above the terrain model"),
            laspy.ExtraBytesParams("row_id", "uint16", "vine row, 0 for none"),
        ]
    )
    backend = laspy.LazBackend.LazrsParallel
    try:
        with laspy.open(path, mode="w", header=header, do_compress=True, laz_backend=backend) as writer:
            for part in cloud.parts():
                points = laspy.ScaleAwarePointRecord.zeros(part.size, header=header)
                points.x, points.y, points.z = part.xyz.T
                points["classification"], points["row_id"] = classify(part)
                points["HeightAboveGround"] = part.heights
                writer.write_points(points)
    except LazrsError as error:
        raise OSError(f"{path.name}: {error}: is the disk full?") from error
