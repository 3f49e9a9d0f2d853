"""Filters of images in compiled code."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vinemap.compute.arrays import Flags, Floats, Values

MIRRORED, CARRIED_ON = 0.0, 1.0
"""What lies beyond the edges: the image again, or its outermost values. No whole numbers, which compile one by one."""


@compiled
def blurred_down(image: Values, sigma: float, edge: float) -> Values:
    """Image (n, m) smoothed along its columns by a Gaussian of a standard deviation in cells, cut off at four."""
    n, m = image.shape
    radius = int(4 * sigma + 0.5)
    weights = np.empty(radius + 1)
    total = 0.0
    for k in range(radius + 1):
        weights[k] = np.exp(-0.5 * (k / sigma) ** 2)
        total += weights[k] * (2.0 if k else 1.0)
    weights /= total
    lines, out = np.empty(n + 2 * radius, dtype=np.int64), np.empty((n, m))
    for at in range(n + 2 * radius):
        line = at - radius
        if edge == MIRRORED:
            line %= 2 * n
            line = min(line, 2 * n - 1 - line)
        lines[at] = min(max(line, 0), n - 1)
    for i in range(n):
        here = out[i]
        for j in range(m):
            here[j] = weights[0] * image[i, j]
        for k in range(1, radius + 1):
            a, b, weight = lines[i + radius - k], lines[i + radius + k], weights[k]
            for j in range(m):
                here[j] += weight * (image[a, j] + image[b, j])
    return out


@compiled
def blurred(image: Values, sigma: float) -> Values:
    """Image (n, m) smoothed both ways, mirrored beyond its edges, as of :func:`blurred_down`."""
    down = blurred_down(image, sigma, MIRRORED)
    return blurred_down(down.T.copy(), sigma, MIRRORED).T.copy()


def distance_to(cells: Flags) -> Floats:
    """Distance (ny, nx) in cells from each cell to the nearest of those marked, exact; inf where none is.

    By parabolas whose lower envelope is taken along the rows (Felzenszwalb & Huttenlocher, 2012).
    """
    ny, nx = cells.shape
    down, out = np.empty((ny, nx), dtype=np.int32), np.empty((ny, nx))
    in_threads(lambda part: _distance_down(*part, cells, down), stretches(nx))
    in_threads(lambda part: _distance_across(*part, down, out), stretches(ny))
    return out


@compiled
def _distance_down(first: int, last: int, cells: Flags, out: NDArray[np.int32]) -> None:
    """Distance (ny, nx) to the nearest marked cell of the same column, for columns from first to last - 1."""
    ny, nx = cells.shape
    far = ny + nx
    for i in range(ny):
        for j in range(first, last):
            above = out[i - 1, j] if i else far
            out[i, j] = 0 if cells[i, j] else min(above + 1, far)
    for i in range(ny - 2, -1, -1):
        for j in range(first, last):
            out[i, j] = min(out[i, j], out[i + 1, j] + 1)


@compiled
def _distance_across(first: int, last: int, down: NDArray[np.int32], out: Values) -> None:
    """Distance (ny, nx) to the nearest marked cell, of rows from first to last - 1."""
    ny, nx = down.shape
    far = ny + nx
    vertex, start = np.empty(nx, dtype=np.int64), np.empty(nx)
    for i in range(first, last):
        n = 0
        for j in range(nx):
            if down[i, j] == far:
                continue
            own = float(down[i, j]) ** 2 + j * j
            here = -np.inf
            while n:
                k = vertex[n - 1]
                here = (own - float(down[i, k]) ** 2 - k * k) / (2.0 * (j - k))
                if here > start[n - 1]:
                    break
                n -= 1
            vertex[n], start[n] = j, here if n else -np.inf
            n += 1
        p = 0
        for j in range(nx):
            if n == 0:
                out[i, j] = np.inf
                continue
            while p + 1 < n and start[p + 1] <= j:
                p += 1
            k = vertex[p]
            out[i, j] = math.sqrt(float(down[i, k]) ** 2 + float(j - k) ** 2)
