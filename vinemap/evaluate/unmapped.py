"""What stands in a parcel and in none of its rows, and why: heights above ground against the rows that were found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import geopandas as gpd
import numpy as np
import shapely
import shapely.geometry
from affine import Affine
from scipy.ndimage import binary_dilation, binary_opening, find_objects, label
from scipy.spatial import cKDTree

from vinemap.compute.filters import distance_to
from vinemap.geo.raster import Grid, Raster, block_sum, coarser
from vinemap.surfaces.cover import WIDEST
from vinemap.surfaces.statistics import LOWEST

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Floats

TALL, WIDE, LOW, ROWLESS, ALONE = "too tall", "too wide", "too low", "no rows seen", "alone"
"""Reasons for which something is in no row."""
HALF = 0.5
"""Share of the rows' height below which what stands beside them is no vine of their age."""
BESIDE = 0.75
"""Spacings from a row within which there is no room for another."""
CELL = 0.25
"""Metres, about: side of the cells that are looked at."""
NEXT = 1.25
"""Spacings from a row within which the next one stands."""
STEP = 0.5
"""Metres between the points of rows."""
SPACING, WIDTH = 3.0, 0.5
"""Metres between rows and across their canopies, where no row tells."""
HIGH = 0.9
"""Order of the heights of what stands somewhere that is its height."""
ROW = 2.0
"""Spacings of length from which plants look like a row."""
SPECK = 4
"""Cells of what may be noise."""
PART = 0.25
"""Share of what hangs together below which a part of another kind goes with the rest."""
STAIRS = 0.75
"""Cells by which an outline may leave its cells, so that stairs are straight and one row of cells stays one."""
ROUGH = 0.02
"""Share of a polygon's size by which its outline may be off."""
CORNERS = np.ones((3, 3))
"""What touches at a corner hangs together."""


class Usual(NamedTuple):
    """What the rows of a parcel are like: medians in metres, or what is usual where there is none."""

    spacing: float
    width: float
    height: float
    """NaN where no row tells."""
    widest: float
    """Across which no canopy is closed."""


def find_unmapped(
    chm: Raster, rows: gpd.GeoDataFrame, parcel: gpd.GeoDataFrame | None = None, *, tallest: float = 3.6
) -> gpd.GeoDataFrame:
    """Find what stands in a parcel and in none of its rows.

    A row takes its canopy, as wide as it was measured, and half of what is free beside it. Between rows, what is lower
    than half of them is a cover crop. The rest is told apart by why it is in no row; what is of one kind, and closer
    together than rows are, is one polygon. Weeds, and what is smaller than a metre of row, are left out.

    Parameters
    ----------
    chm : Raster
        Canopy height in metres, NaN where there are no points.
    rows : GeoDataFrame
        LineString with ``spacing_m``, ``width_m`` and ``height_m``.
    parcel : GeoDataFrame, optional
        Polygons of the parcel; by default it is all that the cloud covers.
    tallest : float
        Height in metres above which there are no vines.

    Returns
    -------
    GeoDataFrame
        MultiPolygon, the largest first, with ``reason``: "too tall"; "too wide", closed across 2 m, or across twice a
        row's canopy, or the spacing of the rows; "too low", a row less than half as high as the others; "no rows seen",
        as high and wide as vines, a row beside rows or several beside each other; "alone", the same with none beside
        it. ``area_m2``, ``share`` of the parcel, ``height_m`` that a tenth of it exceeds, and ``width_m``, the widest
        that it is closed.
    """
    chm = _coarse(chm)
    usual = _usual(rows)
    polygon = None if parcel is None else shapely.union_all(parcel.geometry.to_numpy())
    away = _away_from_rows(chm, rows, polygon, usual, tallest)
    found: list[dict[str, Any]] = []
    if not np.isnan(away).all():
        found = _places(*_around(chm, away, margin=usual.spacing), usual, tallest)
    names = ("reason", "area_m2", "height_m", "width_m", "geometry")
    table = gpd.GeoDataFrame({name: [one[name] for one in found] for name in names}, geometry="geometry", crs=chm.crs)
    seen = np.count_nonzero(np.isfinite(chm.values)) * chm.grid.resolution**2
    area = seen if polygon is None else float(shapely.area(polygon))
    table["share"] = table["area_m2"] / max(area, chm.grid.resolution**2)
    return table.sort_values("area_m2", ascending=False, ignore_index=True)


