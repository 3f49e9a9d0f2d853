"""Smooth surfaces through the levels of cells: local planes from coarse to fine, and one quadratic."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import correlate1d

from vinemap.compute.threads import in_threads, strips
from vinemap.geo.raster import block_sum

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Floats
    from vinemap.compute.threads import Strip

NARROWEST = 1.2
"""Cells of the narrowest plane that is still fitted well: wider ones are fitted on blocks of cells."""
RIDGE = 0.02
"""Weight that holds a local plane to the coarser surface where cells are few."""


def quadratic_trend(level: Floats, held: Flags) -> Floats:
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
    out: Floats = terms @ coefficients
    return out


def multiscale_fit(level: Floats, weight: Floats, sigma: float) -> Floats:
    """Local planes of width sigma (cells), held to ever wider ones where cells lack."""
    surface = np.zeros_like(level)
    for scale in (9.0, 3.0, 1.0):
        surface = surface + _decimated_fit(level - surface, weight, sigma * scale)
    return surface


def _decimated_fit(level: Floats, weight: Floats, sigma: float) -> Floats:
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


def _plane_fit(level: Floats, weight: Floats, sigma: float) -> Floats:
    """Value at each cell of the weighted local plane through levels (ny, nx): first-order local regression."""
    radius = int(np.ceil(2.5 * sigma))
    t = np.arange(-radius, radius + 1) / sigma
    bell = np.exp(-0.5 * t**2)
    bell /= bell.sum()
    kernels = bell, bell * t, bell * t**2

    def moment(of: Floats, i: int, j: int) -> Floats:
        down: Floats = correlate1d(of, kernels[i], axis=0, mode="constant")
        out: Floats = correlate1d(down, kernels[j], axis=1, mode="constant")
        return out

    def fitted(strip: Strip) -> Floats:
        weights = weight[strip.around]
        values = weights * level[strip.around]
        w, wi, wj, wii, wij, wjj = (moment(weights, *ij) for ij in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)))
        z, zi, zj = (moment(values, *ij) for ij in ((0, 0), (1, 0), (0, 1)))
        w, wii, wjj = w + RIDGE, wii + RIDGE, wjj + RIDGE
        # Cramer's rule for the constant term of the symmetric 3 x 3 normal equations.
        a, b, c = wii * wjj - wij**2, wij * wj - wi * wjj, wi * wij - wii * wj
        out: Floats = (a * z + b * zi + c * zj) / (a * w + b * wi + c * wj)
        return out[strip.inner]

    return np.concatenate(in_threads(fitted, strips(level.shape, beside=radius)))
