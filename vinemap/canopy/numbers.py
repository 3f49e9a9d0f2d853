"""Sections and rows in numbers: heights, widths, volumes, and how well the polygons model the foliage (Table 3.1)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from vinemap.canopy.points import LOWLY, above_weeds
from vinemap.compute.compiled import compiled
from vinemap.compute.order import quantile
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
CELL = 0.1
"""Metres of height, on one side of a canopy, and across it, that a point shows."""
SEEN = 0.45, 0.8
"""Shares of such cells that are shown where a canopy's numbers are to be doubted, and where they aren't."""
FULL = 0.6, 0.85
"""Shares of a canopy's width that hold foliage where its numbers are to be doubted, as with two curtains, or aren't."""
DIFFERENT = 0.25, 0.14
"""Shares by which sections a metre apart differ, where their numbers are to be doubted, and where they aren't."""
SPREADING = 2.5, 0.8
"""Ratios of width to depth of a canopy whose underside was hardly seen, and of one that hides little of it."""
ON_WEEDS, HIDDEN = 0.08, (0.45, 0.25)
"""Metres above where low rows are told from weeds by their height within which foliage may go on below, and shares of
a row's height up to its foot where its numbers are to be doubted, and where they aren't."""
ODD_SIZE, ODD_DEVIATIONS = 1.4, 4.0
"""Ratio of a row's height or width to the median of its block, or its inverse, and deviations from it, that are odd."""
FEW, NEARBY = 3, 3.0
"""Rows of a block that can be compared; else those within so many spacings are."""


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
    seen: Values
    """Share (m,) of both sides, from the lowest points up to the height, on which there are points."""
    full: Values
    """Share (m,) of the width on which there are points."""


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
    left, right = (quantile_of(canopy.points[:, 0], canopy.start, q) for q in (HIGH, LOW))
    height = quantile_of(canopy.height, canopy.start, TOP)
    indices = *modelling_indices(*areas), complexity_reduction(canopy, c=c)
    lowest = quantile_of(canopy.height, canopy.start, LOW)
    shown = _shown(canopy.points, canopy.height, canopy.start, (right, left), (lowest, height))
    return Measures(np.diff(canopy.start), height, bottom, left - right, areas[2], *indices, *shown)


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
        ``width_m`` (2–98% across), ``area_m2`` (the foliage's), ``n_points`` and the ``extent_m`` along the row from
        which they are; tree-row volume ``trv_m3_ha`` = height · width · 10,000 / spacing, leaf-wall area ``lwa_m2_ha``
        = 2 (height − bottom) · 10,000 / spacing; Table 3.1's indices ``good``, ``under``, ``over``, ``reduction`` and
        ``quality`` = G − (U + O) + R (Eq. 23); and ``seen`` and ``full``, the shares of both sides, and of the width,
        on which there are points.
    """
    normal = np.column_stack([-at.tangent[:, 1], at.tangent[:, 0]])
    reach = np.stack([polygons[:, :, 0].min(axis=1), polygons[:, :, 0].max(axis=1)], axis=1)
    ends = at.origin[:, None, :2] + reach[:, :, None] * normal[:, None]
    level = np.repeat(at.origin[:, None, 2:], 2, axis=1)
    return gpd.GeoDataFrame(
        {
            "row_id": at.row_id,
            "position_m": at.position,
            "height_m": measures.height,
            "bottom_m": measures.bottom,
            "width_m": measures.width,
            "area_m2": measures.area,
            "n_points": measures.n_points,
            "extent_m": at.extent,
            "trv_m3_ha": measures.height * measures.width * HECTARE / at.spacing,
            "lwa_m2_ha": 2 * (measures.height - measures.bottom) * HECTARE / at.spacing,
            "good": measures.good,
            "under": measures.under,
            "over": measures.over,
            "reduction": measures.reduction,
            "quality": measures.good - (measures.under + measures.over) + measures.reduction,
            "seen": measures.seen,
            "full": measures.full,
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


@compiled
def _shown(
    points: Values, heights: Values, start: Ints, sides: tuple[Values, Values], ends: tuple[Values, Values]
) -> tuple[Values, Values]:
    """Shares (m,) of cells that have points: of height on both sides, between ends; and across, between sides."""
    (right, left), (bottom, top) = sides, ends
    seen, full = np.zeros(len(right)), np.zeros(len(right))
    for k in range(len(right)):
        n = max(math.ceil((top[k] - bottom[k]) / CELL), 1)
        m = max(math.ceil((left[k] - right[k]) / CELL), 1)
        beside, across = np.zeros(2 * n), np.zeros(m)
        for p in range(start[k], start[k + 1]):
            i = int((heights[p] - bottom[k]) / CELL)
            if 0 <= i < n and heights[p] >= bottom[k]:
                cell = 2 * i + int(2 * points[p, 0] > left[k] + right[k])
                seen[k] += (1 - beside[cell]) / (2 * n)
                beside[cell] = 1
            j = min(max(int((points[p, 0] - right[k]) / CELL), 0), m - 1)
            full[k] += (1 - across[j]) / m
            across[j] = 1
    return seen, full


def quantile_of(values: Values, start: Ints, q: float) -> Values:
    """Quantile (m,) of the values (n,) of each section; 0 where it has none."""
    out, held = np.zeros(len(start) - 1), np.array(values, dtype=np.float64)
    in_threads(lambda part: _quantiles(*part, held, start, q, out), stretches(len(out)))
    return out


@compiled
def _quantiles(first: int, last: int, values: Values, start: Ints, q: float, out: Values) -> None:
    """Write quantiles of sections, whose values lose their order."""
    for k in range(first, last):
        if start[k + 1] > start[k]:
            out[k] = quantile(values, start[k], start[k + 1], q)


def summarise_rows(rows: gpd.GeoDataFrame, sections: gpd.GeoDataFrame, *, step: float) -> gpd.GeoDataFrame:
    """Give rows the means of their sections, and their foliage's ``volume_m3``; NaN where there is none.

    The means are ``height_m``, ``width_m``, ``bottom_m``, ``trv_m3_ha`` and ``lwa_m2_ha``. The volume is that of the
    foliage's outlines, each reaching half way to its neighbours, or half a ``step`` into a gap.
    """
    groups = sections.groupby("row_id")
    names = ["height_m", "width_m", "bottom_m", "trv_m3_ha", "lwa_m2_ha"]
    means = groups[names].mean().reindex(rows["row_id"])
    row = sections["row_id"].to_numpy()
    volume = (sections["area_m2"] * lengths_of(sections, step)).groupby(row).sum().reindex(rows["row_id"])
    return rows.assign(**{name: means[name].to_numpy() for name in names}, volume_m3=volume.to_numpy())


def as_seen(
    rows: gpd.GeoDataFrame, sections: gpd.GeoDataFrame, *, tops: bool
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Rows and sections without what isn't known where ``tops`` alone were seen: where foliage begins, and its wall."""
    unknown = dict.fromkeys(("bottom_m", "lwa_m2_ha"), np.nan) if tops else {}
    return rows.assign(**unknown), sections.assign(**unknown)


def lengths_of(sections: gpd.GeoDataFrame, step: float) -> Values:
    """Metres of row (m,) for which each section stands."""
    position, row = sections["position_m"].to_numpy(), sections["row_id"].to_numpy()
    away = np.diff(position)
    # Stations of a short row may lie up to half a step further apart; what lies further apart is a gap.
    way = np.where(np.diff(row) == 0, np.where(away <= 1.5 * step, away, step), 0.0)
    out: Values = (np.concatenate([[0.0], way]) + np.concatenate([way, [0.0]]))[: len(row)] / 2
    return out


def judge_canopies(rows: gpd.GeoDataFrame, sections: gpd.GeoDataFrame, *, step: float) -> gpd.GeoDataFrame:
    """Give rows a ``canopy_confidence``, and the flags ``height`` and ``width``; NaN and no flag without a canopy.

    The confidence, from 0 to 1, is the product of seven numbers from 0 to 1:

    - the share of the row's length without its gaps that has sections;
    - the share of its canopy that isn't cut at a side;
    - how much of the canopy was seen, on both sides from its lowest points to its top;
    - how much of its width holds foliage, and no air between two curtains;
    - how much of its underside isn't hidden, as it is where a canopy is wider than deep;
    - where it is low, how much of it stands above weeds;
    - how well sections agree in width and area that are a metre apart, or so far that they share no point.

    A row's height or width is flagged where its ratio to the median of its block, or of the rows around it where that
    has few, is odd, unless rows there differ anyway.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``block``, ``spacing_m``, ``gap_m``, ``unseen_m``, ``cut``, ``flags``, ``height_m``,
        ``bottom_m`` and ``width_m``.
    sections : GeoDataFrame
        Sections of these rows.
    step : float
        Metres between sections.
    """
    row = sections["row_id"].to_numpy()
    gaps, cut = (rows[name].to_numpy(dtype=float) for name in (["gap_m", "unseen_m"], "cut"))
    canopy = np.maximum(shapely.length(rows.geometry.to_numpy()) - gaps.sum(axis=1), step)
    table = pd.DataFrame(
        {
            "modelled": pd.Series(lengths_of(sections, step)).groupby(row).sum(),
            "seen": sections.groupby("row_id")["seen"].mean(),
            "full": sections.groupby("row_id")["full"].mean(),
            "difference": _difference(sections, step=step),
        }
    ).reindex(rows["row_id"])
    confidence = np.minimum(table["modelled"].to_numpy() / canopy, 1) * _between(table["seen"].to_numpy(), SEEN)
    confidence *= (1 - cut) * _between(table["full"].to_numpy(), FULL)
    confidence *= _between(table["difference"].to_numpy(), DIFFERENT)
    height, bottom, width = (rows[f"{name}_m"].to_numpy(dtype=float) for name in ("height", "bottom", "width"))
    confidence *= _between(width / np.maximum(height - bottom, CELL), SPREADING)
    cut_off = (height < LOWLY) & (bottom < above_weeds(height) + ON_WEEDS)
    confidence *= np.where(cut_off, _between(bottom / np.maximum(height, CELL), HIDDEN), 1.0)
    flags = rows["flags"].tolist()
    groups = _comparable(rows)
    for name, sizes in (("height", height), ("width", width)):
        for k in np.flatnonzero(_unlike(sizes, groups)).tolist():
            flags[k] = f"{flags[k]},{name}".lstrip(",")
    return rows.assign(canopy_confidence=confidence, flags=flags)


def _between(values: Values, ends: tuple[float, float]) -> Values:
    """Where values (n,) lie on the way from one end, 0, to the other, 1."""
    out: Values = np.clip((values - ends[0]) / (ends[1] - ends[0]), 0, 1)
    return out


def _difference(sections: gpd.GeoDataFrame, *, step: float) -> pd.Series:
    """Median difference of rows' sections a metre or their extent apart, in width or area, whichever is more.

    It is told as a share of the median section's.
    """
    row, position, extent = (sections[name].to_numpy() for name in ("row_id", "position_m", "extent_m"))
    apart = np.maximum(1, np.round(np.maximum(extent, 1) / step).astype(int))
    one = np.flatnonzero(np.arange(len(row)) + apart < len(row))
    other = one + apart[one]
    pairs = (row[other] == row[one]) & (position[other] - position[one] < (apart[one] + 1) * step)
    sizes = sections[["width_m", "area_m2"]].to_numpy(dtype=float)
    differences = pd.DataFrame(np.abs(sizes[other] - sizes[one])[pairs]).groupby(row[one][pairs]).median()
    medians = pd.DataFrame(sizes).groupby(row).median()
    # A few sections can't be held against each other, which doesn't speak for them.
    out: pd.Series = (differences / medians).fillna(1.0).max(axis=1)
    return out


def _comparable(rows: gpd.GeoDataFrame) -> list[Ints]:
    """Positions of the rows with which each is compared, itself among them: its block's, or else the nearest."""
    block, lines = rows["block"].to_numpy(), shapely.force_2d(rows.geometry.to_numpy())
    members = {one: np.flatnonzero(block == one) for one in np.unique(block)}
    tree = shapely.STRtree(lines)
    reach = NEARBY * rows["spacing_m"].to_numpy(dtype=float)
    return [
        own if len(own := members[one]) >= FEW else tree.query(line, predicate="dwithin", distance=far)
        for one, line, far in zip(block, lines, reach, strict=True)
    ]


def _unlike(sizes: Values, groups: list[Ints]) -> list[bool]:
    """Whether each size (n,), which may be NaN, is unlike those of its group."""
    out = []
    for size, group in zip(sizes, groups, strict=True):
        known = sizes[group][np.isfinite(sizes[group])]
        if len(known) < FEW or not np.isfinite(size):
            out.append(False)
            continue
        median = float(np.median(known))
        usual = 1.4826 * float(np.median(np.abs(known - median)))
        out.append(bool(abs(np.log(size / median)) > np.log(ODD_SIZE) and abs(size - median) > ODD_DEVIATIONS * usual))
    return out
