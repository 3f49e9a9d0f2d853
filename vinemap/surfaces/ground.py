"""Terrain from the cloud: a DTM on a raster of robust low percentiles.

A cell tells its terrain by a low order statistic of the heights in it, corrected for the statistic's expected
depth below the mean of the noise. Local planes are fitted to the cells, from coarse to fine; cells that stand
above them (canopy, trees, houses) lose their weight, so that under a closed canopy the surface is carried on
from around. On terraces soil may stand off the fit, up to the brow of a wall and down to its foot, if it hangs
together with soil on the fit in one thin layer; at the wall itself it stays where its cells tell it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.special import ndtr, ndtri

from vinemap.cloud.bins import cells_a_block
from vinemap.compute.links import NEXT, parts_of
from vinemap.errors import InputError
from vinemap.geo.raster import Grid, Raster, cell_of, coarser, grid_over, sample
from vinemap.surfaces.planes import multiscale_fit, quadratic_trend
from vinemap.surfaces.statistics import order_statistics

if TYPE_CHECKING:
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Floats, Ints, Values

GROUND = 2
"""ASPRS class of ground."""
EVEN = 0.02
"""Metres that terrain may rise from cell to cell above what a fit was made along."""
WEEDS = 0.4
"""Metres between a cell's low height and its high one up to which its vegetation is weeds, and not a canopy."""
NEAR = 0.3
"""Metres over which the last planes are fitted, and over which cells tell of weeds together."""
UNEVEN = 0.05
"""Share by which bare soil may be noisier at one place than at another."""
ON_IT = 0.1
"""Share of a layer's cells from which on it is soil, if they lie on what was fitted to all."""
STEEP = 0.5
"""Rise over run from which on what was fitted may run across a wall."""


class _Cells(NamedTuple):
    """Order statistics of the heights in each cell (ny, nx): counts, and quantiles where there are points."""

    n: Floats
    low: Floats
    middle: Floats
    high: Floats


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
        Metres that soil of a terrace may stand off the surface around it; 0 where there are none.
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
    blocks = cells_a_block(resolution)
    grid = grid_over(*cloud.extent, resolution=resolution, multiple=blocks)
    wide = coarser(grid, resolution=blocks * resolution)
    x, y = grid.centres()
    coarse = Raster(_coarse_surface(cloud, grid, blocks), wide, cloud.crs)
    surface = Raster(sample(coarse, np.stack(np.meshgrid(x, y), axis=-1)), grid, cloud.crs)
    for _ in range(2):
        n, found = order_statistics(cloud, surface, grid, (quantile, 0.5, 0.9))
        cells = _Cells(n, *found)
        fitted = _fit_terrain(cells, surface.values, resolution, quantile, tolerance, terrace_height)
        surface = Raster(surface.values + fitted, grid, cloud.crs)
        # On slopes and terraces that were new to it, soil is thin only once cells lie along them.
        if np.quantile(_fall(fitted), 0.95) < EVEN:
            break
    return surface


def classified_terrain(cloud: Cloud, *, resolution: float = 0.25) -> Raster:
    """Digital terrain model through the points of a cloud that are classified as ground, without holes.

    Local planes are fitted to the cells' mean heights from coarse to fine, and bridge the cells that have none.

    Raises
    ------
    InputError
        If no point is classified as ground.
    """
    low, high = cloud.extent
    grid = grid_over(low, high, resolution=resolution, multiple=cells_a_block(resolution))
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
    surface = quadratic_trend(level, held)
    for reach in (1.5, 1.5, 0.6, 0.3):
        surface = surface + multiscale_fit(level - surface, weight, reach / resolution)
        off = np.abs(level - surface)
        weight = plain / (1 + (off / (0.05 + 2 * np.median(off[held]))) ** 2)
    return Raster(surface + reference, grid, cloud.crs)


