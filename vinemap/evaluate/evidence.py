"""What speaks for a row, from its surroundings: ingredients from 0 to 1."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import shapely
from scipy.spatial import cKDTree

from vinemap.compute.beside import nearest_beside
from vinemap.geo.raster import Raster, cell_of, sample, sample_across
from vinemap.surfaces.things import around_cells, roughness

if TYPE_CHECKING:
    import geopandas as gpd

    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.surfaces.seen import Seen
    from vinemap.surfaces.waves import RowField

SLACK = 0.02
"""Metres to which rows' courses are needed."""
UNUSUAL = 1.5
"""Ratio of a distance to the usual one, or its inverse, from which a row isn't beside another as it ought to be."""
STANDS, TWICE = 0.2, 0.2
"""Share of a row's length along which the next one stands at the least, where the one after it is mostly the nearest,
and by how many of its distances that one is off two of them at the most."""
STEP = 0.5
"""Metres between the stations at which rows are looked at."""
REACH = 2.5
"""Spacings within which a row has neighbours."""
PARALLEL, STRAIGHT = np.cos(np.radians(10)), np.cos(np.radians(6))
"""Cosine of the angle within which rows are parallel, and within which one goes on where another stopped."""
SEAM = 4.0
"""Metres before and after a place at which a neighbour ends and another begins: half a track and more."""
TANGENT = 5.0
"""Metres of a row that tell where it would go on."""
LONGEST_GAP = 40.0
"""Metres over which one row may go on in another."""
THROUGH = np.arange(0.05, 1, 0.1)
"""Shares of a gap at which it is looked for what is taller than vines."""
AROUND = 3.5
"""Spacings within which other rows tell whether there is a track."""
LIKE = 4
"""Nearest rows with the second narrowest of which, for its height, a canopy is compared."""
ASIDE = 2 / 3
"""Spacings aside of a row where the next one's canopy begins."""
LONE = 1 / 3
"""Company of a row that has none where the others have none, either."""
RIDGE, FLANK = 0.35, 0.2
"""Shares of a row's usual cover from which a station has canopy, and down to which that reaches across."""
FAINT, PLAIN = 0.15, 0.35
"""Likelihood of a row field that tells no rows, and from which on it tells them."""
BLURRED, CLEAR = 0.3, 0.6
"""The same of how clearly rows show without a wave."""
SMOOTH, CROOKED = 0.04, 0.1
"""Radians a metre by which a row's turn varies up to which it bends, and from which what is found wanders."""
BEND = 10.0
"""Metres over which rows bend alike."""
CHORD = 2.0
"""Metres between which a row's turn is told."""
NOISE, EVEN, COARSE, LEAFY = 0.1, 2.2, 0.02, 1.4
"""Order of the ground's roughness that is only noise; how many times as rough, and metres, the top of a row is at the
most that is none of leaves, as panels and bales are; and how many times as rough as that it is where leaves make it."""


class _Stations(NamedTuple):
    """Points along all rows, one row after the other."""

    row: Ints
    xy: Values
    tangent: Values
    start: Ints
    """First station (rows + 1,) of each row."""

    def share(self, flags: Flags | Values) -> Values:
        """Mean of what stations (n,) tell, row by row."""
        out: Values = np.add.reduceat(flags.astype(float), self.start[:-1]) / np.diff(self.start)
        return out

    def median(self, values: Values) -> Values:
        """Median of what stations (n,) tell where they tell something, row by row; NaN where none does."""
        out: Values = pd.Series(values).groupby(self.row).median().to_numpy(dtype=float)
        return out


class _Beside(NamedTuple):
    """The nearest parallel row to the left and to the right of stations (n, 2)."""

    away: Values
    """Metres; inf where there is none."""
    row: Ints
    """Which; −1 where there is none."""


