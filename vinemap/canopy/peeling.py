"""Outliers of a section peeled off its hull (Algorithm 1)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.canopy.hull import append_to, area_of, as_complex, checked_start, cross, order_of, packed, ring_of
from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from vinemap.compute.arrays import Complex, Flags, Floats, Ints


class Peeled(NamedTuple):
    """What is left of m sections of n points once their outliers are peeled off."""

    kept: Flags
    """(n,) False for outliers and non-finite points."""
    area: Floats
    """(m,) area of the kept points' convex hull, m²; NaN for fewer than 3 finite points."""
    perimeter: Floats
    """(m,) length of that hull's outline, m."""
    hull: Floats
    """(h, 2) the hulls' vertices, section after section, counter-clockwise, m."""
    start: Ints
    """(m + 1,) where each section's begin; none for fewer than 3 finite points."""


def peel_sections(points: ArrayLike, start: ArrayLike, *, share: float = 0.02) -> Peeled:
    """Peel a share of every section's points, rounded up, off as outliers (Algorithm 1).

    Each is the hull vertex without which the hull's area shrinks most (ties: the first). At least 3 points stay, and
    all those of a hull that has no area left.

    Parameters
    ----------
    points : array_like of shape (n, 2)
        (y, z) of all sections, section after section, m.
    start : array_like of shape (m + 1,)
        Section k holds ``points[start[k]:start[k + 1]]``.
    share : float
        Share of a section's points.

    Raises
    ------
    ValueError
        If share or start is out of bounds.
    """
    if not 0 <= share < 1:
        raise ValueError(f"share is {share}: give a share of the points in [0, 1)")
    section = as_complex(points)
    offsets = checked_start(start, len(section))
    m = len(offsets) - 1
    kept, area, perimeter = np.isfinite(section), np.full(m, math.nan), np.full(m, math.nan)
    hulls, size = np.empty(len(section), dtype=np.complex128), np.zeros(m, dtype=np.int64)
    in_threads(lambda part: _peel_all(*part, section, offsets, share, kept, area, perimeter, hulls, size), stretches(m))
    return Peeled(kept, area, perimeter, *packed(hulls, offsets[:-1], size))


@compiled
def _walk(p: Complex, inner: Flags, chain: Ints, size: int, stop: int) -> int:
    """Extend the chain from its last point to ``stop`` over the inner points right of the line between them."""
    floor = size - 1
    first = chain[floor]
    a, b = p[first], p[stop]
    step = 1 if stop > first else -1
    for i in range(first + step, stop, step):
        if inner[i] and cross(a, b, p[i]) < 0 and not (i > 0 and inner[i - 1] and p[i] == p[i - 1]):
            size = append_to(p, chain, floor, size, i)
    return append_to(p, chain, floor, size, stop) if stop != first else size


@compiled
def _expose(p: Complex, inner: Flags, ring: Ints, u: int, chain: Ints) -> tuple[int, float]:
    """Hull from one neighbour of u to the other once u is gone: size of ``chain``, and twice the area lost."""
    a, b = ring[0, u], ring[1, u]
    chain[0] = a
    if u + 1 < len(p) and inner[u + 1] and p[u + 1] == p[u]:
        chain[1], chain[2] = u + 1, b
        return 3, 0.0
    size = int(np.int64(1))  # a plain 1 would have `_walk` compiled twice
    if (a < u) != (u < b):  # u is the leftmost or rightmost: the chain turns at the one that takes its place
        step = 1 if u < a else -1
        end = u + step
        while end not in (a, b) and (not inner[end] or p[end] == p[a] or p[end] == p[b]):
            end += step
        while end > 0 and inner[end] and inner[end - 1] and p[end] == p[end - 1]:
            end -= 1
        size = _walk(p, inner, chain, size, end)
    turned = size
    for k in range(1, turned):  # on a line, rounding could have these found again on the way back
        inner[chain[k]] = False
    size = _walk(p, inner, chain, size, b)
    for k in range(1, turned):
        inner[chain[k]] = chain[k] != b
    loss = cross(p[a], p[u], p[b])
    for k in range(2, size):
        loss -= cross(p[a], p[chain[k - 1]], p[chain[k]])
    return size, loss


@compiled
def _peel(p: Complex, index: Ints, count: int) -> tuple[Ints, Ints]:
    """Positions removed from sorted points, in order, and those on the hull that is left; ``index`` breaks ties."""
    n = len(p)
    vertices = ring_of(p)
    size = len(vertices)
    removed = np.empty(max(min(count, n - 3), 0), dtype=np.int64)
    if len(removed) == 0 or size < 3:
        return removed[:0], vertices
    ring, chain = np.empty((2, n), dtype=np.int64), np.empty(n + 1, dtype=np.int64)
    loss, inner = np.empty(n), np.ones(n, dtype=np.bool_)
    for k in range(size):
        u, v = vertices[k - 1], vertices[k]
        ring[1, u], ring[0, v], inner[v] = v, u, False
    for u in vertices:
        loss[u] = _expose(p, inner, ring, u, chain)[1]
    head, done = vertices[0], 0
    while done < len(removed) and size >= 3:
        best, u = head, ring[1, head]
        while u != head:
            if loss[u] > loss[best] or (loss[u] == loss[best] and index[u] < index[best]):
                best = u
            u = ring[1, u]
        removed[done] = best
        done += 1
        head, u = ring[0, best], ring[1, best]
        length = _expose(p, inner, ring, best, chain)[0]
        size += length - 3
        for k in range(1, length):
            ring[1, chain[k - 1]], ring[0, chain[k]], inner[chain[k]] = chain[k], chain[k - 1], False
        for _ in range(length if size >= 3 else 0):
            loss[u] = _expose(p, inner, ring, u, chain)[1]
            u = ring[0, u]
    left = np.empty(size, dtype=np.int64)
    for k in range(size):
        left[k] = head
        head = ring[1, head]
    return removed[:done], left


@compiled
def _peel_all(
    first: int,
    last: int,
    points: Complex,
    start: Ints,
    share: float,
    kept: Flags,
    area: Floats,
    perimeter: Floats,
    hulls: Complex,
    size: Ints,
) -> None:
    """Peel sections, and write of their hulls the areas, perimeters, vertices and numbers of them."""
    for k in range(first, last):
        here, n = np.empty(start[k + 1] - start[k], dtype=np.int64), 0
        for i in range(start[k], start[k + 1]):
            if kept[i]:
                here[n] = i
                n += 1
        if n < 3:
            continue
        p = points[here[:n]]
        order = order_of(p)
        p = p[order]
        removed, ring = _peel(p, order, math.ceil(share * n - 1e-9))
        for i in removed:
            kept[here[order[i]]] = False
        for i in range(len(ring)):
            hulls[start[k] + i] = p[ring[i]]
        hull = hulls[start[k] : start[k] + len(ring)]
        area[k], size[k], perimeter[k] = area_of(hull), len(ring), 0.0
        for i in range(len(ring)):
            perimeter[k] += abs(hull[i] - hull[i - 1])
