"""The c-gon of least area around a section's hull (Problem 1), three of its vertices given.

A section's points are (y, z) in metres, z up and y drawn to the right; polygons run counter-clockwise.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.canopy.hull import area_of, as_complex, as_pairs, cross, order_of, ring_of, shared_area
from vinemap.canopy.peeling import peel_sections
from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from vinemap.compute.arrays import Complex, Flags, Floats, Ints

SNAP = 1e-6
"""Share of a section's extent within which a foot that was moved is set on the hull's vertex."""
FLAT = 1e-12
"""Share of a section's extent below which a vertex of its outline stands on its neighbours' line."""
LONGEST = 256
"""An outline of more edges is first simplified from outside: no two edges in a row turn by less than 360°/LONGEST."""


class Enclosures(NamedTuple):
    """The c-gons of m sections."""

    polygon: Floats
    """(m, c, 2) v1 … vc, counter-clockwise, m; NaN where not valid."""
    valid: Flags
    """(m,) False for fewer than 3 finite points or a non-finite fixed vertex."""
    hull_area: Floats
    """(m,) area of the points' convex hull, m²."""
    area: Floats
    """(m,) area of the c-gon, m²."""
    shared_area: Floats
    """(m,) area that the c-gon and that hull share, m²."""


def enclose(points: ArrayLike, start: ArrayLike, feet: ArrayLike, *, c: int = 7, slide: bool = False) -> Enclosures:
    """Enclose every section's points in the c-gon of minimum area whose v1, v2, vc are given.

    The polygon leaves v2 and arrives at vc along the hull of (points, v2, vc), so all points are left of all its edges
    but the two at v1; those cut points off where v1, v2, vc are not below them. v1 may be reflex.

    Where the fixed vertices don't fit the points they give way: feet in the wrong order are swapped, a foot inside the
    hull moves out sideways, at its height, to the hull (v2 to the right, vc to the left), and a v1 beyond the canopy
    becomes the middle of the feet. Where the outline has fewer than c vertices its longest edges are halved.

    Parameters
    ----------
    points : array_like of shape (n, 2)
        (y, z) of all sections, section after section, m; those that aren't finite don't count.
    start : array_like of shape (m + 1,)
        Section k holds ``points[start[k]:start[k + 1]]``.
    feet : array_like of shape (m, 3, 2)
        The fixed vertices v1 (bottom, middle), v2 (right foot) and vc (left foot).
    c : int
        Number of vertices, 5 or more (with 4 the polygon may have to be infinite).
    slide : bool
        Whether v2 and vc may slide along the hull's edge that holds v1, to where the area is least; where no edge
        does they stay.

    Raises
    ------
    ValueError
        If c or start is out of bounds.

    Notes
    -----
    Eq. 12-19 of the thesis; the bilinear programme's optimum is found exactly, by choosing edges.
    """
    if c < 5:
        raise ValueError(f"c is {c}: a c-gon with three fixed vertices needs c >= 5")
    whole, fixed = peel_sections(points, start, share=0.0), as_complex(feet).reshape(-1, 3)
    m = len(fixed)
    if len(whole.area) != m:
        raise ValueError(f"start must climb from 0 to {len(whole.kept)} in {m + 1} numbers")
    hulls, polygon = as_complex(whole.hull), np.full((m, c), complex(math.nan, math.nan))
    areas = np.full((3, m), math.nan)
    in_threads(lambda part: _enclose_all(*part, hulls, whole.start, fixed, slide, polygon, areas), stretches(m))
    return Enclosures(as_pairs(polygon), np.isfinite(areas[1]), *areas)


@compiled
def _place(ring: Complex, foot: complex, side: float, extent: float) -> tuple[int, float, complex]:
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
        if 0 < foot.real - a.real < d.real and abs(cross(a, a + d, foot)) <= FLAT * extent * abs(d):
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
def _around(rest: Complex, right: complex, left: complex) -> Complex:
    """Vertices (n + 1,) of the hull of a convex polygon and both feet, from the right foot round to the left one.

    Of more than ``LONGEST`` they are simplified.
    """
    corners = np.empty(len(rest) + 2, dtype=np.complex128)
    corners[0], corners[1] = right, left
    for k in range(len(rest)):
        corners[k + 2] = rest[k]
    corners = corners[order_of(corners)]
    ring = corners[ring_of(corners)]
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
        if backward or cross(p, ahead, q) < -FLAT * extent * abs(ahead - p):
            out[size] = q
            size += 1
    out[size] = left
    return out[: size + 1] if size < LONGEST else _simplify(out[: size + 1])


@compiled
def _turn(q: Complex, i: int, j: int) -> float:
    """Sine of the turn from edge i of the outline to edge j, times their lengths; 0 where it is 0 or 180°."""
    a, b = q[i + 1] - q[i], q[j + 1] - q[j]
    sine = a.real * b.imag - a.imag * b.real
    return sine if abs(sine) > FLAT * abs(a) * abs(b) else 0.0


