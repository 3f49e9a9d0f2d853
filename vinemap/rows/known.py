"""Known rows: lines that are measured rather than sought.

Where rows are known, the canopy is a wave across them whose phase tells how far aside each line lies. Where a row
doesn't stand apart from those beside it, as under a closed roof, nothing tells, and the line stays as it is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from scipy.ndimage import gaussian_filter1d

from vinemap.compute.threads import in_threads
from vinemap.errors import InputError
from vinemap.geo.crs import project
from vinemap.geo.curve import normals, resample
from vinemap.geo.layers import some_of
from vinemap.geo.raster import Raster, cell_of, sample_across
from vinemap.rows.centre_line import whittaker

if TYPE_CHECKING:
    from pyproj import CRS

    from vinemap.compute.arrays import Values
    from vinemap.surfaces.seen import Seen
    from vinemap.surfaces.waves import RowField

STEP = 0.5
"""Metres between the stations at which lines are looked at."""
FAR, USUAL = 15.0, 2.5
"""Metres within which a line has others beside it, and between rows where none has."""
CLOSEST = 0.3
"""Metres across, less than which lines lie on one row."""
CLOSER = 0.75
"""Share of the lines' distance that rows are apart of which only some are known."""
SLANT, TRACK = 0.35, 1.75
"""Metres along a line to a metre across up to which another is beside it, and ratio of their distance to the usual one
from which there is a track between."""
SHORTEST = 2.0
"""Metres of a line, or it is none of a row."""
SEEN, WHOLE = 0.5, 0.9
"""Share of a line that was seen, or it is left out, and from which it lies in the cloud as a whole."""
CELLS = 48
"""Cells of a spacing across a line."""
THEREABOUTS, PARALLEL = 15.0, np.cos(np.radians(20))
"""Spacings, and cosine of the angle, within which lines may lie aside together."""
AGREED = 0.7
"""Share of the lines' canopy that says the same, from which they lie aside together."""
ALONG, BENDS = 0.5, 8.0
"""Standard deviation, in spacings, of the stretch of a line that tells how far aside it lies there, and wavelength of
bends below which that is noise."""
HELD = 0.1
"""Weight of the whole line in that, where it has gaps."""
ALLEY, APART = 0.1, 0.5
"""Half width, in spacings, of what lies midway between rows, and the most cover there, in that of a row that stands
apart."""
PAIR, UNEVEN, DIP = 0.65, 0.15, 0.7
"""Distance of a row's curtains in that to the next row's, share of it by which they may lie unevenly, and cover between
them in theirs, at the most."""
THIN, LEAST = 0.02, 0.15
"""Metres of full cover across a line, and share of what is usual, below which there is no canopy."""
ENOUGH = 0.25
"""Share of a line that has canopy, or its course isn't told by it."""
REACH, ROOM = 3.0, 3.5
"""Metres by which an end may move, and that are looked at beyond it."""
AHEAD = 0.3
"""Spacings from a line carried on within which another that it would meet lies ahead."""


class _Wave(NamedTuple):
    """Canopy across a line, at its stations (n,)."""

    curve: Values
    """The stations (n, 2)."""
    phase: Values
    """First harmonic (n,) of the cover across a spacing, in complex metres."""
    amount: Values
    """Metres (n,) of full cover in that."""


def lines_here(known: gpd.GeoDataFrame, seen: Seen, crs: CRS) -> tuple[gpd.GeoDataFrame, list[str]]:
    """Bring known lines to a cloud's CRS, and leave out those where it shows nothing.

    Parameters
    ----------
    known : GeoDataFrame
        LineString with ``row_id`` and ``label``.
    seen : Seen
        What the cloud shows.
    crs : CRS
        The cloud's.

    Returns
    -------
    lines : GeoDataFrame
        With ``spacing_m``, the mean distance of lines about each.
    remarks : list of str
        What is to be known of lines that lie outside, a sentence each.

    Raises
    ------
    InputError
        If that are all.
    """
    lines = known.set_geometry(gpd.GeoSeries(project(known.geometry.to_numpy(), known.crs, crs), crs=crs))
    shapes = lines.geometry.to_numpy()
    placed = np.isfinite(shapely.bounds(shapes)).all(axis=1)
    points, line = shapely.get_coordinates(shapely.segmentize(shapes[placed], STEP), return_index=True)
    share = np.zeros(len(lines))
    share[placed] = np.bincount(line, seen.at(points)) / np.bincount(line)
    short = placed & (shapely.length(shapes) < SHORTEST)
    shown = (share >= SEEN) & ~short
    if not shown.any():
        raise InputError(
            f"none of the {len(known)} known rows lies in the cloud: do both show the same place, in the right CRS?"
        )
    kinds = share < SEEN, short & (share >= SEEN), shown & (share < WHOLE)
    outside, small, partly = (lines["label"][rows].tolist() for rows in kinds)
    n = len(known)
    remarks = {
        f"{len(outside)} of {n} known rows lie outside of the cloud, and are left out: {some_of(outside)}": outside,
        f"{len(small)} of {n} known rows are shorter than {SHORTEST:g} m, and are left out: {some_of(small)}": small,
        f"{len(partly)} of {n} known rows reach out of the cloud: {some_of(partly)}": partly,
    }
    return space_lines(lines[shown].reset_index(drop=True)), [remark for remark, holds in remarks.items() if holds]


