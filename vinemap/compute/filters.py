"""Gaussian filters in compiled code: rows' images are small, and many."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.compute.compiled import compiled

if TYPE_CHECKING:
    from vinemap.compute.arrays import Values

MIRRORED, CARRIED_ON = 0, 1
"""What lies beyond the edges: the image again, or its outermost values."""


@compiled
def blurred_down(image: Values, sigma: float, edge: int) -> Values:
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
