"""Sections of canopy: convex hull, outlier peeling (Algorithm 1) and the minimum-area c-gon (Problem 1).

A section's points are (y, z) in metres, z up and y drawn to the right; polygons run counter-clockwise.
Compiled code takes them as complex numbers y + iz; it stays in one file, as compiled functions must.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.compute.threads import compiled, in_threads, stretches

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Points = NDArray[np.complex128]
    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

FLAT = 1e-12
"""Share of a section's extent below which a vertex of its outline stands on its neighbours' line."""
SNAP = 1e-6
"""Share of a section's extent within which a foot that was moved is set on the hull's vertex."""
BLUNT = 0.5
"""Cosine of the turn up to which a corner of a grown outline stays one; sharper ones are cut."""
LONGEST = 256
"""An outline of more edges is first simplified from outside: no two edges in a row turn by less than 360°/LONGEST."""


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


class Enclosures(NamedTuple):
    """The c-gons of m sections that hold n points."""

    polygon: Floats
    """(m, c, 2) v1 … vc, counter-clockwise, m; NaN where not valid."""
    valid: Flags
    """(m,) False for fewer than 3 finite points or a non-finite fixed vertex."""
    kept: Flags
    """(n,) False for outliers and non-finite points."""
    hull_area: Floats
    """(m,) area of the kept points' convex hull, m²."""
    area: Floats
    """(m,) area of the c-gon, m²."""
    shared_area: Floats
    """(m,) area that the c-gon and that hull share, m²."""


