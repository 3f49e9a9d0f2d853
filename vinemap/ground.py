"""Terrain from the cloud: a DTM on a raster of robust low percentiles, and heights above it.

A cell tells its terrain by a low order statistic of the heights in it, corrected for the statistic's expected
depth below the mean of the noise. Local planes are fitted to the cells, from coarse to fine; cells that stand
above them (canopy, trees, houses) lose their weight, so that under a closed canopy the surface is carried on
from around. On terraces a patch may stand above the fit if its points lie in one thin layer, as soil does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import binary_opening, correlate1d, maximum_filter
from scipy.special import ndtr, ndtri

from vinemap.compiled import compiled, in_threads, stretches
from vinemap.raster import Grid, Raster, block_sum, cell_of, coarser, grid_over, sample

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vinemap.cloud import PointCloud

    Values = NDArray[np.float64]

COARSE = 1.0
"""Cell size in metres of the first, coarse surface."""
STEP, LOWEST, BITS = 0.001, -500.0, 20
"""Heights are sorted in steps of a millimetre, from so many metres, as integers of so many bits."""
MOST_STEPS = 2**BITS - 1
EVEN = 0.02
"""Metres that terrain may rise from cell to cell above what a fit was made along."""
WEEDS = 0.3
"""Metres between a cell's low height and its median up to which its vegetation is weeds, and not a canopy."""
FEW = 6.0
"""Points whose heights tell nothing of weeds."""
SPIKE = 0.3
"""Metres by which a cell of the canopy height model may stand out."""
NARROWEST = 1.2
"""Cells of the narrowest plane that is still fitted well: wider ones are fitted on blocks of cells."""
RIDGE = 0.02
"""Weight that holds a local plane to the coarser surface where cells are few."""


class _Cells(NamedTuple):
    """Order statistics of the heights in each cell (ny, nx): counts, and quantiles where there are points."""

    n: Values
    low: Values
    middle: Values
    high: Values


def terrain_model(
    cloud: PointCloud,
    *,
    resolution: float = 0.25,
    quantile: float = 0.1,
    tolerance: float = 0.12,
    terrace_height: float = 1.0,
) -> Raster:
    """Digital terrain model of a cloud, without holes.

    Parameters
    ----------
    cloud : PointCloud
        Points of terrain, vegetation and whatever stands on it; no classes needed.
    resolution : float
        Cell size in metres.
    quantile : float
        Order of the height that stands for a cell's terrain, 0 to 0.5.
    tolerance : float
        Metres that a cell may stand above the surface around it and still count as terrain.
    terrace_height : float
        Metres up to which a raised thin layer counts as a terrace; 0 where there are none.

    Returns
    -------
    Raster
        Elevations in metres (ny, nx).
    """
    xyz, crs = cloud.xyz, cloud.crs
    grid = grid_over(xyz, resolution=resolution)
    wide = coarser(grid, resolution=COARSE)
    x, y = grid.centres()
    coarse = Raster(_coarse_surface(xyz, wide), wide, crs)
    surface = Raster(sample(coarse, np.stack(np.meshgrid(x, y), axis=-1)), grid, crs)
    cell = cell_of(xyz, grid)
    for _ in range(2):
        cells = _order_statistics(xyz[:, 2] - sample(surface, xyz), cell, grid, quantile)
        fitted = _fit_terrain(cells, resolution, quantile, tolerance, terrace_height)
        surface = Raster(surface.values + fitted, grid, crs)
        # On slopes and terraces that were new to it, soil is thin only once cells lie along them.
        if min(grid.shape) < 2 or np.quantile(np.hypot(*np.gradient(fitted)), 0.95) < EVEN:
            break
    return surface


def _fit_terrain(cells: _Cells, resolution: float, quantile: float, tolerance: float, terrace_height: float) -> Values:
    """Terrain (ny, nx) that cells tell, in their own heights."""
    noise = _noise(cells, quantile)
    level = cells.low - noise * _depth(cells.n, quantile) * _soil_share(cells, noise, quantile)
    spread = cells.high - cells.low
    weight = np.where(cells.n > 0, np.minimum(cells.n, 15.0) / (1 + (spread / (8 * noise)) ** 2), 0.0)
    thin = binary_opening((cells.n > 3) & (spread < 8 * noise), np.ones((3, 3)))
    surface = np.zeros(level.shape)
    for reach, slack in ((1.5, 4.0), (1.5, 2.5), (1.0, 1.5), (0.6, 1.0), (0.6, 1.0)):
        above = level - surface
        terrain = above < slack * tolerance
        terrain |= thin & (above < terrace_height)
        terrain &= above > -3 * slack * tolerance
        surface = _multiscale(level, weight * terrain, reach / resolution)
    return _multiscale(level, weight * terrain, 0.3 / resolution)


