"""Simulated UAV surveys of vineyards whose rows, dead vines and ground are known exactly.

Rays come down as from several flight positions, find leaves with a chance per metre of foliage, else the
ground, and are then spoilt as photogrammetry spoils points: noise, points bled at depth edges, floaters.
So tops and sides are seen unevenly, the foot of the canopy hardly, the ground below it seldom.
"""

from __future__ import annotations

import tempfile
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from vinemap import paths
from vinemap.simulate.matching import Matching, matcher
from vinemap.simulate.plants import Foliage, Vineyard, dead_vines_of, foliage_of, grow
from vinemap.simulate.rays import CELL, TAN_WIDEST, Obstacle, Sheet, cells_over, meet_leaves, meet_things
from vinemap.simulate.terrain import Array, Terrain, waves
from vinemap.simulate.truth import truth_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd

MADE = date(2019, 6, 1)
"""Date that a simulated cloud states, so that the same survey is the same file on any day."""
CHUNK = 1 << 18


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
    sheets: Sequence[Sheet] = (),
    beside: Sequence[Vineyard] = (),
    sensor: Matching | None = None,
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
        Trees, huts, cars, posts.
    sheets : sequence of Sheet
        Roofs of leaves, nets.
    beside : sequence of Vineyard
        What grows in rows and is no vine: hedges, strips of a cover crop. It's in none of the tables of truth.
    sensor : Matching
        What image matching makes of the rays; by default every ray that meets something gives a point.
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
    grown = [*vineyards, *beside]
    dead = [vines for vineyard in grown for vines in dead_vines_of(vineyard, rng)]
    stations = grow(grown, dead, terrain, rng)
    dead = dead[: sum(len(vineyard.rows) for vineyard in vineyards)]
    rows, dead_vines, gaps, parcels = truth_of(vineyards, dead, stations, terrain, crs)
    hulls = shapely.union_all(parcels.geometry.to_numpy())
    outline = hulls.convex_hull.buffer(surroundings)

    over = cells_over(outline, stations)
    shapely.prepare([hulls, outline])
    rate = np.where(shapely.contains_xy(outline, *over.centres.T), density_outside, 0.0)
    rate[shapely.contains_xy(hulls, *over.centres.T)] = density
    rate *= np.clip(1 + 0.2 * waves(rng, 12.0)(*over.centres.T), 0.4, 1.6)
    rays = np.repeat(np.arange(len(over.centres)), rng.poisson(rate * CELL**2))
    heading = rng.uniform(0, 2 * np.pi) + 0.8 * waves(rng, 35.0)(*over.centres.T)
    tufts = weeds * np.clip(waves(rng, 7.0)(*over.centres.T) - 0.6, 0, 0.8) / 0.8
    # Distances begin anew at each curtain; a cell with none near names the station past the last.
    curtain = np.append(np.cumsum(np.diff(stations.arc, prepend=np.inf) < 0), 0)
    hidden = 0.65 * (over.distance < np.append(stations.half_width, -1.0)[over.nearest])
    spoil = matcher(sensor, stations, over, rng) if sensor else None

    clouds = []
    for cells in np.array_split(rays, len(rays) // CHUNK + 1):
        n = len(cells)
        xy = over.centres[cells] + rng.uniform(-CELL / 2, CELL / 2, (n, 2))
        aim = np.column_stack([xy, terrain(*xy.T)])
        # Most views come from one side, so the other side of a canopy is seen less.
        toward = heading[cells] + rng.normal(0, 0.9, n) + np.pi * (rng.random(n) < (0.4 if sensor else 0.25))
        lean = (TAN_WIDEST * rng.random(n) ** 0.7)[:, None] * np.column_stack([np.cos(toward), np.sin(toward)])

        # A leaning ray may pass one row high up and its neighbour low down.
        upper, lower = over.station_at(xy + 1.6 * lean), over.station_at(xy + 0.5 * lean)
        rise = meet_leaves((aim, lean), upper, 1.6, stations, rng)
        two = np.flatnonzero(curtain[upper] != curtain[lower])
        rise[two] = np.maximum(rise[two], meet_leaves((aim[two], lean[two]), lower[two], 0.5, stations, rng))
        southings = over.centres[cells, 1]  # cells come from south to north
        rise = np.maximum(rise, meet_things((aim, lean), southings, obstacles, sheets, terrain, rng))

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
        found = leaf | (rng.random(n) >= hidden[cells])
        if spoil:
            points, matched = spoil(points, aim[:, 2], leaf)
            found &= matched
        clouds.append(points[found])
    foliage = foliage_of(stations, len(rows))
    return Survey(name, np.round(np.concatenate(clouds), 3), rows, dead_vines, gaps, parcels, terrain, foliage)


def write_survey(survey: Survey, folder: Path | str, *, flown: date = MADE) -> Path:
    """Write ``<name>.laz``, ``parcels.gpkg`` and ``truth.gpkg`` (layers rows, dead_vines, gaps); return the first.

    ``flown`` is the date that the cloud's header states.
    All three are made aside and then moved into ``folder``, the cloud last, so nothing half-made is ever there.
    """
    import laspy  # only the writer needs it

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(survey.xyz.min(axis=0))
    header.creation_date = flown
    header.add_crs(survey.rows.crs)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = survey.xyz.T
    with tempfile.TemporaryDirectory(prefix=".writing-", dir=folder) as aside:
        made = [
            place(Path(aside)) for place in (paths.boundaries, paths.truth, partial(paths.cloud, survey=survey.name))
        ]
        survey.parcels.to_file(made[0], layer="parcels", VERSION="1.2")
        survey.rows.to_file(made[1], layer="rows", VERSION="1.2")
        survey.dead_vines.to_file(made[1], layer="dead_vines", mode="a")
        survey.gaps.to_file(made[1], layer="gaps", mode="a")
        cloud.write(str(made[2]))
        for path in made:
            path.replace(folder / path.name)
    return paths.cloud(folder, survey.name)
