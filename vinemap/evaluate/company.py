"""Which rows run beside rows, how far away, and where they end: stations along all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import shapely
from scipy.spatial import cKDTree

from vinemap.compute.beside import nearest_beside
from vinemap.geo.curve import cross, unit
from vinemap.geo.raster import Raster, sample

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.surfaces.seen import Seen

UNUSUAL = 1.5
"""Ratio of a distance to the usual one, or its inverse, from which a row isn't beside another as it ought to be."""
STANDS, TWICE = 0.2, 0.2
"""Share of a row's length along which the next one stands at the least, where the one after it is mostly the nearest,
and by how many of its distances that one is off two of them at the most."""
STEP = 0.5
"""Metres between the stations at which rows are looked at."""
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


class Stations(NamedTuple):
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


class Beside(NamedTuple):
    """The nearest parallel row to the left and to the right of stations (n, 2)."""

    away: Values
    """Metres; inf where there is none."""
    row: Ints
    """Which; −1 where there is none."""


def stations_along(lines: Values) -> Stations:
    """Stations along lines (n,), about ``STEP`` apart."""
    n = np.maximum(2, np.rint(shapely.length(lines) / STEP).astype(int) + 1)
    start = np.concatenate([[0], np.cumsum(n)])
    row = np.repeat(np.arange(len(lines)), n)
    share = (np.arange(start[-1]) - start[row]) / (n - 1)[row]
    xy = shapely.get_coordinates(shapely.line_interpolate_point(lines[row], share, normalized=True))
    each = np.arange(start[-1])
    way = xy[np.minimum(each + 1, start[row + 1] - 1)] - xy[np.maximum(each - 1, start[row])]
    return Stations(row, xy, unit(way), start)


def beside_each(at: Stations, block: Ints, reach: Values) -> Beside:
    """The nearest row on both sides of every station, within the metres that rows (n,) of a block reach."""
    wide = pd.Series(reach).groupby(block).transform("max").to_numpy()[at.row]
    away, other = nearest_beside(at.xy, at.tangent, at.row, wide, along=0.75 * STEP, parallel=PARALLEL)
    return Beside(away, np.where(other >= 0, at.row[other], -1))


def _seen_from(xy: Values, tangent: Values, other: Values) -> tuple[Values, Values]:
    """Metres along a direction and to its left at which others lie."""
    way = other - xy
    return (way * tangent).sum(axis=-1), cross(tangent, way)


def usually_apart(at: Stations, beside: Beside) -> Values:
    """Metres (rows,) at which the next row runs mostly, or, if the one after does, where it stands; NaN for none."""
    away = beside.away.min(axis=1)
    nearest = np.where(np.isfinite(away), away, np.nan)
    least = pd.Series(nearest).groupby(at.row).quantile(STANDS).to_numpy(dtype=float)
    mostly = at.median(nearest)
    return np.where(np.abs(mostly - 2 * least) < TWICE * least, least, mostly)


def accompanied(at: Stations, beside: Beside, usual: Values) -> Flags:
    """Stations (n,) beside which a row runs at a distance that is usual for both."""
    there = beside.row >= 0
    expected = np.stack([np.repeat(usual[at.row][:, None], 2, axis=1), usual[beside.row]])
    ratio = np.where(there, beside.away, np.nan) / expected
    out: Flags = ((ratio > 1 / UNUSUAL) & (ratio < UNUSUAL)).all(axis=0).any(axis=1)
    return out


def crosses(at: Stations, beside: Beside, usual: Values) -> Values:
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


def goes_on(at: Stations, usual: Values, chm: Raster, seen: Seen, high: float) -> Values:
    """How far rows (n,) end where another leads on and those around run through, from none of these to all.

    What lies between must have been seen, and nothing stand there that is taller than vines.
    """
    ends = np.column_stack([at.start[:-1], at.start[1:] - 1]).ravel()
    row = at.row[ends]
    back = round(TANGENT / STEP)
    backwards, forwards = np.maximum(ends - back, at.start[row]), np.minimum(ends + back, at.start[row + 1] - 1)
    inner = np.where(np.arange(len(ends)) % 2, backwards, forwards)
    xy = at.xy[ends]
    outward = unit(xy - at.xy[inner])
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