def _coarse(chm: Raster) -> Raster:
    """Means in cells of about ``CELL``, where the raster's are smaller."""
    n = max(1, round(CELL / chm.grid.resolution))
    if n == 1:
        return chm
    known = np.isfinite(chm.values)
    count = block_sum(known, n)
    mean = block_sum(np.where(known, chm.values, 0.0), n) / np.where(count > 0, count, np.nan)
    return Raster(mean, coarser(chm.grid, resolution=n * chm.grid.resolution), chm.crs)


def _usual(rows: gpd.GeoDataFrame) -> Usual:
    if len(rows) == 0:
        return Usual(SPACING, WIDTH, np.nan, WIDEST)
    spacing, width, height = (float(rows[name].median()) for name in ("spacing_m", "width_m", "height_m"))
    width = width if np.isfinite(width) else min(WIDTH, spacing / 2)
    return Usual(spacing, width, height, min(max(WIDEST, 2 * width), spacing))


def _away_from_rows(
    chm: Raster, rows: gpd.GeoDataFrame, polygon: shapely.Geometry | None, usual: Usual, tallest: float
) -> Floats:
    """Spacings to a row, or inf if none is next, of cells in which something stands that is in no row; else NaN."""
    grid = chm.grid
    i, j = np.nonzero(chm.values >= LOWEST)
    height = chm.values[i, j]
    x, y = (centres[k] for centres, k in zip(grid.centres(), (j, i), strict=True))
    free = np.ones(len(x), dtype=bool) if polygon is None else shapely.contains_xy(polygon, x, y)
    out = np.full(grid.shape, np.nan)
    if len(rows) == 0:
        out[i[free], j[free]] = np.inf
        return out
    spacing, width = rows["spacing_m"].to_numpy(), rows["width_m"].fillna(usual.width).to_numpy()
    tops = rows["height_m"].fillna(usual.height).to_numpy()
    lines = shapely.segmentize(shapely.force_2d(rows.geometry.to_numpy()), STEP)
    points, row = shapely.get_coordinates(lines, return_index=True)
    metres, nearest = cKDTree(points).query(
        np.column_stack([x, y]), distance_upper_bound=NEXT * float(spacing.max()), workers=-1
    )
    row = row[np.minimum(nearest, len(row) - 1)]
    away = np.where(metres <= NEXT * spacing[row], metres / spacing[row], np.inf)
    canopy = (metres <= width[row] / 2 + np.maximum(spacing - width, 0)[row] / 4) & (height <= tallest)
    crop = (away <= BESIDE) & (height < HALF * tops[row])
    left, own = np.zeros(grid.shape, dtype=bool), np.zeros(grid.shape, dtype=bool)
    left[i, j], own[i, j] = free & ~canopy & ~crop, canopy

    # What hangs together with a canopy, and doesn't reach beyond the middle between two rows, belongs to it.
    whole, n = label(left, CORNERS)
    where = whole[i, j]
    reach = np.zeros(n + 1)
    np.maximum.at(reach, where, away)
    touching = np.zeros(n + 1, dtype=bool)
    touching[whole[binary_dilation(own, CORNERS)]] = True
    kept = (where > 0) & ~(touching & (reach <= HALF + grid.resolution / usual.spacing))[where]
    out[i[kept], j[kept]] = away[kept]
    return out


def _around(chm: Raster, away: Floats, *, margin: float) -> tuple[Raster, Floats]:
    """Both where one of them is known, with a margin in metres in which neither is."""
    n = int(np.ceil(margin / chm.grid.resolution)) + 1
    (i, j), grid = np.nonzero(~np.isnan(away)), chm.grid
    window = slice(i.min(), i.max() + 1), slice(j.min(), j.max() + 1)
    values, away = (np.pad(v[window], n, constant_values=np.nan) for v in (chm.values, away))
    west, north = grid.west + (j.min() - n) * grid.resolution, grid.north - (i.min() - n) * grid.resolution
    return Raster(values, Grid(float(west), float(north), grid.resolution, *values.shape), chm.crs), away


