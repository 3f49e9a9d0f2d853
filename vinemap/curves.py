"""Clusters of key points to row curves γ: order, centre line, and ends on the canopy itself.

The enhanced key points are ordered as in the thesis (section 2.3.3) and give a first course. Canopy cover is then
read along that course, straightened: an image with one line of cells across the row every 0.1 m. Its centroids,
smoothed, are the centre line; where its canopy begins and ends are the row's ends; where it has none are the gaps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import shapely
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from vinemap.raster import Raster, sample

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Values = NDArray[np.floating]

STATION = 0.1
"""Metres between the stations of a straightened row."""
BIN = 0.05
"""Metres between its cells across."""
VERTEX = 0.5
"""Metres between the vertices of a curve."""


class Row(NamedTuple):
    """A traced row: curve (n, 2), canopy runs (k, 2) as metres along it, mean width of its canopy in metres."""

    curve: Values
    runs: Values
    width: float


def trace_rows(
    key_points: gpd.GeoDataFrame,
    cover: Raster,
    dtm: Raster,
    *,
    threshold: float = 2.0,
    smoothing: float = 3.0,
    end_share: float = 0.5,
    min_gap: float = 0.8,
    min_length: float = 4.0,
    min_radius: float = 8.0,
    max_width: float = 1.6,
    min_support: float = 0.25,
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Trace the curve of every cluster of key points.

    Parameters
    ----------
    key_points : GeoDataFrame
        Points with ``cluster``, ``direction_deg`` and ``spacing_m``.
    cover : Raster
        Canopy cover 0–1.
    dtm : Raster
        Terrain, which gives curves their elevation.
    threshold : float
        Metres t between enhanced key points.
    smoothing : float
        Wavelength in metres below which bends of the centre line are taken for noise.
    end_share : float
        Share of the row's median cover at which its canopy begins and ends.
    min_gap : float
        Metres without canopy that make a gap.
    min_length : float
        Metres that a row must have; twice as many where no other row runs beside it.
    min_radius : float
        Radius in metres of the tightest bend that a row takes as a whole.
    max_width : float
        Metres of canopy across beyond which it isn't a vine row.
    min_support : float
        Share of its length on which a row must have canopy.

    Returns
    -------
    rows, gaps : GeoDataFrame
        LineStringZ with ``cluster``, ``spacing_m``, ``width_m``, ``gap_m``, ``support``; LineStringZ with
        ``cluster``, ``start_m``, ``end_m``, ``length_m`` along γ.
    """
    rows, gaps = [], []
    for cluster, points in key_points.groupby("cluster"):
        xy = points.get_coordinates().to_numpy()
        spacing = float(points["spacing_m"].median())
        course = order_key_points(xy, np.radians(points["direction_deg"].to_numpy()), threshold=threshold)
        row = _trace(course, cover, spacing, smoothing, end_share)
        if row is None:
            continue
        length = float(np.hypot(*np.diff(row.curve, axis=0).T).sum())
        support = float(np.diff(row.runs, axis=1).sum()) / length
        if length < max(min_length, 3 * row.width) or row.width > max_width or support < min_support:
            continue
        if _turn(row.curve) > 2 / 3 * length / min_radius:
            continue
        line = _line(row.curve, dtm)
        empty = np.column_stack([row.runs[:-1, 1], row.runs[1:, 0]])
        empty = empty[np.diff(empty, axis=1)[:, 0] >= min_gap]
        rows.append((cluster, spacing, row.width, float(np.diff(empty, axis=1).sum()), support, line))
        for start, end in empty:
            piece = _line(_between(row.curve, start, end), dtm)
            gaps.append((cluster, start, end, end - start, piece))
    table = _frame(rows, ["cluster", "spacing_m", "width_m", "gap_m", "support"], cover)
    table = table[~_repeated(table)]
    table = table[_accompanied(table) | (table.length >= 2 * min_length)].reset_index(drop=True)
    missing = _frame(gaps, ["cluster", "start_m", "end_m", "length_m"], cover)
    return table, missing[missing["cluster"].isin(table["cluster"])].reset_index(drop=True)


def order_key_points(xy: Values, direction: Values, *, threshold: float = 2.0) -> Values:
    """Order the key points of one row, thinned to the enhanced key points e1 … en.

    From the key point in the middle, the row is scanned to both ends: the next point is the closest one at least
    ``threshold`` ahead in the local frame; where none is so far, the farthest ends the row (section 2.3.3).

    Parameters
    ----------
    xy : (n, 2) array
        Key points in metres.
    direction : (n,) array
        Direction of the row at each in radians; its sense doesn't matter.
    threshold : float
        Metres t between enhanced key points.

    Returns
    -------
    (k, 2) array
        Enhanced key points in order along the row.
    """
    start = int(np.argmin(np.hypot(*(xy - np.median(xy, axis=0)).T)))
    heading = np.array([np.cos(direction[start]), np.sin(direction[start])])
    halves = [_scan(xy, direction, start, way * heading, threshold) for way in (-1, 1)]
    return xy[halves[0][::-1] + [start] + halves[1]]