def space_lines(lines: gpd.GeoDataFrame, field: RowField | None = None) -> gpd.GeoDataFrame:
    """Give lines their ``spacing_m``: the mean distance of those thereabouts, or else that of all others.

    Where a row field tells of rows along a line that are far closer, only some of them are known, and that counts.
    """
    shapes = shapely.force_2d(lines.geometry.to_numpy())
    share = np.array([[0.25, 0.5, 0.75]])
    back, points, ahead = (
        shapely.line_interpolate_point(shapes[:, None], share + step, normalized=True).ravel()
        for step in (-0.05, 0.0, 0.05)
    )
    way = shapely.get_coordinates(ahead) - shapely.get_coordinates(back)
    way /= np.maximum(np.hypot(*way.T), 1e-9)[:, None]
    point, other = shapely.STRtree(shapes).query(points, predicate="dwithin", distance=FAR)
    foot = shapely.get_coordinates(shapely.shortest_line(points[point], shapes[other])).reshape(-1, 2, 2)
    there = foot[:, 1] - foot[:, 0]
    along = (way[point] * there).sum(axis=1)
    left = way[point, 0] * there[:, 1] - way[point, 1] * there[:, 0]
    abreast = np.abs(along) <= SLANT * np.abs(left) + 1e-6
    places = pd.Series(left[abreast]).groupby(point[abreast])
    steps = places.apply(lambda one: _usual_step(one.to_numpy())).reindex(range(len(points)))
    spacing = steps.groupby(np.arange(len(points)) // 3).median().to_numpy()
    usual = float(np.nanmedian(spacing)) if np.isfinite(spacing).any() else USUAL
    spacing = np.where(np.isfinite(spacing), spacing, usual)
    if field:
        told = np.array([_told_by(field, shape) for shape in shapes])
        spacing = np.where(told < CLOSER * spacing, told, spacing)
    return lines.assign(spacing_m=spacing)


def _told_by(field: RowField, line: shapely.LineString) -> float:
    """Spacing in metres that a row field tells along a line; NaN where there are no rows along it."""
    curve = resample(shapely.get_coordinates(line), STEP)
    way = np.gradient(curve, axis=0)
    cells = cell_of(curve, field.spacing.grid)
    direction, spacing = (one.values.ravel()[cells] for one in (field.direction, field.spacing))  # noqa: PD011 - no frames
    turn = np.abs(np.cos(np.radians(direction) - np.arctan2(way[:, 1], way[:, 0])))
    along = (turn >= PARALLEL) & np.isfinite(spacing)
    return float(np.median(spacing[along])) if along.mean() > 0.5 else np.nan


def _usual_step(places: Values) -> float:
    """Mean distance in metres of places that follow each other, but for tracks between; NaN of one place."""
    steps = np.diff(np.sort(places))
    steps = steps[steps > CLOSEST]
    return float(steps[steps <= TRACK * np.median(steps)].mean()) if len(steps) else np.nan


def follow_lines(lines: gpd.GeoDataFrame, cover: Raster, *, course: str = "fit", ends: str = "fit") -> gpd.GeoDataFrame:
    """Move lines sideways onto their canopy, each to the nearest row that all those thereabouts agree upon.

    Parameters
    ----------
    lines : GeoDataFrame
        LineString with ``spacing_m``.
    cover : Raster
        Canopy cover 0–1.
    course, ends : str
        Whether these may move, "fit", or not, "keep".

    Returns
    -------
    GeoDataFrame
        The courses in the lines' order, with ``spacing_m``, ``curtains_m`` and ``alone`` as of
        :func:`vinemap.rows.curves.trace_rows`; ``moves``, whether the fit may move the course further; ``slack_m`` by
        which ends may move, ``before_m`` and ``after_m`` beyond them that are the row's own; ``least_m`` of full cover
        across, below which there is no canopy; and ``kept``, whether nothing shows where the row runs, though it might
        move.
    """
    spacing = lines["spacing_m"].to_numpy(dtype=float)
    shapes = shapely.force_2d(lines.geometry.to_numpy())
    near = _thereabouts(shapes, spacing)
    waves = in_threads(lambda one: _wave(*one, cover), list(zip(shapes, spacing, strict=True)))
    usual = np.median([np.quantile(wave.amount, 0.9) for wave in waves])
    least = max(LEAST * float(usual), THIN)
    weight = np.array([wave.phase.sum() for wave in waves])
    shifts = _shifts(waves, spacing, _together(weight, near))
    rows = list(zip(waves, shifts, spacing, strict=True))
    apart, curtains = np.array(in_threads(lambda row: _across(*row, cover), rows)).T
    curtains = pd.Series(curtains[near[1].astype(int)]).groupby(near[0]).median().to_numpy()
    apart = (apart > 0) & [np.mean(wave.amount > least) >= ENOUGH for wave in waves]
    aside = _together(np.where(apart, weight, 0), near) * spacing
    curves = [
        wave.curve + (shift if told else np.full(len(shift), own))[:, None] * normals(wave.curve, smoothing=1 / STEP)
        for wave, shift, told, own in zip(waves, shifts, apart, aside, strict=True)
    ]
    if course == "keep":
        curves = [shapely.get_coordinates(shape) for shape in shapes]
    courses = [shapely.LineString(curve) for curve in curves]
    before, after = _own_room(courses, spacing).T
    table = {
        "spacing_m": spacing,
        "curtains_m": curtains,
        "alone": False,
        "moves": apart & (course == "fit"),
        "slack_m": np.where(apart & (ends == "fit"), REACH, 0.0),
        "before_m": before,
        "after_m": after,
        "least_m": least,
        "kept": ~apart & ("fit" in (course, ends)),
    }
    return gpd.GeoDataFrame(table, geometry=courses, crs=lines.crs)


def name_rows(
    lines: gpd.GeoDataFrame, courses: gpd.GeoDataFrame, rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame, list[str]]:
    """Give rows the numbers and labels of the lines that they were known by, and gaps the number of their row.

    Parameters
    ----------
    lines, courses : GeoDataFrame
        The known lines with ``row_id`` and ``label``, and their courses with ``kept``.
    rows : GeoDataFrame
        In the lines' order, with ``support`` and ``flags``, to which ``no_canopy`` and ``kept`` are added.
    gaps : GeoDataFrame
        With ``row`` (position in rows) and ``start_m``.

    Returns
    -------
    rows, gaps : GeoDataFrame
        Gaps without ``row``.
    remarks : list of str
        What is to be known of the rows, a sentence each.
    """
    bare = rows["support"].to_numpy() == 0
    kept = courses["kept"].to_numpy() & ~bare
    said = zip(rows["flags"], np.where(bare, "no_canopy", ""), np.where(kept, "kept", ""), strict=True)
    flags = [",".join(filter(None, words)) for words in said]
    rows = rows.assign(row_id=lines["row_id"].to_numpy(), label=lines["label"].to_numpy(), flags=flags)
    of = gaps["row"].to_numpy(dtype=np.int64)
    gaps = gaps.assign(row_id=rows["row_id"].to_numpy()[of]).iloc[np.lexsort((gaps["start_m"], of))]
    gaps = gaps.drop(columns="row").reset_index(drop=True)
    (empty, still), n = (rows["label"][some].tolist() for some in (bare, kept)), len(rows)
    remarks = {
        f"{len(empty)} of {n} known rows have no canopy: {some_of(empty)}": empty,
        f"nothing shows where {len(still)} of {n} known rows run, as canopies are closed or too few: they are kept as "
        f"given, or moved with those around: {some_of(still)}": still,
    }
    return rows, gaps, [remark for remark, holds in remarks.items() if holds]


def _wave(line: shapely.LineString, spacing: float, cover: Raster) -> _Wave:
    curve = resample(shapely.get_coordinates(line), STEP)
    across = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    image = sample_across(cover, curve, normals(curve, smoothing=1 / STEP), spacing * across)
    image *= spacing / CELLS
    return _Wave(curve, image @ np.exp(2j * np.pi * across), image.sum(axis=1))


def _thereabouts(shapes: Values, spacing: Values) -> Values:
    """Pairs (3, k) of lines that are near each other and parallel, themselves included: two indices and their sense."""
    ends = shapely.get_coordinates(shapely.line_interpolate_point(shapes[:, None], [[0, 1]], normalized=True))
    chord = np.diff(ends.reshape(-1, 2, 2), axis=1)[:, 0]
    chord /= np.maximum(np.hypot(*chord.T), 1e-9)[:, None]
    i, j = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=THEREABOUTS * spacing)
    sense = (chord[i] * chord[j]).sum(axis=1)
    near = (np.abs(sense) >= PARALLEL) | (i == j)
    out: Values = np.stack([i[near], j[near], np.where(sense[near] < 0, -1, 1)])
    return out


