"""Double curtains: rows whose vines feed two, told from rows that stand in pairs.

From above both look alike. The row field's wave is either that of the rows or that of the curtains; where a vine is
missing, both curtains of its row have a gap, and pairs of rows have gaps of their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import label, uniform_filter, uniform_filter1d

from vinemap.geo.raster import sample_across

if TYPE_CHECKING:
    import geopandas as gpd

    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Raster

FAR = 3.0
"""Spacings to both sides within which several curtains show."""
SOME = 5
"""Of so many nodes in either direction one is looked at for double curtains."""
UNEVEN, DIP = 0.15, 0.7
"""Share by which the distances of curtains may differ, and cover between two in theirs, at the most."""
PAIR, CLOSE = 0.65, 0.8
"""Distance of a row's curtains in that to the next row's, at the most: where the field's wave is that of the rows, and
where gaps tell that they are."""
AGREE = 0.07
"""Share by which the distance of rows may differ from that of the field, or twice that, or three times."""
AROUND, MOST = 8.0, 0.6
"""Spacings, side of the square about a node, and share of what stands there in pairs, where rows have two curtains."""
ALONG, STEP, LINES = 4.0, 0.1, 5
"""Metres to both sides along the curtains in which gaps are sought, their steps, and lines along each."""
BAND, GAP, BARE = 0.25, 0.8, 0.2
"""Half the width of a curtain in the distance of two, metres of it over which cover is averaged, and share of what
there is of it thereabouts below which there is a gap."""
SHARED, OTHERS, ENOUGH = 0.3, 1 / 3, 2.0
"""Share of the gaps that curtains have with the other of their row at the least, gaps with the next row's in these at
the most, and metres of them."""


def abreast(profile: Values, offsets: Values, nodes: Values, cover: Raster, *, min_cover: float) -> Values:
    """Places (m, 7) where four curtains stand side by side, as profiles (n, bins) across the rows at nodes (n, 4) show.

    They are x, y, the distance of two curtains of a row, 0 where all are about as far from each other, that of two rows
    if they have two, and metres of gaps: those of both curtains of a row, of one alone, and of it and the next row's.
    """
    node, k = np.nonzero(peaks(profile, min_cover))
    if len(node) < 4:
        return np.empty((0, 7))
    top, v = profile[node, k + 1], offsets[k + 1]
    between = np.minimum.reduceat(profile.ravel(), node * profile.shape[1] + k + 1)[:-1]
    apart = (np.diff(node) == 0) & (between <= DIP * np.minimum(top[:-1], top[1:]))
    gap = np.diff(v)
    first, second, third = gap[:-2], gap[1:-1], gap[2:]
    outer = (first + third) / 2
    less, more = np.minimum(outer, second), np.maximum(outer, second)
    close = (less <= CLOSE * more) & (np.abs(first - third) <= 2 * UNEVEN * outer)
    times = (less + more) / nodes[node[:-3], 3]
    agree = np.min([np.abs(times / n - 1) for n in (1, 2, 3)], axis=0) <= AGREE
    shown = apart[:-2] & apart[1:-1] & apart[2:] & (agree | ~close)
    out = np.column_stack([nodes[node[:-3], :2], np.where(close, less, 0.0), less + more, np.zeros((len(less), 3))])
    of = np.flatnonzero(shown & close)
    out[of, 4:] = _gaps(nodes[node[of]], v[of[:, None] + np.arange(4)], (outer < second)[of], cover)
    found: Values = out[shown]
    return found


def peaks(profile: Values, least: float) -> Flags:
    """Where profiles (n, bins) have maxima of so much at the least: (n, bins - 2), as none is at an end."""
    middle = profile[:, 1:-1]
    out: Flags = (middle >= profile[:, :-2]) & (middle > profile[:, 2:]) & (middle >= least)
    return out


def _gaps(nodes: Values, v: Values, ends: Flags, cover: Raster) -> Values:
    """Metres (m, 3) of gaps in four curtains at distances (m, 4) to the left of nodes (m, 4).

    They are those of the second and of the third that the other of its row has and the next row's hasn't, that neither
    has, and that only the next row's has. A row's curtains are the first two and the last two, or else the middle ones.
    """
    along = np.column_stack([np.cos(nodes[:, 2]), np.sin(nodes[:, 2])]).repeat(4, axis=0)
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    u = np.arange(-ALONG, ALONG + STEP / 2, STEP)
    half = BAND * np.minimum(v[:, 1] - v[:, 0], v[:, 2] - v[:, 1]).repeat(4)
    across = np.zeros((len(v) * 4, len(u)))
    for side in np.linspace(-1, 1, LINES):
        at = nodes[:, :2].repeat(4, axis=0) + (v.ravel() + side * half)[:, None] * normal
        across += sample_across(cover, at, along, u)
    there = across.reshape(len(v), 4, len(u))
    bare = uniform_filter1d(there, round(GAP / STEP), axis=2) < BARE * there.mean(axis=(1, 2), keepdims=True)
    # What is bare as far as is looked is no gap, but a row's end.
    beyond = np.logical_and.accumulate(bare, axis=2) | np.logical_and.accumulate(bare[:, :, ::-1], axis=2)[:, :, ::-1]
    place = np.arange(len(v))[:, None]
    curtains = [1, 2], np.where(ends[:, None], [0, 3], [2, 1]), np.where(ends[:, None], [2, 1], [0, 3])
    one, other, following = (bare[place, of] for of in curtains)
    one = one & ~np.any([beyond[place, of] for of in curtains], axis=0)
    kinds = one & other & ~following, one & ~other & ~following, one & ~other & following
    out: Values = STEP * np.stack([kind.sum(axis=(1, 2)) for kind in kinds], axis=1)
    return out


def with_curtains(nodes: Values, cells: Ints, found: Values, step: float) -> Values:
    """Nodes (n, 6): the same, the distance of a row's two curtains (m), 0 where it has one, and whether gaps tell that.

    Where rows have two, their spacing is that of what was ``found`` (m, 7) abreast, as the field may have taken that of
    curtains for it. What hangs together is all of one kind.
    """
    out = np.column_stack([nodes, np.zeros((len(nodes), 2))])
    close = found[:, 2] > 0
    if not close.any():
        return out
    i, j = (cells // SOME).T
    side = SOME * step
    west, north = nodes[0, :2] + (cells[0, [1, 0]] + 0.5) * step * [-1, 1]
    there = tuple(np.floor(np.column_stack([north - found[:, 1], found[:, 0] - west]) / side).astype(int).T)
    counts = np.zeros((4, i.max() + 1, j.max() + 1))
    what = np.ones(len(found)), close, found[:, 2], close * found[:, 3]
    for count, values in zip(counts, what, strict=True):
        np.add.at(count, there, values)
    width = max(1, round(AROUND * float(np.median(nodes[:, 3])) / side))
    some, double, metres, spacing = (uniform_filter(count, width, mode="constant") for count in counts)
    most = np.zeros(some.shape, dtype=bool)
    most[i, j] = ((double > MOST * some) & (double > 1e-9))[i, j]
    parts, n = label(most, np.ones((3, 3)))
    apart, rows = (values / np.maximum(double, 1e-9) for values in (metres, spacing))
    for part in range(1, n + 1):
        here, theirs = parts == part, close & (parts[there] == part)
        mine = here[i, j]
        if not theirs.any():
            here, theirs = most, close
        between = rows[i[mine], j[mine]]
        times = np.maximum(np.round(between / nodes[mine, 3]), 1)
        usual = float(np.median(times))
        curtains, of_rows = (float(np.median(found[theirs, k])) for k in (2, 3))
        length = 2 * np.count_nonzero(here[i, j]) * step**2 / of_rows
        told = _of_one_row(found[theirs, 4:], length)
        if told or (usual <= 2 and curtains <= PAIR * (of_rows - curtains)):
            out[mine, 3:] = np.column_stack([between, apart[i[mine], j[mine]], np.full(len(between), told)])
        else:
            out[mine, 3] = np.where(times < usual, between / usual, nodes[mine, 3])
    return out


def curtain_remarks(courses: gpd.GeoDataFrame) -> list[str]:
    """A remark if rows were taken for such of two curtains by their distances alone, as pairs of rows have the same.

    Parameters
    ----------
    courses : GeoDataFrame
        With ``curtains_m`` and ``told``, as of :func:`vinemap.rows.curves.trace_rows`.
    """
    guessed = courses[(courses["curtains_m"] > 0) & ~courses["told"]]
    if len(guessed) == 0:
        return []
    apart = guessed["curtains_m"].median()
    remark = (
        f"{len(guessed)} rows are taken for such of two curtains, {apart:.1f} m apart, by their distances alone: if "
        "they are two rows each, known rows tell it (--rows)"
    )
    return [remark]


def _of_one_row(gaps: Values, length: float) -> bool:
    """Whether metres of gaps (m, 3) that were found in curtains so long tell that two belong to a row."""
    both, alone, others = gaps.mean(axis=0) / (4 * ALONG) * length
    return bool(both >= ENOUGH and both >= SHARED * (both + alone) and others <= OTHERS * both)
