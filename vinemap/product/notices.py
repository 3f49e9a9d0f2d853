"""What an agronomist should know of a product before trusting it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from vinemap.compute.beside import nearest_beside
from vinemap.evaluate.changes import ASIDE, are_others, lie_aside
from vinemap.evaluate.confidence import DOUBTFUL
from vinemap.evaluate.unmapped import ALONE, LOW, ROWLESS, TALL, WIDE
from vinemap.geo.crs import project
from vinemap.geo.curve import across, at_each, cross, resample, tangents_of_each
from vinemap.geo.raster import block_sum, cell_of
from vinemap.rows.curtains import CLOSE
from vinemap.rows.standing.gaps import UNSEEN
from vinemap.surfaces.statistics import LOWEST

if TYPE_CHECKING:
    from collections.abc import Mapping

    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.evaluate.shift import Shift
    from vinemap.geo.raster import Grid, Raster

SIDE = 2.0
"""Metres, about: side of the squares that points cover or don't."""
COVERED = 0.95
"""Share of a parcel that a survey of it covers."""
DENSE = 60.0
"""Points a square metre below which canopies come out poorly."""
FEW = 5.0
"""Points a square metre below which vines may not be seen."""
MISTAKEN = 0.4
"""Spacings by which a flight may lie off known rows before these are mistaken."""
STEP = 0.5
"""Metres between the points of rows."""
TOP = 0.98
"""Order of the height to which plants stand."""
MUCH = 0.2
"""Share of the rows' length on which trees don't hang over them."""
MOST_LEFT = 0.02
"""Share of a parcel on which something may stand that is in no row and might be vines."""
MOST_TALL = 0.3
"""Share of a parcel on which trees don't stand."""
BESIDE, PARALLEL = 3.0, 0.95
"""Spacings within which rows stand beside each other, and cosine of the angle between them."""
WIDEST, ALIKE, PAIRED = 1.8, 0.15, 0.5
"""Metres between two curtains of a row, at the most, share by which pairs' distances differ, and of rows in pairs."""
MIDDLE, ON_ROW = (0.35, 0.65), np.array([-0.1, 0.0, 0.1])
"""Spacings from a row between which the middle of an alley lies, and at which its canopy does."""
BARE, POINTS = 0.5, 4
"""Share of an alley's stretches that shows ground mostly, and cells of one that would, if points were as on the row."""
MAIN = 0.1
"""Share of what is in no row from which a reason is worth to be told."""


def notices(
    rows: gpd.GeoDataFrame, chm: Raster, parcel: gpd.GeoDataFrame, unmapped: gpd.GeoDataFrame, n_points: int
) -> list[str]:
    """Remarks, a sentence each: how far and how densely points cover a parcel, doubtful rows and canopies, the rest.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``confidence`` and ``canopy_confidence``.
    chm : Raster
        Canopy height, NaN where there are no points.
    parcel : GeoDataFrame
        Polygons of the parcel.
    unmapped : GeoDataFrame
        As of :func:`vinemap.evaluate.unmapped.find_unmapped`. What is too tall is no vine and is told only where it may
        be why no row was found.
    n_points : int
        Number of points.
    """
    n = max(1, round(SIDE / chm.grid.resolution))
    seen = block_sum(np.isfinite(chm.values), n) > 0
    side = n * chm.grid.resolution
    polygon = shapely.union_all(parcel.geometry.to_numpy())
    covered = _covered(polygon, seen, chm.grid, side)
    density = n_points / max(np.count_nonzero(seen) * side**2, 1.0)
    doubtful = int((rows["confidence"] < DOUBTFUL).sum())
    remarks = {
        f"the cloud covers {covered:.0%} of the parcel": covered < COVERED,
        f"{density:.0f} points/m², canopies are poor below {DENSE:.0f}": density < DENSE,
        f"{doubtful} of {len(rows)} rows are doubtful (confidence below {DOUBTFUL:g})": doubtful > 0,
    }
    told = [remark for remark, holds in remarks.items() if holds] + _doubtful_canopies(rows)
    return told + (_in_no_row(unmapped) if len(rows) else [_why_nothing(unmapped, density)])


def shift_notices(shift: Shift | None, rows: gpd.GeoDataFrame) -> list[str]:
    """A remark if a flight lies so far aside of known rows that each may be taken for the next.

    Parameters
    ----------
    shift : Shift or None
        How far it lies off.
    rows : GeoDataFrame
        LineString with ``spacing_m``.
    """
    if shift is None:
        return []
    chords = np.array([np.subtract(*shapely.get_coordinates(line)[[-1, 0]]) for line in rows.geometry])
    along = chords / np.linalg.norm(chords, axis=1)[:, None]
    aside = np.abs(cross(along, shift.metres))
    if not (aside > MISTAKEN * rows["spacing_m"]).any():
        return []
    remark = (
        f"the flight lies {aside.max():.2f} m aside of the known rows, almost half of their distance or more: a row "
        "may have been taken for the next; see that both have the right CRS and the same base station"
    )
    return [remark]


