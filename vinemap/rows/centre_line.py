"""The middle of a row in a straightened image of it: its centre line, and the smoothing that makes it one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import shift

from vinemap.compute.compiled import compiled
from vinemap.compute.filters import CARRIED_ON, blurred_down
from vinemap.compute.order import quantile
from vinemap.geo.curve import normals, resample, smoothed
from vinemap.geo.raster import sample, sample_across

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd

    from vinemap.compute.arrays import Values
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.cover import Levels

TREND = 5.0
"""Cutoff of a row's trend, in cutoffs of its detail."""
SLOPE = 1.0
"""Cutoff of a detail's slopes, in cutoffs of its bends."""
DETAIL = 0.3
"""Share of the mean weight that draws a detail to zero in gaps."""
BACKGROUND, FULL = 0.25, 0.65
"""Shares of a row's cover: what is less isn't its canopy, and what is more counts no more than that."""
USUAL = 0.8
"""Metres to both sides of a row in which its canopy is looked for, if its spacing leaves as much."""
SETTLED = 2e-4
"""Metres by which a centre line moves at the most when it is found."""
ABREAST = 0.48
"""Share of the spacing, at the most, that lies to both sides of a row and is its own."""
COURSE = 20.0
"""Wavelength in metres below which a course's bends are not trusted."""
EDGE, ROOM = 0.2, 1.75
"""Share of a row's cover at which its canopy ends across it, and how many times that far its points are taken."""
CELL = 0.05
"""Metres of a cell of a straightened row, along and across."""


def centre_line(image: Values, offsets: Values, *, reach: float, cutoff: float, curtains: float = 0.0) -> Values:
    """Offset in metres (n,) of the canopy's centre from a curve at each station of a straightened row.

    Centroids above a background, within ``reach`` metres of the smoothed centre so far, smoothed robustly.

    Parameters
    ----------
    image : (n, m) array
        Canopy cover at n stations and m cells across.
    offsets : (m,) array
        The cells' metres to the left of the curve.
    reach : float
        Metres to both sides.
    cutoff : float
        Wavelength in stations below which bends are noise.
    curtains : float
        Metres between the two curtains of a double canopy, whose centre lies between them; 0 where there is one.
    """
    if curtains:
        image, reach = _laid_together(image, offsets, curtains), curtains / 2
    return _centre(np.ascontiguousarray(image), offsets, reach, cutoff)


def _laid_together(image: Values, offsets: Values, curtains: float) -> Values:
    """Image (n, m) with both curtains on the middle between them, each in half, however uneven they are."""
    cells = curtains / 2 / (offsets[1] - offsets[0])
    left, right = (shift(image, (0, way * cells), order=1, mode="nearest") for way in (-1, 1))
    out: Values = (left + right) / 2
    return out


@compiled
def _centre(image: Values, offsets: Values, reach: float, cutoff: float) -> Values:
    """Smoothed centroids (n,) of canopy (n, m) within reach of them."""
    n, first = len(image), int(np.int64(0))  # a plain 0 would have `quantile` compiled twice
    excess = _excess(blurred_down(image, cutoff / 20, CARRIED_ON))
    measured, weight, robust, ranked = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    centre = image[:, 0].copy()
    for i in range(n):
        centre[i] = 0.0
    for _ in range(4):
        _centroids(excess, offsets, centre, reach, measured, weight)
        for i in range(n):
            ranked[i] = weight[i]
        # Stations of a stray leaf or two tell nothing of the row's middle.
        typical = max(quantile(ranked, first, n, 0.7), 1e-9)
        for i in range(n):
            weight[i] *= min(max(2 * weight[i] / typical - 0.5, 0.0), 1.0)
            robust[i] = weight[i]
        before = centre
        for _ in range(3):
            centre, held = _smoothed(measured, robust, cutoff), first
            for i in range(n):
                if weight[i] > 0:
                    ranked[held] = abs(measured[i] - centre[i])
                    held += 1
            scale = 1.5 * quantile(ranked, first, held, 0.5) + 0.01 if held else 1.0
            for i in range(n):
                robust[i] = weight[i] / (1 + ((measured[i] - centre[i]) / (2 * scale)) ** 2)
        if _farthest(centre, before) < SETTLED:
            break
    return centre


