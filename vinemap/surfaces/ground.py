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

from vinemap.cloud.bins import quantiles_in
from vinemap.compute.threads import in_threads
from vinemap.errors import InputError
from vinemap.geo.raster import Grid, Raster, above, block_sum, cell_of, coarser, grid_over, sample, window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vinemap.cloud.tiles import Cloud

    Values = NDArray[np.float64]

GROUND = 2
"""ASPRS class of ground."""
COARSE = 1.0
"""Cell size in metres of the first, coarse surface."""
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
    cloud: Cloud,
    *,
    resolution: float = 0.25,
    quantile: float = 0.1,
    tolerance: float = 0.12,
    terrace_height: float = 1.0,
    engine: str = "vinemap",
) -> Raster:
    """Digital terrain model of a cloud, without holes.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        Points of terrain, vegetation and whatever stands on it; no classes needed, but by the engine "pdal".
    resolution : float
        Cell size in metres.
    quantile : float
        Order of the height that stands for a cell's terrain, 0 to 0.5.
    tolerance : float
        Metres that a cell may stand above the surface around it and still count as terrain.
    terrace_height : float
        Metres up to which a raised thin layer counts as a terrace; 0 where there are none.
    engine : str
        "vinemap", or "pdal": the surface through the points that PDAL classified as ground, for which of all
        these only ``resolution`` counts.

    Returns
    -------
    Raster
        Elevations in metres (ny, nx).
    """
    if engine == "pdal":
        return classified_terrain(cloud, resolution=resolution)
    blocks = _blocks(resolution)
    grid = grid_over(*cloud.extent, resolution=resolution, multiple=blocks)
    wide = coarser(grid, resolution=blocks * resolution)
    x, y = grid.centres()
    coarse = Raster(_coarse_surface(cloud, grid, blocks), wide, cloud.crs)
    surface = Raster(sample(coarse, np.stack(np.meshgrid(x, y), axis=-1)), grid, cloud.crs)
    for _ in range(2):
        n, found = _order_statistics(cloud, surface, grid, (quantile, 0.5, 0.9))
        cells = _Cells(n, *found)
        fitted = _fit_terrain(cells, resolution, quantile, tolerance, terrace_height)
        surface = Raster(surface.values + fitted, grid, cloud.crs)
        # On slopes and terraces that were new to it, soil is thin only once cells lie along them.
        if min(grid.shape) < 2 or np.quantile(np.hypot(*np.gradient(fitted)), 0.95) < EVEN:
            break
    return surface


def _blocks(resolution: float) -> int:
    """Cells a side of the blocks of the coarse surface."""
    return max(1, round(COARSE / resolution))


def block_side(resolution: float) -> float:
    """Side in metres of the terrain model's blocks of cells, which a cloud in tiles must not divide."""
    return _blocks(resolution) * resolution


def classified_terrain(cloud: Cloud, *, resolution: float = 0.25) -> Raster:
    """Digital terrain model through the points of a cloud that are classified as ground, without holes.

    Local planes are fitted to the cells' mean heights from coarse to fine, and bridge the cells that have none.

    Raises
    ------
    InputError
        If no point is classified as ground.
    """
    low, high = cloud.extent
    grid = grid_over(low, high, resolution=resolution, multiple=_blocks(resolution))
    reference = float(np.round((low[2] + high[2]) / 2))
    n, total = np.zeros((2, grid.ny * grid.nx))
    for part in cloud.parts():
        if part.classification is not None:
            ground = part.xyz[part.classification == GROUND]
            cell = cell_of(ground, grid)
            n += np.bincount(cell, minlength=len(n))
            total += np.bincount(cell, ground[:, 2] - reference, minlength=len(n))
    if not n.any():
        raise InputError("no point of the cloud is classified as ground: leave out ground.engine")
    held = n.reshape(grid.shape) > 0
    level = (total / np.maximum(n, 1)).reshape(grid.shape)
    plain = weight = np.minimum(n, 15.0).reshape(grid.shape)
    surface = _trend(level, held)
    for reach in (1.5, 1.5, 0.6, 0.3):
        surface = surface + _multiscale(level - surface, weight, reach / resolution)
        off = np.abs(level - surface)
        weight = plain / (1 + (off / (0.05 + 2 * np.median(off[held]))) ** 2)
    return Raster(surface + reference, grid, cloud.crs)


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


