"""Waves of rows in windows of the canopy's cover: the spectrum's, and by the thesis's cylinders for comparison."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import sparse
from scipy.fft import fft, irfft, rfft
from scipy.ndimage import gaussian_filter, maximum_filter

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads
from vinemap.geo.curve import turn_between
from vinemap.geo.raster import cell_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Ints, Values
    from vinemap.geo.raster import Raster

SURE = 0.55
"""Strength from which a window has rows in one direction only."""
CYLINDER_TURN = 1.0
"""Degrees between the directions in which a cylinder is sliced."""
COVER_RESOLUTION = 0.25
"""Cell size in metres of the cover whose spectrum is taken."""
NEAR, LEAST_COVER = 2.5, 0.02
"""Metres from canopy, and what cover is canopy, within which there may be rows."""
PADDING = 2
"""Windows are zero-padded to this many times their width: the peak's position needs the finer bins."""
HARMONICS = 3
"""Multiples of the wave's frequency that belong to the rows: canopies are narrower than a sine's crest."""
CLEAR, ASKEW = 0.3, np.radians(15)
"""How clearly canopies are drawn out in a direction that tells a wave, and radians by which that may be off."""
EDGE, THERE = 0.35, 1.2
"""Metres: standard deviations of the Gaussians by which edges of canopies are told, and of what tells their grain."""
BATCH = 16


class Peaks(NamedTuple):
    """Wave of each window (my, mx): direction of the rows in radians, spacing in metres, strength 0–1."""

    direction: Values
    spacing: Values
    strength: Values


class Grain(NamedTuple):
    """Direction (my, mx) in radians along which canopy is drawn out, and how clearly, 0–1."""

    direction: Values
    clear: Values

    def off(self, direction: Values) -> Values:
        """Radians by which directions are off it; 0 where it isn't clear."""
        turn = np.nan_to_num(turn_between(direction, self.direction))
        out: Values = np.where(self.clear >= CLEAR, turn, 0.0)
        return out


def scan_spectrum(
    cover: Values, window: float, step: float, band: tuple[float, float], drawn: Grain
) -> tuple[Peaks, Peaks]:
    """Strongest waves of the windows centred on a grid of nodes, node (0, 0) at the raster's corner, and the next ones.

    The next are those in another direction, where the strongest don't hold most of a window's variance, or don't run as
    canopies are drawn out there.
    """
    windows, occupied, shape = _windows(cover, round(window / COVER_RESOLUTION / 2), step)
    hann = np.hanning(windows.shape[-1] + 1)[:-1]
    taper = (hann[:, None] * hann).astype(np.float32)
    batches = [occupied[start : start + BATCH] for start in range(0, len(occupied), BATCH)]

    def waves(batch: Ints) -> Values:
        return _strongest_wave(windows[*batch.T], taper, band, Grain(*(values[*batch.T] for values in drawn)))

    first, second = _peaks(in_threads(waves, batches), occupied, shape, sets=2)
    return first, second


def grain(cover: Values, step: float) -> Grain:
    """How canopy is drawn out about each node of a scan.

    It is told by the structure tensor (Bigün & Granlund 1987), which a lone line beyond a few metres doesn't turn.
    """
    stride, (my, mx) = _nodes(cover.shape, step)
    beyond = [(0, max(0, (m - 1) * stride + 1 - n)) for m, n in zip((my, mx), cover.shape, strict=True)]
    padded = np.pad(cover.astype(np.float32), beyond)

    def edges(order: tuple[int, int]) -> Values:
        out: Values = gaussian_filter(padded, EDGE / COVER_RESOLUTION, order=order)
        return out

    def about(pair: tuple[Values, Values]) -> Values:
        blurred = gaussian_filter(pair[0] * pair[1] / steep, THERE / COVER_RESOLUTION)
        out: Values = blurred[::stride, ::stride][:my, :mx].astype(np.float64)
        return out

    south, east = in_threads(edges, [(1, 0), (0, 1)])
    steep = np.maximum(np.hypot(east, south), np.float32(1e-6))
    xx, yy, xy = in_threads(about, [(east, east), (south, south), (east, south)])
    # Rasters count rows southwards, and canopy lies across its gradient.
    direction = np.mod(np.arctan2(-2 * xy, xx - yy) / 2 + np.pi / 2, np.pi)
    return Grain(direction, np.hypot(xx - yy, 2 * xy) / np.maximum(xx + yy, 1e-12))


def scan_cylinders(cover: Values, radius: float, step: float, band: tuple[float, float]) -> Peaks:
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

    def waves(batch: Ints) -> Values:
        k = np.arange(len(batch))
        histogram = (sums @ windows[*batch.T][:, inside].T).T.reshape(len(batch), len(angles), n) / size
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
    return _peaks([waves(batch) for batch in batches], occupied, shape, sets=1)[0]


def _windows(cover: Values, half: int, step: float) -> tuple[Values, Ints, tuple[int, int]]:
    """Windows (my, mx, 2 half, 2 half) on a grid of nodes from the raster's corner, and those (k, 2) near canopy.

    They are a view: those of many nodes at once would take far more memory than the raster.
    """
    size = 2 * half
    stride, (my, mx) = _nodes(cover.shape, step)
    # Windows reach over the edge by half their width; what lies there is no canopy.
    padded = np.zeros([(m - 1) * stride + size for m in (my, mx)], dtype=np.float32)
    padded[half : half + cover.shape[0], half : half + cover.shape[1]] = cover[
        : padded.shape[0] - half, : padded.shape[1] - half
    ]
    windows = sliding_window_view(padded, (size, size))[::stride, ::stride]
    reach = 2 * round((NEAR + step) / COVER_RESOLUTION) + 1
    canopy = np.pad(maximum_filter(cover, reach) > LEAST_COVER, [(0, 2 * stride)], mode="edge")
    return windows, np.argwhere(canopy[::stride, ::stride][:my, :mx]), (my, mx)