def peel_sections(points: ArrayLike, start: ArrayLike, *, share: float = 0.02) -> Peeled:
    """Peel a share of every section's points, rounded up, off as outliers; at least 3 points stay (Algorithm 1).

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
    section = as_complex(points)
    offsets = _checked(start, len(section), share)
    m = len(offsets) - 1
    kept, area, perimeter = np.isfinite(section), np.full(m, math.nan), np.full(m, math.nan)
    hulls, size = np.empty(len(section), dtype=np.complex128), np.zeros(m, dtype=np.int64)
    in_threads(lambda part: _peel_all(*part, section, offsets, share, kept, area, perimeter, hulls, size), stretches(m))
    return Peeled(kept, area, perimeter, *_packed(hulls, offsets[:-1], size))


def _packed(points: Points, at: Ints, size: Ints) -> tuple[Floats, Ints]:
    """Points (k, 2) that were written with room between them, ``size`` of them from each place on, and their starts."""
    start = np.concatenate([[0], np.cumsum(size)])
    return as_pairs(points[np.arange(start[-1]) + np.repeat(at - start[:-1], size)]), start


def grow(points: ArrayLike, start: ArrayLike, feet: ArrayLike, reach: ArrayLike) -> tuple[Floats, Ints, Floats]:
    """Outline of every section's foliage: the convex hull of its points and its feet, and what lies within reach of it.

    Parameters
    ----------
    points, start : array_like of shape (n, 2), (m + 1,)
        As in :func:`peel_sections`.
    feet : array_like of shape (m, 3, 2)
        v1 (bottom, middle), v2 (right foot, positive y) and vc (left foot), m.
    reach : array_like of shape (m,)
        Metres by which edges are moved outward.

    Returns
    -------
    points : array (k, 2)
        Vertices of the outlines, section after section; sharp corners are cut.
    start : array (m + 1,)
        Where each section's begin.
    feet : array (m, 3, 2)
        The feet, moved down by the reach and outward by half of it.
    """
    section = as_complex(points)
    offsets = _checked(start, len(section), 0.0)
    fixed, out = as_complex(feet).reshape(-1, 3), np.asarray(reach, dtype=float)
    room = offsets + 2 * np.arange(len(offsets))
    outline, size = np.empty(2 * room[-1], dtype=np.complex128), np.zeros(len(fixed), dtype=np.int64)
    in_threads(lambda part: _grow_all(*part, section, offsets, fixed, out, outline, size), stretches(len(size)))
    left = np.where(fixed[:, 1].real >= fixed[:, 2].real, 0.5, -0.5)
    moved = fixed + out[:, None] * np.stack([0 * left - 1j, left - 1j, -left - 1j], axis=1)
    return *_packed(outline, 2 * room[:-1], size), as_pairs(moved)


def enclose(
    points: ArrayLike, start: ArrayLike, feet: ArrayLike, *, c: int = 7, share: float = 0.02, slide: bool = False
) -> Enclosures:
    """Peel every section's outliers and enclose the rest in the c-gon of minimum area whose v1, v2, vc are given.

    The polygon leaves v2 and arrives at vc along the hull of (kept points, v2, vc), so all kept points are left of all
    its edges but the two at v1; those cut points off where v1, v2, vc are not below them. v1 may be reflex.

    Where the fixed vertices don't fit the points they give way: feet in the wrong order are swapped, a foot inside the
    hull moves out sideways, at its height, to the hull (v2 to the right, vc to the left), and a v1 beyond the canopy
    becomes the middle of the feet. Where the outline has fewer than c vertices its longest edges are halved.

    Parameters
    ----------
    points : array_like of shape (n, 2)
        (y, z) of all sections, section after section, m.
    start : array_like of shape (m + 1,)
        Section k holds ``points[start[k]:start[k + 1]]``.
    feet : array_like of shape (m, 3, 2)
        The fixed vertices v1 (bottom, middle), v2 (right foot) and vc (left foot).
    c : int
        Number of vertices, 5 or more (with 4 the polygon may have to be infinite).
    share : float
        Share of a section's points to peel, rounded up; at least 3 points stay.
    slide : bool
        Whether v2 and vc may slide along the hull's edge that holds v1, to where the area is least; where no edge
        does they stay.

    Raises
    ------
    ValueError
        If c, share or start is out of bounds.

    Notes
    -----
    Algorithm 1 and Eq. 12-19 of the thesis; the bilinear programme's optimum is found exactly, by choosing edges.
    """
    section, fixed = as_complex(points), as_complex(feet).reshape(-1, 3)
    offsets = _checked(start, len(section), share)
    if c < 5:
        raise ValueError(f"c is {c}: a c-gon with three fixed vertices needs c >= 5")
    if len(offsets) != len(fixed) + 1:
        raise ValueError(f"start must climb from 0 to {len(section)} in {len(fixed) + 1} numbers")
    m = len(fixed)
    polygon, kept, areas = np.full((m, c), complex(math.nan, math.nan)), np.isfinite(section), np.full((3, m), math.nan)
    in_threads(
        lambda part: _enclose_all(*part, section, offsets, fixed, share, slide, polygon, kept, areas), stretches(m)
    )
    return Enclosures(as_pairs(polygon), np.isfinite(areas[1]), kept, *areas)


def _checked(start: ArrayLike, n: int, share: float) -> Ints:
    offsets = np.ascontiguousarray(start, dtype=np.int64)
    if not 0 <= share < 1:
        raise ValueError(f"share is {share}: give a share of the points in [0, 1)")
    if len(offsets) == 0 or offsets[0] != 0 or offsets[-1] != n or np.any(np.diff(offsets) < 0):
        raise ValueError(f"start must climb from 0 to {n}")
    return offsets


def hull(points: ArrayLike) -> Ints:
    """Indices (h,) of the vertices of the convex hull of points (n, 2), counter-clockwise from the leftmost (Eq. 12).

    Of points that coincide the first is the vertex; points on the hull's edges are none.
    """
    section = as_complex(points)
    order = _sorted(section)
    return order[_hull(section[order])] if len(section) else order


def peel(points: ArrayLike, count: int) -> Ints:
    """Indices of up to ``count`` outliers among points (n, 2), in the order of their removal (Algorithm 1).

    Each is the hull vertex without which the hull's area shrinks most (ties: the lowest index). Stops at 3 points, and
    where the hull has no area left.
    """
    section = as_complex(points)
    order = _sorted(section)
    return order[_peel(section[order], order, count)[0]] if len(section) else order


def as_complex(points: ArrayLike) -> Points:
    """Points (..., 2) as complex numbers (...)."""
    return np.ascontiguousarray(points, dtype=np.float64).reshape(*np.shape(points)[:-1], 2).view(np.complex128)[..., 0]


def as_pairs(points: Points) -> Floats:
    """Complex numbers (...) as points (..., 2)."""
    return np.ascontiguousarray(points).view(np.float64).reshape(*points.shape, 2)


@compiled
def _cross(a: complex, b: complex, p: complex) -> float:
    """Twice the area of (a, b, p): positive where p is left of a → b."""
    return (b.real - a.real) * (p.imag - a.imag) - (b.imag - a.imag) * (p.real - a.real)


@compiled
def _area(polygon: Points) -> float:
    """Shoelace area, positive if counter-clockwise (Eq. 13 without its absolute values)."""
    total = 0.0
    for i in range(2, len(polygon)):
        total += _cross(polygon[0], polygon[i - 1], polygon[i])
    return total / 2


@compiled
def _sorted(p: Points) -> Ints:
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
def _append(p: Points, chain: Ints, floor: int, size: int, i: int) -> int:
    """Add point i to the convex chain that begins at chain[floor], dropping those that it hides; the new size."""
    while size - floor >= 2 and _cross(p[chain[size - 2]], p[chain[size - 1]], p[i]) <= 0:
        size -= 1
    chain[size] = i
    return size + 1


@compiled
def _hull(p: Points) -> Ints:
    """Positions on the hull of sorted points (monotone chain)."""
    n = len(p)
    chain = np.empty(n + 2, dtype=np.int64)
    lower = np.zeros(n, dtype=np.bool_)  # on a line, rounding could have a point on both chains
    floor, size = 0, 0
    for k in range(2 * n - 1):  # to the right over the lower points, back over the upper ones
        i = k if k < n else 2 * n - 2 - k
        if k == n:
            floor = size - 1
            for j in range(1, size):
                lower[chain[j]] = True
        if i == 0 or (p[i] != p[i - 1] and not lower[i]):
            size = _append(p, chain, floor, size, i)
    return chain[: max(size - 1, 1)]


@compiled
def _walk(p: Points, inner: Flags, chain: Ints, size: int, stop: int) -> int:
    """Extend the chain from its last point to ``stop`` over the inner points right of the line between them."""
    floor = size - 1
    first = chain[floor]
    a, b = p[first], p[stop]
    step = 1 if stop > first else -1
    for i in range(first + step, stop, step):
        if inner[i] and _cross(a, b, p[i]) < 0 and not (i > 0 and inner[i - 1] and p[i] == p[i - 1]):
            size = _append(p, chain, floor, size, i)
    return _append(p, chain, floor, size, stop) if stop != first else size


@compiled
def _expose(p: Points, inner: Flags, ring: Ints, u: int, chain: Ints) -> tuple[int, float]:
    """Hull from one neighbour of u to the other once u is gone: size of ``chain``, and twice the area lost."""
    a, b = ring[0, u], ring[1, u]
    chain[0] = a
    if u + 1 < len(p) and inner[u + 1] and p[u + 1] == p[u]:
        chain[1], chain[2] = u + 1, b
        return 3, 0.0
    size = 1
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
    loss = _cross(p[a], p[u], p[b])
    for k in range(2, size):
        loss -= _cross(p[a], p[chain[k - 1]], p[chain[k]])
    return size, loss


@compiled
def _peel(p: Points, index: Ints, count: int) -> tuple[Ints, Ints]:
    """Positions removed from sorted points, in order, and those on the hull that is left; ``index`` breaks ties."""
    n = len(p)
    vertices = _hull(p)
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
def _place(ring: Points, foot: complex, side: float, extent: float) -> tuple[int, float, complex]:
    """Edge of the ring that holds a foot, where on it (0-1), and the foot, moved out sideways if it is inside.

    Side is 1 for the right foot, which starts the outline and so an edge, and -1 for the left one, which ends one.
    """
    m = len(ring)
    at, share, reach = (m // 2, 0.0, -math.inf) if side > 0 else (m - 1, 1.0, -math.inf)
    for k in range(m):
        a, d = ring[k], ring[(k + 1) % m] - ring[k]
        if foot == a:
            return (k, 0.0, foot) if side > 0 else ((k - 1) % m, 1.0, foot)
        t = (foot.imag - a.imag) / d.imag if d.imag != 0 else math.nan
        if 0 < foot.real - a.real < d.real and abs(_cross(a, a + d, foot)) <= FLAT * extent * abs(d):
            at, share, reach = k, (foot.real - a.real) / d.real, math.inf  # on the underside: it stays
        elif side * d.imag > 0 and 0 <= t <= 1 and side * (a.real + t * d.real) > reach:
            at, share, reach = k, t, side * (a.real + t * d.real)
    a, d = ring[at], ring[(at + 1) % m] - ring[at]
    if share * abs(d) <= SNAP * extent:
        return (at, 0.0, a) if side > 0 else ((at - 1) % m, 1.0, a)
    if (1 - share) * abs(d) <= SNAP * extent:
        return ((at + 1) % m, 0.0, a + d) if side > 0 else (at, 1.0, a + d)
    return at, share, a + share * d


@compiled
def _outline(rest: Points, right: complex, left: complex) -> Points:
    """Vertices (n + 1,) of the hull of a convex polygon and both feet, from the right foot round to the left one."""
    corners = np.empty(len(rest) + 2, dtype=np.complex128)
    corners[0], corners[1] = right, left
    for k in range(len(rest)):
        corners[k + 2] = rest[k]
    corners = corners[_sorted(corners)]
    ring = corners[_hull(corners)]
    m = len(ring)
    low, high = corners[0].imag, corners[0].imag
    for corner in corners:
        low, high = min(low, corner.imag), max(high, corner.imag)
    extent = max(corners[-1].real - corners[0].real, high - low)
    first, t, right = _place(ring, right, 1.0, extent)
    last, u, left = _place(ring, left, -1.0, extent)
    between = (last - first) % m if first != last else (0 if t < u else m)
    out = np.empty(between + 2, dtype=np.complex128)
    out[0] = right
    size = 1
    for k in range(1, between + 1):
        p, q, ahead = out[size - 1], ring[(first + k) % m], ring[(first + k + 1) % m] if k < between else left
        backward = ((q - p) * (ahead - q).conjugate()).real < 0
        if backward or _cross(p, ahead, q) < -FLAT * extent * abs(ahead - p):
            out[size] = q
            size += 1
    out[size] = left
    return out[: size + 1]


@compiled
def _turn(q: Points, i: int, j: int) -> float:
    """Sine of the turn from edge i of the outline to edge j, times their lengths; 0 where it is 0 or 180°."""
    a, b = q[i + 1] - q[i], q[j + 1] - q[j]
    sine = a.real * b.imag - a.imag * b.real
    return sine if abs(sine) > FLAT * abs(a) * abs(b) else 0.0


@compiled
def _corner(q: Points, i: int, j: int) -> tuple[complex, float]:
    """Where edges i < j of the outline meet, and twice the area of (q[i + 1], corner, q[j]); infinite if they don't."""
    turn = _turn(q, i, j)
    if j == i + 1 or turn <= 0:
        return q[j], 0.0 if j == i + 1 else math.inf
    corner = q[i + 1] + _cross(q[j], q[j + 1], q[i + 1]) / turn * (q[i + 1] - q[i])
    return corner, _cross(q[i + 1], corner, q[j])


