"""How far the meshes of canopies lie from the foliage, told by the canopies' own points, without any truth."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from vinemap.canopy.mesh import breaks, corners_of
from vinemap.canopy.numbers import HIGH, LOW, TOP, quantile_of
from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches
from vinemap.evaluate.confidence import DOUBTFUL

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.canopy.model import CanopyModel
    from vinemap.canopy.points import Sections
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Floats, Ints, Values

PATCH, PATCHES = 0.2, 12
"""Metres, about a leaf's width: side of the patches of a canopy's surface, which leaves don't show more finely; and how
many of them an outline has at the least, so that those of a small canopy are narrower."""
FEW = 30
"""Patches whose median tells an error to a centimetre; of fewer it isn't told."""
CROWD = 1.2
"""Points of a patch, on the mean, of which the outermost is the surface's; a lone one is any of the foliage's depth."""
UPPER = 2 / 3
"""Share of a canopy's depth above which it is seen from both sides, and tells its middle."""
NUMBERS = ("mesh_error_m", "mesh_median_m", "mesh_95_m", "mesh_inside")
"""What is told of a row."""


class Near(NamedTuple):
    """Where points (n,) are beside the meshes of canopies."""

    distance: Values
    """Metres to the mesh, negative inside; NaN where it doesn't go on to both sides of the point's section."""
    patch: Ints
    """Number of the patch of the section's outline that is nearest, from v2 round to vc; -1 for the underside."""


def measure_meshes(
    cloud: Cloud, model: CanopyModel, rows: gpd.GeoDataFrame, *, step: float, tops: bool = False
) -> gpd.GeoDataFrame:
    """Give rows how far their canopies' points lie from their meshes, and how far, by that, the foliage's surface does.

    Measured are the sections of the model's sample. ``mesh_median_m`` and ``mesh_95_m`` are quantiles of their points'
    distances to the mesh, negative inside, and ``mesh_inside`` is the share of them that is inside: foliage is deep,
    and points lie in it. ``mesh_error_m`` is the model's part: the median of the distances of the foliage's surface to
    the mesh, on its sides and top. In each of the ``PATCHES`` the surface lies where the outermost point does, and
    as much further out as foliage reaches beyond its points. What one flank hides the other shows: of a patch tell its
    own points or, where these are more, those of the other side, mirrored. All are NaN without a canopy, and the
    last where few patches have points, or most have one, where ``tops`` alone were seen, and where
    ``canopy_confidence`` is low.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        The points of which the canopies were made.
    model : CanopyModel
        The canopies.
    rows : GeoDataFrame
        Rows with ``row_id`` and ``canopy_confidence``.
    step : float
        Metres between sections.
    """
    section = np.repeat(np.flatnonzero(model.sampled), np.diff(model.sample.start))
    points, tangent = _places(cloud, model.sample.member), model.at.tangent[section]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0], np.zeros(len(section))])
    other = points - 2 * (model.sample.points[:, :1] - _middles(model.sample)[:, None]) * normal
    own, mirrored = (distances(p, section, model.at, model.polygons, step=step) for p in (points, other))
    row = model.at.row_id[section]
    told = {}
    ends = np.flatnonzero(np.diff(row, prepend=-1, append=-1))
    for first, last in pairwise(ends.tolist()):
        mine = slice(first, last)
        near = [Near(side.distance[mine], side.patch[mine]) for side in (own, mirrored)]
        told[int(row[first])] = _error(section[mine], near, model.reach), *_spread(near[0].distance)
    nothing = (np.nan,) * len(NUMBERS)
    table = np.array([told.get(int(one), nothing) for one in rows["row_id"]]).reshape(-1, len(NUMBERS))
    known = (rows["canopy_confidence"].to_numpy(dtype=float) >= DOUBTFUL) & (not tops)
    table[~known, 0] = np.nan
    return rows.assign(**dict(zip(NUMBERS, table.T, strict=True)))


