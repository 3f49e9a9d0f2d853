"""Row direction, inter-row spacing and vineyard likelihood, from the spectrum of the canopy's cover.

Rows are a plane wave in a raster of canopy cover: in a window of a few rows the strongest peak of its power
spectrum lies across the rows at one cycle a spacing (Delenne et al. 2008; the thesis scans cylinders instead).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import shapely
from scipy.ndimage import map_coordinates, maximum_filter
from scipy.spatial import cKDTree

from vinemap.compute.beside import nearest_beside
from vinemap.geo.curve import at
from vinemap.geo.raster import Grid, Raster, coarser
from vinemap.rows.windows import axial_median, one_way, prescribed, settled, shown, with_the_grain
from vinemap.surfaces.waves import (
    COVER_RESOLUTION,
    LEAST_COVER,
    NEAR,
    Peaks,
    RowField,
    grain,
    scan_cylinders,
    scan_spectrum,
)

if TYPE_CHECKING:
    import geopandas as gpd

    from vinemap.compute.arrays import Ints, Values

FIELD_RESOLUTION = 0.5
"""Cell size in metres of the rasters of a row field."""
ALIGNED = 0.87
"""Cosine of the angle between windows' rows up to which those between them run between."""


def estimate_row_field(
    cover: Raster,
    *,
    method: str = "spectrum",
    window: float = 18.0,
    radius: float = 6.5,
    step: float = 2.0,
    min_spacing: float = 0.8,
    max_spacing: float = 6.0,
    row_direction: float | None = None,
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
    row_direction : float, optional
        Direction of all rows, in degrees anticlockwise from the grid's east, within 12°; by default it is found.

    Returns
    -------
    RowField
        On a grid of 0.5 m over the cover's area. Likelihood is the share of the window's variance that the wave
        and its harmonics carry; direction and spacing are NaN where it is zero.
    """
    base = _block_mean(cover, COVER_RESOLUTION)
    band = (min_spacing, max_spacing)
    least = (window / 2 / step) ** 2
    drawn = grain(base.values, step)
    waves: tuple[Peaks, ...]
    if method == "cylinders":
        waves = (scan_cylinders(base.values, radius, step, band),)
        peaks, square = waves[0], np.zeros_like(drawn.clear, dtype=bool)
    else:
        waves = with_the_grain(*scan_spectrum(base.values, window, step, band, drawn), drawn)
        peaks, square = one_way(*waves, drawn, least=least)
    if row_direction is not None:
        peaks = prescribed(waves, np.radians(row_direction))
    peaks = settled(axial_median(peaks), least=least)
    plain = shown(peaks, drawn, square)
    grid = coarser(cover.grid, resolution=FIELD_RESOLUTION)
    stride = max(1, round(step / COVER_RESOLUTION)) * COVER_RESOLUTION
    field = _resample(peaks, plain, grid, base.grid, stride, cover)
    return replace(field, square=row_direction is None and bool(square.any()))


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


def _resample(peaks: Peaks, plain: Values, grid: Grid, base: Grid, step: float, cover: Raster) -> RowField:
    """Bring the waves of the windows to a raster, weighted by their strength."""
    x, y = grid.centres()
    i, j = np.meshgrid((base.north - y) / step, (x - base.west) / step, indexing="ij")

    def there(values: Values) -> Values:
        out: Values = map_coordinates(values, [i, j], order=1, mode="nearest")
        return out

    strength, turned, spacings = peaks.strength, np.nan_to_num(peaks.direction), np.nan_to_num(peaks.spacing)
    wave = strength**2 * np.exp(2j * turned)
    mean = there(wave.real) + 1j * there(wave.imag)
    direction = np.mod(np.degrees(np.angle(mean) / 2), 180)
    weight = there(strength**2)
    spacing = there(strength**2 * spacings) / np.maximum(weight, 1e-12)
    # Where blocks meet, or rows a hedge, none runs between their directions.
    unlike = np.abs(mean) < ALIGNED * weight
    nearest = _strongest_of_four(strength**2, i[unlike], j[unlike])
    direction[unlike], spacing[unlike] = np.degrees(turned[nearest]), spacings[nearest]
    reach = 2 * round(NEAR / FIELD_RESOLUTION) + 1
    near = maximum_filter(_block_mean(cover, FIELD_RESOLUTION).values, reach) > LEAST_COVER
    likelihood = np.where(near, there(strength), 0.0)
    known = weight > 1e-9

    def raster(values: Values) -> Raster:
        return Raster(values, grid, cover.crs)

    return RowField(
        raster(np.where(known, direction, np.nan)),
        raster(np.where(known, spacing, np.nan)),
        raster(likelihood),
        plain=raster(there(plain)),
    )


def _strongest_of_four(weight: Values, i: Values, j: Values) -> tuple[Ints, Ints]:
    """Rows and columns (n,) of those nodes (my, mx) about places (n,) that weigh most there, as a mean takes them."""
    my, mx = weight.shape
    corners = [
        (np.clip(np.floor(i).astype(int) + a, 0, my - 1), np.clip(np.floor(j).astype(int) + b, 0, mx - 1))
        for a in (0, 1)
        for b in (0, 1)
    ]
    share = [weight[corner] * (1 - np.abs(i - corner[0])) * (1 - np.abs(j - corner[1])) for corner in corners]
    most = np.argmax(share, axis=0)
    row, column = (np.choose(most, list(nodes)) for nodes in zip(*corners, strict=True))
    return row, column


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
        field.square,
        field.plain,
    )


def _spacing_beside(here: Values, chord: Values, row: Ints, expected: Values) -> Values:
    """Mean distance in metres (n,) from points of rows to the rows on both sides, NaN where there is none."""
    way = chord / np.hypot(*chord.T)[:, None]
    sides, _ = nearest_beside(here, way, row, 1.8 * expected, along=0.75, apart=0.3)
    reached = np.isfinite(sides)
    n = reached.sum(axis=1)
    return np.where(n > 0, np.where(reached, sides, 0).sum(axis=1) / np.maximum(n, 1), np.nan)