def _fit_terrain(
    cells: _Cells, base: Values, resolution: float, quantile: float, tolerance: float, terrace_height: float
) -> Floats:
    """Terrain (ny, nx) that cells tell, in their own heights, which are above a base (ny, nx)."""
    half, points = _half_spread(cells, quantile, NEAR / resolution)
    noise = _noise(half, points)
    share = _soil_share(half / noise, points, quantile)
    level = cells.low - noise * share * _depth(cells.n, quantile, _soil(cells, quantile))
    spread = cells.high - cells.low
    weight = np.where(cells.n > 0, np.minimum(cells.n, 15.0) / (1 + (spread / (8 * noise)) ** 2), 0.0)
    # How high weeds have lifted a low height is a guess: bare soil beside them knows better.
    weight /= 1 + (2 * (1 - share)) ** 2
    # From one quantile to the other, soil spans some 2.6 times its noise, and as much as the base falls beneath it.
    thin = (cells.n > 1) & (spread < 4 * noise + (0.9 - quantile) * _fall(base))
    layer = _layers(np.where(cells.n > 0, base + level, np.nan), thin, tolerance)
    size = np.bincount(layer.ravel())
    surface = np.zeros(level.shape)
    for reach, slack in ((1.5, 4.0), (1.5, 2.5), (1.0, 1.5), (0.6, 1.0), (0.6, 1.0)):
        above = level - surface
        on_it = np.bincount(layer[np.abs(above) < tolerance], minlength=len(size)) > ON_IT * size
        soil = on_it[layer] & (np.abs(above) < terrace_height)
        terrain = soil | (above < slack * tolerance) & (above > -3 * slack * tolerance)
        surface = multiscale_fit(level, weight * terrain, reach / resolution)
    surface = multiscale_fit(level, weight * terrain, NEAR / resolution)
    steep = _fall(base + surface) > STEEP * resolution
    edge = soil & thin & steep & (np.abs(level - surface) > tolerance)
    # What lies in a cell at a wall is wall, up to its brow.
    brow = maximum_filter(np.where(edge, base + level, -np.inf), 3) - base
    wall = np.where(steep & ~(soil & thin), np.where(cells.n > 0, np.minimum(brow, cells.high), brow), -np.inf)
    out: Floats = np.where(edge, level, np.maximum(surface, wall))
    return out


def _layers(height: Floats, thin: Flags, step: float) -> Ints:
    """Layer (ny, nx) of each cell: cells beside each other, within a step in height, are of one if either is thin."""
    index = np.arange(height.size, dtype=np.int32).reshape(height.shape)
    ends = []
    for one, other in NEXT:
        linked = (thin[one] | thin[other]) & (np.abs(height[one] - height[other]) < step)
        ends.append(np.stack([index[one][linked], index[other][linked]]))
    return parts_of(height.size, *np.concatenate(ends, axis=1)).reshape(height.shape)


def _fall(surface: Values) -> Floats:
    """Metres that a surface falls across each of its cells (ny, nx)."""
    return np.hypot(*np.gradient(surface)) if min(surface.shape) > 1 else np.zeros(surface.shape)


def _coarse_surface(cloud: Cloud, grid: Grid, blocks: int) -> Floats:
    """Smooth surface through the low parts of blocks of cells, blind to what stands on them or floats below."""
    low, high = cloud.extent
    reference = float(np.round((low[2] + high[2]) / 2))
    level = Raster(np.full((1, 1), reference), grid, cloud.crs)
    n, (lowest,) = order_statistics(cloud, level, grid, (0.05,), blocks=blocks)
    step = blocks * grid.resolution
    # Local planes are held to zero where cells are few, so the hillside must be gone first: an upper edge that stood
    # out above them would be taken for a house.
    held = n > 0
    trend = quadratic_trend(lowest, held)
    bare = lowest - trend
    weight = held.astype(float)
    surface = np.zeros(n.shape)
    for sigma in (8.0, 8.0, 5.0, 5.0, 5.0, 4.0, 4.0, 4.0):
        surface = multiscale_fit(bare, weight, sigma / step)
        above_it = np.where(held, bare - surface, 0.0)
        scale = 0.1 + 1.5 * float(np.median(np.abs(above_it[held])))
        asymmetric = np.where(above_it > 0, above_it / scale, above_it / (5 * scale))
        weight = np.where(held, 1 / (1 + asymmetric**2) ** 2, 0.0)
    return surface + trend + reference