@compiled
def _tangent(q: Points, i: int, j: int) -> tuple[complex, complex, float]:
    """Ends of the edge between edges i < j that touches the outline at its midpoint, where that can beat flush edges.

    That is where i and j turn by more than 180°. The area is twice that of (q[i + 1], end, end, q[j]), else infinite.
    """
    one, two, least = q[0], q[0], math.inf
    turn = _turn(q, i, j)
    if turn >= 0:
        return one, two, least
    a, b = q[i + 1] - q[i], q[j + 1] - q[j]
    for k in range(i + 2, j):
        w = 2 * q[k] - q[i] - q[j]
        p = q[i] + (w.real * b.imag - w.imag * b.real) / turn * a
        r = q[j] + (a.real * w.imag - a.imag * w.real) / turn * b
        if _cross(p, r, q[k - 1]) >= 0 and _cross(p, r, q[k + 1]) >= 0 and _cross(q[i + 1], p, r) >= 0:
            added = _cross(q[i + 1], p, r) + _cross(q[i + 1], r, q[j])
            if added < least:
                one, two, least = p, r, added
    return one, two, least


@compiled
def _choose(q: Points, c: int) -> Points:
    """The c - 3 free vertices: c - 2 of the outline's edges, first and last included, that add the least area to it.

    All are flush but at most one; no vertices where no choice closes the polygon. State of the dynamic programme:
    whether the one not flush is spent, edges used so far, the last of them.
    """
    n, edges = len(q) - 1, c - 2
    swept = np.zeros(n + 1)
    for k in range(2, n + 1):
        swept[k] = swept[k - 1] + _cross(q[0], q[k - 1], q[k])
    cost, origin = np.full((2, edges, n), math.inf), np.zeros((2, edges, n), dtype=np.int64)
    cost[0, 0, 0] = 0
    for j in range(1, n):
        for i in range(j):
            chain = swept[j] - swept[i + 1] - _cross(q[0], q[i + 1], q[j])
            flush, skip = _corner(q, i, j)[1] - chain, _tangent(q, i, j)[2] - chain
            for used in range(1, edges):
                for spent in range(2):
                    if cost[spent, used - 1, i] + flush < cost[spent, used, j]:
                        cost[spent, used, j], origin[spent, used, j] = cost[spent, used - 1, i] + flush, i
                if used > 1 and cost[0, used - 2, i] + skip < cost[1, used, j]:
                    cost[1, used, j], origin[1, used, j] = cost[0, used - 2, i] + skip, -1 - i
    if min(cost[0, edges - 1, n - 1], cost[1, edges - 1, n - 1]) == math.inf:
        return q[:0]
    return _trace(q, origin, 1 if cost[1, edges - 1, n - 1] < cost[0, edges - 1, n - 1] else 0)