def evidence(
    rows: gpd.GeoDataFrame, cover: Raster, chm: Raster, field: RowField, seen: Seen, *, high: float
) -> pd.DataFrame:
    """What speaks for rows, each from 0 to 1, and the share of their canopy's length that is ``cut`` at a side.

    They are **company**, the share of the length along which another row runs beside it at the distance that is usual
    for both, which tells less where most rows stand alone; **whole**, that it doesn't go on beyond its end where others
    go on, nor crosses where those beside it end; **alike**, that its canopy isn't far wider for its height than theirs;
    **claimed**, the share beside which no canopy stands where the next row ought to be; its **support**; its
    **contrast**; its **length** in spacings; the **wave** of rows thereabouts, which bushes in no order hardly have;
    that its course is **smooth**; and that its top is **rough**, as leaves are.

    Parameters are as of :func:`vinemap.evaluate.confidence.judge_rows`; there is a row at the least.
    """
    spacing = rows["spacing_m"].to_numpy(dtype=float)
    lines = shapely.simplify(shapely.force_2d(rows.geometry.to_numpy()), SLACK)
    at = _stations(lines)
    beside = _beside(at, rows["block"].to_numpy(), REACH * spacing)
    usual = np.where(np.isfinite(own := _usual(at, beside)), own, spacing)
    normal = np.column_stack([-at.tangent[:, 1], at.tangent[:, 0]])
    ridge = sample_across(cover, at.xy, normal, np.arange(-2, 3) * cover.grid.resolution).max(axis=1)
    level = at.median(np.where(ridge >= at.median(ridge)[at.row], ridge, np.nan))
    standing = ridge > RIDGE * level[at.row]
    shape = _aspect(at, chm, normal, np.where(standing, usual[at.row], np.nan))
    company = at.share(_accompanied(at, beside, usual))
    return pd.DataFrame(
        {
            "company": np.maximum(company, LONE * (1 - float(np.median(company)))),
            "whole": 1 - np.maximum(_goes_on(at, usual, chm, seen, high), _crosses(at, beside, usual)),
            "alike": _alike(lines, shape),
            "claimed": 1 - at.share(_unclaimed(at, beside, usual, cover, normal, level)),
            "support": np.minimum(rows["support"].to_numpy(dtype=float) / 0.6, 1),
            "contrast": np.clip((rows["contrast"].to_numpy(dtype=float) - 0.2) / 0.6, 0, 1),
            "length": 1 - np.exp(-shapely.length(lines) / (2 * usual)),
            "wave": _wave(at, field),
            "smooth": np.clip((CROOKED - _wandering(at)) / (CROOKED - SMOOTH), 0, 1),
            "rough": _rough(at, chm, standing),
            "cut": _cut(at, usual, cover, seen, normal, np.where(standing, level[at.row], np.nan)),
        }
    )


def _stations(lines: Values) -> _Stations:
    n = np.maximum(2, np.rint(shapely.length(lines) / STEP).astype(int) + 1)
    start = np.concatenate([[0], np.cumsum(n)])
    row = np.repeat(np.arange(len(lines)), n)
    share = (np.arange(start[-1]) - start[row]) / (n - 1)[row]
    xy = shapely.get_coordinates(shapely.line_interpolate_point(lines[row], share, normalized=True))
    each = np.arange(start[-1])
    way = xy[np.minimum(each + 1, start[row + 1] - 1)] - xy[np.maximum(each - 1, start[row])]
    return _Stations(row, xy, way / np.maximum(np.hypot(*way.T), 1e-9)[:, None], start)


def _beside(at: _Stations, block: Ints, reach: Values) -> _Beside:
    """The nearest row on both sides of every station, within the metres that rows (n,) of a block reach."""
    wide = pd.Series(reach).groupby(block).transform("max").to_numpy()[at.row]
    away, other = nearest_beside(at.xy, at.tangent, at.row, wide, along=0.75 * STEP, parallel=PARALLEL)
    return _Beside(away, np.where(other >= 0, at.row[other], -1))


