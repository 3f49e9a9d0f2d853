"""Rays from above that meet leaves, trees, huts, roofs of leaves, nets, or the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from scipy.spatial import cKDTree

from vinemap.simulate.plants import EDGE, LAYERS, Stations, bulge
from vinemap.simulate.terrain import waves

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.simulate.terrain import Array, Terrain

STEPS = 14  # steps of a ray through a canopy
CELL = 0.25  # cells in which rays are dealt out (m)
TAN_WIDEST = math.tan(math.radians(35))


class Cells(NamedTuple):
    """Cells of :data:`CELL` m over a survey, row by row from its south-western corner."""

    corner: Array
    shape: tuple[int, int]
    """Cells from west to east, and from south to north."""
    centres: Array
    """(n, 2), m."""
    distance: Array
    """Metres (n,) to the nearest station of foliage."""
    nearest: NDArray[np.intp]
    """That station (n,); one past the last where none is near."""

    def of(self, xy: Array) -> NDArray[np.intp]:
        """Cell (m,) of points; of those outside, the outermost."""
        i, j = np.clip(((xy - self.corner) / CELL).astype(int), 0, np.subtract(self.shape, 1)).T
        return np.asarray(j * self.shape[0] + i)

    def station_at(self, xy: Array) -> NDArray[np.intp]:
        """Station (m,) nearest to the cell of points."""
        return np.asarray(self.nearest[self.of(xy)])


def cells_over(outline: shapely.Polygon, stations: Stations) -> Cells:
    """Cells of an outline's bounds, each with the station of foliage that is nearest, within 2 m."""
    corner = np.floor(np.array(outline.bounds[:2]))
    nx, ny = np.ceil((np.array(outline.bounds[2:]) - corner) / CELL).astype(int) + 1
    centres = (np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), axis=-1).reshape(-1, 2) + 0.5) * CELL + corner
    distance, nearest = cKDTree(stations.xy).query(centres, distance_upper_bound=2.0)
    return Cells(corner, (int(nx), int(ny)), centres, distance, nearest)


@dataclass(frozen=True)
class Obstacle:
    """A tree or bush (ellipsoid of leaves), or a hut, post or wall (solid box); metres, heights above its ground."""

    x: float
    y: float
    half_length: float
    half_width: float
    top: float
    bottom: float = 0.0
    solid: bool = False
    azimuth: float = 0.0
    """Direction of its length, degrees anticlockwise from east."""
    eaves: float | None = None
    """Height at which the roof of a solid begins that is a ridge along its length; by default the roof is flat."""

    @property
    def reach(self) -> float:
        """Metres from its middle within which a ray may end that it meets."""
        return math.hypot(self.half_length, self.half_width) + TAN_WIDEST * self.top + 1


@dataclass(frozen=True)
class Sheet:
    """What spreads over rows: a closed roof of leaves, or a net; metres above ground."""

    outline: shapely.Polygon
    height: float
    """Of its upper side, on the mean; it sags and bulges by ``sag``."""
    depth: float = 0.3
    caught: float = 0.75
    """Share of rays that it stops, more in some patches than in others."""
    sag: float = 0.05


def meet_leaves(
    rays: tuple[Array, Array],
    nearest: NDArray[np.intp],
    at_height: float,
    stations: Stations,
    rng: np.random.Generator,
) -> Array:
    """Height above ``aim`` at which rays meet a leaf of one row, 0 where they don't.

    Parameters
    ----------
    rays : arrays (n, 3), (n, 2)
        ``aim``, where they end on the ground, and ``lean``, their horizontal way for every metre up.
    nearest, at_height : array (n,), float
        The station nearest to a ray (one past the last: none near) where it passes this height above ``aim``.
    """
    aim, lean = rays
    met = np.zeros(len(aim))
    near = np.flatnonzero(nearest < len(stations.arc))
    if len(near) == 0:
        return met
    aim, lean, nearest = aim[near], lean[near], nearest[near]
    offset = aim[:, :2] + at_height * lean - stations.xy[nearest]
    (ax, ay), (lx, ly) = stations.along[nearest].T, lean.T
    s, ds = offset[:, 0] * ax + offset[:, 1] * ay, lx * ax + ly * ay  # along the row, from the station
    c, dc = offset[:, 1] * ax - offset[:, 0] * ay, ly * ax - lx * ay
    dc = np.where(np.abs(dc) < 1e-9, 1e-9, dc)

    widest = stations.half_width.max() + np.abs(stations.shift).max() + EDGE
    level = stations.ground[nearest] - aim[:, 2]
    one, two = at_height + (-widest - c) / dc, at_height + (widest - c) / dc
    high = np.minimum(level + stations.top.max(), np.maximum(one, two))
    low = np.maximum(np.maximum(level + stations.bottom.min(), 0.02), np.minimum(one, two))
    through = np.flatnonzero(high > low)
    s, ds, c, dc, high, low = (value[through] for value in (s, ds, c, dc, high, low))
    nearest, z = nearest[through], aim[through, 2]
    per_metre, last = 1 / stations.step[nearest], len(stations.arc) - 1

    drop = (high - low) / STEPS
    path = drop * np.sqrt(1 + np.sum(lean[through] ** 2, axis=1))
    depth, needed, rise = np.zeros(len(z)), rng.exponential(size=len(z)), np.zeros(len(z))
    up = high - drop * rng.random(len(z))
    for _ in range(STEPS):
        ahead = up - at_height
        cell = np.clip(nearest + np.rint((s + ahead * ds) * per_metre).astype(int), 0, last)
        base = stations.ground[cell] + stations.bottom[cell]
        relative = (z + up - base) / (stations.top[cell] - stations.bottom[cell])
        width = stations.half_width[cell] * bulge(relative)
        within = np.clip((width - np.abs(c + ahead * dc - stations.shift[cell])) / EDGE + 0.5, 0, 1)
        within[(relative < 0) | (relative >= 1)] = 0
        layer = (np.clip(relative, 0, 0.999) * LAYERS).astype(int)
        depth += within * stations.leaves[cell, layer] * path
        rise = np.where((rise == 0) & (depth >= needed), up, rise)
        up -= drop
    met[near[through]] = rise
    return met