@compiled
def _farthest(values: Values, others: Values) -> float:
    """How far values (n,) are from others at the most."""
    most = 0.0
    for i in range(len(values)):
        most = max(most, abs(values[i] - others[i]))
    return most


@compiled
def _excess(image: Values) -> Values:
    """Cover (n, m) above what isn't canopy, where its flanks tell its middle, and cover only how well it was seen."""
    (n, m), first = image.shape, int(np.int64(0))
    ranked = np.zeros(n)
    for i in range(n):
        for j in range(m):
            ranked[i] = max(ranked[i], image[i, j])
    strength = quantile(ranked, first, n, 0.7)
    for i in range(n):
        for j in range(m):
            image[i, j] = min(max(image[i, j] - BACKGROUND * strength, 0.0), (FULL - BACKGROUND) * strength)
    return image


@compiled
def _centroids(excess: Values, offsets: Values, centre: Values, reach: float, measured: Values, weight: Values) -> None:
    """Measure centroids (n,) of canopy (n, m) within reach of a centre (n,), and how much canopy tells them."""
    for i in range(len(excess)):
        amount, moment = 0.0, 0.0
        for j in range(len(offsets)):
            # A soft edge, so that a cell more or less doesn't move the centroid.
            soft = min(max((reach - abs(offsets[j] - centre[i])) / 0.1 + 0.5, 0.0), 1.0)
            amount += excess[i, j] * soft
            moment += excess[i, j] * soft * offsets[j]
        measured[i], weight[i] = moment / max(amount, 1e-9), amount


def whittaker(values: Values, weights: Values, *, cutoff: float) -> Values:
    """Smooth values (n,) by penalised least squares on their second differences (Eilers 2003).

    ``cutoff`` is the wavelength, in samples, that is halved where weights are 1; where they are 0 the smoothest
    course is carried over.
    """
    data, weight = (np.ascontiguousarray(v, dtype=float) for v in (values, weights))
    return _whittaker(data, weight, float(cutoff), 0.0, 0.0)


@compiled
def _smoothed(values: Values, weights: Values, cutoff: float) -> Values:
    """Values (n,) as their trend and a detail.

    Across a gap the detail fades and the trend leads: an end's own wiggle must not aim the bridge.
    """
    none = float(np.float64(0.0))  # a plain 0 would have all compiled twice
    trend = _whittaker(values, weights, TREND * cutoff, none, none)
    detail = values.copy()
    for i in range(len(values)):
        detail[i] -= trend[i]
    detail = _whittaker(detail, weights, cutoff, SLOPE * cutoff, DETAIL + none)
    for i in range(len(values)):
        detail[i] += trend[i]
    return detail


@compiled
def _whittaker(values: Values, weights: Values, cutoff: float, slope: float, ridge: float) -> Values:
    """What :func:`whittaker` does, with penalties on first differences and on values in gaps, too.

    ``slope`` is a wavelength for first differences: with it, a short stretch between gaps can't take a slope of its
    own. ``ridge``, a share of the mean weight, draws values to zero in gaps.
    """
    if len(values) < 3:
        return values.copy()
    weighted = np.empty(len(values))
    for i in range(len(values)):
        weighted[i] = weights[i] * values[i]
    return _solve(_penalties(weights, cutoff, slope, max(ridge, 1e-9)), weighted)