def _places(chm: Raster, away: Floats, usual: Usual, tallest: float) -> list[dict[str, Any]]:
    """What stands in no row, a polygon each of one kind."""
    cell, left = chm.grid.resolution, ~np.isnan(away)
    depth = distance_to(~left) * cell
    tall, wide, narrow = _kinds(chm, left, depth, usual, tallest)
    narrow = _without_specks(narrow, max(SPECK, round(usual.width / cell)))
    closed = _closed(narrow, usual.spacing / 2 / cell)
    least = max(SPECK, usual.width / cell**2)
    found = []
    for reason, own, area in ((TALL, tall, tall), (WIDE, wide, wide), (None, narrow, closed)):
        places, _ = label(area, None if reason else CORNERS)
        room = distance_to(~area) * cell if reason is None else depth
        for k, window in enumerate(find_objects(places), start=1):
            place = places[window] == k
            stand = own[window] & place
            if np.count_nonzero(stand) < least:
                continue
            height = float(np.quantile(chm.values[window][stand], HIGH))
            width, across = (2 * float(d[window][s].max()) - cell / 2 for d, s in ((depth, stand), (room, place)))
            low = height < HALF * usual.height
            row = np.count_nonzero(stand) * cell**2 >= ROW * usual.spacing * width
            if low and (width > usual.width + cell or not row):
                continue
            beside = across > width + usual.spacing / 2 or (row and bool(np.isfinite(away[window][stand]).any()))
            why = reason or (LOW if low else ROWLESS if beside else ALONE)
            polygon = _polygon(place, chm.grid, window, hole=usual.widest**2)
            shape = {"area_m2": float(shapely.area(polygon)), "geometry": polygon}
            found.append(shape | {"reason": why, "height_m": height, "width_m": width})
    return found


def _kinds(chm: Raster, left: Flags, depth: Floats, usual: Usual, tallest: float) -> tuple[Flags, Flags, Flags]:
    """Cells of what is too tall, of what is too wide, and the rest; ``depth`` is their distance from what is free."""
    cell = chm.grid.resolution
    kinds = np.where(left, 3, 0)  # 1 is too tall, 2 too wide, 3 the rest, 0 none
    kinds[left & _near(depth > usual.widest / 2, usual.widest / cell)] = 2
    kinds[left & _near(binary_opening(left & (chm.values > tallest), np.ones((2, 2))), tallest / 2 / cell)] = 1
    whole, n = label(left, CORNERS)
    shares = np.bincount(4 * whole.ravel() + kinds.ravel(), minlength=4 * (n + 1)).reshape(-1, 4)
    most = shares.argmax(axis=1)
    # A skirt of a tree, or a corner of a roof, goes with what it hangs together with.
    for kind in (1, 2, 3):
        parts, m = label(kinds == kind, CORNERS)
        size = np.bincount(parts.ravel(), minlength=m + 1)
        of = np.zeros(m + 1, dtype=np.int64)
        of[parts] = whole
        small = size < np.minimum(PART * shares.sum(axis=1)[of], (2 * usual.widest / cell) ** 2)
        small[0] = False
        kinds[small[parts]] = most[whole[small[parts]]]
    return kinds == 1, kinds == 2, kinds == 3


def _near(mask: Flags, reach: float) -> Flags:
    """Cells within a reach in cells of those of a mask."""
    out: Flags = distance_to(mask) <= reach if mask.any() else mask
    return out


def _closed(mask: Flags, reach: float) -> Flags:
    """Cells of a mask and between those that are less than twice a reach in cells apart; its margin is free."""
    if not mask.any():
        return mask
    out: Flags = mask | (distance_to(~_near(mask, reach)) > reach)
    return out


def _without_specks(mask: Flags, least: int) -> Flags:
    """What hangs together in so many cells."""
    parts, _ = label(mask, CORNERS)
    size = np.bincount(parts.ravel())
    size[0] = 0
    out: Flags = size[parts] >= least
    return out


def _polygon(place: Flags, grid: Grid, window: tuple[slice, slice], *, hole: float) -> shapely.MultiPolygon:
    """Outline of cells in a window of a grid, of few vertices, without holes smaller than so many m²."""
    from rasterio.features import shapes  # half a second of start-up, needed only here

    cell, (top, left) = grid.resolution, (edge.start for edge in window)
    corner = Affine(cell, 0, grid.west + left * cell, 0, -cell, grid.north - top * cell)
    found = shapes(place.astype(np.uint8), mask=place, connectivity=4, transform=corner)
    whole = shapely.multipolygons([shapely.geometry.shape(part) for part, _ in found])
    whole = shapely.simplify(whole, cell * max(STAIRS, ROUGH * np.count_nonzero(place) ** 0.5))
    kept = [
        shapely.Polygon(part.exterior, [ring for ring in part.interiors if shapely.Polygon(ring).area >= hole])
        for part in shapely.get_parts(whole)
    ]
    return shapely.multipolygons(kept)
