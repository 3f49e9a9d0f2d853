"""Key points: canopy centres found across the rows at the nodes of a 0.5 m grid (thesis, section 2.3.1)."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
from scipy.ndimage import gaussian_filter1d

from vinemap.compute.threads import in_threads
from vinemap.geo.raster import sample, sample_across
from vinemap.rows.curtains import FAR, SOME, abreast, peaks, with_curtains

if TYPE_CHECKING:
    from vinemap.compute.arrays import Ints, Values
    from vinemap.geo.raster import Grid, Raster
    from vinemap.surfaces.waves import RowField

BATCH = 1_000
WIDE = (1.0, 1.5, 2.0, 3.0)
"""Multiples of the smoothing for canopies that are the wider."""
WIDTH_SHARE = 0.3
"""Standard deviation of the smoothing, in widths of the canopy."""
TAIL = 2.5
"""Standard deviations up to which the smoothing reaches."""
SLICES = 3
"""Lines across the rows that are averaged in a slice."""
MERGED = 0.6
"""Standard deviation of the smoothing that leaves one maximum of two curtains, in their distance."""


def detect_key_points(
    cover: Raster,
    dtm: Raster,
    field: RowField,
    *,
    grid_step: float = 0.5,
    reach: float = 0.6,
    slice_width: float = 0.5,
    bin_width: float = 0.05,
    smoothing: float = 0.15,
    min_cover: float = 0.12,
    min_likelihood: float = 0.1,
) -> gpd.GeoDataFrame:
    """Find the canopy's central points (Eq. 1–3).

    At every node O of a grid, canopy cover in a slice across the local rows makes a profile D(v) (Eq. 1, of cover
    instead of point counts, so that it doesn't follow the cloud's density); its maxima v̂ are the central points
    c = O + v̂·(−sin ϑ, cos ϑ) (Eq. 2–3), with ϑ the direction of the rows. Where rows have two curtains, closer to each
    other than to the next row's, it lies between both.

    Parameters
    ----------
    cover : Raster
        Canopy cover 0–1.
    dtm : Raster
        Terrain, for the points' elevation.
    field : RowField
        Direction and spacing of the rows.
    grid_step, slice_width, bin_width : float
        Distance of the nodes, width of the slice along the rows and of the profile's bins, in metres.
    smoothing : float
        Standard deviation in metres of the Gaussian that smooths a profile, at the least: a hollow canopy has one
        maximum, not two.
    reach : float
        How far a profile reaches to both sides, in inter-row spacings. The thesis's cylinders of 5 m reach 2.
    min_cover, min_likelihood : float
        Cover that a maximum must have, and likelihood that a node must have.

    Returns
    -------
    GeoDataFrame
        PointZ with columns ``cover`` (0–1), ``direction_deg`` and ``spacing_m`` of the field there, and ``curtains_m``,
        the distance of the two curtains of a row, 0 where it has one, and ``told``, whether gaps tell that.
    """
    nodes, cells = _nodes(field, cover.grid, grid_step, min_likelihood)
    some = nodes[(cells % SOME == SOME // 2).all(axis=1)]

    def curtains(batch: Values) -> Values:
        profile, offsets = _profiles(cover, batch, FAR * batch[:, 3].max(), slice_width, bin_width)
        profile = gaussian_filter1d(profile, smoothing / bin_width, axis=1)
        return abreast(profile, offsets, batch, cover, min_cover=min_cover)

    def maxima(batch: Values) -> Values:
        # Beyond its reach a profile goes on for what the Gaussian needs.
        double = float(batch[:, 4].max())
        margin = TAIL * max(WIDE[-1] * smoothing, MERGED * double) + bin_width
        profile, offsets = _profiles(cover, batch, reach * batch[:, 3].max() + margin, slice_width, bin_width)
        if double:
            profile = gaussian_filter1d(profile, MERGED * double / bin_width, axis=1, truncate=TAIL)
        else:
            profile = _smoothed(profile, offsets, batch[:, 3], smoothing)
        # What is laid together is spread, too.
        return _maxima(profile, offsets, batch, reach, min_cover / 2 if double else min_cover)

    found = np.concatenate([np.empty((0, 7)), *in_threads(curtains, _batches(some))])
    nodes = with_curtains(nodes, cells, found, grid_step)
    double = nodes[:, 4] > 0
    batches = [*_batches(nodes[~double]), *_batches(nodes[double])]
    points = np.concatenate([np.empty((0, 7)), *in_threads(maxima, batches)])
    z = sample(dtm, points[:, :2]) if len(points) else np.empty(0)
    return gpd.GeoDataFrame(
        dict(zip(("cover", "direction_deg", "spacing_m", "curtains_m"), points[:, 2:6].T, strict=True))
        | {"told": points[:, 6] > 0},
        geometry=gpd.points_from_xy(points[:, 0], points[:, 1], z),
        crs=cover.crs,
    )


def central_points(origin: Values, offsets: Values, direction: Values) -> Values:
    """Points (n, 2) at offsets (n,) in metres to the left of rows of a direction in radians (n,), from origins (n, 2).

    Eq. 2–3, with ϑ the direction of the row.
    """
    normal = np.column_stack([-np.sin(direction), np.cos(direction)])
    out: Values = origin + offsets[:, None] * normal
    return out


def _batches(nodes: Values) -> list[Values]:
    return [nodes[start : start + BATCH] for start in range(0, len(nodes), BATCH)]


def _nodes(field: RowField, grid: Grid, step: float, min_likelihood: float) -> tuple[Values, Ints]:
    """Nodes (n, 4) as x, y, direction (rad), spacing (m), where rows are likely, and their cells (n, 2) of the grid."""
    x = np.arange(grid.west + step / 2, grid.west + grid.nx * grid.resolution, step)
    y = np.arange(grid.north - step / 2, grid.north - grid.ny * grid.resolution, -step)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    direction, spacing, likelihood = field.at(xy)
    likely = (likelihood >= min_likelihood) & np.isfinite(direction) & np.isfinite(spacing)
    nodes: Values = np.column_stack([xy, np.radians(direction), spacing])[likely]
    return nodes, np.argwhere(likely.reshape(len(y), len(x)))


def _profiles(
    cover: Raster, nodes: Values, extent: float, slice_width: float, bin_width: float
) -> tuple[Values, Values]:
    """Profiles D(v) (n, bins) across the rows at nodes (n, 4), and the bins' offsets v to the left in metres."""
    origin, direction = nodes[:, :2], nodes[:, 2]
    half = int(np.ceil(extent / bin_width))
    offsets = np.arange(-half, half + 1) * bin_width
    tangent = np.column_stack([np.cos(direction), np.sin(direction)])
    normal = np.column_stack([-np.sin(direction), np.cos(direction)])
    profile = np.zeros((len(nodes), len(offsets)))
    for along in np.linspace(-slice_width / 2, slice_width / 2, SLICES):
        profile += sample_across(cover, origin + along * tangent, normal, offsets)
    return profile / SLICES, offsets


