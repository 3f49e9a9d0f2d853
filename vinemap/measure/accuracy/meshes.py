"""How far meshes are off, as their canopies' points tell it and as it is, on simulated vineyards."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vinemap.canopy.numbers import judge_canopies, summarise_rows
from vinemap.evaluate.meshes import PATCH, distances, measure_meshes
from vinemap.geo.curve import cross
from vinemap.simulate.plants import foliage_outlines

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.canopy.model import CanopyModel
    from vinemap.chain import RowMap
    from vinemap.compute.arrays import Flags, Floats, Ints
    from vinemap.simulate.plants import Foliage
    from vinemap.simulate.survey import Survey

APART = 0.04
"""Metres between points of the true surface, round a station."""


class MeshErrors(NamedTuple):
    """Errors of the meshes of a map, or of several."""

    told: Floats
    """``mesh_error_m`` (rows,), NaN where it isn't told."""
    true: Floats
    """The same of the true surface (rows,), NaN where none is near, as by a hedge."""

    @property
    def both(self) -> Flags:
        """Which rows' errors are told and true."""
        out: Flags = np.isfinite(self.told) & np.isfinite(self.true)
        return out


def compare_meshes(survey: Survey, found: RowMap, model: CanopyModel, *, step: float) -> MeshErrors:
    """Hold what is told of the meshes of a map, with sections every ``step`` metres, against its survey's foliage."""
    rows = judge_canopies(summarise_rows(found.rows, model.table, step=step), model.table, step=step)
    told = measure_meshes(found.cloud, model, rows, step=step)["mesh_error_m"].to_numpy(dtype=float)
    points, section = _beside(true_surface(survey), model)
    near = distances(points, section, model.at, model.polygons, step=step)
    seen = np.isfinite(near.distance) & (near.patch >= 0)
    off, row = np.abs(near.distance[seen]), model.at.row_id[section[seen]]
    true = [np.median(off[row == one]) if (row == one).any() else np.nan for one in rows["row_id"]]
    return MeshErrors(told, np.array(true, dtype=float))


def pool_meshes(errors: Sequence[MeshErrors]) -> MeshErrors:
    """Errors of several maps as those of one."""
    return MeshErrors(*(np.concatenate(values) for values in zip(*errors, strict=True)))


def true_surface(survey: Survey) -> Floats:
    """Points (n, 3) at equal steps over the foliage of every station, from foot to foot, leaves' reach included."""
    foliage = survey.foliage
    if len(foliage.row) == 0:
        return np.empty((0, 3))
    outlines = foliage_outlines(foliage)
    way = np.cumsum(np.hypot(*np.diff(outlines, axis=1, prepend=outlines[:, :1]).transpose(2, 0, 1)), axis=1)
    n = np.maximum(np.round(way[:, -1] / APART).astype(int), 1)
    round_ = [
        np.column_stack([np.interp((np.arange(k) + 0.5) / k * along[-1], along, side) for side in ring.T])
        for k, along, ring in zip(n, way, outlines, strict=True)
    ]
    station, across = np.repeat(np.arange(len(n)), n), np.concatenate(round_)
    along = _ways(foliage)[station]
    left = np.column_stack([-along[:, 1], along[:, 0]])
    ground = survey.terrain(*foliage.xy.T)[station]
    return np.column_stack([foliage.xy[station] + across[:, :1] * left, ground + across[:, 1]])


def _ways(foliage: Foliage) -> Floats:
    """Unit tangents (n, 2) of the rows at stations: the way between those beside that are of the same stretch."""
    step = np.diff(foliage.xy, axis=0)
    parted = (np.diff(foliage.row) != 0) | (np.hypot(*step.T) > 2 * foliage.step[1:])
    step[parted] = 0.0
    way = np.pad(step, [(1, 0), (0, 0)]) + np.pad(step, [(0, 1), (0, 0)])
    out: Floats = way / np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    return out


def _beside(points: Floats, model: CanopyModel) -> tuple[Floats, Ints]:
    """Points of a surface beside sections, within half the rows' spacing, and the section of each, climbing."""
    if len(points) == 0 or len(model.at.origin) == 0:
        return np.empty((0, 3)), np.empty(0, dtype=np.int64)
    section = cKDTree(model.at.origin[:, :2]).query(points[:, :2])[1]
    away, way = points[:, :2] - model.at.origin[section, :2], model.at.tangent[section]
    along, left = (away * way).sum(axis=1), cross(way, away)
    chosen = np.flatnonzero((np.abs(along) <= PATCH / 2) & (np.abs(left) < model.at.spacing[section] / 2))
    chosen = chosen[np.argsort(section[chosen], kind="stable")]
    return points[chosen], section[chosen]