def _seen_from(xy: Values, tangent: Values, other: Values) -> tuple[Values, Values]:
    """Metres along a direction and to its left at which others lie."""
    way = other - xy
    return (way * tangent).sum(axis=-1), tangent[..., 0] * way[..., 1] - tangent[..., 1] * way[..., 0]


def _usual(at: _Stations, beside: _Beside) -> Values:
    """Metres (rows,) at which the next row runs mostly, or, if the one after does, where it stands; NaN for none."""
    nearest = np.where((away := beside.away.min(axis=1)) < np.inf, away, np.nan)
    least = pd.Series(nearest).groupby(at.row).quantile(STANDS).to_numpy(dtype=float)
    mostly = at.median(nearest)
    return np.where(np.abs(mostly - 2 * least) < TWICE * least, least, mostly)


def _accompanied(at: _Stations, beside: _Beside, usual: Values) -> Flags:
    """Stations (n,) beside which a row runs at a distance that is usual for both."""
    there = beside.row >= 0
    expected = np.stack([np.repeat(usual[at.row][:, None], 2, axis=1), usual[beside.row]])
    ratio = np.where(there, beside.away, np.nan) / expected
    out: Flags = ((ratio > 1 / UNUSUAL) & (ratio < UNUSUAL)).all(axis=0).any(axis=1)
    return out


def _crosses(at: _Stations, beside: _Beside, usual: Values) -> Values:
    """How far rows (n,) run on where those beside them end and others begin: 1 on both sides, 0.5 at an edge."""
    k = round(SEAM / STEP)
    next_ones = np.where(beside.away < UNUSUAL * usual[at.row][:, None], beside.row, -1)
    before, after = next_ones[: -2 * k], next_ones[2 * k :]
    one_row = (at.row[: -2 * k] == at.row[2 * k :])[:, None]
    broken = one_row & (before != after) & (before >= 0) & (after >= 0)
    away, then = beside.away[: -2 * k], beside.away[2 * k :]
    broken &= (away < UNUSUAL * then) & (then < UNUSUAL * away)  # else the other one was there before, behind the first
    none = one_row & (before < 0) & (after < 0)
    seam = np.where(broken.all(axis=1), 1.0, np.where(broken.any(axis=1) & none.any(axis=1), 0.5, 0.0))
    out = np.zeros(len(at.start) - 1)
    np.maximum.at(out, at.row[k : k + len(seam)], seam)
    return out