def height_above_ground(cloud: PointCloud, dtm: Raster) -> Values:
    """Height in metres (n,) of every point above the terrain model."""
    return cloud.xyz[:, 2] - sample(dtm, cloud.xyz)


def canopy_height_model(cloud: PointCloud, heights: NDArray[np.floating], *, resolution: float = 0.25) -> Raster:
    """Canopy height model: the 98% height in metres of each cell's points, NaN where there is none.

    A cell stands no higher than the highest of its eight neighbours by more than ``SPIKE``, so that a point in the
    air doesn't make a tower.
    """
    grid = grid_over(cloud.xyz, resolution=resolution)
    cells = _order_statistics(heights, cell_of(cloud.xyz, grid), grid, 0.98)
    height = np.maximum(cells.low, 0)
    around = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    height = np.minimum(height, maximum_filter(height, footprint=around) + SPIKE)
    return Raster(np.where(cells.n > 0, height, np.nan), grid, cloud.crs)


def _coarse_surface(xyz: Values, grid: Grid) -> Values:
    """Smooth surface (ny, nx) through the low parts of a cloud, blind to what stands on it or floats below."""
    reference = float(np.round(xyz[:, 2].mean()))
    cells = _order_statistics(xyz[:, 2] - reference, cell_of(xyz, grid), grid, 0.05)
    # Local planes are held to zero where cells are few, so the hillside must be gone first: an upper edge that stood
    # out above them would be taken for a house.
    trend = _trend(cells)
    cells = cells._replace(low=cells.low - trend)
    weight = (cells.n > 0).astype(float)
    surface = np.zeros(grid.shape)
    for sigma in (8.0, 8.0, 5.0, 5.0, 5.0, 4.0, 4.0, 4.0):
        surface = _multiscale(cells.low, weight, sigma / COARSE)
        above = np.where(cells.n > 0, cells.low - surface, 0.0)
        scale = 0.1 + 1.5 * float(np.median(np.abs(above[cells.n > 0])))
        asymmetric = np.where(above > 0, above / scale, above / (5 * scale))
        weight = np.where(cells.n > 0, 1 / (1 + asymmetric**2) ** 2, 0.0)
    return surface + trend + reference


def _trend(cells: _Cells) -> Values:
    """Quadratic surface (ny, nx) through the cells' low heights, fitted robustly."""
    ny, nx = cells.n.shape
    y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    held = cells.n > 0
    design, low = terms[held], cells.low[held]
    weight = np.ones(len(low))
    coefficients = np.zeros(6)
    for _ in range(10):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(design * root[:, None], low * root, rcond=None)[0]
        off = np.abs(low - design @ coefficients)
        weight = 1 / (1 + (off / (0.1 + 2 * np.median(off))) ** 2)
    out: Values = terms @ coefficients
    return out


def _order_statistics(heights: NDArray[np.floating], cells: NDArray[np.int64], grid: Grid, quantile: float) -> _Cells:
    """Quantiles of heights in cells, by one sort."""
    metres, keys = np.asarray(heights, dtype=np.float64), np.empty(len(cells), dtype=np.int64)
    in_threads(lambda part: _fill_keys(*part, metres, cells, keys), stretches(len(keys)))
    keys.sort()
    n = _count_keys(keys, grid.ny * grid.nx)
    first = np.cumsum(n) - n

    def at(q: float) -> Values:
        rank = np.maximum(np.ceil(q * n).astype(np.int64) - 1, 0)
        found = keys[np.minimum(first + rank, len(keys) - 1)] & MOST_STEPS
        return np.where(n > 0, found * STEP + LOWEST, 0.0).reshape(grid.shape)

    return _Cells(n.reshape(grid.shape).astype(float), at(quantile), at(0.5), at(0.9))


@compiled
def _fill_keys(first: int, last: int, heights: Values, cells: NDArray[np.int64], keys: NDArray[np.int64]) -> None:
    """Integers (n,) that hold a point's cell above and its height below."""
    for p in range(first, last):
        step = min(max(int((heights[p] - LOWEST) / STEP), 0), MOST_STEPS)
        keys[p] = cells[p] << BITS | step


@compiled
def _count_keys(keys: NDArray[np.int64], n_cells: int) -> NDArray[np.int64]:
    n = np.zeros(n_cells, dtype=np.int64)
    for key in keys:
        n[key >> BITS] += 1
    return n