@compiled
def _trace(q: Points, origin: Ints, spent: int) -> Points:
    """The vertices of a choice, from its last edge back."""
    used, j = origin.shape[1] - 1, origin.shape[2] - 1
    free = np.empty(used, dtype=np.complex128)
    while used > 0:
        i = origin[spent, used, j]
        if i >= 0:
            free[used - 1] = _corner(q, i, j)[0]
            used -= 1
        else:
            i, spent = -1 - i, 0
            free[used - 2], free[used - 1], _ = _tangent(q, i, j)
            used -= 2
        j = i
    return free


@compiled
def _simplify(q: Points) -> Points:
    """A circumscribed outline of fewer edges (see LONGEST), first and last edge kept."""
    n, size, last = len(q) - 1, 1, 0
    out = np.empty_like(q)
    out[0] = q[0]
    for j in range(1, n):
        a, b = q[last + 1] - q[last], q[min(j + 2, n)] - q[min(j + 1, n - 1)]
        w = a.conjugate() * b
        if j == n - 1 or not 0 <= math.atan2(w.imag, w.real) <= math.tau / LONGEST:
            out[size] = _corner(q, last, j)[0]
            size, last = size + 1, j
    out[size] = q[n]
    return out[: size + 1]


@compiled
def _split(q: Points, c: int) -> Points:
    """The inner vertices of an outline of c - 2 edges or fewer, its longest edges halved until there are c - 3."""
    out = np.empty(c - 1, dtype=np.complex128)
    for k in range(len(q)):
        out[k] = q[k]
    for size in range(len(q), c - 1):
        at = 1
        for k in range(2, size):
            if abs(out[k] - out[k - 1]) > abs(out[at] - out[at - 1]):
                at = k
        for k in range(size, at, -1):
            out[k] = out[k - 1]
        out[at] = (out[at - 1] + out[at + 1]) / 2
    return out[1:-1]


