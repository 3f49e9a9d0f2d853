"""Row direction, inter-row spacing and vineyard likelihood, from the spectrum of the canopy's cover.

Rows are a plane wave in a raster of canopy cover: in a window of a few rows the strongest peak of its power
spectrum lies across the rows at one cycle a spacing (Delenne et al. 2008; the thesis scans cylinders instead).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from numpy.lib.stride_tricks import sliding_window_view
from scipy import sparse
from scipy.fft import fft, irfft, rfft
from scipy.ndimage import map_coordinates, maximum_filter
from scipy.spatial import cKDTree

from vinemap.compute.threads import compiled, in_threads
from vinemap.geo.raster import Grid, Raster, RowField, coarser
from vinemap.rows.frame import at

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd
    from numpy.typing import NDArray

    Values = NDArray[np.floating]

FIELD_RESOLUTION = 0.5
"""Cell size in metres of the rasters of a row field."""
COVER_RESOLUTION = 0.25
"""Cell size in metres of the cover whose spectrum is taken."""
NEAR, LEAST_COVER = 2.5, 0.02
"""Metres from canopy, and what cover is canopy, within which there may be rows."""
PADDING = 2
"""Windows are zero-padded to this many times their width: the peak's position needs the finer bins."""
HARMONICS = 3
"""Multiples of the wave's frequency that belong to the rows: canopies are narrower than a sine's crest."""
CYLINDER_TURN = 1.0
"""Degrees between the directions in which a cylinder is sliced."""
BATCH = 128


class _Peaks(NamedTuple):
    """Wave of each window (my, mx): direction of the rows in radians, spacing in metres, strength 0–1."""

    direction: Values
    spacing: Values
    strength: Values


def estimate_row_field(
    cover: Raster,
    *,
    method: str = "spectrum",
    window: float = 16.0,
    radius: float = 5.0,
    step: float = 2.0,
    min_spacing: float = 1.2,
    max_spacing: float = 4.5,
) -> RowField:
    """Estimate the row field from canopy cover.

    Parameters
    ----------
    cover : Raster
        Canopy cover 0–1.
    method : str
        "spectrum" as described above, or the thesis's "cylinders", for comparison.
    window, radius, step : float
        Width of the square windows of the spectrum, radius of the cylinders, and the distance of both, in metres.
    min_spacing, max_spacing : float
        Band of inter-row spacings in metres in which the peak is sought.

    Returns
    -------
    RowField
        On a grid of 0.5 m over the cover's area. Likelihood is the share of the window's variance that the wave
        and its harmonics carry; direction and spacing are NaN where it is zero.
    """
    base = _block_mean(cover, COVER_RESOLUTION)
    band = (min_spacing, max_spacing)
    scan, size = (_scan_cylinders, radius) if method == "cylinders" else (_scan_spectrum, window)
    peaks = scan(base.values, size, step, band)
    peaks = _axial_median(peaks)
    grid = coarser(cover.grid, resolution=FIELD_RESOLUTION)
    stride = max(1, round(step / COVER_RESOLUTION)) * COVER_RESOLUTION
    return _resample(peaks, grid, base.grid, stride, cover)


def _block_mean(raster: Raster, resolution: float) -> Raster:
    """Means of the cells whose centres lie in each of coarser cells; 0 where there is none."""
    grid = coarser(raster.grid, resolution=resolution)
    x, y = raster.grid.centres()
    j = np.minimum(((x - grid.west) / resolution).astype(int), grid.nx - 1)
    i = np.minimum(((grid.north - y) / resolution).astype(int), grid.ny - 1)
    (row, first_row), (column, first_column) = (np.unique(v, return_index=True) for v in (i, j))
    down = np.add.reduceat(raster.values, first_row, axis=0, dtype=np.float64)
    mean = np.zeros(grid.shape)
    n = np.outer(np.bincount(i), np.bincount(j))[np.ix_(row, column)]
    mean[np.ix_(row, column)] = np.add.reduceat(down, first_column, axis=1) / n
    return Raster(mean, grid, raster.crs)


def _scan_spectrum(cover: Values, window: float, step: float, band: tuple[float, float]) -> _Peaks:
    """Strongest wave of the windows centred on a grid of nodes, node (0, 0) at the raster's corner."""
    windows, occupied, shape = _windows(cover, round(window / COVER_RESOLUTION / 2), step)
    hann = np.hanning(windows.shape[-1] + 1)[:-1]
    taper = (hann[:, None] * hann).astype(np.float32)
    batches = [occupied[start : start + BATCH] for start in range(0, len(occupied), BATCH)]
    waves = in_threads(lambda batch: _strongest_wave(windows[batch], taper, band), batches)
    return _peaks(waves, occupied, shape)