def _goes_on(at: _Stations, usual: Values, chm: Raster, seen: Seen, high: float) -> Values:
    """How far rows (n,) end where another leads on and those around run through, from none of these to all.

    What lies between must have been seen, and nothing stand there that is taller than vines.
    """
    ends = np.column_stack([at.start[:-1], at.start[1:] - 1]).ravel()
    row = at.row[ends]
    back = round(TANGENT / STEP)
    backwards, forwards = np.maximum(ends - back, at.start[row]), np.minimum(ends + back, at.start[row + 1] - 1)
    inner = np.where(np.arange(len(ends)) % 2, backwards, forwards)
    xy = at.xy[ends]
    outward = xy - at.xy[inner]
    outward /= np.maximum(np.hypot(*outward.T), 1e-9)[:, None]
    pairs = cKDTree(xy).query_pairs(LONGEST_GAP, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    gap, across = _seen_from(xy[i], outward[i], xy[j])
    facing = (row[i] != row[j]) & (gap > 0) & ((outward[i] * outward[j]).sum(axis=1) < -STRAIGHT)
    facing &= np.abs(across) < np.minimum(0.15 * usual[row[i]] + 0.03 * gap, 0.4 * usual[row[i]])
    i, gap = i[facing], gap[facing]
    middle = xy[i] + 0.5 * gap[:, None] * outward[i]
    along = xy[i, None] + (THROUGH * gap[:, None])[..., None] * outward[i, None]
    tall = sample(chm, along.reshape(-1, 2)).reshape(along.shape[:2]) > high
    between = seen.at(middle) & ~tall.any(axis=1)
    i, gap, middle = i[between], gap[between], middle[between]
    out = np.zeros(len(at.start) - 1)
    if len(i) == 0:
        return out
    tree = cKDTree(at.xy)
    for k, (end, length) in enumerate(zip(i, gap, strict=True)):
        wide = AROUND * usual[row[end]]
        near = np.array(tree.query_ball_point(middle[k], np.hypot(wide, 0.5 * length + 1)), dtype=int)
        along, across = _seen_from(middle[k], outward[end], at.xy[near])
        inside = (np.abs(along) < 0.5 * length + 1) & (np.abs(across) < wide)
        inside &= np.abs(across) > 0.5 * usual[row[end]]
        run = np.bincount(at.row[near[inside]], minlength=len(out)) * STEP
        through = np.count_nonzero(run >= 0.9 * (length + 1))
        along, across = _seen_from(middle[k], outward[end], middle)
        broken = np.count_nonzero((np.abs(across) < wide) & (np.abs(along) < 0.5 * (length + gap))) / 2
        out[row[end]] = max(out[row[end]], np.clip(2 * through / (through + max(broken, 1)) - 0.5, 0, 1))
    return out


def _aspect(at: _Stations, chm: Raster, normal: Values, usual: Values) -> Values:
    """Width of rows' canopies (n,) over their height: what stands above half of it, within a spacing; NaN if unknown.

    ``usual`` (stations,) is the spacing, NaN where there is no canopy.
    """
    known = np.flatnonzero(np.isfinite(usual))
    offsets = np.linspace(-0.5, 0.5, 17)
    out = np.full(len(at.start) - 1, np.nan)
    if len(known) == 0:
        return out
    wide = normal[known] * usual[known, None]
    heights = sample(chm, at.xy[known, None] + offsets[:, None] * wide[:, None])
    top = np.where(np.isfinite(heights[:, 5:12]), heights[:, 5:12], -np.inf).max(axis=1)
    top = np.where(np.isfinite(top), top, np.nan)
    height = at.median(pd.Series(top, index=known).reindex(np.arange(len(at.row))).to_numpy())
    seen = np.isfinite(heights)
    above = (np.nan_to_num(heights) > 0.5 * height[at.row[known], None]).sum(axis=1)
    width = above / np.maximum(seen.sum(axis=1), 1) * usual[known]
    n = np.bincount(at.row[known], minlength=len(out))
    mean = np.bincount(at.row[known], width, len(out)) / np.maximum(n, 1)
    return np.where(n > 0, mean / height, np.nan)


def _alike(lines: Values, aspect: Values) -> Values:
    """How far rows (n,) are as wide for their height as those around, of ``aspect`` (n,): 1 to 1.5 times, 0 from 3."""
    out = np.ones(len(lines))
    middles = shapely.get_coordinates(shapely.line_interpolate_point(lines, 0.5, normalized=True))
    n = min(len(lines), 4 * LIKE)
    if n < 3:
        return out
    candidates = cKDTree(middles).query(middles, n)[1][:, 1:]
    away = shapely.distance(lines[:, None], lines[candidates])
    nearest = np.take_along_axis(candidates, np.argsort(away, axis=1)[:, :LIKE], axis=1)
    ratio = aspect / np.sort(aspect[nearest], axis=1)[:, 1]
    return np.where(np.isfinite(ratio), np.clip(np.log(3 / np.maximum(ratio, 1e-3)) / np.log(2), 0, 1), 1)


def _unclaimed(at: _Stations, beside: _Beside, usual: Values, cover: Raster, normal: Values, level: Values) -> Flags:
    """Stations (n,) beside which canopy as strong as theirs stands where a next row would, and there is none."""
    wide = normal * usual[at.row][:, None]
    offsets = np.linspace(0.85, 1.15, 7)
    out = np.zeros(len(at.row), dtype=bool)
    for side, sign in enumerate((1, -1)):
        there = np.nan_to_num(sample_across(cover, at.xy, sign * wide, offsets)).max(axis=1)
        out |= (there > 0.6 * level[at.row]) & ~(beside.away[:, side] < UNUSUAL * usual[at.row])
    return out


def _wave(at: _Stations, field: RowField) -> Values:
    """How plainly rows (n,) lie in a wave of rows, or show without one."""
    likelihood = at.share(np.nan_to_num(field.at(at.xy)[2]))
    out: Values = np.clip((likelihood - FAINT) / (PLAIN - FAINT), 0, 1)
    if field.plain:
        alone = at.share(np.nan_to_num(sample(field.plain, at.xy)))
        out = np.maximum(out, np.clip((alone - BLURRED) / (CLEAR - BLURRED), 0, 1))
    return out


def _wandering(at: _Stations) -> Values:
    """Root mean square of how far rows' (n,) turn between two stations is off what it is thereabouts, radians a metre.

    It is told by chords of ``CHORD`` metres.
    """
    k = round(CHORD / STEP)
    first = np.arange(max(len(at.row) - k - 1, 0))
    first = first[at.row[first] == at.row[first + k + 1]]
    a, b = at.xy[first + k] - at.xy[first], at.xy[first + k + 1] - at.xy[first + 1]
    turn = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1)) / STEP
    row, rows = at.row[first], len(at.start) - 1
    total = np.concatenate([[0.0], np.cumsum(turn)])
    n = np.bincount(row, minlength=rows)
    begin = np.concatenate([[0], np.cumsum(n)])
    here, reach = np.arange(len(turn)), round(BEND / STEP / 2)
    low, high = np.maximum(here - reach, begin[row]), np.minimum(here + reach + 1, begin[row + 1])
    off = turn - (total[high] - total[low]) / (high - low)
    out: Values = np.sqrt(np.bincount(row, off**2, rows) / np.maximum(n, 1))
    return out