@compiled
def _polygon(rest: Points, bottom: complex, right: complex, left: complex, out: Points) -> None:
    """Write the c-gon around a convex polygon to ``out`` (c,)."""
    if right.real < left.real:
        right, left = left, right
    q = _outline(rest, right, left)
    if len(q) > LONGEST:
        q = _simplify(q)
    c = len(out)
    free = _split(q, c) if len(q) < c else _choose(q, c)
    while len(free) == 0:  # it turns too far for so few edges: the feet stand on the underside, and move to its ends
        q = q[1:-1]
        free = _split(q, c) if len(q) < c else _choose(q, c)
    out[0], out[1], out[c - 1] = bottom, q[0], q[-1]
    for k in range(c - 3):
        out[k + 2] = free[k]
    if _cross(q[-1], q[0], bottom) > 0:
        for k in range(1, len(q)):
            if _cross(q[k - 1], q[k], bottom) < 0:
                out[0] = (q[0] + q[-1]) / 2


@compiled
def _slide(rest: Points, bottom: complex, out: Points) -> bool:
    """Write the c-gon whose v2 and vc lie on the line of the edge of ``rest`` that holds v1; whether one does."""
    c, extent = len(out), 0.0
    for corner in rest:
        extent = max(extent, abs(corner - bottom))
    for k in range(len(rest)):
        a, b = rest[k - 1], rest[k]
        if a.real < bottom.real < b.real and abs(_cross(a, b, bottom)) <= FLAT * extent * abs(b - a):
            q = _outline(rest, bottom, bottom)
            if len(q) > LONGEST:
                q = _simplify(q)
            free = _split(q, c + 2) if len(q) < c + 2 else _choose(q, c + 2)
            if len(free) == 0:
                return False
            out[0], out[1:] = bottom, free
            return True
    return False


