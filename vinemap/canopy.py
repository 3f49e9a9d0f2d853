"""Canopy told from terrain in every section, and measured (thesis, section 3.2.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import shapely
from scipy.ndimage import correlate1d

from vinemap.mesh import Mesh, loft, merge

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.cloud import Sections

    Values = NDArray[np.floating]
    Flags = NDArray[np.bool_]

BIN = 0.05
"""Metres: bins δs of the histograms of Eq. 8–9."""
NOISE_CELL = 0.1
"""Metres: cells of a section in which a point has neighbours or is noise."""
FOOT_QUANTILE = 0.02
"""Order of the height, among a section's canopy points, at which foliage begins."""
FOOT_BAND = 0.2
"""Metres above the foot whose points tell how wide the canopy stands on it."""


def separate_canopy(
    sections: Sections,
    *,
    margin: float = 0.4,
    half_width: float = 0.9,
    max_height: float = 2.9,
    min_neighbours: float = 0.02,
    min_points: int = 8,
    min_share: float = 0.15,
    min_height: float = 0.8,
) -> Sections:
    """Keep the canopy's points, and the sections that have a canopy.

    On each side of γ a plane runs from the foot of the vines to the canopy's wall at the elevation of the inter-row
    (Eq. 4–10). A point is canopy if it lies ``margin`` above that plane, where the printed plane cuts through the
    soil's own noise on flat ground, and as far above the terrain model.

    Parameters
    ----------
    sections : Sections
        All points of every section.
    margin, half_width, max_height : float
        Metres above plane and terrain at which canopy begins, to the side of γ at which it ends, and above terrain at
        which it ends.
    min_neighbours : float
        Share of a section's canopy points that must lie around a point (in 3 x 3 cells of 0.1 m), or it is noise.
    min_points : int
        Points that a section must have.
    min_share : float
        Share of the median section's points that a section must have.
    min_height : float
        Metres that 90% height of a section must reach.
    """
    section = sections.section
    side = sections.points[:, 0] >= 0
    y, z = np.abs(sections.points[:, 0]), sections.points[:, 1]
    canopy = (sections.height >= margin) & (sections.height <= max_height) & (y <= half_width)
    slope = np.zeros(len(y))
    for sign in (True, False):
        on = side == sign
        slope[on] = _plane_slope(sections, on, canopy)[section[on]]
    canopy &= z >= slope * y + margin
    canopy &= _has_neighbours(sections.points, section, canopy, min_neighbours)
    n = np.bincount(section[canopy], minlength=len(sections.row_id))
    enough = n >= max(float(min_points), min_share * float(np.median(n[n > 0])) if n.any() else 0.0)
    enough &= quantile_of(sections.height[canopy], np.concatenate([[0], np.cumsum(n)]), 0.9) >= min_height
    return sections.subset(canopy & enough[section], enough)


def _plane_slope(sections: Sections, on: Flags, canopy: Flags) -> Values:
    """Slope h/w (m,) of the plane on one side of every section: elevation of the inter-row over the wall's distance."""
    m = len(sections.row_id)
    section = sections.section
    y, z = np.abs(sections.points[:, 0]), sections.points[:, 1]
    wall = _peak(y[on & canopy], section[on & canopy], m, 0.0, 1.0)
    ground = on & (np.abs(sections.height) < 0.3) & (y > wall[section])
    level = _peak(z[ground], section[ground], m, -1.5, 1.5)
    # The inter-row's elevation is that of its middle: the plane through it must not be steeper than the ground.
    distance = np.bincount(section[ground], weights=y[ground], minlength=m) / np.maximum(
        np.bincount(section[ground], minlength=m), 1
    )
    return np.where(distance > 0, level / np.maximum(distance, 0.2), 0.0)


