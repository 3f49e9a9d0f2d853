"""Ground among the points of a cloud, classified by filters of PDAL: its own, or a pipeline of its users."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from vinemap.cloud.pdal.engine import load_pdal, stages_of
from vinemap.cloud.pdal.stages import classify
from vinemap.cloud.points import PointCloud
from vinemap.compute.apart import apart
from vinemap.errors import InputError, VinemapError, WorkerError, reason_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from vinemap.cloud.tiles import Cloud, Collector, TiledCloud
    from vinemap.compute.arrays import Floats
    from vinemap.config.settings import GroundOptions

AROUND = 25.0
"""Metres around a tile whose points a filter sees as well, so that tiles have no edges: more than houses are wide."""
ASTRAY = 1.0
"""Metres by which stages may move points, as where they thin them to the middles of cells."""


def classified(cloud: Cloud, ground: GroundOptions, collector: Collector) -> Cloud:
    """A cloud with the classes that PDAL's filters give its points: 2 for ground.

    Filters see the points of a cloud in memory all at once, those of one in tiles tile by tile, with what is around.
    They are given X, Y and Z in metres alone.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        Points.
    ground : GroundOptions
        Which filters, with which options.
    collector : Collector
        Takes the tiles' points anew.

    Raises
    ------
    DependencyError
        If PDAL can't be loaded.
    ConfigError
        If the pipeline can't be used.
    InputError
        If PDAL can't run the filters, they leave no point, or move them elsewhere.
    """
    load_pdal()
    stages = stages_of(ground)
    name = str(ground.pipeline or stages[0]["type"])
    if isinstance(cloud, PointCloud):
        points = np.concatenate([np.empty((0, 4)), *_run(stages, cloud.xyz, None, name)])
        _check(len(points), points, *cloud.extent, name)
        classes = points[:, 3].astype(np.uint8)
        return PointCloud(
            np.ascontiguousarray(points[:, :3]),
            cloud.crs,
            cloud.vertical,
            classification=classes,
            remarks=cloud.remarks,
        )
    collector.most = 0
    for xyz, own in _with_surroundings(cloud):
        for points in _run(stages, xyz, own, name):
            _check(1, points, xyz.min(axis=0), xyz.max(axis=0), name)
            if len(points):
                collector.add(points)
    _check(collector.size, np.empty((0, 4)), *cloud.extent, name)
    return replace(collector.cloud(cloud.crs, cloud.vertical), remarks=cloud.remarks)


def _with_surroundings(cloud: TiledCloud) -> Iterator[tuple[Floats, NDArray[np.bool_]]]:
    """Points (n, 3) of every tile and of what is around it, and which of them are its own."""
    for tile in cloud.tiles:
        box = shapely.box(*tile.low[:2], *tile.high[:2])
        low, high = tile.low[:2] - AROUND, tile.high[:2] + AROUND
        parts, own = [], []
        for part in cloud.parts(box, AROUND):
            near = part.xyz[((part.xyz[:, :2] >= low) & (part.xyz[:, :2] <= high)).all(axis=1)]
            parts.append(near)
            own.append(np.full(len(near), part.first == tile.first))
        yield np.concatenate(parts), np.concatenate(own)


def _run(
    stages: Sequence[dict[str, Any]], xyz: Floats, own: NDArray[np.bool_] | None, name: str
) -> Iterator[NDArray[np.float64]]:
    try:
        with closing(apart(classify, stages, xyz, own)) as parts:
            yield from parts
    except WorkerError as error:
        if error.heals:
            raise
        raise InputError(f"{name}: PDAL can't run it on this cloud ({error})") from error
    except VinemapError:
        raise
    except (RuntimeError, OSError, ValueError) as error:
        reason = reason_of(error)[:200]
        raise InputError(f"{name}: PDAL can't run it on this cloud ({reason})") from error


def _check(n: int, points: Floats, low: Floats, high: Floats, name: str) -> None:
    """Make sure that stages leave points, and leave them where they were."""
    if n == 0:
        raise InputError(f"{name}: leaves no point of the cloud")
    if len(points) and (
        (points[:, :2].min(axis=0) < low[:2] - ASTRAY).any() or (points[:, :2].max(axis=0) > high[:2] + ASTRAY).any()
    ):
        raise InputError(f"{name}: moves points to elsewhere: leave out what changes x and y")
