"""Curves in plan: polylines (n, 2) in metres, places along them, and the ways they run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Ints, Values


def at(curve: Values, position: Values) -> Values:
    """Points (m, 2) of a curve (n, 2) at metres (m,) along it; before its start and past its end, its ends."""
    way = way_along(curve)
    return np.column_stack([np.interp(position, way, curve[:, k]) for k in (0, 1)])


def at_each(curves: Sequence[Values], which: Ints, position: Values) -> Values:
    """Points (m, 2) of several curves (n, 2), which of them (m,), at metres (m,) along it, as of :func:`at`."""
    points = np.concatenate(curves)
    first = np.cumsum([0, *(len(curve) for curve in curves[:-1])])
    way = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T)])
    way[first] = 1.0
    way = np.cumsum(way)
    last = way[[*(first[1:] - 1), len(way) - 1]]
    along = way[first][which] + np.clip(position, 0.0, (last - way[first])[which])
    return np.column_stack([np.interp(along, way, points[:, k]) for k in (0, 1)])


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
    tangent = gaussian_filter1d(np.gradient(curve, axis=0), smoothing, axis=0, mode="nearest")
    tangent /= np.hypot(*tangent.T)[:, None]
    return np.column_stack([-tangent[:, 1], tangent[:, 0]])


def way_along(curve: Values) -> Values:
    """Metres (n,) from the start of a curve (n, 2) to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(curve, axis=0).T))])


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