def _rough(at: _Stations, chm: Raster, standing: Flags) -> Values:
    """How far tops of rows (n,), at stations with canopy, are rougher than noise makes the evenest ground."""
    around, ground = around_cells(chm)
    cells, tops = cell_of(at.xy[standing], chm.grid), np.zeros(chm.grid.shape, dtype=bool)
    tops.ravel()[cells] = True
    rough = roughness(around, tops | ground)
    even = min(EVEN * float(np.quantile(rough[ground], NOISE)), COARSE) if ground.any() else 0.0
    if even == 0:
        return np.ones(len(at.start) - 1)
    own = np.full(len(standing), np.nan)
    own[standing] = rough.ravel()[cells]
    out: Values = np.clip((at.median(own) / even - 1) / (LEAFY - 1), 0, 1)
    return np.nan_to_num(out, nan=1.0)


def _cut(at: _Stations, usual: Values, cover: Raster, seen: Seen, normal: Values, level: Values) -> Values:
    """Share of the canopy of rows (n,) that reaches, at a side, to where nothing is seen from there almost to a next.

    Their ends lie at an edge by themselves. ``level`` (stations,) is the cover, NaN where there is no canopy.
    """
    inner = np.isfinite(level)
    inner[at.start[:-1]] = inner[at.start[1:] - 1] = False
    cut, step = np.zeros(len(at.row), dtype=bool), cover.grid.resolution
    far = ASIDE * usual[at.row]
    offsets = np.arange(0.0, float(far.max()), step)
    for side in (normal, -normal):
        k = np.flatnonzero(inner & ~seen.at(at.xy + far[:, None] * side))
        xy = at.xy[k, None] + offsets[:, None] * side[k, None]
        shown = (offsets <= far[k, None]) & seen.at(xy.reshape(-1, 2)).reshape(xy.shape[:2])
        canopy = shown & (np.nan_to_num(sample_across(cover, at.xy[k], side[k], offsets)) > FLANK * level[k, None])
        last, flank = ((offsets * flags).max(axis=1) for flags in (shown, canopy))
        cut[k] |= flank >= last - seen.grid.resolution - step
    return at.share(cut) / np.maximum(at.share(inner), 1e-9)
