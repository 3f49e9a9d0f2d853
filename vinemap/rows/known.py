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
from vinemap.geo.curve import normals, resample, unit
from vinemap.geo.layers import some_of
from vinemap.geo.raster import Raster, sample_across
from vinemap.rows.centre_line import whittaker
from vinemap.rows.curtains import DIP, PAIR, UNEVEN
from vinemap.surfaces.lines import PARALLEL, STEP

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Ints, Values

CELLS = 48
"""Cells of a spacing across a line."""
THEREABOUTS = 15.0
"""Spacings within which lines may lie aside together."""
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
ONE_ROW = 0.3
"""Spacings within which two lines that have moved lie on one row, if it is along half of the shorter one."""
THIN, LEAST = 0.02, 0.15
"""Metres of full cover across a line, and share of what is usual, below which there is no canopy."""
ENOUGH = 0.25
"""Share of a line that has canopy, or its course isn't told by it."""
REACH, ROOM = 3.0, 3.5
"""Metres by which an end may move, and that are looked at beyond it."""
NONE = -1
"""Position of no line."""
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


def follow_lines(lines: gpd.GeoDataFrame, cover: Raster, *, course: str = "fit", ends: str = "fit") -> gpd.GeoDataFrame:
    """Move lines sideways onto their canopy, each to the nearest row that all those thereabouts agree upon.

    Of two lines that would come to lie on one row, the nearer one takes it, and the other stays where it is.

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
        across, below which there is no canopy; ``kept``, whether nothing shows where the row runs, though it might
        move; and ``taken_by``, the position of the line that has its row, -1 of none.
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
    taken_by = _taken_by([_moved(*one) for one in zip(waves, shifts, strict=True)], shifts, aside, spacing, apart)
    apart &= taken_by < 0
    curves = [
        _moved(wave, shift if told else np.full(len(shift), own))
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
        "taken_by": taken_by if course == "fit" else NONE,
    }
    return gpd.GeoDataFrame(table, geometry=courses, crs=lines.crs)


def name_rows(
    lines: gpd.GeoDataFrame, courses: gpd.GeoDataFrame, rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame, list[str]]:
    """Give rows the numbers and labels of the lines that they were known by, and gaps the number of their row.

    Parameters
    ----------
    lines, courses : GeoDataFrame
        The known lines with ``row_id`` and ``label``, and their courses with ``kept`` and ``taken_by``.
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
    by = courses["taken_by"].to_numpy()
    lost, label = np.flatnonzero(by != NONE), rows["label"].to_numpy()
    (empty, still), n = (rows["label"][some].tolist() for some in (bare, kept & (by == NONE))), len(rows)
    pairs = [f"{one} (that of {other})" for one, other in zip(label[lost], label[by[lost]], strict=True)]
    remarks = {
        f"{len(pairs)} of {n} known rows would have come to lie on the canopy of another, and stay where they are: "
        f"{some_of(pairs)}": pairs,
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
    chord = unit(np.diff(ends.reshape(-1, 2, 2), axis=1)[:, 0])
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


def _moved(wave: _Wave, shift: Values) -> Values:
    """A line's stations (n, 2), moved to the left by metres (n,)."""
    out: Values = wave.curve + shift[:, None] * normals(wave.curve, smoothing=1 / STEP)
    return out


def _taken_by(curves: list[Values], shifts: list[Values], aside: Values, spacing: Values, apart: Flags) -> Ints:
    """The line (n,) that has the row on which one would come to lie with it, and to which it is nearer; or none.

    How near is counted from where all lines thereabouts lie.
    """
    courses = [shapely.LineString(curve) for curve in curves]
    miss = np.array([np.abs(shift - own).mean() for shift, own in zip(shifts, aside, strict=True)])
    rank = np.lexsort((np.arange(len(miss)), miss)).argsort()
    i, j = shapely.STRtree(courses).query(courses, predicate="dwithin", distance=ONE_ROW * spacing)
    near = apart[i] & apart[j] & (rank[j] < rank[i])
    pairs = np.column_stack([i, j])[near]
    out = np.full(len(courses), NONE)
    for worse, better in pairs[np.argsort(rank[pairs[:, 1]], kind="stable")].tolist():
        shorter, longer = sorted((worse, better), key=lambda k: len(curves[k]))
        beside = shapely.dwithin(shapely.points(curves[shorter]), courses[longer], ONE_ROW * spacing[worse])
        if out[worse] == out[better] == NONE and beside.mean() > 0.5:
            out[worse] = better
    return out


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