def _scan(xy: Values, direction: Values, start: int, heading: Values, threshold: float) -> list[int]:
    found: list[int] = []
    here = start
    while len(found) < len(xy):
        offset = xy - xy[here]
        ahead = offset @ heading
        beside = np.abs(offset[:, 0] * heading[1] - offset[:, 1] * heading[0])
        cone = (ahead > 0) & (beside <= 0.5 * ahead)
        far = cone & (ahead >= threshold)
        if not far.any():
            if cone.any() and ahead[cone].max() > 0.25 * threshold:
                found.append(int(np.argmax(np.where(cone, ahead, -1))))
            return found
        here = int(np.argmin(np.where(far, ahead, np.inf)))
        found.append(here)
        axis = np.array([np.cos(direction[here]), np.sin(direction[here])])
        heading = axis if axis @ heading >= 0 else -axis
    return found


def _trace(course: Values, cover: Raster, spacing: float, smoothing: float, end_share: float) -> Row | None:
    """Centre line, ends and canopy runs of a row whose rough course (k, 2) is known."""
    if len(course) < 2:
        return None
    margin = min(2.0, 0.8 * spacing)
    half = min(0.8, 0.42 * spacing)
    curve = _resample(_extend(course, margin), STATION)
    for reach in (half, 0.75 * half):
        image, offsets = _straighten(cover, curve, half)
        centre = _centre_line(image, offsets, reach, smoothing)
        curve = _resample(curve + centre[:, None] * _normals(curve), STATION)
    image, offsets = _straighten(cover, curve, half)
    profile = image.sum(axis=1) * BIN
    runs = _runs(profile, end_share)
    if len(runs) == 0:
        return None
    inside = np.arange(len(profile)) * STATION
    living = profile[((inside[:, None] >= runs[:, 0]) & (inside[:, None] <= runs[:, 1])).any(axis=1)]
    peak = np.quantile(image.max(axis=1), 0.9)
    width = float(np.median(living)) / max(float(peak), 1e-6)
    kept = _between(curve, runs[0, 0], runs[-1, 1])
    return Row(_resample(kept, VERTEX), runs - runs[0, 0], width)


def _turn(curve: Values) -> float:
    """Angle in radians between the first and the last third of a curve."""
    k = max(1, len(curve) // 3)
    first, last = curve[k] - curve[0], curve[-1] - curve[-1 - k]
    return abs(float(np.arctan2(first[0] * last[1] - first[1] * last[0], first @ last)))


def _repeated(rows: gpd.GeoDataFrame) -> NDArray[np.bool_]:
    """Whether a row lies for the most part within a quarter of a spacing of a longer one."""
    lines = shapely.force_2d(rows.geometry.to_numpy())
    out = np.zeros(len(rows), dtype=bool)
    order = np.argsort(shapely.length(lines))
    for n, i in enumerate(order):
        longer = lines[order[n + 1 :]]
        near = longer[shapely.dwithin(lines[i], longer, 0.25 * rows["spacing_m"].iloc[i])]
        beside = shapely.union_all(shapely.buffer(near, 0.25 * rows["spacing_m"].iloc[i]))
        out[i] = shapely.intersection(lines[i], beside).length > 0.5 * lines[i].length
    return out


def _accompanied(rows: gpd.GeoDataFrame) -> NDArray[np.bool_]:
    """Whether another row of about the same direction lies within two spacings of each."""
    lines = rows.geometry.to_numpy()
    out = np.zeros(len(rows), dtype=bool)
    if len(rows) < 2:
        return out
    chord = np.array([np.diff(shapely.get_coordinates(line)[[0, -1]], axis=0)[0] for line in lines])
    angle = np.arctan2(chord[:, 1], chord[:, 0])
    i, j = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=2 * rows["spacing_m"].to_numpy())
    parallel = np.abs(np.sin(angle[i] - angle[j])) < np.sin(np.radians(20))
    out[i[parallel & (i != j)]] = True
    return out


def _straighten(cover: Raster, curve: Values, half: float) -> tuple[Values, Values]:
    """Cover (stations, cells across) along a curve, and the cells' offsets to the left in metres."""
    n = int(np.ceil(half / BIN))
    offsets = np.arange(-n, n + 1) * BIN
    return sample(cover, curve[:, None] + offsets[:, None] * _normals(curve)[:, None]), offsets


