"""Simulated UAV surveys of vineyards whose rows, dead vines and ground are known exactly.

Rays come down as from several flight positions, find leaves with a chance per metre of foliage, else the
ground, and are then spoilt as photogrammetry spoils points: noise, points bled at depth edges, floaters.
So tops and sides are seen unevenly, the foot of the canopy hardly, the ground below it seldom.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Terrain = Callable[[Array, Array], Array]
"""Elevation (m) of the ground at x (east) and y (north)."""

MADE = date(2019, 6, 1)
"""Date that a simulated cloud states, so that the same survey is the same file on any day."""

STATION = 0.1  # spacing of canopy stations along a row (m)
CELL = 0.25  # cells in which rays are dealt out (m)
BARE = 40  # cells without foliage beyond each end of a row, more than a ray crosses
LAYERS = 16  # heights at which the foliage of a station has a density of its own
STEPS = 14  # steps of a ray through a canopy
EDGE = 0.06  # depth over which foliage thins out at its surface (m)
TAN_WIDEST = math.tan(math.radians(35))
CHUNK = 1 << 18


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
    dead: float = 0.05
    """Share of single dead vines."""
    gaps: Sequence[int] = ()
    """Runs of so many dead vines, dealt to rows at random."""
    outline: shapely.Polygon | None = None
    """Polygon of the parcel; by default 3 m about the hull of the rows. A parcel without rows needs one."""


@dataclass(frozen=True)
class Obstacle:
    """A tree or bush (ellipsoid of leaves), or a hut, post or wire (solid box); metres, heights above its ground."""

    x: float
    y: float
    half_length: float
    half_width: float
    top: float
    bottom: float = 0.0
    solid: bool = False
    azimuth: float = 0.0
    """Direction of its length, degrees anticlockwise from east."""


class Foliage(NamedTuple):
    """The canopy of all living stretches of rows at stations (n,), metres."""

    row: NDArray[np.intp]
    """Position of the row in the table of rows."""
    xy: Array
    """(n, 2) on the row's line."""
    step: Array
    """Length of row that the station stands for."""
    top: Array
    """Height above ground."""
    bottom: Array
    half_width: Array
    """At the widest height."""
    shift: Array
    """Of the foliage's middle, to the left of the row."""


class Survey(NamedTuple):
    """A simulated survey and its truth, in one projected CRS."""

    name: str
    xyz: Array
    """Points (n, 3), m, on a grid of 1 mm."""
    rows: gpd.GeoDataFrame
    """LineStringZ on the ground between the ends of the foliage; parcel, row, length_3d, n_vines, n_dead,
    mean_height, mean_width."""
    dead_vines: gpd.GeoDataFrame
    """PointZ; parcel, row, vine (1 is at e1)."""
    gaps: gpd.GeoDataFrame
    """LineStringZ on the ground from foliage to foliage over dead vines; parcel, row, n_vines."""
    parcels: gpd.GeoDataFrame
    """Polygons; name."""
    terrain: Terrain
    foliage: Foliage


class _Stations(NamedTuple):
    """Canopy in cells along all rows, concatenated; every row goes on bare for BARE cells at both ends."""

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


def waves(rng: np.random.Generator, wavelength: float) -> Terrain:
    """Smooth random surface of mean 0 and variance 1, with waves of about ``wavelength`` (m)."""
    n = 8
    wave = 2 * np.pi / (wavelength * rng.uniform(0.7, 1.6, n))
    heading, phase = rng.uniform(0, 2 * np.pi, (2, n))

    def surface(x: Array, y: Array) -> Array:
        total = np.zeros(np.shape(x))
        for k in range(n):
            total += np.sin(wave[k] * (x * math.cos(heading[k]) + y * math.sin(heading[k])) + phase[k])
        return total * math.sqrt(2 / n)

    return surface