def _depth(n: Values, quantile: float) -> Values:
    """Expected order statistic of n standard normal heights (Blom 1958)."""
    rank = np.maximum(np.ceil(quantile * n), 1)
    out: Values = ndtri((rank - 0.375) / (np.maximum(n, 1) + 0.25))
    return out


def _soil_share(cells: _Cells, noise: float, quantile: float) -> Values:
    """How much of the noise's depth lies between a cell's low quantile and its soil: 1 on bare soil, below 0 in weeds.

    Heights in weeds are taken as even from the soil up, blurred by the noise: the taller the weeds, the wider the
    quantiles lie apart, and the higher the low one stands above the soil instead of below it.
    """
    x = np.linspace(-4, 45, 2000)
    table = []
    for tall in np.linspace(0.01, 40, 80):
        share = (_ramp(x) - _ramp(x - tall)) / tall
        low, middle = np.interp([quantile, 0.5], share, x)
        table.append((middle - low, -low))
    apart, depth = np.array(table).T
    bare = -float(ndtri(quantile))
    spread = cells.middle - cells.low
    # Few points tell little: they are taken for soil's until more of them say otherwise.
    share = np.interp(spread / noise, apart, depth) / bare
    share = (cells.n * share + FEW) / (cells.n + FEW)
    return np.where(spread < WEEDS, share, 1.0)


def _ramp(x: Values) -> Values:
    """Integral of the standard normal distribution function."""
    out: Values = x * ndtr(x) + np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    return out


def _noise(cells: _Cells, quantile: float) -> float:
    """Standard deviation in metres of the heights of bare soil: that of the cells with the thinnest layers."""
    dense = cells.n >= max(5.0, float(np.quantile(cells.n[cells.n > 0], 0.5)))
    half = (cells.middle - cells.low)[dense] / -_depth(cells.n[dense], quantile)
    return float(np.clip(np.quantile(half, 0.33), 0.005, 0.1)) if half.size else 0.03


def _multiscale(level: Values, weight: Values, sigma: float) -> Values:
    """Local planes of width sigma (cells), held to ever wider ones where cells lack."""
    surface = np.zeros_like(level)
    for scale in (9.0, 3.0, 1.0):
        surface = surface + _decimated_fit(level - surface, weight, sigma * scale)
    return surface


def _decimated_fit(level: Values, weight: Values, sigma: float) -> Values:
    """:func:`_plane_fit` for wide planes on blocks of cells, brought back to the cells."""
    k = int(sigma / NARROWEST)
    if k < 2:
        return _plane_fit(level, weight, sigma)
    mean_weight = block_sum(weight, k) / k**2
    mean_level = block_sum(weight * level, k) / k**2 / np.maximum(mean_weight, 1e-9)
    wide = _plane_fit(mean_level, mean_weight, sigma / k)
    i, j = ((np.arange(n) + 0.5) / k - 0.5 for n in level.shape)
    for axis, at in ((0, i), (1, j)):
        low = np.clip(np.floor(at).astype(int), 0, max(wide.shape[axis] - 2, 0))
        part = (at - low)[:, None] if axis == 0 else (at - low)[None, :]
        high = np.minimum(low + 1, wide.shape[axis] - 1)
        wide = np.take(wide, low, axis) * (1 - part) + np.take(wide, high, axis) * part
    return wide


def _plane_fit(level: Values, weight: Values, sigma: float) -> Values:
    """Value at each cell of the weighted local plane through levels (ny, nx): first-order local regression."""
    radius = int(np.ceil(2.5 * sigma))
    t = np.arange(-radius, radius + 1) / sigma
    bell = np.exp(-0.5 * t**2)
    bell /= bell.sum()
    kernels = bell, bell * t, bell * t**2

    def moment(values: Values, a: int, b: int) -> Values:
        down: Values = correlate1d(values, kernels[a], axis=0, mode="constant")
        out: Values = correlate1d(down, kernels[b], axis=1, mode="constant")
        return out

    w, wi, wj = moment(weight, 0, 0), moment(weight, 1, 0), moment(weight, 0, 1)
    wii, wij, wjj = moment(weight, 2, 0), moment(weight, 1, 1), moment(weight, 0, 2)
    values = weight * level
    z, zi, zj = moment(values, 0, 0), moment(values, 1, 0), moment(values, 0, 1)
    w, wii, wjj = w + RIDGE, wii + RIDGE, wjj + RIDGE
    # Cramer's rule for the constant term of the symmetric 3 x 3 normal equations.
    a, b, c = wii * wjj - wij**2, wij * wj - wi * wjj, wi * wij - wii * wj
    return (a * z + b * zi + c * zj) / (a * w + b * wi + c * wj)