def _peak(values: Values, section: NDArray[np.int64], m: int, low: float, high: float) -> Values:
    """Position (m,) of the peak of each section's histogram of values between two bounds; 0 where it has none."""
    n = round((high - low) / BIN)
    bins = np.clip(((values - low) / BIN).astype(np.int64), 0, n - 1)
    histogram = np.bincount(section * n + bins, minlength=m * n).reshape(m, n)
    smooth = correlate1d(histogram.astype(float), [0.25, 0.5, 0.25], axis=1)
    return np.where(histogram.any(axis=1), low + (smooth.argmax(axis=1) + 0.5) * BIN, 0.0)


def _has_neighbours(points: Values, section: NDArray[np.int64], canopy: Flags, share: float) -> Flags:
    """Whether at least a share of its section's canopy points, and two others, lie around each point (n, 2)."""
    m = int(section[-1]) + 1 if len(section) else 0
    out = np.zeros(len(points), dtype=bool)
    if not canopy.any():
        return out
    cell = np.floor(points[canopy] / NOISE_CELL).astype(np.int64)
    cell -= cell.min(axis=0)
    ny, nz = cell.max(axis=0) + 1
    index = (section[canopy] * ny + cell[:, 0]) * nz + cell[:, 1]
    n = np.bincount(index, minlength=m * ny * nz).reshape(m, ny, nz).astype(np.float32)
    around = correlate1d(correlate1d(n, [1, 1, 1], axis=1, mode="constant"), [1, 1, 1], axis=2, mode="constant")
    total = np.bincount(section[canopy], minlength=m)[section[canopy]]
    out[canopy] = around.ravel()[index] >= np.maximum(3, share * total)
    return out


def quantile_of(values: Values, start: NDArray[np.int64], q: float) -> Values:
    """Quantile (m,) of the values (n,) of each section; 0 where it has none."""
    n = np.diff(start)
    section = np.repeat(np.arange(len(n)), n)
    ordered = values[np.lexsort((values, section))]
    if len(ordered) == 0:
        return np.zeros(len(n))
    rank = q * np.maximum(n - 1, 0)
    low = np.minimum(start[:-1] + np.floor(rank).astype(np.int64), len(ordered) - 1)
    high = np.minimum(start[:-1] + np.ceil(rank).astype(np.int64), len(ordered) - 1)
    part = rank - np.floor(rank)
    return np.where(n > 0, ordered[low] * (1 - part) + ordered[high] * part, 0.0)


def find_feet(canopy: Sections) -> tuple[Sections, Values]:
    """Find where the foliage of every section begins: the c-gon's fixed vertices v1, v2 and vc.

    The thesis sets them at soil level, where the polygon takes in the void under the canopy; here they lie at the
    foliage's foot: v1 under its middle, v2 and vc at its sides.

    Returns
    -------
    canopy : Sections
        Without the points below the foot.
    feet : (m, 3, 2) array
        v1, v2 (left of γ, positive y) and vc of every section, in metres of its frame.
    """
    m = len(canopy.row_id)
    foot = quantile_of(canopy.points[:, 1], canopy.start, FOOT_QUANTILE)
    canopy = canopy.subset(canopy.points[:, 1] >= foot[canopy.section], np.ones(m, dtype=bool))
    y, z = canopy.points.T
    band = z <= foot[canopy.section] + FOOT_BAND
    n = np.bincount(canopy.section[band], minlength=m)
    start = np.concatenate([[0], np.cumsum(n)])
    left, right = quantile_of(y[band], start, 0.95), quantile_of(y[band], start, 0.05)
    feet = np.stack([(left + right) / 2, foot, left, foot, right, foot], axis=-1).reshape(m, 3, 2)
    return canopy, feet