def _middles(sections: Sections) -> Values:
    """Metres (n,) to the left of γ at which the canopy of each point's row has its middle, as its upper part shows it.

    That is seen from all sides, where a flank may be hidden.
    """
    low, top = (quantile_of(sections.points[:, 1], sections.start, q) for q in (LOW, TOP))
    upper = sections.subset(sections.points[:, 1] >= np.repeat(low + UPPER * (top - low), np.diff(sections.start)))
    right, left = (quantile_of(upper.points[:, 0], upper.start, q) for q in (LOW, HIGH))
    middle = pd.Series((right + left) / 2).groupby(sections.row_id).transform("median")
    return np.repeat(middle.to_numpy(dtype=float), np.diff(sections.start))


def _spread(distance: Values) -> tuple[float, float, float]:
    """Median and 95% of the distances (n,) of a row's points, and the share of them inside."""
    known = distance[np.isfinite(distance)]
    if not len(known):
        return (np.nan,) * 3
    median, most = np.quantile(known, [0.5, 0.95])
    return float(median), float(most), float(np.mean(known <= 0))


def _error(section: Ints, sides: Sequence[Near], reach: Values) -> float:
    """Median distance of a row's surface, of whose sections are points (n,), as they lie and mirrored."""
    each, rank = np.unique(section, return_inverse=True)
    width = max(side.patch.max() for side in sides) + 1
    n, outermost = np.zeros((2, len(each) * width), dtype=int), np.full((2, len(each) * width), -np.inf)
    for side, near in enumerate(sides):
        seen = np.isfinite(near.distance) & (near.patch >= 0)
        place = rank[seen] * width + near.patch[seen]
        n[side] = np.bincount(place, minlength=n.shape[1])
        np.maximum.at(outermost[side], place, near.distance[seen] + reach[section[seen]])
    own, mirrored = outermost
    told = n.any(axis=0)
    off = np.where(n[0] >= n[1], own, mirrored)[told]
    known = len(off) >= FEW and n.max(axis=0)[told].mean() >= CROWD
    return float(np.median(np.abs(off))) if known else np.nan


def _places(cloud: Cloud, member: NDArray[np.int32]) -> Floats:
    """Coordinates (n, 3) of members of a cloud."""
    xyz = np.empty((len(member), 3))
    for part in cloud.parts():
        mine = member - part.first
        inside = (mine >= 0) & (mine < part.size)
        xyz[inside] = part.xyz[mine[inside]]
    return xyz


def distances(points: Floats, section: Ints, at: Sections, polygons: Floats, *, step: float) -> Near:
    """Distances of points to the meshes of canopies, near their sections.

    They are those to the nearest of the triangles of Eq. 22 between the sections around, exact for points that aren't
    deeper in a canopy than its sections are apart; caps of meshes don't count.

    Parameters
    ----------
    points : (n, 3) array
        In the sections' CRS.
    section : (n,) array
        Section of each, which climbs; points further than half a ``PATCH`` from it along the row aren't measured.
    at : Sections
        m sections; their points don't matter.
    polygons : (m, c, 2) array
        Their c-gons, in metres.
    step : float
        Metres between sections.
    """
    frame = at.origin, at.tangent, polygons, corners_of(at, polygons), ~breaks(at.row_id, at.position, step)
    out = Near(np.full(len(points), np.nan), np.full(len(points), -1))
    in_threads(lambda part: _measure(*part, points, section, frame, out), stretches(len(points)))
    return out