def pair_notices(rows: gpd.GeoDataFrame) -> list[str]:
    """A remark if rows stand in pairs, of which each may be one row of two curtains.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``spacing_m``.
    """
    curves = [shapely.get_coordinates(line) for line in rows.geometry]
    places = [np.arange(SIDE / 2, length, SIDE) for length in shapely.length(rows.geometry)]
    row = np.repeat(np.arange(len(rows)), [len(some) for some in places])
    if len(row) == 0:
        return []
    at = curves, row, np.concatenate(places)
    reach = BESIDE * rows["spacing_m"].to_numpy(dtype=float)[row]
    away, _ = nearest_beside(at_each(*at), tangents_of_each(*at), row, reach, along=SIDE / 2, parallel=PARALLEL)
    near, far = np.array([np.median(np.sort(away[row == k], axis=1), axis=0) for k in np.unique(row)]).T
    inner = np.isfinite(far)
    pairs = inner & (near <= np.minimum(CLOSE * far, WIDEST))
    if not pairs.any():
        return []
    apart, beyond = np.median(near[pairs]), np.median(far[pairs])
    pairs &= (np.abs(near / apart - 1) <= ALIKE) & (np.abs(far / beyond - 1) <= ALIKE)
    if np.count_nonzero(pairs) < max(2, PAIRED * np.count_nonzero(inner)):
        return []
    told = (
        f"rows stand in pairs, {apart:.1f} m apart and {beyond:.1f} m from the next ones: if each is a row of two "
        "curtains, known rows tell it (--rows)"
    )
    return [told]


def ground_notices(rows: gpd.GeoDataFrame, chm: Raster) -> list[str]:
    """A remark if no ground is seen between rows, as where it was taken out of a cloud.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``spacing_m``.
    chm : Raster
        As of :func:`notices`.
    """
    beside, known, shares = np.linspace(*MIDDLE, 7), np.isfinite(chm.values).ravel(), []
    offsets = np.concatenate([-beside, beside, ON_ROW])
    for line, spacing in zip(rows.geometry, rows["spacing_m"].to_numpy(dtype=float), strict=True):
        if np.isfinite(spacing):
            curve = resample(shapely.get_coordinates(line), STEP)
            xy = across(curve, spacing * offsets, smoothing=SIDE)
            shown = known[cell_of(xy.reshape(-1, 2), chm.grid)].reshape(xy.shape[:2])
            middle, row = shown[:, : 2 * len(beside)], shown[:, 2 * len(beside) :]
            apart = int(np.ceil(POINTS / (middle.shape[1] * max(row.mean(), 0.01))))
            shares.append(np.logical_or.reduceat(middle.any(axis=1), np.arange(0, len(middle), apart)).mean())
    if not shares or (share := np.median(shares)) > BARE:
        return []
    told = (
        f"alleys show ground on {share:.0%} of their length only: if it was taken out of the cloud, map the whole one, "
        "as canopies are measured above the lowest that is left, and come out too low"
    )
    return [told]


def change_notices(kept: Mapping[str, str]) -> list[str]:
    """A remark for each file of an earlier product that stays, by another name, as somebody has changed it."""
    return [
        f"{name} was changed since it was made: it stays beside the new one, as {other}" for name, other in kept.items()
    ]


def _doubtful_canopies(rows: gpd.GeoDataFrame) -> list[str]:
    """A remark if canopies of rows weren't seen well enough to trust their heights, widths and volumes."""
    doubtful = int((rows["canopy_confidence"] < DOUBTFUL).sum())
    remark = (
        f"heights, widths and volumes of {doubtful} of {len(rows)} rows are doubtful: their canopies were seen too "
        f"sparsely or unevenly (canopy_confidence below {DOUBTFUL:g})"
    )
    return [remark] if doubtful else []


def _in_no_row(unmapped: gpd.GeoDataFrame) -> list[str]:
    """What stands in a parcel and in none of its rows, where it is much and may be vines."""
    vines = unmapped[unmapped["reason"] != TALL]
    if vines["share"].sum() <= MOST_LEFT:
        return []
    return [f"what stands on {_size(vines)} is in no row: {_reasons(vines)}"]


def _why_nothing(unmapped: gpd.GeoDataFrame, density: float) -> str:
    """Why no row was found."""
    if len(unmapped):
        return f"no row was found in what stands on {_size(unmapped)}: {_reasons(unmapped)}"
    few = f", or too few points show it ({density:.1f} a m²)" if density < FEW else ""
    return f"no row was found: nothing stands there that is as high as vines{few}"


def _size(unmapped: gpd.GeoDataFrame) -> str:
    return f"{unmapped['area_m2'].sum():,.0f} m² ({unmapped['share'].sum():.0%} of the parcel)"