def measure_sections(canopy: Sections, polygons: Values, area: Values, *, crs: CRS) -> gpd.GeoDataFrame:
    """Table of sections, each as a line across the row on the ground.

    Heights and widths come from quantiles of the points, never from the polygons' corners.

    Parameters
    ----------
    canopy : Sections
        Canopy points of every section.
    polygons : (m, c, 2) array
        c-gons in the sections' frames, in metres.
    area : (m,) array
        Their areas in m².

    Returns
    -------
    GeoDataFrame
        LineStringZ with ``row_id``, ``position_m``, ``height_m`` (98.5% height above ground), ``bottom_m`` (2%),
        ``width_m`` (2–98% across), ``area_m2`` and ``n_points``.
    """
    y = canopy.points[:, 0]
    left, right = quantile_of(y, canopy.start, 0.98), quantile_of(y, canopy.start, 0.02)
    normal = np.column_stack([-canopy.tangent[:, 1], canopy.tangent[:, 0]])
    reach = np.stack([polygons[:, :, 0].min(axis=1), polygons[:, :, 0].max(axis=1)], axis=1)
    ends = canopy.origin[:, None, :2] + reach[:, :, None] * normal[:, None]
    level = np.repeat(canopy.origin[:, None, 2:], 2, axis=1)
    return gpd.GeoDataFrame(
        {
            "row_id": canopy.row_id,
            "position_m": canopy.position,
            "height_m": quantile_of(canopy.height, canopy.start, 0.985),
            "bottom_m": quantile_of(canopy.height, canopy.start, 0.02),
            "width_m": left - right,
            "area_m2": area,
            "n_points": np.diff(canopy.start),
        },
        geometry=shapely.linestrings(np.concatenate([ends, level], axis=2)) if len(ends) else [],
        crs=crs,
    )


def summarise_rows(rows: gpd.GeoDataFrame, sections: gpd.GeoDataFrame, *, step: float) -> gpd.GeoDataFrame:
    """Give rows their canopy's mean ``height_m`` and ``width_m``, and its ``volume_m3``; NaN where there is none.

    The volume lies between consecutive sections, as the mesh's does: the mean of their areas times their distance.
    """
    groups = sections.groupby("row_id")
    means = groups[["height_m", "width_m"]].mean().reindex(rows["row_id"])
    position, area = sections["position_m"].to_numpy(), sections["area_m2"].to_numpy()
    joined = ~_breaks(sections["row_id"].to_numpy(), position, step)
    pieces = (area[1:] + area[:-1]) / 2 * np.diff(position) * joined
    volume = sections.iloc[1:].assign(piece=pieces).groupby("row_id")["piece"].sum().reindex(rows["row_id"])
    return rows.assign(
        height_m=means["height_m"].to_numpy(), width_m=means["width_m"].to_numpy(), volume_m3=volume.to_numpy()
    )


def _breaks(row_id: NDArray[np.int64], position: Values, step: float) -> Flags:
    """Whether the canopy ends (m - 1,) between consecutive sections (m,): another row, or more than one lacks."""
    out: Flags = (np.diff(row_id) != 0) | (np.diff(position) > 2.5 * step)
    return out


def section_meshes(canopy: Sections, polygons: Values, rows: gpd.GeoDataFrame, *, step: float) -> list[Mesh]:
    """Closed meshes of the rows' canopies: polygons of consecutive sections, joined (Eq. 20–22).

    A mesh closes and starts anew where more than one section lacks.

    Parameters
    ----------
    canopy : Sections
        m sections in order of row and position.
    polygons : (m, c, 2) array
        Their c-gons.
    rows : GeoDataFrame
        Rows with ``row_id`` and ``label``; their numbers go with the meshes.
    step : float
        Metres between sections.
    """
    normal = np.column_stack([-canopy.tangent[:, 1], canopy.tangent[:, 0], np.zeros(len(canopy.row_id))])
    corners = canopy.origin[:, None] + polygons[:, :, :1] * normal[:, None] + polygons[:, :, 1:] * np.array([0, 0, 1.0])
    breaks = _breaks(canopy.row_id, canopy.position, step)
    runs = np.split(np.arange(len(corners)), np.flatnonzero(breaks) + 1)
    meshes = []
    numbers = rows.drop(columns="geometry").set_index("row_id", drop=False)
    for row_id, values in numbers.iterrows():
        pieces = [loft(corners[run]) for run in runs if len(run) > 1 and canopy.row_id[run[0]] == row_id]
        if pieces:
            meshes.append(
                Mesh(*merge(pieces), row_id=int(values["row_id"]), label=str(values["label"]), extras=values.to_dict())
            )
    return meshes