def simulate(
    vineyards: Sequence[Vineyard],
    terrain: Terrain,
    *,
    name: str = "synthetic",
    crs: str = "EPSG:32632",
    density: float = 400.0,
    density_outside: float = 60.0,
    surroundings: float = 6.0,
    obstacles: Sequence[Obstacle] = (),
    weeds: float = 0.15,
    noise: float = 0.025,
    bled: float = 0.01,
    floaters: float = 0.0005,
    seed: int = 0,
) -> Survey:
    """Survey vineyards from the air.

    Parameters
    ----------
    vineyards : sequence of Vineyard
        One a parcel, with rows in ``crs``; without rows, a meadow.
    terrain : callable
        Elevation of the ground (m).
    density, density_outside, surroundings : float
        Rays a square metre (30% more or less, in patches; nearly as many points) inside the parcels, and on
        the ``surroundings`` m about their common hull.
    obstacles : sequence of Obstacle
        Trees and huts.
    weeds : float
        Height (m) of the weeds, which cover about a quarter of the ground in patches.
    noise : float
        Standard deviation (m) of points, upwards on the ground, all ways in the canopy.
    bled, floaters : float
        Shares of points that hang between canopy and ground, and metres above or below it.
    seed : int
        The same seed gives the same survey.
    """
    rng = np.random.default_rng(seed)
    dead = [vines for vineyard in vineyards for vines in _dead_vines(vineyard, rng)]
    stations = _grow(vineyards, dead, terrain, rng)
    rows, dead_vines, gaps, parcels = _truth(vineyards, dead, stations, terrain, crs)
    hulls = shapely.union_all(parcels.geometry.to_numpy())
    outline = hulls.convex_hull.buffer(surroundings)

    corner = np.floor(np.array(outline.bounds[:2]))
    nx, ny = np.ceil((np.array(outline.bounds[2:]) - corner) / CELL).astype(int) + 1
    centres = (np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), axis=-1).reshape(-1, 2) + 0.5) * CELL + corner
    distance, nearest = cKDTree(stations.xy).query(centres, distance_upper_bound=2.0)
    shapely.prepare([hulls, outline])
    rate = np.where(shapely.contains_xy(outline, *centres.T), density_outside, 0.0)
    rate[shapely.contains_xy(hulls, *centres.T)] = density
    rate *= np.clip(1 + 0.2 * waves(rng, 12.0)(*centres.T), 0.4, 1.6)
    rays = np.repeat(np.arange(len(centres)), rng.poisson(rate * CELL**2))
    heading = rng.uniform(0, 2 * np.pi) + 0.8 * waves(rng, 35.0)(*centres.T)
    tufts = weeds * np.clip(waves(rng, 7.0)(*centres.T) - 0.6, 0, 0.8) / 0.8
    row_at = np.append(stations.row, -1)  # a cell with no row near names the station past the last
    hidden = 0.65 * (distance < np.append(stations.half_width, -1.0)[nearest])

    def nearest_at(xy: Array) -> NDArray[np.intp]:
        i, j = np.clip(((xy - corner) / CELL).astype(int), 0, [nx - 1, ny - 1]).T
        return np.asarray(nearest[j * nx + i])

    clouds = []
    for cells in np.array_split(rays, len(rays) // CHUNK + 1):
        n = len(cells)
        xy = centres[cells] + rng.uniform(-CELL / 2, CELL / 2, (n, 2))
        aim = np.column_stack([xy, terrain(*xy.T)])
        # Three quarters of the views come from one side, so the other side of a canopy is seen less.
        toward = heading[cells] + rng.normal(0, 0.9, n) + np.pi * (rng.random(n) < 0.25)
        lean = (TAN_WIDEST * rng.random(n) ** 0.7)[:, None] * np.column_stack([np.cos(toward), np.sin(toward)])

        # A leaning ray may pass one row high up and its neighbour low down.
        upper, lower = nearest_at(xy + 1.6 * lean), nearest_at(xy + 0.5 * lean)
        rise = _meet_leaves((aim, lean), upper, 1.6, stations, rng)
        two = np.flatnonzero(row_at[upper] != row_at[lower])
        rise[two] = np.maximum(rise[two], _meet_leaves((aim[two], lean[two]), lower[two], 0.5, stations, rng))
        for obstacle in obstacles:
            rise = np.maximum(rise, _meet_obstacle(aim, lean, obstacle, terrain, rng))

        leaf = rise > 0
        edges = np.flatnonzero(leaf)
        edges = rng.choice(edges, min(len(edges), rng.binomial(n, bled)), replace=False)
        rise[edges] *= rng.uniform(0.03, 0.97, len(edges))
        points = aim + np.column_stack([lean * rise[:, None], rise])
        spread = np.where(leaf[:, None], noise, noise * np.array([0.3, 0.3, 1.0]))
        spread[edges, :2] = 3 * noise
        points += rng.normal(size=(n, 3)) * spread
        points[:, 2] += np.where(leaf, 0, tufts[cells] * rng.random(n))
        flyers = np.flatnonzero(rng.random(n) < floaters)
        points[flyers, 2] += rng.choice([-1, 1], len(flyers)) * rng.uniform(0.5, 8.0, len(flyers))
        clouds.append(points[leaf | (rng.random(n) >= hidden[cells])])
    return Survey(
        name, np.round(np.concatenate(clouds), 3), rows, dead_vines, gaps, parcels, terrain, _foliage(stations)
    )


def foliage_outlines(foliage: Foliage, *, n: int = 24) -> Array:
    """Outlines (stations, 2 n, 2) of the foliage across its rows, leaves' reach included: metres left and above ground.

    They run counter-clockwise where what lies to the left is drawn to the right.
    """
    relative = np.linspace(0, 1, n)
    reach = EDGE / 2
    width = foliage.half_width[:, None] * _bulge(relative) + reach
    z = foliage.bottom[:, None] - reach + relative * (foliage.top - foliage.bottom + 2 * reach)[:, None]
    left = np.stack([foliage.shift[:, None] + width, z], axis=2)
    right = np.stack([foliage.shift[:, None] - width, z], axis=2)
    return np.concatenate([left, right[:, ::-1]], axis=1)


def write_survey(survey: Survey, folder: Path | str) -> Path:
    """Write ``<name>.laz``, ``parcels.gpkg`` and ``truth.gpkg`` (layers rows, dead_vines, gaps); return the first.

    All three are made aside and then moved into ``folder``, the cloud last, so nothing half-made is ever there.
    """
    import laspy  # only the writer needs it

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(survey.xyz.min(axis=0))
    header.creation_date = MADE
    header.add_crs(survey.rows.crs)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = survey.xyz.T
    with tempfile.TemporaryDirectory(prefix=".writing-", dir=folder) as aside:
        survey.parcels.to_file(Path(aside, "parcels.gpkg"), layer="parcels", VERSION="1.2")
        survey.rows.to_file(Path(aside, "truth.gpkg"), layer="rows", VERSION="1.2")
        survey.dead_vines.to_file(Path(aside, "truth.gpkg"), layer="dead_vines", mode="a")
        survey.gaps.to_file(Path(aside, "truth.gpkg"), layer="gaps", mode="a")
        cloud.write(str(Path(aside, f"{survey.name}.laz")))
        for made in ("parcels.gpkg", "truth.gpkg", f"{survey.name}.laz"):
            Path(aside, made).replace(folder / made)
    return folder / f"{survey.name}.laz"


def _reached(row: Array) -> Array:
    """Distance (n,) of a polyline's vertices from its start."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(row, axis=0), axis=1)))


def _at(row: Array, distance: Array) -> Array:
    """Points (m, 2) of a polyline at distances from its start."""
    return np.column_stack([np.interp(distance, _reached(row), coordinate) for coordinate in row.T])


def _on_ground(row: Array, distance: Array, terrain: Terrain) -> Array:
    """Points (m, 3) on the ground at distances from a polyline's start."""
    xy = _at(row, distance)
    return np.column_stack([xy, terrain(*xy.T)])


def _dead_vines(vineyard: Vineyard, rng: np.random.Generator) -> list[NDArray[np.bool_]]:
    """Which vines of every row are dead; never a row's first or last, so that rows end where they say."""
    counts = [max(round(_reached(row)[-1] / vineyard.vine_spacing), 3) for row in vineyard.rows]
    dead = [rng.random(n) < vineyard.dead for n in counts]
    order = rng.permutation(len(counts))
    for k, run in enumerate(vineyard.gaps):
        i = order[k % len(order)]
        start = rng.integers(1, max(counts[i] - run, 2))
        dead[i][start : start + run] = True
    for vines in dead:
        vines[[0, -1]] = False
    return dead


def _grow(
    vineyards: Sequence[Vineyard], dead: Sequence[NDArray[np.bool_]], terrain: Terrain, rng: np.random.Generator
) -> _Stations:
    parts = []
    plots = [(vineyard, row) for vineyard in vineyards for row in vineyard.rows]
    for k, ((vineyard, row), vines) in enumerate(zip(plots, dead, strict=True)):
        length = _reached(row)[-1]
        step = length / math.ceil(length / STATION)
        arc = (np.arange(-BARE, round(length / step) + BARE) + 0.5) * step
        n, ends = len(arc), np.diff(row[[0, 1, -2, -1]], axis=0)[::2]
        beyond = ends / np.linalg.norm(ends, axis=1, keepdims=True) * BARE * step
        xy = _at(np.vstack([row[0] - beyond[0], row, row[-1] + beyond[1]]), arc + BARE * step)
        along = np.gradient(xy, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)

        pitch = length / len(vines)
        lows, highs = np.flatnonzero(np.diff(np.pad(vines.astype(int), 1))).reshape(-1, 2).T * pitch
        lows, highs = lows + rng.uniform(-0.05, 0.12, len(lows)), highs - rng.uniform(-0.05, 0.12, len(highs))
        lows, highs = np.append(lows, [-np.inf, length]), np.append(highs, [0.0, np.inf])
        inside = np.maximum(lows[:, None] - arc, arc - highs[:, None]).min(axis=0)  # depth into the foliage

        middles = (np.arange(len(vines)) + 0.5) * pitch
        vigour, girth, lean, foot = (np.interp(arc, middles, rng.normal(size=len(vines))) for _ in range(4))
        fine = gaussian_filter1d(rng.normal(size=(2, n)), 1.0, axis=1)
        smooth = waves(rng, 18.0)
        shoots = (rng.random((2, n)) < [[0.04], [0.03]]) * rng.random((2, n))
        bottom = vineyard.bottom + 0.04 * foot
        top = vineyard.height * (1 + 0.03 * smooth(arc, arc) + 0.035 * vigour + 0.03 * fine[0]) + 0.4 * shoots[0]
        top = np.maximum(top - 0.2 * (top - bottom) * np.clip(1 - inside / 0.25, 0, 1), bottom + 0.2)
        half_width = vineyard.half_width * (1 + 0.08 * smooth(arc, -arc) + 0.1 * girth + 0.1 * fine[1])
        half_width = (np.maximum(half_width, 0.08) + 0.15 * shoots[1]) * np.sqrt(
            np.clip(inside / (0.45 * vineyard.half_width), 0, 1)
        )
        half_width[inside <= 0] = -1.0
        thinning = np.linspace(0.5, 1.1, LAYERS)  # towards the shaded foot, of which little is ever matched
        leaves = vineyard.leafiness * thinning * rng.gamma(1.5, 1 / 1.5, (n, LAYERS))
        ground = terrain(*xy.T)
        parts.append(
            _Stations(
                np.full(n, k), xy, along, arc, np.full(n, step), ground, top, bottom, half_width, 0.02 * lean, leaves
            )
        )
    if not parts:
        none, flat = np.empty(0), np.empty((0, 2))
        no_leaves = np.empty((0, LAYERS))
        return _Stations(np.empty(0, np.intp), flat, flat, none, none, none, none, none, none, none, no_leaves)
    return _Stations(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _bulge(relative: Array) -> Array:
    """Width of a canopy at relative heights, 0 at its bottom to 1 at its top, as a share of the greatest."""
    off = (relative - 0.4) / np.where(relative > 0.4, 0.62, 0.6)
    return np.sqrt(np.maximum(1 - off**2, 0))


def _foliage(stations: _Stations) -> Foliage:
    alive = stations.half_width > 0
    row, xy, step = stations.row[alive], stations.xy[alive], stations.step[alive]
    top, bottom = stations.top[alive], stations.bottom[alive]
    return Foliage(row, xy, step, top, bottom, stations.half_width[alive], stations.shift[alive])


def _truth(
    vineyards: Sequence[Vineyard], dead: Sequence[NDArray[np.bool_]], stations: _Stations, terrain: Terrain, crs: str
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame, gpd.GeoDataFrame, gpd.GeoDataFrame]:
    rows, spots, gaps = [], [], []
    plots = [(vineyard.name, i, row) for vineyard in vineyards for i, row in enumerate(vineyard.rows, 1)]
    for k, ((name, i, row), vines) in enumerate(zip(plots, dead, strict=True)):
        length = _reached(row)[-1]
        line = _on_ground(row, np.linspace(0, length, math.ceil(length / 0.25) + 1), terrain)
        own = (stations.row == k) & (stations.arc > 0) & (stations.arc < length)
        alive = own & (stations.half_width > 0)
        height, width = stations.top[alive].mean(), 2 * stations.half_width[alive].mean()
        rows.append((name, i, _reached(line)[-1], len(vines), vines.sum(), height, width, shapely.LineString(line)))
        gone = np.flatnonzero(vines)
        middles = (gone + 0.5) * length / len(vines)
        points = _on_ground(row, middles, terrain)
        spots += [(name, i, vine + 1, shapely.Point(point)) for vine, point in zip(gone, points, strict=True)]
        bare = np.flatnonzero(np.diff(np.pad(stations.half_width[own] <= 0, 1).astype(int))).reshape(-1, 2)
        for start, end in bare * stations.step[own][0]:
            piece = _on_ground(row, np.linspace(start, end, math.ceil((end - start) / 0.25) + 1), terrain)
            missing = np.count_nonzero((middles > start) & (middles < end))
            gaps.append((name, i, missing, shapely.LineString(piece)))
    outlines = [(v.name, v.outline or shapely.MultiLineString(v.rows).convex_hull.buffer(3.0)) for v in vineyards]
    canopy = ["length_3d", "n_vines", "n_dead", "mean_height", "mean_width"]

    def frame(records: list[Any], columns: list[str]) -> gpd.GeoDataFrame:
        table = pd.DataFrame(records, columns=[*columns, "geometry"])
        return gpd.GeoDataFrame(table, geometry="geometry", crs=crs)

    return (
        frame(rows, ["parcel", "row", *canopy]),
        frame(spots, ["parcel", "row", "vine"]),
        frame(gaps, ["parcel", "row", "n_vines"]),
        frame(outlines, ["name"]),
    )


def _meet_leaves(
    rays: tuple[Array, Array],
    nearest: NDArray[np.intp],
    at_height: float,
    stations: _Stations,
    rng: np.random.Generator,
) -> Array:
    """Height above ``aim`` at which rays meet a leaf of one row, 0 where they don't.

    Parameters
    ----------
    rays : arrays (n, 3), (n, 2)
        ``aim``, where they end on the ground, and ``lean``, their horizontal way for every metre up.
    nearest, at_height : array (n,), float
        The station nearest to a ray (one past the last: none near) where it passes this height above ``aim``.
    """
    aim, lean = rays
    met = np.zeros(len(aim))
    near = np.flatnonzero(nearest < len(stations.arc))
    if len(near) == 0:
        return met
    aim, lean, nearest = aim[near], lean[near], nearest[near]
    offset = aim[:, :2] + at_height * lean - stations.xy[nearest]
    (ax, ay), (lx, ly) = stations.along[nearest].T, lean.T
    s, ds = offset[:, 0] * ax + offset[:, 1] * ay, lx * ax + ly * ay  # along the row, from the station
    c, dc = offset[:, 1] * ax - offset[:, 0] * ay, ly * ax - lx * ay
    dc = np.where(np.abs(dc) < 1e-9, 1e-9, dc)

    widest = stations.half_width.max() + np.abs(stations.shift).max() + EDGE
    level = stations.ground[nearest] - aim[:, 2]
    one, two = at_height + (-widest - c) / dc, at_height + (widest - c) / dc
    high = np.minimum(level + stations.top.max(), np.maximum(one, two))
    low = np.maximum(np.maximum(level + stations.bottom.min(), 0.02), np.minimum(one, two))
    through = np.flatnonzero(high > low)
    s, ds, c, dc, high, low = (value[through] for value in (s, ds, c, dc, high, low))
    nearest, z = nearest[through], aim[through, 2]
    per_metre, last = 1 / stations.step[nearest], len(stations.arc) - 1

    drop = (high - low) / STEPS
    path = drop * np.sqrt(1 + np.sum(lean[through] ** 2, axis=1))
    depth, needed, rise = np.zeros(len(z)), rng.exponential(size=len(z)), np.zeros(len(z))
    up = high - drop * rng.random(len(z))
    for _ in range(STEPS):
        ahead = up - at_height
        cell = np.clip(nearest + np.rint((s + ahead * ds) * per_metre).astype(int), 0, last)
        base = stations.ground[cell] + stations.bottom[cell]
        relative = (z + up - base) / (stations.top[cell] - stations.bottom[cell])
        width = stations.half_width[cell] * _bulge(relative)
        within = np.clip((width - np.abs(c + ahead * dc - stations.shift[cell])) / EDGE + 0.5, 0, 1)
        within[(relative < 0) | (relative >= 1)] = 0
        layer = (np.clip(relative, 0, 0.999) * LAYERS).astype(int)
        depth += within * stations.leaves[cell, layer] * path
        rise = np.where((rise == 0) & (depth >= needed), up, rise)
        up -= drop
    met[near[through]] = rise
    return met


def _meet_obstacle(aim: Array, lean: Array, obstacle: Obstacle, terrain: Terrain, rng: np.random.Generator) -> Array:
    """Height above ``aim`` at which rays meet a tree or a hut, 0 where they don't."""
    met = np.zeros(len(aim))
    reach = math.hypot(obstacle.half_length, obstacle.half_width) + TAN_WIDEST * obstacle.top + 1
    near = np.flatnonzero(np.hypot(aim[:, 0] - obstacle.x, aim[:, 1] - obstacle.y) < reach)
    ground = float(terrain(np.array([obstacle.x]), np.array([obstacle.y]))[0])
    half_height = (obstacle.top - obstacle.bottom) / 2
    half = np.array([obstacle.half_length, obstacle.half_width, half_height])
    # In units of the half axes: a point of the ray is start + rise * way.
    cos, sin = math.cos(math.radians(obstacle.azimuth)), math.sin(math.radians(obstacle.azimuth))
    own_axes = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    start = (aim[near] - [obstacle.x, obstacle.y, ground + obstacle.bottom + half_height]) @ own_axes / half
    way = np.column_stack([lean[near], np.ones(len(near))]) @ own_axes / half
    if obstacle.solid:
        way = np.where(np.abs(way) < 1e-9, 1e-9, way)
        faces = np.sort([(-1 - start) / way, (1 - start) / way], axis=0)
        low, high = faces[0].max(axis=1), faces[1].min(axis=1)
        rise = high
    else:
        a, b, c = (way**2).sum(axis=1), (way * start).sum(axis=1), (start**2).sum(axis=1) - 1
        root = np.sqrt(np.maximum(b**2 - a * c, 0))
        low, high = (-b - root) / a, (-b + root) / a
        rise = high - rng.exponential(0.35, len(near))
    met[near] = np.where((rise > np.maximum(low, 0)) & (high > low), rise, 0)
    return met