@compiled
def _penalties(weights: Values, cutoff: float, slope: float, ridge: float) -> Values:
    """Diagonal and both bands (n, 3) of what minimises Σ w (x − v)² + penalties on Δ²x, Δx, and x in gaps."""
    n, second, first = len(weights), (cutoff / (2 * np.pi)) ** 4, (slope / (2 * np.pi)) ** 2
    level = 0.0
    for weight in weights:
        level += weight
    level = level / n if level != 0 else 1.0
    gap_first, gap_last = n, -1
    for i in range(n):
        if weights[i] >= 0.1 * level:
            gap_first, gap_last = min(gap_first, i), i
    bands = np.zeros((n, 3))
    for i in range(n):
        left, inner, right = i > 1, 0 < i < n - 1, i < n - 2
        in_gap = gap_first < i < gap_last and weights[i] < 0.1 * level
        bands[i, 0] = weights[i] + level * (
            second * (left + 4 * inner + right) + first * ((i > 0) + (i < n - 1)) + (ridge if in_gap else 1e-9)
        )
        bands[i, 1] = -level * (2 * second * (inner + right) + first * (i < n - 1))
        bands[i, 2] = level * second * right
    return bands


@compiled
def _solve(bands: Values, values: Values) -> Values:
    """Solve a symmetric system (n, n) of diagonal and two bands (n, 3) by its factors L D Lᵀ."""
    n = len(values)
    x = values.copy()
    for i in range(n):
        for k in range(1, min(i, 2) + 1):
            x[i] -= bands[i - k, k] * x[i - k]
            bands[i, 0] -= bands[i - k, 0] * bands[i - k, k] ** 2
        if i > 0:
            bands[i, 1] -= bands[i - 1, 0] * bands[i - 1, 1] * bands[i - 1, 2]
        bands[i, 1] /= bands[i, 0]
        bands[i, 2] /= bands[i, 0]
    for i in range(n - 1, -1, -1):
        x[i] /= bands[i, 0]
        for k in range(1, min(n - 1 - i, 2) + 1):
            x[i] -= bands[i, k] * x[i + k]
    return x


def runs_above(profile: Values, level: float) -> Values:
    """Stretches (k, 2), in samples, on which a profile (n,) lies above a level, interpolated where it crosses."""
    padded = np.concatenate([[0.0], profile, [0.0]])
    above = padded > level
    rise, fall = np.flatnonzero(above[1:] & ~above[:-1]), np.flatnonzero(~above[1:] & above[:-1])
    start = rise - 1 + (level - padded[rise]) / (padded[rise + 1] - padded[rise])
    end = fall - 1 + (padded[fall] - level) / (padded[fall] - padded[fall + 1])
    out: Values = np.clip(np.column_stack([start, end]), 0, len(profile) - 1)
    return out


def smooth_course(course: Values, *, beyond: float) -> Values:
    """Course without the bends that the centre line is to find, carried on beyond its ends."""
    return resample(smoothed(course, wavelength=COURSE, beyond=beyond, step=5 * CELL), CELL)


def half_width(spacing: Values | float) -> Values:
    """Metres to both sides of a row, of a spacing in metres, in which its canopy is looked for."""
    return np.minimum(USUAL, 0.42 * np.asarray(spacing))


def half_widths(courses: gpd.GeoDataFrame, curves: Sequence[Values], cover: Raster, levels: Levels) -> Values:
    """Metres to both sides of courses in which their canopy is looked for: more where it is wide among others."""
    spacing, alone = (courses[name].to_numpy() for name in ("spacing_m", "alone"))
    half: Values = half_width(spacing)
    anywhere = bool(levels.touching.any())
    for k in np.flatnonzero(~alone).tolist():
        stations, most = curves[k][:: round(1 / CELL)], max(half[k], ABREAST * spacing[k])
        if anywhere and (sample(levels.ridge, stations) > sample(levels.body, stations)).any():
            half[k] = most
            continue
        aside = np.arange(0.0, spacing[k] / 2, cover.grid.resolution)
        offsets = np.concatenate([-aside[:0:-1], aside])
        profile: Values = sample_across(cover, stations, normals(stations, smoothing=1.0), offsets).mean(axis=0)
        both = profile[len(aside) - 1 :] + profile[len(aside) - 1 :: -1]
        half[k] = np.clip(ROOM * aside[both >= EDGE * both.max()][-1], half[k], most)
    return half
