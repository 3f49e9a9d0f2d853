"""The frame of a row: metres along its curve and to its left, and what is done in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from vinemap.raster import cell_of, grid_over

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.floating]

TREND = 5.0
"""Cutoff of a row's trend, in cutoffs of its detail."""
SLOPE = 1.0
"""Cutoff of a detail's slopes, in cutoffs of its bends."""
GUIDE = 0.25
"""Metres between the points of a curve to which cloud points are referred, and the cells of their lookup."""


class RowCoordinates(NamedTuple):
    """Points near rows, in the frame of the nearest one."""

    row: NDArray[np.int64]
    """Position (n,) of the row in the list of curves."""
    along: Values
    """Metres (n,) along the row; negative before its start."""
    left: Values
    """Metres (n,) to its left."""
    member: NDArray[np.int64]
    """Index (n,) of the point in the cloud."""


def row_coordinates(xyz: Values, curves: Sequence[Values], reach: Values) -> RowCoordinates:
    """Refer the points (n, ≥2) within ``reach`` (rows,) metres of their nearest curve (k, 2) to it."""
    lengths = [float(way_along(curve)[-1]) for curve in curves]
    guides = [np.linspace(0, length, max(2, round(length / GUIDE) + 1)) for length in lengths]
    row = np.concatenate([np.full(len(g), k) for k, g in enumerate(guides)])
    position = np.concatenate(guides)
    guide = np.concatenate([at(curve, g) for curve, g in zip(curves, guides, strict=True)])
    tangent = np.concatenate([tangents(curve, g) for curve, g in zip(curves, guides, strict=True)])
    # The nearest guide of a cell is near enough to the nearest of its points: both are projected on its tangent.
    grid = grid_over(xyz, resolution=GUIDE)
    centres = np.stack(np.meshgrid(*grid.centres()), axis=-1).reshape(-1, 2)
    distance, nearest = cKDTree(guide).query(centres, distance_upper_bound=float(reach.max()) + GUIDE, workers=-1)
    member = np.flatnonzero(np.isfinite(distance)[cell_of(xyz, grid)])
    near = xyz[member, :2]
    g = nearest[cell_of(near, grid)]
    offset = near - guide[g]
    along = position[g] + (offset * tangent[g]).sum(axis=1)
    left = tangent[g, 0] * offset[:, 1] - tangent[g, 1] * offset[:, 0]
    inside = np.abs(left) <= reach[row[g]]
    return RowCoordinates(row[g][inside], along[inside], left[inside], member[inside])


def at(curve: Values, position: Values) -> Values:
    """Points (m, 2) of a curve (n, 2) at metres (m,) along it; before its start and past its end, its ends."""
    way = way_along(curve)
    return np.column_stack([np.interp(position, way, curve[:, k]) for k in (0, 1)])


def half_width(spacing: Values | float) -> Values:
    """Metres to both sides of a row, of a spacing in metres, in which its canopy is looked for."""
    return np.minimum(0.8, 0.42 * np.asarray(spacing))


def tangents(curve: Values, position: Values) -> Values:
    """Unit tangents (m, 2) of a curve (n, 2) at metres (m,) along it, over half a metre."""
    chord = at(curve, position + 0.25) - at(curve, position - 0.25)
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