def _together(weight: Values, near: Values) -> Values:
    """How far aside (n,) lines lie together, in spacings to the left, by the complex weights (n,) of their canopy."""
    i, j, sense = near
    theirs = np.where(sense < 0, weight[j].conj(), weight[j])
    total, most = np.zeros(len(weight), dtype=complex), np.zeros(len(weight))
    np.add.at(total, i, theirs)
    np.add.at(most, i, np.abs(theirs))
    return np.where(np.abs(total) > AGREED * most, np.angle(total) / (2 * np.pi), 0.0)


def _shifts(waves: list[_Wave], spacing: Values, together: Values) -> list[Values]:
    """Metres (stations,) to the left by which lines miss the row that is nearest to what all thereabouts miss."""
    out = []
    for wave, between, common in zip(waves, spacing, together, strict=True):
        turned = wave.phase * np.exp(-2j * np.pi * common)
        local = gaussian_filter1d(turned, ALONG * between / STEP, mode="nearest") + HELD * turned.mean()
        angle = np.unwrap(np.angle(local))
        # A chord of a bent row may miss its middle by more than half a spacing, but not its ends.
        if abs(angle[-1]) > np.pi:
            angle = np.full(len(angle), np.angle(turned.sum()))
        angle = whittaker(angle, np.abs(local), cutoff=BENDS * between / STEP)
        out.append(between * (common + angle / (2 * np.pi)))
    return out


