"""Ground for vineyards: slopes, terraces, and surfaces through given heights."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from collections.abc import Sequence

PLACE = (414750.0, 4940780.0)
"""Where scenes lie unless told otherwise: in Barolo, EPSG:32632."""
CELL, MARGIN = 1.5, 50.0
"""Metres: cells of the grid on which a surface through heights is held, and by which it is wider than these."""
Array = NDArray[np.float64]
Terrain = Callable[[Array, Array], Array]
"""Elevation (m) of the ground at x (east) and y (north)."""


def hillside(
    slope: float = 0.1,
    *,
    uphill: float = 90.0,
    undulation: float = 0.1,
    elevation: float = 300.0,
    centre: tuple[float, float] = PLACE,
    seed: int = 0,
) -> Terrain:
    """Plane of ``slope`` (rise over run) that rises towards ``uphill`` (degrees anticlockwise from east).

    ``undulation`` is the standard deviation (m) of waves of about 25 m on it, ``elevation`` its height at ``centre``.
    """
    bumps = waves(np.random.default_rng(seed), 25.0)
    dx, dy = slope * math.cos(math.radians(uphill)), slope * math.sin(math.radians(uphill))
    return lambda x, y: elevation + dx * (x - centre[0]) + dy * (y - centre[1]) + undulation * bumps(x, y)


def terraced(terrain: Terrain, rows: Sequence[Array], *, spacing: float = 2.5, riser: float = 0.8) -> Terrain:
    """Cut a slope into treads, level across each row, and risers ``riser`` m wide half way between rows."""
    points = np.concatenate(rows)
    tangents = np.concatenate([np.gradient(row, axis=0) for row in rows])
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]]) / np.linalg.norm(tangents, axis=1, keepdims=True)
    tree = cKDTree(points)

    def surface(x: Array, y: Array) -> Array:
        xy = np.column_stack([np.ravel(x), np.ravel(y)])
        nearest = tree.query(xy)[1]
        across = np.sum((xy - points[nearest]) * normals[nearest], axis=1)
        edge = np.clip((np.abs(across) - (spacing - riser) / 2) / (riser / 2), 0, 1)
        cut = np.minimum(np.abs(across), spacing / 2) * (1 - edge**2 * (3 - 2 * edge)) * np.sign(across)
        foot = xy - cut[:, None] * normals[nearest]
        return terrain(foot[:, 0], foot[:, 1]).reshape(np.shape(x))

    return surface


def surface_through(means: Sequence[tuple[Array, float]], base: Terrain) -> Terrain:
    """Bend ``base`` as little as possible (thin plate) until its mean over each set of points is as given.

    Parameters
    ----------
    means : sequence of (array (k, 2), float)
        Points and the mean elevation over them (m); a single point fixes the surface there.
    base : callable
        Surface to start from.
    """
    points = np.concatenate([xy for xy, _ in means])
    origin, upper = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    averaging = block_diag(*[np.full((1, len(xy)), 1 / len(xy)) for xy, _ in means])

    def kernel(a: Array) -> Array:
        squared = np.sum((a[:, None] - points[None]) ** 2, axis=-1)
        return np.asarray(squared * np.log(np.maximum(squared, 1e-12)))

    def plane(a: Array) -> Array:
        return np.column_stack([np.ones(len(a)), (a - origin) / 100])

    wanted = np.array([z for _, z in means]) - averaging @ base(*points.T)
    flat = averaging @ plane(points)
    system = np.block([[averaging @ kernel(points) @ averaging.T, flat], [flat.T, np.zeros((3, 3))]])
    weights = np.linalg.solve(system, np.concatenate([wanted, np.zeros(3)]))
    nx, ny = np.ceil((upper - origin) / CELL).astype(int) + 1
    nodes = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), axis=-1).reshape(-1, 2) * CELL + origin
    bend = [kernel(part) @ (averaging.T @ weights[:-3]) for part in np.array_split(nodes, len(nodes) // 1000 + 1)]
    grid = np.concatenate(bend) + plane(nodes) @ weights[-3:] + base(*nodes.T)
    spline = spline_filter(grid.reshape(nx, ny), order=3, mode="nearest")

    def surface(x: Array, y: Array) -> Array:
        at = np.stack([(x - origin[0]) / CELL, (y - origin[1]) / CELL])
        return np.asarray(map_coordinates(spline, at, order=3, mode="nearest", prefilter=False))

    return surface


def waves(rng: np.random.Generator, wavelength: float) -> Terrain:
    """Smooth random surface of mean 0 and variance 1, with waves of about ``wavelength`` (m)."""
    n = 8
    wave = 2 * np.pi / (wavelength * rng.uniform(0.7, 1.6, n))
    heading, phase = rng.uniform(0, 2 * np.pi, (2, n))

    def surface(x: Array, y: Array) -> Array:
        total = np.zeros(np.shape(x))
        for k in range(n):
            total += np.sin(wave[k] * (x * math.cos(heading[k]) + y * math.sin(heading[k])) + phase[k])
        return total * math.sqrt(2 / n)

    return surface
