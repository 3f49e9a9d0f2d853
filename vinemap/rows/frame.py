"""The frame of a row: metres along its curve and to its left, and what is done in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d

from vinemap.compute.threads import compiled, in_threads, stretches
from vinemap.geo.raster import grid_over

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from vinemap.cloud.points import PointCloud
    from vinemap.cloud.tiles import Cloud
    from vinemap.geo.raster import Grid

    Values = NDArray[np.floating]

TREND = 5.0
"""Cutoff of a row's trend, in cutoffs of its detail."""
SLOPE = 1.0
"""Cutoff of a detail's slopes, in cutoffs of its bends."""
GUIDE = 0.25
"""Metres between the points of a curve to which cloud points are referred, and the cells of their lookup."""


ROWS_AT_ONCE = 4_000_000
"""Points, about, of the rows that are worked together."""


class RowCoordinates(NamedTuple):
    """Points near rows in the frame of the nearest one, row by row."""

    start: NDArray[np.int64]
    """First point (rows + 1,) of each row; ``start[k + 1]`` is past its last."""
    along: NDArray[np.float32]
    """Metres (n,) along the row; negative before its start."""
    left: NDArray[np.float32]
    """Metres (n,) to its left."""
    member: NDArray[np.int32]
    """Index (n,) of the point in the cloud."""


Taken = tuple["NDArray[np.floating]", ...]
"""What is taken of points beside their coordinates: arrays (n,)."""


class _Guides(NamedTuple):
    """Points on curves to which cloud points are referred: row (g,), metres along it, place and tangent (g, 2)."""

    row: NDArray[np.int64]
    along: Values
    xy: Values
    tangent: Values


class _Lookup(NamedTuple):
    """Raster (ny, nx) of the nearest guides."""

    grid: Grid
    nearest: NDArray[np.int32]
    guides: _Guides


def points_of_rows(
    cloud: Cloud, curves: Sequence[Values], reach: Values, take: Callable[[PointCloud, NDArray[np.int32]], Taken]
) -> Iterator[tuple[NDArray[np.int64], RowCoordinates, Taken]]:
    """Refer a cloud's points within ``reach`` (rows,) metres of their nearest curve (k, 2) to it.

    Yields rows (a,), the frame's coordinates of their points row by row, and for each point what ``take`` tells of a
    part of the cloud and its members: arrays (n,). Group by group of rows, so that they don't take the memory of
    another cloud.
    """
    if not curves:
        return
    for rows in _groups(curves, cloud.size):
        lookup = _lookup(curves, reach, rows)
        within = np.full(len(curves), -1.0)
        within[rows] = reach[rows]
        found = []
        for part in cloud.parts(shapely.MultiLineString([curves[k] for k in rows]), float(reach[rows].max())):
            near = _coordinates(part.xyz, lookup, within)
            found.append((near._replace(member=near.member + np.int32(part.first)), take(part, near.member)))
        yield rows, *_joined(found, rows)


