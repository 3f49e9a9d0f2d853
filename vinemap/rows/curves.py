"""Clusters of key points to the courses of rows: ordered, centred on the canopy, and sifted from what is no row.

The enhanced key points are ordered as in the thesis (section 2.3.3) and give a first course. Canopy cover is then
read along that course, straightened: an image with one line of cells across the row every 0.1 m, whose smoothed
centroids are the row's course.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import geopandas as gpd
import numpy as np
import shapely
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import matrix_power

from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads
from vinemap.geo.curve import between, cross, extend, normals, resample, turn_between
from vinemap.geo.raster import Raster, sample_across
from vinemap.rows.centre_line import centre_line, half_width, runs_above, whittaker
from vinemap.rows.standing.canopy import thereabouts

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Ints, Values

STATION = 0.1
"""Metres between the stations of a straightened row."""
BIN = 0.05
"""Metres between its cells across."""
LONE_WIDTH, LONE_SHARE = 0.85, 0.25
"""Metres of canopy across beyond which, and share of the median length below which, a row with no other beside it is
a hedge or a bush."""
SAME_DIRECTION = np.radians(20)
"""Radians by which rows beside each other may differ."""
BESIDE = 1.3
"""Spacings within which a row runs beside another."""
AMONG = 4
"""Rows to either side among which a row stands: blocks differ."""
LEAST_AMOUNT, MOST_WIDTH, SLIM = 0.15, 1.8, 0.3
"""Canopy and width of a row, in those of the typical one among which it stands, and width in its spacing that none is
too wide for."""
SPARSE = 0.65
"""Share of the length on which most rows have canopy, as bushes that stand apart do, from which one is a row."""
CLOSED = 0.9
"""Spacings across which the canopy of a row may be closed."""
ZIGZAG = 12.0
"""Wavelength in metres below which the course of the key points is noise."""
SMOOTHING = 6.0
"""Wavelength in metres below which bends of a course are noise."""


class _Course(NamedTuple):
    """The middle of a canopy, and its numbers."""

    curve: Values
    """Places (n, 2) along it."""
    width: float
    """Metres across."""
    support: float
    """Share of its length that has canopy."""
    amount: float
    """Square metres of full cover on a metre of it."""


def trace_rows(
    key_points: gpd.GeoDataFrame,
    cover: Raster,
    *,
    threshold: float = 2.0,
    min_length: float = 4.0,
    min_radius: float = 8.0,
    max_width: float = 1.6,
    min_support: float = 0.25,
) -> gpd.GeoDataFrame:
    """Trace the course of every cluster of key points that is a row.

    Parameters
    ----------
    key_points : GeoDataFrame
        Points with ``cluster``, ``direction_deg``, ``spacing_m``, ``curtains_m`` and ``told``.
    cover : Raster
        Canopy cover 0–1.
    threshold : float
        Metres t between enhanced key points.
    min_length : float
        Metres that a row must have; twice as many, and a quarter of the median row, where no other runs beside it.
    min_radius : float
        Radius in metres of the tightest bend that a row takes as a whole.
    max_width : float
        Metres of canopy across beyond which it isn't a vine row, nine tenths of the spacing at the least.
    min_support : float
        Share of its length on which a row must have canopy, or ``SPARSE`` of what most have where that is less.

    Returns
    -------
    GeoDataFrame
        LineString with ``spacing_m``, ``curtains_m`` (between two curtains of a row, 0 where it has one), ``told``
        (whether gaps tell that) and ``alone`` (whether no other row runs beside it).
    """
    xy, direction = key_points.get_coordinates().to_numpy(), np.radians(key_points["direction_deg"].to_numpy())
    spacing, curtains = key_points["spacing_m"].to_numpy(), key_points["curtains_m"].to_numpy()
    told = key_points["told"].to_numpy()

    def trace(members: Ints) -> dict[str, Any] | None:
        ordered = order_key_points(xy[members], direction[members], threshold=threshold)
        apart, double = float(np.median(spacing[members])), float(np.median(curtains[members]))
        course = _centred(ordered, cover, apart, double) if len(ordered) > 1 else None
        if course is None or course.width > max(max_width, CLOSED * apart):
            return None
        line = shapely.LineString(course.curve)
        if line.length < max(min_length, 3 * course.width) or _turn(course.curve) > 2 / 3 * line.length / min_radius:
            return None
        return {
            "spacing_m": apart,
            "curtains_m": double,
            "told": bool(told[members].mean() > 0.5),
            "width": course.width,
            "amount": course.amount,
            "support": course.support,
            "geometry": line,
        }

    clusters = key_points.groupby("cluster").indices
    records = [record for record in in_threads(trace, clusters.values()) if record]
    columns = ("spacing_m", "curtains_m", "told", "width", "amount", "support", "geometry")
    rows = gpd.GeoDataFrame({name: [record[name] for record in records] for name in columns}, crs=key_points.crs)
    if len(rows):
        usual = rows["support"].iloc[_typical(rows["support"].to_numpy(), rows.length.to_numpy())]
        rows = rows[rows["support"] >= min(min_support, SPARSE * usual)]
    rows["simple"] = shapely.simplify(rows.geometry.to_numpy(), 0.02)
    rows = rows[~_repeated(rows)]
    rows = rows[_like_the_others(rows)]
    least = max(2 * min_length, LONE_SHARE * float(rows.length.median())) if len(rows) else 0.0
    alone = ~np.isin(np.arange(len(rows)), _neighbours(rows)[:, 0])
    odd = alone & ((rows.length < least) | (rows["width"] > LONE_WIDTH))
    kept = ["spacing_m", "curtains_m", "told", "alone", "geometry"]
    return rows.assign(alone=alone).loc[~odd, kept].reset_index(drop=True)


def order_key_points(xy: Values, direction: Values, *, threshold: float = 2.0) -> Values:
    """Order the key points of one row, thinned to the enhanced key points e1 … en.

    From the key point in the middle, the row is scanned to both ends: the next point is the closest one at least
    ``threshold`` ahead in the local frame; where none is so far, the farthest ends the row (section 2.3.3).

    Parameters
    ----------
    xy : (n, 2) array
        Key points in metres.
    direction : (n,) array
        Direction of the row at each in radians; its sense doesn't matter.
    threshold : float
        Metres t between enhanced key points.

    Returns
    -------
    (k, 2) array
        Enhanced key points in order along the row.
    """
    start = int(np.argmin(np.hypot(*(xy - np.median(xy, axis=0)).T)))
    heading = np.array([np.cos(direction[start]), np.sin(direction[start])])
    halves = [_scan(xy, direction, start, way * heading, threshold) for way in (-1.0, 1.0)]
    return xy[[*halves[0][::-1], start, *halves[1]]]


@compiled
def _scan(xy: Values, direction: Values, start: int, heading: Values, threshold: float) -> list[int]:
    """Indices of the enhanced key points that follow on a start towards a heading."""
    found = [start]  # by which the compiler knows what it is a list of
    found.pop()
    here = start
    while len(found) < len(xy):
        closest, farthest, least, most = -1, -1, np.inf, 0.25 * threshold
        for k in range(len(xy)):
            x, y = xy[k, 0] - xy[here, 0], xy[k, 1] - xy[here, 1]
            ahead = x * heading[0] + y * heading[1]
            if ahead <= 0 or abs(x * heading[1] - y * heading[0]) > ahead:
                continue
            if threshold <= ahead < least:
                closest, least = k, ahead
            if ahead > most:
                farthest, most = k, ahead
        if closest < 0:
            if farthest >= 0:
                found.append(farthest)
            return found
        here = closest
        found.append(here)
        axis = np.array([np.cos(direction[here]), np.sin(direction[here])])
        heading = axis if axis[0] * heading[0] + axis[1] * heading[1] >= 0 else -axis
    return found


def _centred(ordered: Values, cover: Raster, spacing: float, curtains: float) -> _Course | None:
    """Course along the middle of the canopy, from where it begins to where it ends."""
    half = float(half_width(spacing)) + curtains / 2
    curve = resample(extend(ordered, min(2.0, 0.8 * spacing)), STATION)
    # Key points zigzag; what is added to their course is smooth and would leave the zigzag in.
    even = np.ones(len(curve))
    curve = np.column_stack([whittaker(curve[:, k], even, cutoff=ZIGZAG / STATION) for k in (0, 1)])
    image, offsets = _straighten(cover, curve, half)
    shift = centre_line(image, offsets, reach=half, cutoff=SMOOTHING / STATION, curtains=curtains)
    curve = resample(curve + shift[:, None] * normals(curve, smoothing=1 / STATION), STATION)
    image, offsets = _straighten(cover, curve, half)
    profile = image.sum(axis=1) * BIN
    present = profile[profile > 0.3 * np.quantile(profile, 0.95)]
    if len(present) == 0:
        return None
    typical = float(np.median(present))
    # Where rows are told by their ridges alone, or are of younger vines, they show more faintly over many metres.
    relative = profile / thereabouts(profile, typical, around=spacing / STATION)
    runs = runs_above(relative, 0.5) * STATION
    runs = runs[np.diff(runs, axis=1)[:, 0] >= 0.35]
    if len(runs) == 0:
        return None
    width = typical / max(float(np.quantile(image.max(axis=1), 0.9)), 1e-6)
    full = runs_above(profile, 0.5 * typical) * STATION
    support = float(np.diff(full, axis=1).sum()) / (runs[-1, 1] - runs[0, 0])
    amount = float(profile[round(runs[0, 0] / STATION) : round(runs[-1, 1] / STATION) + 1].mean())
    return _Course(between(curve, runs[0, 0], runs[-1, 1]), width, support, amount)


def _straighten(cover: Raster, curve: Values, half: float) -> tuple[Values, Values]:
    """Cover (stations, cells across) along a curve, and the cells' offsets to the left in metres."""
    n = int(np.ceil(half / BIN))
    offsets = np.arange(-n, n + 1) * BIN
    return sample_across(cover, curve, normals(curve, smoothing=1 / STATION), offsets), offsets


