"""What foliage reaches beyond the hull of its points, the farther the fewer they are, and the outline grown by it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap.canopy.hull import as_complex, as_pairs, checked_start, order_of, packed, ring_of
from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from vinemap.canopy.points import Sections
    from vinemap.compute.arrays import Complex, Floats, Ints, Values

BLUNT = 0.5
"""Cosine of the turn up to which a corner of a grown outline stays one; sharper ones are cut."""
SHORTFALL = 1.15
"""Area that hulls of peeled points lack, in what their vertices tell: measured on simulated vineyards."""
FARTHEST = 0.1
"""Metres that foliage reaches beyond its points at the most."""


def grow(points: ArrayLike, start: ArrayLike, feet: ArrayLike, reach: ArrayLike) -> tuple[Floats, Ints, Floats]:
    """Outline of every section's foliage: the convex hull of its points and its feet, and what lies within reach of it.

    Parameters
    ----------
    points, start : array_like of shape (n, 2), (m + 1,)
        As in :func:`vinemap.canopy.peeling.peel_sections`.
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
    offsets = checked_start(start, len(section))
    fixed, out = as_complex(feet).reshape(-1, 3), np.asarray(reach, dtype=float)
    room = offsets + 2 * np.arange(len(offsets))
    outline, size = np.empty(2 * room[-1], dtype=np.complex128), np.zeros(len(fixed), dtype=np.int64)
    in_threads(lambda part: _grow_all(*part, section, offsets, fixed, out, outline, size), stretches(len(size)))
    left = np.where(fixed[:, 1].real >= fixed[:, 2].real, 0.5, -0.5)
    moved = fixed + out[:, None] * np.stack([0 * left - 1j, left - 1j, -left - 1j], axis=1)
    return *packed(outline, 2 * room[:-1], size), as_pairs(moved)


@compiled
def _grow_all(
    first: int, last: int, points: Complex, start: Ints, feet: Complex, reach: Floats, out: Complex, sizes: Ints
) -> None:
    """Write the outlines' vertices, twice as many as a section's points and feet at the most, and how many they are."""
    for k in range(first, last):
        n = start[k + 1] - start[k]
        body = np.empty(n + 2, dtype=np.complex128)
        for i in range(n):  # as a slice it would take a second to compile
            body[i] = points[start[k] + i]
        body[n], body[n + 1] = feet[k, 1], feet[k, 2]
        body = body[order_of(body)]
        ring = body[ring_of(body)]
        at = size = 2 * (start[k] + 2 * k)
        for i in range(len(ring)):
            one, two = _outward(ring[i - 1], ring[i]), _outward(ring[i], ring[(i + 1) % len(ring)])
            turn = one.real * two.real + one.imag * two.imag
            if turn >= BLUNT:
                y, z = reach[k] * (one.real + two.real), reach[k] * (one.imag + two.imag)
                out[size] = ring[i] + complex(y / (1 + turn), z / (1 + turn))
                size += 1
            else:
                out[size], out[size + 1] = ring[i] + reach[k] * one, ring[i] + reach[k] * two
                size += 2
        sizes[k] = size - at


@compiled
def _outward(a: complex, b: complex) -> complex:
    """Unit normal to the right of a → b, 0 where they coincide."""
    edge = b - a
    length = abs(edge)
    return complex(edge.imag / length, -edge.real / length) if length != 0 else 0j


def foliage_reach(canopy: Sections, area: Values, perimeter: Values, vertices: Ints) -> Values:
    """Metres (m,) by which the foliage reaches beyond the hulls of its points, a mean for every row.

    A hull of points falls short of the body that they were taken from, the more the fewer they are: by the share of
    its area that its vertices are of the points (Efron 1965; Baldin and Reiß 2016).

    Parameters
    ----------
    canopy : Sections
        m sections with the points that their hulls hold.
    area, perimeter, vertices : (m,) array
        Of the hulls, in m² and m; NaN where there is none.
    """
    row, n = np.unique(canopy.row_id, return_inverse=True)[1], np.diff(canopy.start)

    def mean(values: NDArray[Any]) -> Values:
        out: Values = np.bincount(row, weights=np.nan_to_num(values)) / np.maximum(np.bincount(row, weights=n > 0), 1)
        return out

    points, corners = mean(n), mean(vertices)
    missing = SHORTFALL * mean(area) * corners / np.maximum(points - corners, 1)
    out: Values = np.minimum(missing / np.maximum(mean(perimeter), 1e-9), FARTHEST)[row]
    return out