def _smoothed(profile: Values, offsets: Values, spacing: Values, smoothing: float) -> Values:
    """Profiles (n, bins) smoothed by a Gaussian, the wider the wider the canopy in them: a broad top has one middle."""
    step = offsets[1] - offsets[0]
    inside = np.abs(offsets) <= 0.5 * spacing[:, None]
    out: Values = gaussian_filter1d(profile, smoothing / step, axis=1, truncate=TAIL)
    highest = np.maximum((out * inside).max(axis=1), 1e-9)
    width = (profile * inside).sum(axis=1) * step / highest
    wanted = np.digitize(WIDTH_SHARE * width / smoothing, [(a + b) / 2 for a, b in pairwise(WIDE)])
    for k, factor in enumerate(WIDE[1:], start=1):
        mine = wanted == k
        out[mine] = gaussian_filter1d(profile[mine], factor * smoothing / step, axis=1, truncate=TAIL)
    return out


def _maxima(profile: Values, offsets: Values, nodes: Values, reach: float, min_cover: float) -> Values:
    """Maxima (m, 7) of the profiles: x, y, cover, direction (degrees), and what else is known of their nodes (n, 6)."""
    node, k = np.nonzero(peaks(profile, min_cover) & (np.abs(offsets[1:-1]) <= reach * nodes[:, 3:4]))
    left, top, right = profile[node, k], profile[node, k + 1], profile[node, k + 2]
    shift = 0.5 * (left - right) / np.minimum(left - 2 * top + right, -1e-9)
    v = offsets[k + 1] + (offsets[1] - offsets[0]) * np.clip(shift, -0.5, 0.5)
    xy = central_points(nodes[node, :2], v, nodes[node, 2])
    return np.column_stack([xy, top, np.degrees(nodes[node, 2]), nodes[node, 3:]])