def _reasons(unmapped: gpd.GeoDataFrame) -> str:
    """Why something is in no row, in words, the main reasons first."""
    areas = unmapped.groupby("reason")["area_m2"].sum().sort_values(ascending=False)
    most = unmapped.groupby("reason")[["height_m", "width_m"]].max()
    words = {
        TALL: "too tall for vines (up to {height_m:.0f} m)",
        WIDE: "closed over {width_m:.0f} m, so that no rows can be told",
        LOW: "lower than half of the rows ({height_m:.1f} m)",
        ROWLESS: "like vines, but no rows were seen",
        ALONE: "alone",
    }
    main = areas[areas >= MAIN * areas.sum()]
    told = [words[reason].format(**most.loc[reason]) for reason in main.index]
    if len(told) > 1:
        told = [f"{area:,.0f} m² {one}" for one, area in zip(told, main, strict=True)]
    return "; ".join(told)


def height_notices(rows: gpd.GeoDataFrame, chm: Raster, unmapped: gpd.GeoDataFrame, *, highest: float) -> list[str]:
    """Remarks on heights that no vineyard has, as where feet were read as metres.

    Parameters are as of :func:`notices`, and the height in metres up to which canopies are looked for.
    """
    unit = "are heights in metres? Their unit is told by --crs EPSG:n+m"
    if len(rows) == 0:
        known = chm.values[np.isfinite(chm.values)]
        top = float(np.quantile(known, TOP)) if len(known) else LOWEST
        if LOWEST <= top <= highest:
            return []
        return [f"what stands there is up to {top:.3g} m high; if that can't be, {unit}"]
    lacking = int(rows["height_m"].isna().sum())
    stations = shapely.get_coordinates(shapely.segmentize(shapely.force_2d(rows.geometry.to_numpy()), STEP))
    over = np.mean(chm.values.ravel()[cell_of(stations, chm.grid)] > highest)
    tall = unmapped[unmapped["reason"] == TALL]
    much = float(tall["share"].sum())
    remarks = {
        f"what stands on {_size(tall)} is up to {tall['height_m'].max():.1f} m high; if that can't be, {unit}": much
        > MOST_TALL,
        f"{lacking} of {len(rows)} rows have no canopy that could be measured; if many should, {unit}": lacking > 0,
        f"plants are higher than {highest:g} m on {over:.0%} of the rows, and measured only so far; {unit}": over
        > MUCH,
    }
    return [remark for remark, holds in remarks.items() if holds]


def sight_notices(rows: gpd.GeoDataFrame, row_ends: gpd.GeoDataFrame) -> list[str]:
    """Remarks on what wasn't seen of rows, and may be anything.

    Parameters
    ----------
    rows : GeoDataFrame
        With ``unseen_m``.
    row_ends : GeoDataFrame
        With ``row_id`` and ``beyond``.
    """
    hidden, n = rows["unseen_m"].to_numpy(dtype=float), len(rows)
    of, open_ones = np.count_nonzero(hidden), row_ends.loc[row_ends["beyond"] == UNSEEN, "row_id"].nunique()
    remarks = {
        f"{hidden.sum():.1f} m of {of} of {n} rows were not seen: whether vines stand there is not known, and none is "
        "counted as missing": of > 0,
        f"{open_ones} of {n} rows may go on: beyond their ends nothing was seen": open_ones > 0,
    }
    return [remark for remark, holds in remarks.items() if holds]


def known_notices(rows: gpd.GeoDataFrame, known: gpd.GeoDataFrame) -> list[str]:
    """Whether rows stand elsewhere than known lines, each another way: as those of another planting would.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``row_id``, ``spacing_m`` and ``support``.
    known : GeoDataFrame
        The lines by ``row_id``, in any CRS.
    """
    seen = rows[(rows["support"] > 0) & rows["row_id"].isin(known["row_id"])]
    if len(seen) == 0:
        return []
    of = known.set_index("row_id").geometry.loc[seen["row_id"]].to_numpy()
    spacing = float(np.nanmedian(seen["spacing_m"]))
    before = np.asarray(project(of, known.crs, rows.crs), dtype=object)
    off = lie_aside(seen.geometry.to_numpy(), before, spacing=spacing)
    if not are_others(off, spacing=spacing):
        return []
    aside = off > ASIDE * spacing
    far = float(np.median(off[aside]))
    told = (
        f"{aside.sum()} of {len(seen)} rows stand {far:.1f} m or so from where they are known, each another way: "
        "if the parcel was planted anew, they are other rows"
    )
    return [told]


def _covered(polygon: shapely.Geometry, seen: NDArray[np.bool_], grid: Grid, side: float) -> float:
    """Share of the squares with their centres in a polygon that were seen, among those of a raster and beyond it."""
    shapely.prepare(polygon)
    west, south, east, north = shapely.bounds(polygon)
    j = np.arange(np.floor((west - grid.west) / side), np.ceil((east - grid.west) / side))
    i = np.arange(np.floor((grid.north - north) / side), np.ceil((grid.north - south) / side))
    inside = shapely.contains_xy(polygon, *np.meshgrid(grid.west + (j + 0.5) * side, grid.north - (i + 0.5) * side))
    ii, jj = (index.astype(int) for index in np.meshgrid(i, j, indexing="ij"))
    within = inside & (ii >= 0) & (jj >= 0) & (ii < seen.shape[0]) & (jj < seen.shape[1])
    return float(seen[ii[within], jj[within]].sum() / max(np.count_nonzero(inside), 1)) if inside.any() else 1.0
