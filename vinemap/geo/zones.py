"""Which of several polygons hold a point: looked up in cells, and asked of the polygons only along their outlines."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from vinemap.compute.compiled import compiled
from vinemap.geo.crs import metric_crs, project
from vinemap.geo.raster import Grid, cell_at, window

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import geopandas as gpd
    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.compute.arrays import Floats, Ints
    from vinemap.geo.boundaries import Boundary

    Labels = NDArray[np.int32]

CELL = 0.5
"""Metres of a cell, at the least."""
MOST_CELLS = 4_000_000
NOWHERE, ASK = -1, -2
"""What a cell says beside the number of the one polygon that covers it: none touches it, or ask the polygons."""


class Zones(NamedTuple):
    """Polygons, and a raster (ny, nx) that tells of its cells which polygon covers them."""

    polygons: Sequence[shapely.Geometry]
    grid: Grid
    code: Labels


def zones_of(polygons: Sequence[shapely.Geometry]) -> Zones:
    """Zones of polygons with finite coordinates in metres; they may overlap."""
    from scipy.ndimage import binary_dilation  # a tenth of a second of start-up, where there are polygons

    shapely.prepare(np.array(polygons))
    west, south, east, north = shapely.total_bounds(np.array(polygons))
    cell = max(CELL, float(np.sqrt((east - west) * (north - south) / MOST_CELLS)))
    # Two cells more on each side, so that what lies on an outline never falls off the raster.
    first, last = np.floor(west / cell) - 2, np.ceil(north / cell) + 2
    ny, nx = int(last - south / cell) + 3, int(east / cell - first) + 3
    grid = Grid(float(first * cell), float(last * cell), cell, ny, nx)
    code = np.full(grid.shape, NOWHERE, dtype=np.int32)
    for k, polygon in enumerate(polygons):
        corners = np.reshape(shapely.bounds(polygon), (2, 2))
        part, where = window(grid, corners[0] - 2 * cell, corners[1] + 2 * cell)
        inside = shapely.contains_xy(polygon, *np.meshgrid(*part.centres()))
        line = shapely.get_coordinates(shapely.segmentize(shapely.boundary(polygon), cell))
        edge = np.zeros(part.shape, dtype=bool)
        edge[((part.north - line[:, 1]) / cell).astype(int), ((line[:, 0] - part.west) / cell).astype(int)] = True
        edge = binary_dilation(edge, np.ones((3, 3)))
        here = code[where]
        here[inside] = np.where(here[inside] == NOWHERE, k, ASK)
        here[edge] = ASK
    return Zones(polygons, grid, code)


def deal(xyz: Floats, zones: Zones) -> tuple[Floats, Ints]:
    """Give every polygon its points; those in none go to nobody, those in several to each.

    Returns
    -------
    xyz : (m, 3) array
        The points (n, 3) polygon by polygon, in their order.
    start : (k + 1,) array
        Where each polygon's begin.
    """
    label = np.empty(len(xyz), dtype=np.int32)
    _look_up(xyz, zones.grid, zones.code, label)
    asked = np.flatnonzero(label == ASK)
    label[asked] = NOWHERE
    p, k = _ask(xyz[asked], zones.polygons)
    order = np.lexsort((k, p))
    p, k = asked[p[order]], k[order]
    first = np.diff(p, prepend=-1) > 0
    label[p[first]] = k[first]
    return _gather(xyz, label, p[~first], k[~first], len(zones.polygons))


def _ask(xyz: Floats, polygons: Sequence[shapely.Geometry]) -> tuple[Ints, Labels]:
    """Points (n, 3) and the polygons that hold them, pair by pair; eastwards, so that each polygon asks few points."""
    eastwards = np.argsort(xyz[:, 0])
    x, y = xyz[eastwards, 0], xyz[eastwards, 1]
    west, south, east, north = shapely.bounds(np.array(polygons)).T
    first, last = np.searchsorted(x, west, side="left"), np.searchsorted(x, east, side="right")
    points, labels = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int32)]
    for k in np.flatnonzero(first < last).tolist():
        near = first[k] + np.flatnonzero((y[first[k] : last[k]] >= south[k]) & (y[first[k] : last[k]] <= north[k]))
        inside = near[shapely.contains_xy(polygons[k], x[near], y[near])]
        points.append(eastwards[inside])
        labels.append(np.full(len(inside), k, dtype=np.int32))
    return np.concatenate(points), np.concatenate(labels)


@compiled
def _look_up(xyz: Floats, grid: Grid, code: Labels, label: Labels) -> None:
    for p in range(len(xyz)):
        i, j = cell_at(grid, xyz[p, 0], xyz[p, 1])
        label[p] = code[i, j] if 0 <= i < grid.ny and 0 <= j < grid.nx else NOWHERE


@compiled
def _gather(xyz: Floats, label: Labels, again: Ints, into: Labels, k: int) -> tuple[Floats, Ints]:
    """Points by label (n,), and those ``again``, in climbing order, that a further polygon holds too."""
    start = np.zeros(k + 1, dtype=np.int64)
    for zone in label:
        if zone >= 0:
            start[zone + 1] += 1
    for zone in into:
        start[zone + 1] += 1
    place = np.empty(k, dtype=np.int64)
    for zone in range(k):
        place[zone] = start[zone]
        start[zone + 1] += start[zone]
    out = np.empty((start[k], 3))
    q = 0
    for p in range(len(label)):
        if label[p] >= 0:
            _copy(xyz, p, out, place, label[p])
        while q < len(again) and again[q] == p:
            _copy(xyz, p, out, place, into[q])
            q += 1
    return out, start


@compiled
def _copy(xyz: Floats, p: int, out: Floats, place: Ints, zone: int) -> None:
    """Write point p to its zone's place, and move that on; a row at once would be far slower."""
    at = place[zone]
    out[at, 0], out[at, 1], out[at, 2] = xyz[p, 0], xyz[p, 1], xyz[p, 2]
    place[zone] = at + 1


def points_near(
    points: gpd.GeoSeries, boundaries: Mapping[str, Boundary | None], *, reach: float
) -> dict[str, gpd.GeoSeries]:
    """Points that lie within each boundary, or no more than so many metres beside it.

    Parameters
    ----------
    points : GeoSeries
        Points in any CRS.
    boundaries : mapping of str to Boundary
        By the parcels' names; None is everywhere.
    reach : float
        Metres.

    Raises
    ------
    InputError
        If a boundary doesn't lie in its CRS, or nothing leads to that from the points'.
    """
    found: dict[str, gpd.GeoSeries] = {}
    brought: dict[CRS, shapely.STRtree] = {}
    for name, boundary in boundaries.items():
        if not boundary:
            found[name] = points
            continue
        polygon, own = boundary
        crs = metric_crs(own, *shapely.get_coordinates(shapely.point_on_surface(polygon))[0])
        if crs not in brought:
            brought[crs] = shapely.STRtree(project(points.to_numpy(), points.crs, crs))
        near = brought[crs].query(project(polygon, own, crs), predicate="dwithin", distance=reach)
        found[name] = points.iloc[np.sort(near)]
    return found
