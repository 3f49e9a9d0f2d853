"""Vines that grow in rows: which are dead, and the foliage of the others, station by station."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d

from vinemap.geo.curve import at, way_along
from vinemap.simulate.terrain import Array, Terrain, waves

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

STATION = 0.1  # spacing of canopy stations along a row (m)
BARE = 40  # cells without foliage beyond each end of a row, more than a ray crosses
LAYERS = 16  # heights at which the foliage of a station has a density of its own
EDGE = 0.06  # depth over which foliage thins out at its surface (m)


@dataclass(frozen=True)
class Vineyard:
    """Rows of one parcel and how they grow; lengths in metres."""

    name: str
    rows: Sequence[Array]
    """Polylines (n, 2) from e1 to en, along which the foliage stands."""
    height: float = 1.95
    half_width: float = 0.27
    bottom: float = 0.55
    """Height above ground where foliage begins."""
    leafiness: float = 9.0
    """Leaves that a ray meets in a metre of foliage."""
    vine_spacing: float = 0.9
    crown: float | None = None
    """Length along the row of the head of a vine that stands alone, as bush vines do; by default shoots close up."""
    curtains: float | None = None
    """Distance between two curtains that the vines of one row feed; by default there is one, on the row."""
    dead: float = 0.05
    """Share of single dead vines."""
    gaps: Sequence[int] = ()
    """Runs of so many dead vines, dealt to rows at random."""
    bare: shapely.Polygon | shapely.MultiPolygon | None = None
    """Where all vines are dead but the rows' first and last."""
    outline: shapely.Polygon | None = None
    """Polygon of the parcel; by default 3 m about the hull of the rows. A parcel without rows needs one."""


class Foliage(NamedTuple):
    """The canopy of all living stretches of rows, curtain by curtain, at stations (n,), metres."""

    row: NDArray[np.intp]
    """Position of the row in the table of rows."""
    xy: Array
    """(n, 2) on the row's line, or the curtain's."""
    step: Array
    """Length of row that the station stands for."""
    top: Array
    """Height above ground."""
    bottom: Array
    half_width: Array
    """At the widest height."""
    shift: Array
    """Of the foliage's middle, to the left of the row."""


class Stations(NamedTuple):
    """Canopy in cells along all curtains, concatenated; each goes on bare for BARE cells at both ends."""

    row: NDArray[np.intp]
    xy: Array
    along: Array  # unit tangents (n, 2)
    arc: Array  # distance from e1
    step: Array  # length of the cell
    ground: Array
    top: Array  # heights above ground
    bottom: Array
    half_width: Array  # -1 where bare
    shift: Array  # of the foliage's middle, to the left
    leaves: Array  # (n, LAYERS) per metre


def vines_along(vineyard: Vineyard, length: float) -> Array:
    """Distances (n,) of the vines of a row so long from its start."""
    if vineyard.crown is None:
        n = max(round(length / vineyard.vine_spacing), 3)
        return (np.arange(n, dtype=np.float64) + 0.5) * (length / n)
    n = max(round((length - vineyard.crown) / vineyard.vine_spacing) + 1, 3)
    middles: Array = np.linspace(vineyard.crown / 2, length - vineyard.crown / 2, n)
    return middles


def dead_vines_of(vineyard: Vineyard, rng: np.random.Generator) -> list[NDArray[np.bool_]]:
    """Which vines of every row are dead; never a row's first or last, so that rows end where they say."""
    counts = [len(vines_along(vineyard, way_along(row)[-1])) for row in vineyard.rows]
    dead = [rng.random(n) < vineyard.dead for n in counts]
    order = rng.permutation(len(counts))
    for k, run in enumerate(vineyard.gaps):
        i = order[k % len(order)]
        start = rng.integers(1, max(counts[i] - run, 2))
        dead[i][start : start + run] = True
    for row, vines in zip(vineyard.rows, dead, strict=True):
        if vineyard.bare:
            vines[shapely.contains_xy(vineyard.bare, at(row, vines_along(vineyard, way_along(row)[-1])))] = True
        vines[[0, -1]] = False
    return dead