def _depth(n: Floats, quantile: float, soil: Floats | float = 1.0) -> Floats:
    """Expected order statistic of n heights of which a share is soil's, standard normal, and lowest (Blom 1958)."""
    rank = np.maximum(np.ceil(quantile * n), 1)
    out: Floats = ndtri(np.minimum((rank - 0.375) / (np.maximum(soil * n, 1) + 0.25), 0.9))
    return out


def _soil(cells: _Cells, quantile: float) -> Floats:
    """Share of each cell's points that lie below a canopy, about: it begins somewhere between two of the quantiles."""
    begins = np.where(cells.middle - cells.low < WEEDS, (0.5 + 0.9) / 2, (quantile + 0.5) / 2)
    return np.where(cells.high - cells.low < WEEDS, 1.0, begins)


def _half_spread(cells: _Cells, quantile: float, sigma: float) -> tuple[Floats, Floats]:
    """Standard deviation (ny, nx) of heights without a canopy, by their lower half, and how many points told it.

    One cell's few points tell it too badly: it is the mean of the cells within about sigma (cells).
    """
    apart = _depth(cells.n, 0.5) - _depth(cells.n, quantile)
    weight = np.where((cells.high - cells.low < WEEDS) & (apart > 0.1), cells.n, 0.0)
    half = weight * (cells.middle - cells.low) / np.maximum(apart, 0.1)
    total, mean = (gaussian_filter(v, sigma, mode="constant", truncate=2.5) for v in (weight, half))
    return mean / np.maximum(total, 1e-9), total * max(4 * np.pi * sigma**2, 1)


def _soil_share(ratio: Floats, points: Floats, quantile: float) -> Floats:
    """How much of the noise's depth lies between a cell's low quantile and its soil: 1 on bare soil, below 0 in weeds.

    Heights in weeds are taken as even from the soil up, blurred by the noise: the taller the weeds, the greater the
    ratio of their half spread to the noise, and the higher the low quantile stands above the soil instead of below it.
    Since the least excess over 1 would tell of weeds already, only what is beyond chance does.
    """
    x = np.linspace(-4, 45, 2000)
    table = []
    for tall in np.linspace(0.01, 40, 80):
        share = (_ramp(x) - _ramp(x - tall)) / tall
        low, middle = np.interp([quantile, 0.5], share, x)
        table.append((middle - low, -low))
    apart, depth = np.array(table).T
    # Standard error of the difference of two quantiles of normal heights, over their difference.
    z = np.minimum(ndtri(quantile), -0.01)
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    variance = quantile * (1 - quantile) / density**2 + np.pi / 2 - quantile * np.sqrt(2 * np.pi) / density
    chance = np.sqrt(variance / np.maximum(points, 1)) / -z
    excess = np.maximum(ratio - 1 - 2 * chance - UNEVEN, 0.0)
    out: Floats = np.interp(-z * (1 + excess), apart, depth) / -z
    return np.where(points > 0, out, 1.0)


def _ramp(x: Floats) -> Floats:
    """Integral of the standard normal distribution function."""
    out: Floats = x * ndtr(x) + np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    return out


def _noise(half: Floats, points: Floats) -> float:
    """Standard deviation in metres of the heights of bare soil: that of where layers are thinnest."""
    told = points[points > 0]
    dense = half[points >= max(5.0, float(np.median(told)))] if told.size else told
    return float(np.clip(np.quantile(dense, 0.33), 0.005, 0.1)) if dense.size else 0.03