def meet_things(
    rays: tuple[Array, Array],
    southings: Array,
    obstacles: Sequence[Obstacle],
    sheets: Sequence[Sheet],
    terrain: Terrain,
    rng: np.random.Generator,
) -> Array:
    """Height above ``aim`` at which rays meet the first of obstacles and sheets, 0 where they meet none.

    ``southings`` (n,) ascend: the y of rays' ends, to within a metre.
    """
    aim, lean = rays
    met = np.zeros(len(aim))
    for obstacle in obstacles:
        reach = obstacle.reach + 1
        near = slice(*np.searchsorted(southings, [obstacle.y - reach, obstacle.y + reach]))
        met[near] = np.maximum(met[near], meet_obstacle(aim[near], lean[near], obstacle, terrain, rng))
    for sheet in sheets:
        met = np.maximum(met, meet_sheet(aim, lean, sheet, terrain, rng))
    return met


def meet_obstacle(aim: Array, lean: Array, obstacle: Obstacle, terrain: Terrain, rng: np.random.Generator) -> Array:
    """Height above ``aim`` at which rays meet a tree or a hut, 0 where they don't."""
    met = np.zeros(len(aim))
    near = np.flatnonzero(np.hypot(aim[:, 0] - obstacle.x, aim[:, 1] - obstacle.y) < obstacle.reach)
    ground = float(terrain(np.array([obstacle.x]), np.array([obstacle.y]))[0])
    half_height = (obstacle.top - obstacle.bottom) / 2
    half = np.array([obstacle.half_length, obstacle.half_width, half_height])
    # In units of the half axes: a point of the ray is start + rise * way.
    cos, sin = math.cos(math.radians(obstacle.azimuth)), math.sin(math.radians(obstacle.azimuth))
    own_axes = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    start = (aim[near] - [obstacle.x, obstacle.y, ground + obstacle.bottom + half_height]) @ own_axes / half
    way = np.column_stack([lean[near], np.ones(len(near))]) @ own_axes / half
    if obstacle.solid:
        way = np.where(np.abs(way) < 1e-9, 1e-9, way)
        faces = np.sort([(-1 - start) / way, (1 - start) / way], axis=0)
        low, high = faces[0].max(axis=1), faces[1].min(axis=1)
        if obstacle.eaves is not None:
            pitch = (obstacle.top - obstacle.eaves) / half_height
            for side in (pitch, -pitch):
                above, steepness = start[:, 2] + side * start[:, 1] - 1, way[:, 2] + side * way[:, 1]
                high = np.minimum(high, np.where(steepness > 0, -above / steepness, np.inf))
                low = np.maximum(low, np.where(steepness < 0, -above / steepness, -np.inf))
        rise = high
    else:
        a, b, c = (way**2).sum(axis=1), (way * start).sum(axis=1), (start**2).sum(axis=1) - 1
        root = np.sqrt(np.maximum(b**2 - a * c, 0))
        low, high = (-b - root) / a, (-b + root) / a
        rise = high - rng.exponential(0.35, len(near))
    met[near] = np.where((rise > np.maximum(low, 0)) & (high > low), rise, 0)
    return met


def meet_sheet(aim: Array, lean: Array, sheet: Sheet, terrain: Terrain, rng: np.random.Generator) -> Array:
    """Height above ``aim`` at which rays meet a roof of leaves or a net, 0 where they don't."""
    at = aim[:, :2] + sheet.height * lean
    shapely.prepare(sheet.outline)
    under = np.flatnonzero(shapely.contains_xy(sheet.outline, *at.T))
    at, n = at[under], len(under)
    sag, patches = waves(rng, 5.0), waves(rng, 1.5)
    rise = sheet.height + sheet.sag * sag(*at.T) + terrain(*at.T) - aim[under, 2]
    rise -= sheet.depth * np.minimum(rng.exponential(0.4, n), 1)
    met = np.zeros(len(aim))
    met[under] = np.where(rng.random(n) < sheet.caught + 0.15 * patches(*at.T), np.maximum(rise, 0), 0)
    return met
