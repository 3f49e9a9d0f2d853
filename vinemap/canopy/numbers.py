"""Sections and rows in numbers: heights, widths, volumes, and how well the polygons model the foliage (Table 3.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import shapely

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.canopy.points import Sections
    from vinemap.compute.arrays import Ints, Values

HECTARE = 10_000.0
"""Square metres."""
LOW, HIGH, TOP = 0.02, 0.98, 0.985
"""Quantiles of the canopy's points across the row, its sides, and of their heights, its top."""


class Measures(NamedTuple):
    """What is measured of m sections."""

    n_points: Ints
    height: Values
    """98.5% height (m,) of the points above ground in metres."""
    bottom: Values
    """Height (m,) at which the foliage begins in metres."""
    width: Values
    """2–98% of the points across (m,) in metres."""
    area: Values
    """Of the foliage's outline (m,) in m²."""
    good: Values
    under: Values
    over: Values
    """G, U and O (m,) of Table 3.1."""
    reduction: Values
    """R (m,) of Table 3.1."""


def measure_sections(canopy: Sections, bottom: Values, areas: tuple[Values, Values, Values], *, c: int) -> Measures:
    """Measure sections, heights and widths by quantiles of their points, never by the polygons' corners.

    Parameters
    ----------
    canopy : Sections
        Canopy points of m sections.
    bottom : (m,) array
        Height in metres at which the foliage begins.
    areas : three (m,) arrays
        In m²: of what the polygons and the foliage's outlines share, of the polygons, and of the outlines.
    c : int
        Vertices of a polygon.
    """
    y = canopy.points[:, 0]
    width = quantile_of(y, canopy.start, HIGH) - quantile_of(y, canopy.start, LOW)
    height = quantile_of(canopy.height, canopy.start, TOP)
    reduction = complexity_reduction(canopy, c=c)
    return Measures(np.diff(canopy.start), height, bottom, width, areas[2], *modelling_indices(*areas), reduction)


def tabulate_sections(at: Sections, polygons: Values, measures: Measures, *, crs: CRS) -> gpd.GeoDataFrame:
    """Table of sections, each as a line across the row on the ground, as wide as its polygon.

    Parameters
    ----------
    at : Sections
        m sections; their points don't matter.
    polygons : (m, c, 2) array
        c-gons in the sections' frames, in metres.
    measures : Measures
        What was measured of them.

    Returns
    -------
    GeoDataFrame
        LineStringZ with ``row_id``, ``position_m``, ``height_m`` (98.5% height above ground), ``bottom_m``,
        ``width_m`` (2–98% across), ``area_m2`` (the foliage's), ``n_points``; tree-row volume ``trv_m3_ha`` = height ·
        width · 10,000 / spacing, leaf-wall area ``lwa_m2_ha`` = 2 (height − bottom) · 10,000 / spacing; Table 3.1's
        indices ``good``, ``under``, ``over``, ``reduction`` and ``quality`` = G − (U + O) + R (Eq. 23).
    """
    n_points, height, bottom, width, area, good, under, over, reduction = measures
    normal = np.column_stack([-at.tangent[:, 1], at.tangent[:, 0]])
    reach = np.stack([polygons[:, :, 0].min(axis=1), polygons[:, :, 0].max(axis=1)], axis=1)
    ends = at.origin[:, None, :2] + reach[:, :, None] * normal[:, None]
    level = np.repeat(at.origin[:, None, 2:], 2, axis=1)
    return gpd.GeoDataFrame(
        {
            "row_id": at.row_id,
            "position_m": at.position,
            "height_m": height,
            "bottom_m": bottom,
            "width_m": width,
            "area_m2": area,
            "n_points": n_points,
            "trv_m3_ha": height * width * HECTARE / at.spacing,
            "lwa_m2_ha": 2 * (height - bottom) * HECTARE / at.spacing,
            "good": good,
            "under": under,
            "over": over,
            "reduction": reduction,
            "quality": good - (under + over) + reduction,
        },
        geometry=shapely.linestrings(np.concatenate([ends, level], axis=2)) if len(ends) else [],
        crs=crs,
    )


def modelling_indices(shared: Values, model: Values, reference: Values) -> tuple[Values, Values, Values]:
    """Good, under- and over-modelling (m,) of sections (Table 3.1), from areas (m,) in m².

    ``shared`` is what the polygon and the reference have in common; the reference is the foliage's outline.
    """
    good = shared / reference
    return good, 1 - good, (model - shared) / reference


def complexity_reduction(canopy: Sections, *, c: int) -> Values:
    """R (m,) of sections: how much lighter c vertices and 2 c faces are than the points that a section adds.

    Table 3.1, with the sign of the faces' share set right: R can't exceed 0.1.
    """
    added = np.maximum(np.diff(canopy.start) - _in_the_one_before(canopy.member, canopy.start, canopy.row_id), 1)
    return 0.1 * (1 - (c + 3 * 2 * c) / added)


@compiled
def _in_the_one_before(member: NDArray[np.int32], start: Ints, row_id: Ints) -> Values:
    """Points (m,) that a section shares with the one before it."""
    out = np.zeros(len(row_id))
    for k in range(1, len(row_id)):
        if row_id[k] != row_id[k - 1]:
            continue
        i, j = start[k - 1], start[k]
        while i < start[k] and j < start[k + 1]:
            if member[i] == member[j]:
                out[k] += 1
            if member[i] <= member[j]:
                i += 1
            else:
                j += 1
    return out


def quantile_of(values: Values, start: Ints, q: float) -> Values:
    """Quantile (m,) of the values (n,) of each section; 0 where it has none."""
    out = np.zeros(len(start) - 1)
    in_threads(lambda part: _quantiles(*part, np.ascontiguousarray(values), start, q, out), stretches(len(out)))
    return out


@compiled
def _quantiles(first: int, last: int, values: Values, start: Ints, q: float, out: Values) -> None:
    for k in range(first, last):
        if start[k + 1] > start[k]:
            out[k] = np.quantile(values[start[k] : start[k + 1]], q)


def summarise_rows(rows: gpd.GeoDataFrame, sections: gpd.GeoDataFrame, *, step: float) -> gpd.GeoDataFrame:
    """Give rows the means of their sections, and their foliage's ``volume_m3``; NaN where there is none.

    The means are ``height_m``, ``width_m``, ``bottom_m``, ``trv_m3_ha`` and ``lwa_m2_ha``. The volume is that of the
    foliage's outlines, each reaching half way to its neighbours, or half a ``step`` into a gap.
    """
    groups = sections.groupby("row_id")
    names = ["height_m", "width_m", "bottom_m", "trv_m3_ha", "lwa_m2_ha"]
    means = groups[names].mean().reindex(rows["row_id"])
    position, row = sections["position_m"].to_numpy(), sections["row_id"].to_numpy()
    away = np.diff(position)
    # Stations of a short row may lie up to half a step further apart; what lies further apart is a gap.
    way = np.where(np.diff(row) == 0, np.where(away <= 1.5 * step, away, step), 0.0)
    length = (np.concatenate([[0.0], way]) + np.concatenate([way, [0.0]]))[: len(row)] / 2
    volume = (sections["area_m2"] * length).groupby(row).sum().reindex(rows["row_id"])
    return rows.assign(**{name: means[name].to_numpy() for name in names}, volume_m3=volume.to_numpy())