def _groups(rows: Sequence[Values], size: int) -> list[NDArray[np.int64]]:
    """Indices of rows, as curves (k, 2), that lie beside each other in a cloud of so many points, group by group."""
    middles = np.array([row[len(row) // 2] for row in rows])
    widest = int(np.argmax(np.ptp(middles, axis=0)))
    groups = min(max(1, round(size / ROWS_AT_ONCE)), len(rows))
    return [np.sort(part) for part in np.array_split(np.argsort(middles[:, widest], kind="stable"), groups)]


def _joined(found: Sequence[tuple[RowCoordinates, Taken]], rows: NDArray[np.int64]) -> tuple[RowCoordinates, Taken]:
    """Points of some rows, from several parts, row by row."""
    n = np.array([np.diff(near.start)[rows] for near, _ in found])
    start = np.concatenate([[0], np.cumsum(n.sum(axis=0))])
    tables = [(near.along, near.left, near.member, *taken) for near, taken in found]
    if len(tables) > 1:
        order = [(k, near.start[row], near.start[row + 1]) for row in rows for k, (near, _) in enumerate(found)]
        columns = [np.concatenate([tables[k][c][a:b] for k, a, b in order]) for c in range(len(tables[0]))]
    else:
        columns = list(tables[0])
    return RowCoordinates(start, *columns[:3]), tuple(columns[3:])


def _lookup(curves: Sequence[Values], reach: Values, rows: NDArray[np.int64]) -> _Lookup:
    """Guides of all curves, and the nearest ones about some of the rows."""
    lengths = [float(way_along(curve)[-1]) for curve in curves]
    positions = [np.linspace(0, length, max(2, round(length / GUIDE) + 1)) for length in lengths]
    guides = _Guides(
        np.concatenate([np.full(len(g), k) for k, g in enumerate(positions)]),
        np.concatenate(positions),
        np.concatenate([at(curve, g) for curve, g in zip(curves, positions, strict=True)]),
        np.concatenate([tangents(curve, g) for curve, g in zip(curves, positions, strict=True)]),
    )
    widest = float(reach.max()) + GUIDE
    about = np.concatenate([curves[k] for k in rows])
    grid = grid_over(about.min(axis=0) - widest, about.max(axis=0) + widest, resolution=GUIDE)
    return _Lookup(grid, _nearest_guides(guides.xy, grid, widest), guides)


def _coordinates(xyz: Values, lookup: _Lookup, reach: Values) -> RowCoordinates:
    points = np.ascontiguousarray(xyz)
    guide, parts = np.empty(len(points), dtype=np.int32), stretches(len(points))
    counts = np.array(in_threads(lambda part: _find_guides(*part, points, lookup, reach, guide), parts))
    start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    place = start[:-1] + np.cumsum(counts, axis=0) - counts
    along, left = np.empty((2, start[-1]), dtype=np.float32)
    out = RowCoordinates(start, along, left, np.empty(start[-1], dtype=np.int32))
    in_threads(lambda k: _refer(*parts[k], points, guide, lookup.guides, place[k], out), range(len(parts)))
    return out


@compiled
def _nearest_guides(xy: Values, grid: Grid, reach: float) -> NDArray[np.int32]:
    """Guide (ny, nx) nearest to the centre of every cell, -1 where none is within reach.

    It is near enough to the nearest of the cell's points: both project them on about the same tangent.
    """
    nearest = np.full((grid.ny, grid.nx), -1, dtype=np.int32)
    least = np.full((grid.ny, grid.nx), reach**2)
    cells = int(np.ceil(reach / grid.resolution))
    for g in range(len(xy)):
        x, y = (xy[g, 0] - grid.west) / grid.resolution - 0.5, (grid.north - xy[g, 1]) / grid.resolution - 0.5
        for i in range(max(int(y) - cells, 0), min(int(y) + cells + 2, grid.ny)):
            for j in range(max(int(x) - cells, 0), min(int(x) + cells + 2, grid.nx)):
                square = ((j - x) ** 2 + (i - y) ** 2) * grid.resolution**2
                if square < least[i, j]:
                    least[i, j] = square
                    nearest[i, j] = g
    return nearest


@compiled
def _find_guides(
    first: int,
    last: int,
    xyz: Values,
    lookup: _Lookup,
    reach: Values,
    guide: NDArray[np.int32],
) -> NDArray[np.int64]:
    """Guide (n,) to which each point (n, ≥2) is referred, -1 where it is out of its row's reach; points of each row."""
    grid, nearest, guides = lookup
    n = np.zeros(len(reach), dtype=np.int64)
    scale = 1 / grid.resolution
    for p in range(first, last):
        guide[p] = -1
        j, i = (xyz[p, 0] - grid.west) * scale, (grid.north - xyz[p, 1]) * scale
        if j < 0 or i < 0 or j >= grid.nx or i >= grid.ny:
            continue
        g = nearest[int(i), int(j)]
        if g < 0:
            continue
        x, y = xyz[p, 0] - guides.xy[g, 0], xyz[p, 1] - guides.xy[g, 1]
        if abs(guides.tangent[g, 0] * y - guides.tangent[g, 1] * x) <= reach[guides.row[g]]:
            guide[p] = g
            n[guides.row[g]] += 1
    return n


@compiled
def _refer(
    first: int,
    last: int,
    xyz: Values,
    guide: NDArray[np.int32],
    guides: _Guides,
    place: NDArray[np.int64],
    out: RowCoordinates,
) -> None:
    """Write the coordinates of the points (n, ≥2) that have a guide, each row's from its place (rows,) on."""
    for p in range(first, last):
        g = guide[p]
        if g >= 0:
            x, y = xyz[p, 0] - guides.xy[g, 0], xyz[p, 1] - guides.xy[g, 1]
            k = place[guides.row[g]]
            out.along[k] = guides.along[g] + x * guides.tangent[g, 0] + y * guides.tangent[g, 1]
            out.left[k] = guides.tangent[g, 0] * y - guides.tangent[g, 1] * x
            out.member[k] = p
            place[guides.row[g]] += 1


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


def centre_line(image: Values, offsets: Values, *, reach: float, cutoff: float) -> Values:
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
    """
    smooth = gaussian_filter1d(image, cutoff / 20, axis=0, mode="nearest")
    strength = np.quantile(smooth.max(axis=1), 0.7)
    excess = np.maximum(smooth - 0.25 * strength, 0)
    centre: Values = np.zeros(len(image))
    for _ in range(4):
        amount, moment = _centroids(excess, offsets, centre, reach)
        # Stations of a stray leaf or two tell nothing of the row's middle.
        typical = float(np.quantile(amount, 0.7))
        weight = amount * np.clip(2 * amount / max(typical, 1e-9) - 0.5, 0, 1)
        measured = moment / np.maximum(amount, 1e-9)
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


@compiled
def _centroids(excess: Values, offsets: Values, centre: Values, reach: float) -> tuple[Values, Values]:
    """Sums (n,) of canopy (n, m) within reach of a centre (n,), plain and times its offset (m,)."""
    amount, moment = np.zeros(len(excess)), np.zeros(len(excess))
    for i in range(len(excess)):
        for j in range(len(offsets)):
            # A soft edge, so that a cell more or less doesn't move the centroid.
            soft = min(max((reach - abs(offsets[j] - centre[i])) / 0.1 + 0.5, 0.0), 1.0)
            amount[i] += excess[i, j] * soft
            moment[i] += excess[i, j] * soft * offsets[j]
    return amount, moment


def whittaker(values: Values, weights: Values, *, cutoff: float, slope: float = 0.0, ridge: float = 0.0) -> Values:
    """Smooth values (n,) by penalised least squares on their second and first differences (Eilers 2003).

    ``cutoff`` is the wavelength, in samples, that is halved where weights are 1; where they are 0 the smoothest
    course is carried over, drawn to zero between stretches by ``ridge`` (a share of the mean weight). ``slope`` is a
    wavelength for first differences: with it, a short stretch between gaps can't take a slope of its own.
    """
    if len(values) < 3:
        return values
    bands = _penalties(
        np.asarray(weights, dtype=float), (cutoff / (2 * np.pi)) ** 4, (slope / (2 * np.pi)) ** 2, max(ridge, 1e-9)
    )
    return _solve(bands, np.asarray(weights * values, dtype=float))


@compiled
def _penalties(weights: Values, second: float, first: float, ridge: float) -> Values:
    """Diagonal and both bands (n, 3) of what minimises Σ w (x − v)² + penalties on Δ²x, Δx, and x in gaps."""
    n = len(weights)
    level = weights.mean()
    if level == 0:
        level = 1.0
    held = np.flatnonzero(weights >= 0.1 * level)
    gap_first, gap_last = (held[0], held[-1]) if len(held) else (n, -1)
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