def _across(wave: _Wave, shift: Values, spacing: float, cover: Raster) -> tuple[bool, float]:
    """Whether a row stands apart, with little cover midway to the rows on both sides, and metres between its curtains.

    These are 0 where it has but one.
    """
    normal = normals(wave.curve, smoothing=1 / STEP)
    across = np.arange(-CELLS // 2, CELLS // 2 + 1) / CELLS
    profile = sample_across(cover, wave.curve + shift[:, None] * normal, normal, spacing * across).mean(axis=0)
    alleys = (profile[np.abs(across - side) <= ALLEY].mean() for side in (-0.5, 0.5))
    apart = bool(max(alleys) <= APART * profile[np.abs(across) <= 0.25].max())
    right, left = profile[CELLS // 2 :: -1], profile[CELLS // 2 :]
    peaks = np.array([side.argmax() for side in (right, left)])
    dip = profile[CELLS // 2 - peaks[0] : CELLS // 2 + peaks[1] + 1].min()
    double = dip < DIP * min(right.max(), left.max()) and np.ptp(peaks) <= UNEVEN * peaks.sum()
    double &= peaks.sum() <= PAIR * (CELLS - peaks.sum())
    return apart, float(peaks.sum()) / CELLS * spacing if double else 0.0


def _own_room(courses: list[shapely.LineString], spacing: Values) -> Values:
    """Metres (n, 2) beyond both ends of courses that are theirs: half of the way to another one ahead."""
    tree, out = shapely.STRtree(courses), np.full((len(courses), 2), ROOM)
    for k, course in enumerate(courses):
        xy = shapely.get_coordinates(course)
        for end, curve in enumerate((xy, xy[::-1])):
            inner = curve[min(len(curve) - 1, round(5 / STEP))]
            outward = (curve[0] - inner) / max(float(np.hypot(*(curve[0] - inner))), 1e-9)
            way = shapely.LineString([curve[0], curve[0] + 2 * ROOM * outward])
            ahead = tree.query(way, predicate="dwithin", distance=AHEAD * spacing[k])
            ahead = ahead[ahead != k]
            away = shapely.distance(shapely.Point(curve[0]), tree.geometries[ahead])
            out[k, end] = min(ROOM, float(np.min(away, initial=np.inf)) / 2)
    return out