def canopy_height_model(cloud: Cloud, *, resolution: float = 0.25) -> Raster:
    """Canopy height model: the 98% height in metres of each cell's points, NaN where there is none.

    A cell stands no higher than the highest of its eight neighbours by more than ``SPIKE``, so that a point in the
    air doesn't make a tower. The cloud has its heights, and the resolution is that of its terrain model.
    """
    grid = grid_over(*cloud.extent, resolution=resolution, multiple=_blocks(resolution))
    n, found = _order_statistics(cloud, None, grid, (0.98,))
    height = np.maximum(found[0], 0)
    around = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    height = np.minimum(height, maximum_filter(height, footprint=around) + SPIKE)
    return Raster(np.where(n > 0, height, np.nan), grid, cloud.crs)


def _coarse_surface(cloud: Cloud, grid: Grid, blocks: int) -> Values:
    """Smooth surface through the low parts of blocks of cells, blind to what stands on them or floats below."""
    low, high = cloud.extent
    reference = float(np.round((low[2] + high[2]) / 2))
    level = Raster(np.full((1, 1), reference), grid, cloud.crs)
    n, (lowest,) = _order_statistics(cloud, level, grid, (0.05,), blocks=blocks)
    step = blocks * grid.resolution
    # Local planes are held to zero where cells are few, so the hillside must be gone first: an upper edge that stood
    # out above them would be taken for a house.
    held = n > 0
    trend = _trend(lowest, held)
    bare = lowest - trend
    weight = held.astype(float)
    surface = np.zeros(n.shape)
    for sigma in (8.0, 8.0, 5.0, 5.0, 5.0, 4.0, 4.0, 4.0):
        surface = _multiscale(bare, weight, sigma / step)
        above_it = np.where(held, bare - surface, 0.0)
        scale = 0.1 + 1.5 * float(np.median(np.abs(above_it[held])))
        asymmetric = np.where(above_it > 0, above_it / scale, above_it / (5 * scale))
        weight = np.where(held, 1 / (1 + asymmetric**2) ** 2, 0.0)
    return surface + trend + reference


def _trend(level: Values, held: NDArray[np.bool_]) -> Values:
    """Quadratic surface (ny, nx) through the levels of those cells that hold points, fitted robustly."""
    ny, nx = level.shape
    y, x = np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    design, low = terms[held], level[held]
    weight = np.ones(len(low))
    coefficients = np.zeros(6)
    for _ in range(10):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(design * root[:, None], low * root, rcond=None)[0]
        off = np.abs(low - design @ coefficients)
        weight = 1 / (1 + (off / (0.1 + 2 * np.median(off))) ** 2)
    out: Values = terms @ coefficients
    return out


def _order_statistics(
    cloud: Cloud, surface: Raster | None, grid: Grid, quantiles: tuple[float, ...], *, blocks: int = 1
) -> tuple[Values, Values]:
    """Counts and quantiles of the heights above a surface, or else above ground, in blocks of a grid's cells."""
    shape = [side // blocks for side in grid.shape]
    n, found = np.zeros(shape), np.zeros((len(quantiles), *shape))
    for part in cloud.parts():
        around, (rows, columns) = window(grid, *part.extent, multiple=_blocks(grid.resolution))
        heights = part.heights if surface is None else above(surface, part.xyz)
        here = slice(rows.start // blocks, rows.stop // blocks), slice(columns.start // blocks, columns.stop // blocks)
        n[here], found[:, *here] = quantiles_in(part.bins(around), heights, quantiles, blocks=blocks)
    return n, found


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

    values = weight * level
    wanted = [(weight, 0, 0), (weight, 1, 0), (weight, 0, 1), (weight, 2, 0), (weight, 1, 1), (weight, 0, 2)]
    wanted += [(values, 0, 0), (values, 1, 0), (values, 0, 1)]

    def moment(of: tuple[Values, int, int]) -> Values:
        down: Values = correlate1d(of[0], kernels[of[1]], axis=0, mode="constant")
        out: Values = correlate1d(down, kernels[of[2]], axis=1, mode="constant")
        return out

    w, wi, wj, wii, wij, wjj, z, zi, zj = in_threads(moment, wanted)
    w, wii, wjj = w + RIDGE, wii + RIDGE, wjj + RIDGE
    # Cramer's rule for the constant term of the symmetric 3 x 3 normal equations.
    a, b, c = wii * wjj - wij**2, wij * wj - wi * wjj, wi * wij - wii * wj
    return (a * z + b * zi + c * zj) / (a * w + b * wi + c * wj)
