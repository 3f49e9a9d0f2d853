"""What speaks for a row, from its surroundings: ingredients from 0 to 1."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import shapely
from scipy.spatial import cKDTree

from vinemap.evaluate.company import (
    STEP,
    UNUSUAL,
    Beside,
    Stations,
    accompanied,
    beside_each,
    crosses,
    goes_on,
    stations_along,
    usually_apart,
)
from vinemap.geo.curve import cross
from vinemap.geo.raster import Raster, cell_of, sample, sample_across
from vinemap.surfaces.things import around_cells, roughness

if TYPE_CHECKING:
    import geopandas as gpd

    from vinemap.compute.arrays import Flags, Values
    from vinemap.surfaces.seen import Seen
    from vinemap.surfaces.waves import RowField

SLACK = 0.02
"""Metres to which rows' courses are needed."""
REACH = 2.5
"""Spacings within which a row has neighbours."""
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


def evidence(
    rows: gpd.GeoDataFrame, cover: Raster, chm: Raster, field: RowField, seen: Seen, *, high: float
) -> pd.DataFrame:
    """What speaks for rows, each from 0 to 1, and the share of their canopy's length that is ``cut`` at a side.

    They are

    - ``company``: the share of the length along which another row runs beside it at the distance that is usual for
      both, which tells less where most rows stand alone;
    - ``whole``: that it doesn't go on beyond its end where others go on, nor crosses where those beside it end;
    - ``alike``: that its canopy isn't far wider for its height than those of the rows around;
    - ``claimed``: the share of the length beside which no canopy stands where the next row ought to be;
    - ``support``, ``contrast`` and ``length``, in spacings: its own;
    - ``wave``: how plainly rows are a wave thereabouts, which bushes in no order hardly are;
    - ``smooth``: that its course doesn't wander;
    - ``rough``: that its top is rough, as leaves are.

    Parameters are as of :func:`vinemap.evaluate.confidence.judge_rows`; there is a row at the least.
    """
    spacing = rows["spacing_m"].to_numpy(dtype=float)
    lines = shapely.simplify(shapely.force_2d(rows.geometry.to_numpy()), SLACK)
    at = stations_along(lines)
    beside = beside_each(at, rows["block"].to_numpy(), REACH * spacing)
    apart = usually_apart(at, beside)
    usual = np.where(np.isfinite(apart), apart, spacing)
    normal = np.column_stack([-at.tangent[:, 1], at.tangent[:, 0]])
    ridge = sample_across(cover, at.xy, normal, np.arange(-2, 3) * cover.grid.resolution).max(axis=1)
    level = at.median(np.where(ridge >= at.median(ridge)[at.row], ridge, np.nan))
    standing = ridge > RIDGE * level[at.row]
    shape = _aspect(at, chm, normal, np.where(standing, usual[at.row], np.nan))
    company = at.share(accompanied(at, beside, usual))
    return pd.DataFrame(
        {
            "company": np.maximum(company, LONE * (1 - float(np.median(company)))),
            "whole": 1 - np.maximum(goes_on(at, usual, chm, seen, high), crosses(at, beside, usual)),
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


def _aspect(at: Stations, chm: Raster, normal: Values, usual: Values) -> Values:
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


def _unclaimed(at: Stations, beside: Beside, usual: Values, cover: Raster, normal: Values, level: Values) -> Flags:
    """Stations (n,) beside which canopy as strong as theirs stands where a next row would, and there is none."""
    wide = normal * usual[at.row][:, None]
    offsets = np.linspace(0.85, 1.15, 7)
    out = np.zeros(len(at.row), dtype=bool)
    for side, sign in enumerate((1, -1)):
        there = np.nan_to_num(sample_across(cover, at.xy, sign * wide, offsets)).max(axis=1)
        out |= (there > 0.6 * level[at.row]) & ~(beside.away[:, side] < UNUSUAL * usual[at.row])
    return out


def _wave(at: Stations, field: RowField) -> Values:
    """How plainly rows (n,) lie in a wave of rows, or show without one."""
    likelihood = at.share(np.nan_to_num(field.at(at.xy)[2]))
    out: Values = np.clip((likelihood - FAINT) / (PLAIN - FAINT), 0, 1)
    if field.plain:
        alone = at.share(np.nan_to_num(sample(field.plain, at.xy)))
        out = np.maximum(out, np.clip((alone - BLURRED) / (CLEAR - BLURRED), 0, 1))
    return out


def _wandering(at: Stations) -> Values:
    """Root mean square of how far rows' (n,) turn between two stations is off what it is thereabouts, radians a metre.

    It is told by chords of ``CHORD`` metres.
    """
    k = round(CHORD / STEP)
    first = np.arange(max(len(at.row) - k - 1, 0))
    first = first[at.row[first] == at.row[first + k + 1]]
    a, b = at.xy[first + k] - at.xy[first], at.xy[first + k + 1] - at.xy[first + 1]
    turn = np.arctan2(cross(a, b), (a * b).sum(axis=1)) / STEP
    row, rows = at.row[first], len(at.start) - 1
    total = np.concatenate([[0.0], np.cumsum(turn)])
    n = np.bincount(row, minlength=rows)
    begin = np.concatenate([[0], np.cumsum(n)])
    here, reach = np.arange(len(turn)), round(BEND / STEP / 2)
    low, high = np.maximum(here - reach, begin[row]), np.minimum(here + reach + 1, begin[row + 1])
    off = turn - (total[high] - total[low]) / (high - low)
    out: Values = np.sqrt(np.bincount(row, off**2, rows) / np.maximum(n, 1))
    return out


def _rough(at: Stations, chm: Raster, standing: Flags) -> Values:
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


def _cut(at: Stations, usual: Values, cover: Raster, seen: Seen, normal: Values, level: Values) -> Values:
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
