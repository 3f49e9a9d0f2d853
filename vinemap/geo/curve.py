"""Curves in plan: polylines (n, 2) in metres, places along them, and the ways they run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

from vinemap.compute.compiled import compiled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Ints, Values


def at(curve: Values, position: Values) -> Values:
    """Points (m, 2) of a curve (n, 2) at metres (m,) along it; before its start and past its end, its ends."""
    plain = (np.ascontiguousarray(values, dtype=np.float64) for values in (position, way_along(curve), curve))
    return _placed(*plain)


def at_each(curves: Sequence[Values], which: Ints, position: Values) -> Values:
    """Points (m, 2) of several curves (n, 2), which of them (m,), at metres (m,) along it, as of :func:`at`."""
    points = np.concatenate(curves)
    first = np.cumsum([0, *(len(curve) for curve in curves[:-1])])
    way = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T)])
    way[first] = 1.0
    way = np.cumsum(way)
    last = way[[*(first[1:] - 1), len(way) - 1]]
    along = way[first][which] + np.clip(position, 0.0, (last - way[first])[which])
    return _placed(along, way, np.ascontiguousarray(points, dtype=np.float64))


@compiled
def _placed(position: Values, way: Values, vertices: Values) -> Values:
    """Points (m, 2) at metres (m,) along, where vertices (n, 2) lie at metres (n,); the ends' beyond them."""
    n, out = len(way), np.empty((len(position), 2))
    k = 0
    for i in range(len(position)):
        at = position[i]
        if at < way[k] or (k + 2 < n and at >= way[k + 2]):
            k, after = 0, n
            while k + 1 < after:  # numba's searchsorted takes as long to compile as all else here
                middle = (k + after) // 2
                if way[middle] <= at:
                    k = middle
                else:
                    after = middle
        while k + 1 < n and way[k + 1] <= at:
            k += 1
        if k + 1 == n or at <= way[k]:
            out[i, 0], out[i, 1] = vertices[k, 0], vertices[k, 1]
            continue
        for axis in range(2):
            slope = (vertices[k + 1, axis] - vertices[k, axis]) / (way[k + 1] - way[k])
            out[i, axis] = slope * (at - way[k]) + vertices[k, axis]
    return out


def tangents(curve: Values, position: Values) -> Values:
    """Unit tangents (m, 2) of a curve (n, 2) at metres (m,) along it, over half a metre."""
    return tangents_of_each([curve], np.zeros(len(position), dtype=int), position)


def tangents_of_each(curves: Sequence[Values], which: Ints, position: Values) -> Values:
    """Unit tangents (m, 2) of several curves (n, 2), which of them (m,), at metres (m,) along it, over half a metre."""
    chord = at_each(curves, which, position + 0.25) - at_each(curves, which, position - 0.25)
    out: Values = chord / np.hypot(*chord.T)[:, None]
    return out


def normals(curve: Values, *, smoothing: float) -> Values:
    """Unit normals (n, 2) to the left of a curve (n, 2), smoothed over so many of its points."""
    tangent = np.empty_like(curve)
    tangent[0], tangent[-1] = curve[1] - curve[0], curve[-1] - curve[-2]
    tangent[1:-1] = (curve[2:] - curve[:-2]) / 2
    x, y = (gaussian_filter1d(tangent[:, k], smoothing, mode="nearest") for k in (0, 1))
    length, out = np.hypot(x, y), np.empty_like(curve)
    out[:, 0], out[:, 1] = -y / length, x / length
    return out


def across(curve: Values, offsets: Values, *, smoothing: float) -> Values:
    """Places (n, m, 2) beside a curve (n, 2), at offsets (m,) to its left along its normals, smoothed so."""
    out: Values = curve[:, None] + offsets[:, None] * normals(curve, smoothing=smoothing)[:, None]
    return out


def unit(ways: Values) -> Values:
    """Unit vectors (n, 2) of the directions of vectors (n, 2); those of no length stay as they are."""
    out: Values = ways / np.maximum(np.hypot(*ways.T), 1e-9)[:, None]
    return out


def cross(one: Values, other: Values) -> Values:
    """Cross products (…,) of vectors (…, 2): positive where the other one points to the left."""
    out: Values = one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
    return out


def way_along(curve: Values) -> Values:
    """Metres (n,) from the start of a curve (n, 2) to each of its points."""
    return _way(np.ascontiguousarray(curve, dtype=np.float64))


@compiled
def _way(curve: Values) -> Values:
    way = np.zeros(len(curve))
    for k in range(1, len(curve)):
        way[k] = way[k - 1] + np.hypot(curve[k, 0] - curve[k - 1, 0], curve[k, 1] - curve[k - 1, 1])
    return way


def extend(curve: Values, by: float) -> Values:
    """Curve (n, 2) carried straight on by some metres at both ends, along the mean of its last 5 m."""
    ends = []
    for end in (curve, curve[::-1]):
        inner = end[min(int(np.searchsorted(way_along(end), 5.0)), len(end) - 1)]
        outward = (end[0] - inner) / max(float(np.hypot(*(end[0] - inner))), 1e-9)
        ends.append((end[0] + by * outward)[None])
    return np.concatenate([ends[0], curve, ends[1]])


def resample(curve: Values, step: float) -> Values:
    """Curve (n, 2) at equal steps of about ``step`` metres along it, ends kept."""
    length = float(way_along(curve)[-1])
    return at(curve, np.linspace(0, length, max(2, round(length / step) + 1)))


def between(curve: Values, start: float, end: float) -> Values:
    """Part of a curve (n, 2) between two metres along it."""
    way = way_along(curve)
    return at(curve, np.concatenate([[start], way[(way > start) & (way < end)], [end]]))


def smoothed(curve: Values, *, wavelength: float, beyond: float, step: float) -> Values:
    """Curve (n, 2) in steps without bends shorter than a wavelength, carried on beyond its ends; all in metres."""
    n = round(beyond / step)
    known = np.pad(resample(curve, step), [(n, n), (0, 0)])
    weight = np.pad(np.ones(len(known) - 2 * n), n)
    # Third differences: neither the smoothing nor what is carried on straightens an arc.
    third, bands = (-1.0, 3.0, -3.0, 1.0), np.zeros((4, len(known)))
    bands[0] = weight
    stiffness = (wavelength / step / (2 * np.pi)) ** 6
    for i, a in enumerate(third):
        for j, b in enumerate(third[: i + 1]):
            bands[i - j, j : len(known) - 3 + j] += stiffness * a * b
    origin = curve[0]
    out: Values = origin + solveh_banded(bands, weight[:, None] * (known - origin), lower=True)
    return out


def turn_between(direction: Values, way: float | Values) -> Values:
    """Radians between directions and a way, either sense: π / 2 at the most; NaN stays."""
    out: Values = np.abs(np.angle(np.exp(2j * (direction - way)))) / 2
    return out