def _scan_cylinders(cover: Values, radius: float, step: float, band: tuple[float, float]) -> _Peaks:
    """Direction across which the histogram of the cover in a cylinder varies most, and the period of that histogram.

    The thesis scans cylinders so (section 2.3.1); its test, of Comba et al. (2015), is taken as the histogram's
    variance, and the likelihood as its autocorrelation at one period.
    """
    half = int(np.ceil(radius / COVER_RESOLUTION))
    windows, occupied, shape = _windows(cover, half, step)
    i, j = np.mgrid[-half:half, -half:half] + 0.5
    inside = np.hypot(i, j) * COVER_RESOLUTION <= radius
    # Rasters count rows southwards.
    x, y = j[inside] * COVER_RESOLUTION, -i[inside] * COVER_RESOLUTION
    angles = np.radians(np.arange(0, 180, CYLINDER_TURN))
    across = y * np.cos(angles)[:, None] - x * np.sin(angles)[:, None]
    n = 2 * half
    bins = np.clip(np.floor(across / COVER_RESOLUTION).astype(np.int64) + half, 0, n - 1)
    bins += n * np.arange(len(angles))[:, None]
    flat = (np.ones(bins.size), (bins.ravel(), np.tile(np.arange(len(x)), len(angles))))
    sums = sparse.csr_array(flat, shape=(n * len(angles), len(x)))
    size = np.maximum(sums.sum(axis=1).reshape(len(angles), n), 1.0)

    def waves(batch: NDArray[np.int64]) -> Values:
        k = np.arange(len(batch))
        histogram = (sums @ windows[batch][:, inside].T).T.reshape(len(batch), len(angles), n) / size
        histogram -= np.average(histogram, axis=2, weights=np.broadcast_to(size, histogram.shape))[:, :, None]
        best = (histogram**2 * size).sum(axis=2).argmax(axis=1)
        profile = histogram[k, best] * np.sqrt(size[best] / size.max())
        power = np.abs(rfft(profile, n=2 * n, axis=1)) ** 2
        similar = irfft(power, axis=1)[:, :n] / np.maximum(power.mean(axis=1), 1e-12)[:, None]
        similar /= np.maximum(similar[:, :1], 1e-12)
        low, high = (round(spacing / COVER_RESOLUTION) for spacing in band)
        lag = low + similar[:, low : high + 1].argmax(axis=1)
        around = [similar[k, lag + d] for d in (-1, 0, 1)]
        period = [lag[m] + _vertex(*(v[m] for v in around)) for m in k]
        return np.stack([angles[best], np.array(period) * COVER_RESOLUTION, np.clip(around[1], 0, 1)])

    batches = [occupied[start : start + BATCH] for start in range(0, len(occupied), BATCH)]
    return _peaks([waves(batch) for batch in batches], occupied, shape)


