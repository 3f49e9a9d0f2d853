"""Convex hulls in a section, and areas of polygons.

Points are (y, z) in metres, z up and y drawn to the right; polygons run counter-clockwise. Compiled code takes them as
complex numbers y + iz.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.compute.compiled import compiled

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from vinemap.compute.arrays import Complex, Floats, Ints


def checked_start(start: ArrayLike, n: int) -> Ints:
    """Where each section's of n points begin (m + 1,); ValueError if they can't."""
    offsets = np.ascontiguousarray(start, dtype=np.int64)
    if len(offsets) == 0 or offsets[0] != 0 or offsets[-1] != n or np.any(np.diff(offsets) < 0):
        raise ValueError(f"start must climb from 0 to {n}")
    return offsets


def hull(points: ArrayLike) -> Ints:
    """Indices (h,) of the vertices of the convex hull of points (n, 2), counter-clockwise from the leftmost (Eq. 12).

    Of points that coincide the first is the vertex; points on the hull's edges are none.
    """
    section = as_complex(points)
    order = order_of(section)
    return order[ring_of(section[order])] if len(section) else order


def as_complex(points: ArrayLike) -> Complex:
    """Points (..., 2) as complex numbers (...)."""
    return np.ascontiguousarray(points, dtype=np.float64).reshape(*np.shape(points)[:-1], 2).view(np.complex128)[..., 0]


def as_pairs(points: Complex) -> Floats:
    """Complex numbers (...) as points (..., 2)."""
    return np.ascontiguousarray(points).view(np.float64).reshape(*points.shape, 2)


@compiled
def cross(a: complex, b: complex, p: complex) -> float:
    """Twice the area of (a, b, p): positive where p is left of a → b."""
    return (b.real - a.real) * (p.imag - a.imag) - (b.imag - a.imag) * (p.real - a.real)


@compiled
def area_of(polygon: Complex) -> float:
    """Shoelace area, positive if counter-clockwise (Eq. 13 without its absolute values)."""
    total = 0.0
    for i in range(2, len(polygon)):
        total += cross(polygon[0], polygon[i - 1], polygon[i])
    return total / 2


@compiled
def order_of(p: Complex) -> Ints:
    """Order by y, then z, then index (bottom-up merge sort)."""
    n = len(p)
    order, spare = np.arange(n), np.empty(n, dtype=np.int64)
    width = 1
    while width < n:
        for low in range(0, n, 2 * width):
            middle, high = min(low + width, n), min(low + 2 * width, n)
            i, j = low, middle
            for k in range(low, high):
                take = i < middle
                if take and j < high:
                    a, b = p[order[i]], p[order[j]]
                    take = a.real < b.real or (a.real == b.real and a.imag <= b.imag)
                if take:
                    spare[k] = order[i]
                    i += 1
                else:
                    spare[k] = order[j]
                    j += 1
        order, spare = spare, order
        width *= 2
    return order


@compiled
def append_to(p: Complex, chain: Ints, floor: int, size: int, i: int) -> int:
    """Add point i to the convex chain that begins at chain[floor], dropping those that it hides; the new size."""
    while size - floor >= 2 and cross(p[chain[size - 2]], p[chain[size - 1]], p[i]) <= 0:
        size -= 1
    chain[size] = i
    return size + 1


@compiled
def ring_of(p: Complex) -> Ints:
    """Positions on the hull of sorted points (monotone chain)."""
    n = len(p)
    chain = np.empty(n + 2, dtype=np.int64)
    lower = np.zeros(n, dtype=np.bool_)  # on a line, rounding could have a point on both chains
    floor = size = int(np.int64(0))  # a plain 0 would have `append_to` compiled twice
    for k in range(2 * n - 1):  # to the right over the lower points, back over the upper ones
        i = k if k < n else 2 * n - 2 - k
        if k == n:
            floor = size - 1
            for j in range(1, size):
                lower[chain[j]] = True
        if i == 0 or (p[i] != p[i - 1] and not lower[i]):
            size = append_to(p, chain, floor, size, i)
    return chain[: max(size - 1, 1)]


@compiled
def shared_area(polygon: Complex, convex: Complex) -> float:
    """Area that a polygon shares with a convex one, both counter-clockwise (Sutherland and Hodgman 1974)."""
    inside = polygon.copy()
    for k in range(len(convex)):
        a, b = convex[k - 1], convex[k]
        out = np.empty(2 * len(inside) + 2, dtype=np.complex128)
        size = 0
        for i in range(len(inside)):
            p, q = inside[i - 1], inside[i]
            left_p, left_q = cross(a, b, p), cross(a, b, q)
            if (left_p < 0) != (left_q < 0):
                out[size] = p + (q - p) * (left_p / (left_p - left_q))
                size += 1
            if left_q >= 0:
                out[size] = q
                size += 1
        inside = out[:size]
        if size < 3:
            return 0.0
    return area_of(inside)


def packed(points: Complex, at: Ints, size: Ints) -> tuple[Floats, Ints]:
    """Points (k, 2) that were written with room between them, ``size`` of them from each place on, and their starts."""
    start = np.concatenate([[0], np.cumsum(size)])
    return as_pairs(points[np.arange(start[-1]) + np.repeat(at - start[:-1], size)]), start