@compiled
def _corner(q: Complex, i: int, j: int) -> tuple[complex, float]:
    """Where edges i < j of the outline meet, and twice the area of (q[i + 1], corner, q[j]); infinite if they don't."""
    turn = _turn(q, i, j)
    if j == i + 1 or turn <= 0:
        return q[j], 0.0 if j == i + 1 else math.inf
    corner = q[i + 1] + cross(q[j], q[j + 1], q[i + 1]) / turn * (q[i + 1] - q[i])
    return corner, cross(q[i + 1], corner, q[j])


@compiled
def _tangent(q: Complex, i: int, j: int) -> tuple[complex, complex, float]:
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
        if cross(p, r, q[k - 1]) >= 0 and cross(p, r, q[k + 1]) >= 0 and cross(q[i + 1], p, r) >= 0:
            added = cross(q[i + 1], p, r) + cross(q[i + 1], r, q[j])
            if added < least:
                one, two, least = p, r, added
    return one, two, least


@compiled
def _choose(q: Complex, c: int) -> Complex:
    """The c - 3 free vertices: c - 2 of the outline's edges, first and last included, that add the least area to it.

    All are flush but at most one; no vertices where no choice closes the polygon. State of the dynamic programme:
    whether the one not flush is spent, edges used so far, the last of them.
    """
    if len(q) < c:
        return _split(q, c)
    n, edges = len(q) - 1, c - 2
    swept = np.zeros(n + 1)
    for k in range(2, n + 1):
        swept[k] = swept[k - 1] + cross(q[0], q[k - 1], q[k])
    cost, origin = np.empty((2, edges, n)), np.zeros((2, edges, n), dtype=np.int64)
    cost.fill(math.inf)
    cost[0, 0, 0] = 0
    for j in range(1, n):
        for i in range(j):
            chain = swept[j] - swept[i + 1] - cross(q[0], q[i + 1], q[j])
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
def _trace(q: Complex, origin: Ints, spent: int) -> Complex:
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
def _simplify(q: Complex) -> Complex:
    """A circumscribed outline of fewer edges (see LONGEST), first and last edge kept."""
    n, size, last = len(q) - 1, 1, int(np.int64(0))  # a plain 0 would have `_corner` compiled twice
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
def _split(q: Complex, c: int) -> Complex:
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
        out[at] = 0.5 * (out[at - 1] + out[at + 1])
    return out[1:-1]


@compiled
def _polygon(ring: Complex, bottom: complex, right: complex, left: complex, slide: bool, out: Complex) -> None:
    """Write the c-gon around a convex polygon to ``out`` (c,)."""
    c = len(out)
    if slide and _holds(ring, bottom):  # v2 and vc lie on the line of the edge that holds v1
        free = _choose(_around(ring, bottom, bottom), c + 2)
        if len(free) > 0:
            out[0] = bottom
            for k in range(c - 1):  # as a slice it would take a second to compile
                out[k + 1] = free[k]
            return
    if right.real < left.real:
        right, left = left, right
    q = _around(ring, right, left)
    free = _choose(q, c)
    while len(free) == 0:  # it turns too far for so few edges: the feet stand on the underside, and move to its ends
        q = q[1:-1]
        free = _choose(q, c)
    out[0], out[1], out[c - 1] = bottom, q[0], q[-1]
    for k in range(c - 3):
        out[k + 2] = free[k]
    if cross(q[-1], q[0], bottom) > 0:
        for k in range(1, len(q)):
            if cross(q[k - 1], q[k], bottom) < 0:
                out[0] = 0.5 * (q[0] + q[-1])


@compiled
def _holds(ring: Complex, bottom: complex) -> bool:
    """Whether an edge of a polygon's underside holds a point."""
    extent = 0.0
    for corner in ring:
        extent = max(extent, abs(corner - bottom))
    for k in range(len(ring)):
        a, b = ring[k - 1], ring[k]
        if a.real < bottom.real < b.real and abs(cross(a, b, bottom)) <= FLAT * extent * abs(b - a):
            return True
    return False


@compiled
def _enclose_all(
    first: int,
    last: int,
    hulls: Complex,
    start: Ints,
    feet: Complex,
    slide: bool,
    polygon: Complex,
    areas: Floats,
) -> None:
    """Write c-gons (m, c), and the areas (3, m) of the hull, of the c-gon, and of what they share."""
    for k in range(first, last):
        ring = hulls[start[k] : start[k + 1]]
        if len(ring) > 0 and np.isfinite(feet[k, 0] + feet[k, 1] + feet[k, 2]):
            _polygon(ring, feet[k, 0], feet[k, 1], feet[k, 2], slide, polygon[k])
            areas[0, k], areas[1, k], areas[2, k] = area_of(ring), area_of(polygon[k]), shared_area(polygon[k], ring)