def _turn(curve: Values) -> float:
    """Angle in radians between the first and the last third of a curve."""
    k = max(1, len(curve) // 3)
    first, last = curve[k] - curve[0], curve[-1] - curve[-1 - k]
    return abs(float(np.arctan2(cross(first, last), first @ last)))


def _repeated(rows: gpd.GeoDataFrame) -> Flags:
    """Whether a row lies for the most part within a quarter of a spacing of a longer one."""
    lines = rows["simple"].to_numpy()
    out = np.zeros(len(rows), dtype=bool)
    order = np.argsort(shapely.length(lines))
    for n, i in enumerate(order):
        near = 0.25 * rows["spacing_m"].iloc[i]
        longer = lines[order[n + 1 :]]
        beside = shapely.union_all(shapely.buffer(longer[shapely.dwithin(lines[i], longer, near)], near))
        out[i] = shapely.intersection(lines[i], beside).length > 0.5 * lines[i].length
    return out


def _like_the_others(rows: gpd.GeoDataFrame) -> Flags:
    """Whether a row has about as much canopy as most of those that it stands among: no wire between posts, no hedge."""
    out = np.ones(len(rows), dtype=bool)
    pairs = _neighbours(rows)
    enclosed = _enclosed(rows, pairs)
    beside = eye_array(len(rows), format="csr") + coo_array((np.ones(len(pairs)), pairs.T), shape=(len(rows),) * 2)
    near = matrix_power(beside, AMONG)
    length, amount, width, spacing = (
        np.asarray(v) for v in (rows.length, rows["amount"], rows["width"], rows["spacing_m"])
    )
    for k in range(len(rows)):
        others = near.indices[near.indptr[k] : near.indptr[k + 1]]
        if len(others) < 3:
            continue
        typical = others[_typical(amount[others], length[others])]
        widest = max(MOST_WIDTH * width[typical], SLIM * spacing[k])
        out[k] = amount[k] >= LEAST_AMOUNT * amount[typical] and (enclosed[k] or width[k] <= widest)
    return out


def _typical(values: Values, length: Values) -> int:
    """Which of some rows has the median of their values (n,), each of which counts by its length (n,)."""
    order = np.argsort(values)
    return int(order[np.argmax(np.cumsum(length[order]) >= 0.5 * length.sum())])


def _enclosed(rows: gpd.GeoDataFrame, pairs: Ints) -> Flags:
    """Whether rows stand on both sides of each, so that it is no hedge along the vineyard, however wide."""
    lines = rows["simple"].to_numpy()
    sides = np.zeros((2, len(rows)), dtype=bool)
    for i, j in pairs:
        (ax, ay), (bx, by) = shapely.get_coordinates(lines[i])[[0, -1]]
        mx, my = shapely.get_coordinates(shapely.line_interpolate_point(lines[j], 0.5, normalized=True))[0]
        sides[int((bx - ax) * (my - ay) - (by - ay) * (mx - ax) > 0), i] = True
    wide = rows["width"].to_numpy() <= CLOSED * rows["spacing_m"].to_numpy()
    out: Flags = sides.all(axis=0) & wide
    return out


def _neighbours(rows: gpd.GeoDataFrame) -> Ints:
    """Pairs (k, 2) of rows of about the same direction that lie no more than a spacing apart."""
    lines = rows["simple"].to_numpy()
    if len(rows) < 2:
        return np.empty((0, 2), dtype=np.int64)
    chord = np.array([np.diff(shapely.get_coordinates(line)[[0, -1]], axis=0)[0] for line in lines])
    angle = np.arctan2(chord[:, 1], chord[:, 0])
    # Away from rows the spacing is a guess: the smaller of two counts.
    spacing = rows["spacing_m"].to_numpy()
    i, j = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=BESIDE * spacing)
    beside = (i != j) & (shapely.distance(lines[i], lines[j]) <= BESIDE * np.minimum(spacing[i], spacing[j]))
    out: Ints = np.column_stack([i, j])[beside & (turn_between(angle[i], angle[j]) < SAME_DIRECTION)]
    return out