def _windows(cover: Values, half: int, step: float) -> tuple[Values, NDArray[np.int64], tuple[int, int]]:
    """Windows (nodes, 2 half, 2 half) on a grid of nodes (my, mx) from the raster's corner, which are near canopy."""
    size = 2 * half
    stride = max(1, round(step / COVER_RESOLUTION))
    # Windows reach over the edge by half their width; what lies there is no canopy.
    my, mx = (n // stride + 2 for n in cover.shape)
    padded = np.zeros([(m - 1) * stride + size for m in (my, mx)], dtype=np.float32)
    padded[half : half + cover.shape[0], half : half + cover.shape[1]] = cover[
        : padded.shape[0] - half, : padded.shape[1] - half
    ]
    windows = sliding_window_view(padded, (size, size))[::stride, ::stride].reshape(-1, size, size)
    reach = 2 * round((NEAR + step) / COVER_RESOLUTION) + 1
    canopy = np.pad(maximum_filter(cover, reach) > LEAST_COVER, [(0, 2 * stride)], mode="edge")
    return windows, np.flatnonzero(canopy[::stride, ::stride][:my, :mx]), (my, mx)


def _peaks(waves: Sequence[Values], occupied: NDArray[np.int64], shape: tuple[int, int]) -> _Peaks:
    out = np.zeros((3, shape[0] * shape[1]))
    out[:2] = np.nan
    if waves:
        out[:, occupied] = np.concatenate(waves, axis=1)
    return _Peaks(*out.reshape(3, *shape))


def _strongest_wave(windows: Values, taper: Values, band: tuple[float, float]) -> Values:
    """Direction (rad), spacing (m) and strength (0–1) of windows (k, size, size), as (3, k)."""
    size = windows.shape[-1]
    wide = PADDING * size
    mean = np.einsum("kij,ij->k", windows, taper) / taper.sum()
    rows = rfft((windows - mean[:, None, None]) * taper, n=wide, axis=2)
    spectrum = fft(rows, n=wide, axis=1)
    y, x, strength = _strongest(spectrum, COVER_RESOLUTION, *band, HARMONICS, 2 * PADDING)
    # Rasters count rows southwards, so the wave vector points to (x, -y); rows lie across it.
    direction = np.mod(np.arctan2(-y, x) + np.pi / 2, np.pi)
    return np.stack([direction, 1 / np.hypot(x, y), strength])


@compiled
def _strongest(
    spectrum: NDArray[np.complex64], cell: float, shortest: float, longest: float, harmonics: int, reach: int
) -> tuple[Values, Values, Values]:
    """Frequency of the strongest wave (y and x, cycles a metre) of spectra (k, n, n/2 + 1), and its strength 0–1.

    The strength is the share of the power beyond long waves that the main lobes (``reach`` bins wide) about the
    wave and its harmonics hold.
    """
    windows, n, _ = spectrum.shape
    half = n // 2
    unit = n * cell
    lowest, highest, long = (unit / longest) ** 2, (unit / shortest) ** 2, (unit / longest / 1.5) ** 2
    y, x, strength = np.empty(windows), np.empty(windows), np.empty(windows)
    for k in range(windows):
        power = spectrum[k].real ** 2 + spectrum[k].imag ** 2
        total, most = 0.0, -1.0
        best_i, best_j = 0, 0
        for row in range(n):
            i = row if row < half else row - n
            for j in range(half + 1):
                square = i * i + j * j
                if square < long:
                    continue
                # A real signal's spectrum is symmetric: the half that is kept holds the column j = 0 whole.
                total += power[row, j] if j else 0.5 * power[row, j]
                if lowest <= square <= highest and power[row, j] > most:
                    most, best_i, best_j = power[row, j], i, j
        if most < 0:  # no bin lies in so narrow a band
            y[k], x[k], strength[k] = 0.0, 1 / longest, 0.0
            continue
        held = 0.0
        for harmonic in range(1, harmonics + 1):
            held += _lobe(power, harmonic * best_i, harmonic * best_j, reach)
        strength[k] = min(held / max(total, 1e-12), 1.0)
        here = np.log(power[best_i, best_j] + 1e-12)
        left = power[best_i, best_j - 1] if best_j else power[-best_i, 1]
        right = power[best_i, min(best_j + 1, half)]
        x[k] = (best_j + _vertex(np.log(left + 1e-12), here, np.log(right + 1e-12))) / unit
        north, south = np.log(power[best_i - 1, best_j] + 1e-12), np.log(power[best_i + 1, best_j] + 1e-12)
        y[k] = (best_i + _vertex(north, here, south)) / unit
    return y, x, strength


@compiled
def _lobe(power: Values, middle_i: int, middle_j: int, reach: int) -> float:
    """Power about one bin of a spectrum (n, n/2 + 1); none beyond the spectrum's edge."""
    half = power.shape[1] - 1
    held = 0.0
    for a in range(-reach, reach + 1):
        for b in range(-reach, reach + 1):
            i, j = middle_i + a, middle_j + b
            if j < 0:
                i, j = -i, -j
            if -half <= i < half and j <= half:
                held += power[i, j]
    return held


@compiled
def _vertex(left: float, middle: float, right: float) -> float:
    """Offset in (-0.5, 0.5) of the vertex of the parabola through three neighbours."""
    bend = left - 2 * middle + right
    return float(min(max(0.5 * (left - right) / bend, -0.5), 0.5)) if abs(bend) > 1e-9 else 0.0


def _axial_median(peaks: _Peaks) -> _Peaks:
    """Replace each window's wave by the one of its 3 x 3 neighbours that differs least from all of them."""
    my, mx = peaks.direction.shape
    wave = np.where(np.isfinite(peaks.direction), np.exp(2j * np.nan_to_num(peaks.direction)), 0)
    shifts = [(a, b) for a in (0, 1, 2) for b in (0, 1, 2)]
    padded = [np.pad(v, 1) for v in (wave, np.nan_to_num(peaks.spacing), peaks.strength)]
    waves, spacings, weights = (np.stack([p[a : a + my, b : b + mx] for a, b in shifts]) for p in padded)
    cost = np.zeros_like(weights)
    for n in range(len(shifts)):
        turn = np.abs(waves - waves[n])
        stretch = np.abs(np.log(np.maximum(spacings, 0.1) / np.maximum(spacings[n], 0.1)))
        cost[n] = (weights * (turn + stretch)).sum(axis=0)
    cost[weights == 0] = np.inf
    best = cost.argmin(axis=0)[None]
    direction = np.mod(np.angle(np.take_along_axis(waves, best, 0)[0]) / 2, np.pi)
    spacing = np.take_along_axis(spacings, best, 0)[0]
    empty = peaks.strength == 0
    return _Peaks(np.where(empty, np.nan, direction), np.where(empty, np.nan, spacing), peaks.strength)


def _resample(peaks: _Peaks, grid: Grid, base: Grid, step: float, cover: Raster) -> RowField:
    """Bring the waves of the windows to a raster, weighted by their strength."""
    x, y = grid.centres()
    i, j = np.meshgrid((base.north - y) / step, (x - base.west) / step, indexing="ij")

    def at(values: Values) -> Values:
        out: Values = map_coordinates(values, [i, j], order=1, mode="nearest")
        return out

    strength = peaks.strength
    wave = strength**2 * np.exp(2j * np.nan_to_num(peaks.direction))
    direction = np.mod(np.degrees(np.angle(at(wave.real) + 1j * at(wave.imag)) / 2), 180)
    weight = at(strength**2)
    spacing = at(strength**2 * np.nan_to_num(peaks.spacing)) / np.maximum(weight, 1e-12)
    reach = 2 * round(NEAR / FIELD_RESOLUTION) + 1
    near = maximum_filter(_block_mean(cover, FIELD_RESOLUTION).values, reach) > LEAST_COVER
    likelihood = np.where(near, at(strength), 0.0)
    known = weight > 1e-9

    def raster(values: Values) -> Raster:
        return Raster(values, grid, cover.crs)

    return RowField(
        raster(np.where(known, direction, np.nan)), raster(np.where(known, spacing, np.nan)), raster(likelihood)
    )


def refine_row_field(field: RowField, rows: gpd.GeoDataFrame) -> RowField:
    """Take direction and spacing within the vineyard from the rows that were found.

    A window's wave is a mean over some rows; a row's own tangent (over 4 m) and its distance from the rows beside it
    are exact where rows bend, converge, or stand alone.

    Parameters
    ----------
    field : RowField
        As estimated from the spectrum.
    rows : GeoDataFrame
        LineString with ``spacing_m``.
    """
    if len(rows) == 0:
        return field
    curves = [shapely.get_coordinates(line) for line in rows.geometry]
    positions = [np.linspace(0, length, max(2, round(2 * length) + 1)) for length in rows.length]
    row = np.repeat(np.arange(len(curves)), [len(position) for position in positions])
    here, before, after = (
        np.concatenate([at(curve, position + d) for curve, position in zip(curves, positions, strict=True)])
        for d in (0.0, -2.0, 2.0)
    )
    chord = after - before
    direction = np.mod(np.degrees(np.arctan2(chord[:, 1], chord[:, 0])), 180)
    spacing = _spacing_beside(here, chord, row, rows["spacing_m"].to_numpy()[row])

    grid = field.direction.grid
    centres = np.stack(np.meshgrid(*grid.centres()), axis=-1)
    reach = 0.6 * rows["spacing_m"].to_numpy()[row]
    distance, nearest = cKDTree(here).query(centres, distance_upper_bound=reach.max() + 1e-6, workers=-1)
    nearest[np.isinf(distance)] = 0
    inside = distance <= reach[nearest]
    known = inside & np.isfinite(spacing)[nearest]
    return RowField(
        replace(field.direction, values=np.where(inside, direction[nearest], field.direction.values)),
        replace(field.spacing, values=np.where(known, spacing[nearest], field.spacing.values)),
        field.likelihood,
    )


def _spacing_beside(here: Values, chord: Values, row: NDArray[np.int64], expected: Values) -> Values:
    """Mean distance in metres (n,) from points of rows to the rows on both sides, NaN where there is none."""
    if len(here) == 0:
        return np.empty(0)
    way = chord / np.hypot(*chord.T)[:, None]
    pairs = cKDTree(here).query_pairs(1.8 * float(expected.max()), output_type="ndarray")
    pairs = pairs[row[pairs[:, 0]] != row[pairs[:, 1]]]
    near, there = np.concatenate([pairs, pairs[:, ::-1]]).T
    offset = here[there] - here[near]
    along = (offset * way[near]).sum(axis=1)
    left = way[near, 0] * offset[:, 1] - way[near, 1] * offset[:, 0]
    beside = (np.abs(along) <= 0.75) & (np.abs(left) > 0.3) & (np.hypot(along, left) <= 1.8 * expected[near])
    sides = np.full((2, len(here)), np.inf)
    np.minimum.at(sides, ((left > 0).astype(int)[beside], near[beside]), np.abs(left[beside]))
    reached = np.isfinite(sides)
    n = reached.sum(axis=0)
    return np.where(n > 0, np.where(reached, sides, 0).sum(axis=0) / np.maximum(n, 1), np.nan)