def _nodes(shape: tuple[int, ...], step: float) -> tuple[int, tuple[int, int]]:
    """Cells between a scan's nodes, and how many nodes there are (my, mx)."""
    stride = max(1, round(step / COVER_RESOLUTION))
    my, mx = (n // stride + 2 for n in shape)
    return stride, (my, mx)


def _peaks(waves: Sequence[Values], occupied: Ints, shape: tuple[int, int], *, sets: int) -> list[Peaks]:
    """So many sets of waves (3 sets, k) of batches of windows, in their places."""
    out = np.zeros((sets, 3, *shape))
    out[:, :2] = np.nan
    if waves:
        out[:, :, *occupied.T] = np.concatenate(waves, axis=1).reshape(sets, 3, -1)
    return [Peaks(*one) for one in out]


def _strongest_wave(windows: Values, taper: Values, band: tuple[float, float], drawn: Grain) -> Values:
    """Direction (rad), spacing (m) and strength (0–1) of windows (k, size, size), and of the next waves, as (6, k)."""
    size = windows.shape[-1]
    wide = PADDING * size
    mean = np.einsum("kij,ij->k", windows, taper) / taper.sum()
    rows = rfft((windows - mean[:, None, None]) * taper, n=wide, axis=2)
    spectrum = fft(rows, n=wide, axis=1)
    power = spectrum.real**2 + spectrum.imag**2
    first = np.stack(_strongest(power, np.zeros((2, len(power))), *band))
    second = np.zeros_like(first)
    second[1] = 1.0
    weak = np.flatnonzero((first[2] < SURE) | (drawn.off(_across(first)) > ASKEW))
    if len(weak):
        second[:, weak] = _strongest(power[weak], np.ascontiguousarray(first[:2, weak]), *band)
    return np.concatenate([(_across(wave), 1 / np.hypot(*wave[:2]), wave[2]) for wave in (first, second)])


def _across(wave: Values) -> Values:
    """Direction of rows (k,) in radians that lie across waves (≥2, k) of such a frequency in y and x."""
    # Rasters count rows southwards, so the wave vector points to (x, -y).
    out: Values = np.mod(np.arctan2(-wave[0], wave[1]) + np.pi / 2, np.pi)
    return out


@compiled
def _strongest(powers: Values, other: Values, shortest: float, longest: float) -> tuple[Values, Values, Values]:
    """Frequency of the strongest wave (y and x, cycles a metre) of powers (k, n, n/2 + 1), and its strength 0–1.

    It is sought between two wavelengths in metres, 30° at the least from another wave (2, k), if that isn't zero. The
    strength is the share of the power beyond long waves that the main lobes about the wave and its harmonics hold.
    """
    windows, n, _ = powers.shape
    half = n // 2
    unit = n * COVER_RESOLUTION
    lowest, highest, long = (unit / longest) ** 2, (unit / shortest) ** 2, (unit / longest / 1.5) ** 2
    y, x, strength = np.empty(windows), np.empty(windows), np.empty(windows)
    for k in range(windows):
        power = powers[k]
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
                if lowest <= square <= highest and power[row, j] > most and _is_peak(power, i, j):
                    along = i * other[0, k] + j * other[1, k]
                    if along * along <= 0.75 * square * (other[0, k] ** 2 + other[1, k] ** 2):
                        most, best_i, best_j = power[row, j], i, j
        if most < 0:  # no peak lies in the band
            y[k], x[k], strength[k] = 0.0, 1 / longest, 0.0
            continue
        held = 0.0
        for harmonic in range(1, HARMONICS + 1):
            held += _lobe(power, harmonic * best_i, harmonic * best_j, 2 * PADDING)
        strength[k] = min(held / max(total, 1e-12), 1.0)
        here = np.log(power[best_i, best_j] + 1e-12)
        left = power[best_i, best_j - 1] if best_j else power[-best_i, 1]
        right = power[best_i, min(best_j + 1, half)]
        x[k] = (best_j + _vertex(np.log(left + 1e-12), here, np.log(right + 1e-12))) / unit
        north, south = np.log(power[best_i - 1, best_j] + 1e-12), np.log(power[best_i + 1, best_j] + 1e-12)
        y[k] = (best_i + _vertex(north, here, south)) / unit
    return y, x, strength


@compiled
def _is_peak(power: Values, i: int, j: int) -> bool:
    """Whether no bin beside one of a spectrum (n, n/2 + 1) holds more: at the band's end may stand a slope's foot."""
    half = power.shape[1] - 1
    for a in range(-1, 2):
        for b in range(-1, 2):
            row, column = i + a, j + b
            if column < 0:
                row, column = -row, -column
            if -half <= row < half and column <= half and power[row, column] > power[i, j]:
                return False
    return True


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


@dataclass(frozen=True)
class RowField:
    """Rasters of direction (degrees anticlockwise from east, axial in [0, 180)), spacing (m), likelihood (0–1)."""

    direction: Raster
    spacing: Raster
    likelihood: Raster
    square: bool = False
    """Whether somewhere several directions were about as good, as where vines are planted in a square or a quincunx."""
    plain: Raster | None = None
    """How clearly rows show, 0–1, where their wave tells little: a lone row has none, a square two."""

    def at(self, xy: Values) -> tuple[Values, Values, Values]:
        """Direction, spacing and likelihood (n,) of the cells that hold points (n, ≥2)."""
        cell = cell_of(xy, self.direction.grid)
        direction, spacing, likelihood = (
            raster.values.ravel()[cell] for raster in (self.direction, self.spacing, self.likelihood)
        )
        return direction, spacing, likelihood