def grow(
    vineyards: Sequence[Vineyard], dead: Sequence[NDArray[np.bool_]], terrain: Terrain, rng: np.random.Generator
) -> Stations:
    """The canopy of all rows, of which some vines are dead."""
    plots = [(vineyard, row) for vineyard in vineyards for row in vineyard.rows]
    parts = [
        _grow_row(k, vineyard, row, side, vines, terrain, rng)
        for k, ((vineyard, row), vines) in enumerate(zip(plots, dead, strict=True))
        for side in ((0.0,) if vineyard.curtains is None else (vineyard.curtains / 2, -vineyard.curtains / 2))
    ]
    if not parts:
        none, flat = np.empty(0), np.empty((0, 2))
        no_leaves = np.empty((0, LAYERS))
        return Stations(np.empty(0, np.intp), flat, flat, none, none, none, none, none, none, none, no_leaves)
    return Stations(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _grow_row(
    k: int,
    vineyard: Vineyard,
    row: Array,
    side: float,
    vines: NDArray[np.bool_],
    terrain: Terrain,
    rng: np.random.Generator,
) -> Stations:
    """The canopy of a row, number k of all, of which some vines are dead; or its curtain so many metres to the left."""
    length = way_along(row)[-1]
    step = length / math.ceil(length / STATION)
    arc = (np.arange(-BARE, round(length / step) + BARE) + 0.5) * step
    n, ends = len(arc), np.diff(row[[0, 1, -2, -1]], axis=0)[::2]
    beyond = ends / np.linalg.norm(ends, axis=1, keepdims=True) * BARE * step
    xy = at(np.vstack([row[0] - beyond[0], row, row[-1] + beyond[1]]), arc + BARE * step)
    along = np.gradient(xy, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    xy = xy + side * np.column_stack([-along[:, 1], along[:, 0]])

    middles = vines_along(vineyard, length)
    if vineyard.crown is None:
        inside = _depth_in_hedge(arc, length, vines, rng)
    else:
        inside = _depth_in_heads(arc, middles, vines, vineyard.crown, rng)
    vigour, girth, lean, foot = (np.interp(arc, middles, rng.normal(size=len(vines))) for _ in range(4))
    fine = gaussian_filter1d(rng.normal(size=(2, n)), 1.0, axis=1)
    smooth = waves(rng, 18.0)
    shoots = (rng.random((2, n)) < [[0.04], [0.03]]) * rng.random((2, n))
    bottom = vineyard.bottom + 0.04 * foot
    top = vineyard.height * (1 + 0.03 * smooth(arc, arc) + 0.035 * vigour + 0.03 * fine[0]) + 0.4 * shoots[0]
    round_over, lower = (0.25, 0.2) if vineyard.crown is None else (vineyard.crown / 2, 0.5)
    top = np.maximum(top - lower * (top - bottom) * np.clip(1 - inside / round_over, 0, 1), bottom + 0.2)
    half_width = vineyard.half_width * (1 + 0.08 * smooth(arc, -arc) + 0.1 * girth + 0.1 * fine[1])
    to_full = 0.45 * vineyard.half_width if vineyard.crown is None else vineyard.crown / 2
    share = np.clip(inside / to_full, 0, 1)
    half_width = (np.maximum(half_width, 0.08) + 0.15 * shoots[1]) * np.sqrt(share)
    half_width[inside <= 0] = -1.0
    thinning = np.linspace(0.5, 1.1, LAYERS)  # towards the shaded foot, of which little is ever matched
    leaves = vineyard.leafiness * thinning * rng.gamma(1.5, 1 / 1.5, (n, LAYERS))
    ground = terrain(*xy.T)
    lean = 0.02 * lean
    return Stations(np.full(n, k), xy, along, arc, np.full(n, step), ground, top, bottom, half_width, lean, leaves)


def _depth_in_hedge(arc: Array, length: float, dead: NDArray[np.bool_], rng: np.random.Generator) -> Array:
    """Metres from stations to where the hedge of a row ends, at its ends and at dead vines; negative in the open."""
    lows, highs = np.flatnonzero(np.diff(np.pad(dead.astype(int), 1))).reshape(-1, 2).T * (length / len(dead))
    lows, highs = lows + rng.uniform(-0.05, 0.12, len(lows)), highs - rng.uniform(-0.05, 0.12, len(highs))
    lows, highs = np.append(lows, [-np.inf, length]), np.append(highs, [0.0, np.inf])
    depth: Array = np.maximum(lows[:, None] - arc, arc - highs[:, None]).min(axis=0)
    return depth


def _depth_in_heads(
    arc: Array, middles: Array, dead: NDArray[np.bool_], crown: float, rng: np.random.Generator
) -> Array:
    """As much as half a crown in the middle of a head, from which it falls like a parabola to 0 at its edge."""
    reach = crown / 2 * rng.uniform(0.85, 1.0, len(middles))
    reach[[0, -1]] = crown / 2
    vine = np.abs(arc[:, None] - middles).argmin(axis=1)
    depth = crown / 2 * (1 - ((arc - middles[vine]) / reach[vine]) ** 2)
    return np.where(dead[vine], -1.0, depth)


def foliage_of(stations: Stations, rows: int) -> Foliage:
    """What of the stations of so many rows, the first, is alive."""
    alive = (stations.half_width > 0) & (stations.row < rows)
    row, xy, step = stations.row[alive], stations.xy[alive], stations.step[alive]
    top, bottom = stations.top[alive], stations.bottom[alive]
    return Foliage(row, xy, step, top, bottom, stations.half_width[alive], stations.shift[alive])


def foliage_outlines(foliage: Foliage) -> Array:
    """Outlines (stations, 48, 2) of the foliage across its rows, leaves' reach included: metres left and above ground.

    They run counter-clockwise where what lies to the left is drawn to the right.
    """
    relative = np.linspace(0, 1, 24)
    reach = EDGE / 2
    width = foliage.half_width[:, None] * bulge(relative) + reach
    z = foliage.bottom[:, None] - reach + relative * (foliage.top - foliage.bottom + 2 * reach)[:, None]
    left = np.stack([foliage.shift[:, None] + width, z], axis=2)
    right = np.stack([foliage.shift[:, None] - width, z], axis=2)
    return np.concatenate([left, right[:, ::-1]], axis=1)


def on_ground(row: Array, distance: Array, terrain: Terrain) -> Array:
    """Points (m, 3) on the ground at distances from a polyline's start."""
    xy = at(row, distance)
    return np.column_stack([xy, terrain(*xy.T)])


def bulge(relative: Array) -> Array:
    """Width of a canopy at relative heights, 0 at its bottom to 1 at its top, as a share of the greatest."""
    off = (relative - 0.4) / np.where(relative > 0.4, 0.62, 0.6)
    return np.sqrt(np.maximum(1 - off**2, 0))