def centre_line(image: Values, offsets: Values, shift: Values, *, reach: float, cutoff: float) -> Values:
    """Offset in metres (n,) of the canopy's centre from a curve at each station of a straightened row.

    Centroids above a background, within ``reach`` metres of the centre so far, smoothed robustly.

    Parameters
    ----------
    image : (n, m) array
        Canopy cover at n stations and m cells across.
    offsets : (m,) array
        The cells' metres to the left of the curve moved by ``shift``.
    shift : (n,) array
        Metres by which the image has followed the canopy already. What is smoothed is the whole offset from the
        curve: smoothing what is left, pass after pass, would smooth less and less.
    reach : float
        Metres to both sides.
    cutoff : float
        Wavelength in stations below which bends are noise.
    """
    smooth = gaussian_filter1d(image, cutoff / 20, axis=0, mode="nearest")
    strength = np.quantile(smooth.max(axis=1), 0.7)
    excess = np.maximum(smooth - 0.25 * strength, 0)
    centre = shift
    for _ in range(4):
        # A soft edge, so that a cell more or less doesn't move the centroid.
        soft = np.clip((reach - np.abs(offsets - (centre - shift)[:, None])) / 0.1 + 0.5, 0, 1)
        near = excess * soft
        weight = near.sum(axis=1)
        # Stations of a stray leaf or two tell nothing of the row's middle.
        typical = np.quantile(weight, 0.7)
        weight = weight * np.clip(2 * weight / max(typical, 1e-9) - 0.5, 0, 1)
        measured = shift + (near @ offsets) / np.maximum(near.sum(axis=1), 1e-9)
        robust = np.ones(len(image))
        for _ in range(3):
            trusted = weight * robust
            trend = whittaker(measured, trusted, cutoff=TREND * cutoff)
            # Across a gap the detail fades and the trend leads: an end's own wiggle must not aim the bridge.
            centre = trend + whittaker(measured - trend, trusted, cutoff=cutoff, slope=SLOPE * cutoff, ridge=0.3)
            residual = np.abs(measured - centre)
            scale = 1.5 * np.median(residual[weight > 0]) + 0.01 if (weight > 0).any() else 1.0
            robust = 1 / (1 + (residual / (2 * scale)) ** 2)
    return centre


def whittaker(values: Values, weights: Values, *, cutoff: float, slope: float = 0.0, ridge: float = 0.0) -> Values:
    """Smooth values (n,) by penalised least squares on their second and first differences (Eilers 2003).

    ``cutoff`` is the wavelength, in samples, that is halved where weights are 1; where they are 0 the smoothest
    course is carried over, drawn to zero between stretches by ``ridge`` (a share of the mean weight). ``slope`` is a
    wavelength for first differences: with it, a short stretch between gaps can't take a slope of its own.
    """
    n = len(values)
    if n < 3:
        return values
    level = float(np.mean(weights)) or 1.0
    penalty = level * (cutoff / (2 * np.pi)) ** 4
    bands = np.zeros((3, n))
    for k, c in enumerate((1.0, -2.0, 1.0)):
        bands[2, k : n - 2 + k] += penalty * c * c
    bands[1, 1:-1] += -2 * penalty
    bands[1, 2:] += -2 * penalty
    bands[0, 2:] += penalty
    first = level * (slope / (2 * np.pi)) ** 2
    bands[2, :-1] += first
    bands[2, 1:] += first
    bands[1, 1:] -= first
    held = np.flatnonzero(weights >= 0.1 * level)
    gap = np.ones(n, dtype=bool)
    gap[held] = gap[: held[0] if len(held) else n] = gap[held[-1] + 1 if len(held) else n :] = False
    bands[2] += weights + np.where(gap, max(ridge, 1e-9), 1e-9) * level
    out: Values = solveh_banded(bands, weights * values)
    return out


def runs_above(profile: Values, level: float) -> Values:
    """Stretches (k, 2), in samples, on which a profile (n,) lies above a level, interpolated where it crosses."""
    padded = np.concatenate([[0.0], profile, [0.0]])
    above = padded > level
    rise, fall = np.flatnonzero(above[1:] & ~above[:-1]), np.flatnonzero(~above[1:] & above[:-1])
    start = rise - 1 + (level - padded[rise]) / (padded[rise + 1] - padded[rise])
    end = fall - 1 + (padded[fall] - level) / (padded[fall] - padded[fall + 1])
    out: Values = np.clip(np.column_stack([start, end]), 0, len(profile) - 1)
    return out