def _centre_line(image: Values, offsets: Values, reach: float, smoothing: float) -> Values:
    """Offset in metres of the canopy's centre at each station: centroids above a background, smoothed."""
    smooth = uniform_filter1d(image, 5, axis=0)
    strength = np.quantile(smooth.max(axis=1), 0.7)
    excess = np.maximum(smooth - 0.25 * strength, 0)
    centre: Values = np.zeros(len(image))
    weight: Values = np.zeros(len(image))
    for _ in range(4):
        near = excess * (np.abs(offsets - centre[:, None]) <= reach)
        weight = near.sum(axis=1)
        measured = (near @ offsets) / np.maximum(weight, 1e-9)
        robust = np.ones(len(image))
        for _ in range(3):
            centre = whittaker(measured, weight * robust, cutoff=smoothing / STATION)
            residual = np.abs(measured - centre)
            scale = 1.5 * np.median(residual[weight > 0]) + 0.01 if (weight > 0).any() else 1.0
            robust = 1 / (1 + (residual / (2 * scale)) ** 2)
    return centre


def whittaker(values: Values, weights: Values, *, cutoff: float) -> Values:
    """Smooth values (n,) by penalised least squares on their second differences (Eilers 2003).

    ``cutoff`` is the wavelength, in samples, that is halved where weights are 1; where they are 0 the smoothest
    course is carried over.
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
    bands[2] += weights + 1e-9 * level
    out: Values = solveh_banded(bands, weights * values)
    return out


def _runs(profile: Values, end_share: float) -> Values:
    """Runs (k, 2) of canopy in metres along the stations, from where its cover crosses a share of the median."""
    present = profile[profile > 0.3 * np.quantile(profile, 0.95)]
    if len(present) == 0 or present.max() <= 0:
        return np.empty((0, 2))
    level = end_share * float(np.median(present))
    above = np.concatenate([[False], profile > level, [False]])
    rise, fall = np.flatnonzero(above[1:] & ~above[:-1]), np.flatnonzero(~above[1:] & above[:-1])
    padded = np.concatenate([[0.0], profile, [0.0]])
    start = rise - 1 + (level - padded[rise]) / (padded[rise + 1] - padded[rise])
    end = fall - 1 + (padded[fall] - level) / (padded[fall] - padded[fall + 1])
    runs = np.clip(np.column_stack([start, end]), 0, len(profile) - 1) * STATION
    long: Values = runs[runs[:, 1] - runs[:, 0] >= 0.35]
    return long


def _normals(curve: Values) -> Values:
    """Unit normals (n, 2) to the left of a curve (n, 2)."""
    tangent = gaussian_filter1d(np.gradient(curve, axis=0), 10, axis=0, mode="nearest")
    tangent /= np.hypot(*tangent.T)[:, None]
    return np.column_stack([-tangent[:, 1], tangent[:, 0]])


def _extend(course: Values, by: float) -> Values:
    """Course (k, 2) carried straight on at both ends, along the mean of its last 5 m."""
    out = [course]
    for end, sign in ((course, 1), (course[::-1], -1)):
        way = np.hypot(*(end - end[0]).T)
        inner = end[min(int(np.searchsorted(way, 5.0)), len(end) - 1)]
        outward = (end[0] - inner) / max(float(np.hypot(*(end[0] - inner))), 1e-9)
        out.insert(0 if sign > 0 else len(out), (end[0] + by * outward)[None])
    return np.concatenate(out)


def _resample(curve: Values, step: float) -> Values:
    """Curve (n, 2) at equal steps of about ``step`` metres along it, ends kept."""
    way = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(curve, axis=0).T))])
    at = np.linspace(0, way[-1], max(2, round(way[-1] / step) + 1))
    return np.column_stack([np.interp(at, way, curve[:, k]) for k in (0, 1)])


def _between(curve: Values, start: float, end: float) -> Values:
    """Part of a curve (n, 2) between two metres along it."""
    way = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(curve, axis=0).T))])
    inner = way[(way > start) & (way < end)]
    at = np.concatenate([[start], inner, [end]])
    return np.column_stack([np.interp(at, way, curve[:, k]) for k in (0, 1)])


def _line(curve: Values, dtm: Raster) -> shapely.LineString:
    return shapely.LineString(np.column_stack([curve, sample(dtm, curve)]))


def _frame(records: Sequence[tuple[object, ...]], columns: list[str], cover: Raster) -> gpd.GeoDataFrame:
    data = {name: [r[k] for r in records] for k, name in enumerate(columns)}
    return gpd.GeoDataFrame(data, geometry=[r[-1] for r in records], crs=cover.crs)