@compiled
def _measure(
    first: int, last: int, points: Floats, section: Ints, frame: tuple[Values, Values, Values, Values, Flags], out: Near
) -> None:
    """Write where points are beside the meshes."""
    origin, tangent, polygons, corners, joined = frame
    for p in range(first, last):
        k = section[p]
        if k == 0 or k == len(joined) or not (joined[k - 1] and joined[k]):
            continue
        x, y, z = points[p, 0] - origin[k, 0], points[p, 1] - origin[k, 1], points[p, 2] - origin[k, 2]
        along = tangent[k, 0] * x + tangent[k, 1] * y
        if abs(along) > 0.5 * PATCH:
            continue
        out.patch[p] = _patch(polygons[k], tangent[k, 0] * y - tangent[k, 1] * x, z)
        # Sections stand upright across γ: what is above a point belongs to the stretch between the two around it.
        own = k if along >= 0 else k - 1
        square, above = _stretch(points[p], corners[own], corners[own + 1])
        other = 2 * k - 1 - own
        if along**2 < square:
            square = min(square, _stretch(points[p], corners[other], corners[other + 1])[0])
        beyond = own + own - other
        ends = k + 2 * (own - k) + 1
        if 0 <= beyond < len(joined) and joined[beyond]:
            way_x, way_y = points[p, 0] - origin[ends, 0], points[p, 1] - origin[ends, 1]
            if (tangent[ends, 0] * way_x + tangent[ends, 1] * way_y) ** 2 < square:
                square = min(square, _stretch(points[p], corners[beyond], corners[beyond + 1])[0])
        out.distance[p] = math.sqrt(square) if above % 2 == 0 else -math.sqrt(square)


@compiled
def _stretch(p: Values, one: Values, two: Values) -> tuple[float, int]:
    """Squared distance of a point to the triangles between two sections' corners (c, 3), and how many are above it."""
    c, square, above = len(one), np.inf, 0
    for i in range(c):
        j = (i + 1) % c
        away, over = _triangle(p, one[i], one[j], two[i])
        square, above = min(square, away), above + over
        away, over = _triangle(p, one[j], two[j], two[i])
        square, above = min(square, away), above + over
    return square, above


@compiled
def _patch(polygon: Values, y: float, z: float) -> int:
    """Patch of a c-gon's outline from v2 round to vc that is nearest to (y, z); -1 where its underside is nearer."""
    c = len(polygon)
    nearest, at, way = np.inf, -1.0, 0.0
    for i in range(c):
        ay, az = polygon[i, 0], polygon[i, 1]
        by, bz = polygon[(i + 1) % c, 0] - ay, polygon[(i + 1) % c, 1] - az
        length = math.hypot(by, bz)
        t = min(max(((y - ay) * by + (z - az) * bz) / max(length, TINY) ** 2, 0.0), 1.0)
        away = math.hypot(y - ay - t * by, z - az - t * bz)
        under = i == 0 or i == c - 1
        if away < nearest:
            nearest, at = away, -1.0 if under else way + t * length
        if not under:
            way += length
    n = max(round(way / PATCH), PATCHES)
    return int(min(at / max(way, TINY) * n, n - 0.5)) if at >= 0 else -1


@compiled
def _triangle(p: Values, a: Values, b: Values, c: Values) -> tuple[float, int]:
    """Squared distance of a point to a triangle, and whether that is above it."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    ur, vr = ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
    twice = uu * vv - uv * uv
    s, t = (vv * ur - uv * vr), (uu * vr - uv * ur)
    if twice > 0 and s >= 0 and t >= 0 and s + t <= twice:
        s, t = s / twice, t / twice
        square = (x - s * ux - t * vx) ** 2 + (y - s * uy - t * vy) ** 2 + (z - s * uz - t * vz) ** 2
    else:  # an edge is nearest
        square = np.inf
        for edge in range(3):
            s, t = 0.0, 0.0
            if edge == 0:
                s = min(max(ur / max(uu, TINY), 0.0), 1.0)
            elif edge == 1:
                t = min(max(vr / max(vv, TINY), 0.0), 1.0)
            else:
                t = min(max((vr - ur + uu - uv) / max(uu - 2 * uv + vv, TINY), 0.0), 1.0)
                s = 1.0 - t
            square = min(square, (x - s * ux - t * vx) ** 2 + (y - s * uy - t * vy) ** 2 + (z - s * uz - t * vz) ** 2)
    flat = ux * vy - uy * vx
    if flat == 0:
        return square, 0
    s, t = (x * vy - y * vx) / flat, (ux * y - uy * x) / flat
    return square, int(s >= 0 and t >= 0 and s + t < 1 and s * uz + t * vz > z)


TINY = 1e-12
"""Lengths in metres, and squares of such, below which there is no edge."""