@compiled
def _shared(polygon: Points, convex: Points) -> float:
    """Area that a polygon shares with a convex one, both counter-clockwise (Sutherland and Hodgman 1974)."""
    inside = polygon.copy()
    for k in range(len(convex)):
        a, b = convex[k - 1], convex[k]
        out = np.empty(2 * len(inside) + 2, dtype=np.complex128)
        size = 0
        for i in range(len(inside)):
            p, q = inside[i - 1], inside[i]
            left_p, left_q = _cross(a, b, p), _cross(a, b, q)
            if (left_p < 0) != (left_q < 0):
                out[size] = p + (q - p) * (left_p / (left_p - left_q))
                size += 1
            if left_q >= 0:
                out[size] = q
                size += 1
        inside = out[:size]
        if size < 3:
            return 0.0
    return _area(inside)


@compiled
def _peel_one(points: Points, kept: Flags, share: float) -> Points:
    """The convex hull of a section's kept points, once the outliers among them are no longer kept."""
    here = np.flatnonzero(kept)
    p = points[here]
    order = _sorted(p)
    p = p[order]
    removed, ring = _peel(p, order, math.ceil(share * len(p) - 1e-9))
    for i in removed:
        kept[here[order[i]]] = False
    return p[ring]


@compiled
def _peel_all(
    first: int,
    last: int,
    points: Points,
    start: Ints,
    share: float,
    kept: Flags,
    area: Floats,
    perimeter: Floats,
    hulls: Points,
    size: Ints,
) -> None:
    for k in range(first, last):
        mine = slice(start[k], start[k + 1])
        if kept[mine].sum() >= 3:
            ring = _peel_one(points[mine], kept[mine], share)
            area[k], size[k], perimeter[k] = _area(ring), len(ring), 0.0
            for i in range(len(ring)):
                hulls[start[k] + i] = ring[i]
                perimeter[k] += abs(ring[i] - ring[i - 1])


@compiled
def _grow_all(
    first: int, last: int, points: Points, start: Ints, feet: Points, reach: Floats, out: Points, sizes: Ints
) -> None:
    """Write the outlines' vertices, twice as many as a section's points and feet at the most, and how many they are."""
    for k in range(first, last):
        n = start[k + 1] - start[k]
        body = np.empty(n + 2, dtype=np.complex128)
        body[:n], body[n], body[n + 1] = points[start[k] : start[k + 1]], feet[k, 1], feet[k, 2]
        body = body[_sorted(body)]
        ring = body[_hull(body)]
        at = size = 2 * (start[k] + 2 * k)
        for i in range(len(ring)):
            one, two = _outward(ring[i - 1], ring[i]), _outward(ring[i], ring[(i + 1) % len(ring)])
            turn = one.real * two.real + one.imag * two.imag
            if turn >= BLUNT:
                out[size] = ring[i] + reach[k] * (one + two) / (1 + turn)
                size += 1
            else:
                out[size], out[size + 1] = ring[i] + reach[k] * one, ring[i] + reach[k] * two
                size += 2
        sizes[k] = size - at


@compiled
def _outward(a: complex, b: complex) -> complex:
    """Unit normal to the right of a → b, 0 where they coincide."""
    edge = b - a
    return -1j * edge / abs(edge) if edge != 0 else 0j


@compiled
def _enclose_all(
    first: int,
    last: int,
    points: Points,
    start: Ints,
    feet: Points,
    share: float,
    slide: bool,
    polygon: Points,
    kept: Flags,
    areas: Floats,
) -> None:
    """Write c-gons (m, c), and the areas (3, m) of the hull, of the c-gon, and of what they share."""
    for k in range(first, last):
        mine = slice(start[k], start[k + 1])
        if kept[mine].sum() >= 3 and np.isfinite(feet[k, 0] + feet[k, 1] + feet[k, 2]):
            ring = _peel_one(points[mine], kept[mine], share)
            if not (slide and _slide(ring, feet[k, 0], polygon[k])):
                _polygon(ring, feet[k, 0], feet[k, 1], feet[k, 2], polygon[k])
            areas[0, k], areas[1, k], areas[2, k] = _area(ring), _area(polygon[k]), _shared(polygon[k], ring)
