"""Which rows are neighbours, and where along them: what each row sees to its left and right."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from vinemap.geo.curve import at, tangents, way_along
from vinemap.rows.blocks import NEIGHBOURS

if TYPE_CHECKING:
    import geopandas as gpd
    from numpy.typing import NDArray

    from vinemap.compute.arrays import Floats, Ints

STEP = 0.5
"""Metres between the places of a row from which it looks around."""
SIGHT = 3.0
"""Spacings as far as which is looked for the row on the other side."""

Pair = tuple[int, int]
"""Positions of two neighbours: the row on the right of what lies between, and the one on its left."""


class Side(NamedTuple):
    """One side of a row, every half metre."""

    row: int
    along: Floats
    xyz: Floats
    normal: Floats
    facing: Ints
    """Row that is seen along the normal, -1 where there is none within sight."""
    distance: Floats


def aligned(rows: gpd.GeoDataFrame) -> list[Floats]:
    """Curves (n, 3) of the rows, all in one direction in each block: that of most."""
    curves: list[Floats] = [shapely.get_coordinates(line, include_z=True) for line in rows.geometry]
    chords = np.array([curve[-1, :2] - curve[0, :2] for curve in curves]).reshape(-1, 2)
    blocks = rows["block"].to_numpy()
    for block in np.unique(blocks):
        members = np.flatnonzero(blocks == block)
        against = chords[members] @ chords[members[0]] < 0
        for i in members[against if against.sum() * 2 <= len(members) else ~against]:
            curves[i] = curves[i][::-1]
    return curves


def look(i: int, sign: int, curves: list[Floats], spacing: Floats, tree: shapely.STRtree) -> Side:
    """What a row sees to its left (1) or right (-1)."""
    curve = curves[i]
    way = way_along(curve[:, :2])
    along = np.linspace(0, way[-1], max(3, int(np.ceil(way[-1] / STEP)) + 1))
    xyz = np.column_stack([at(curve[:, :2], along), np.interp(along, way, curve[:, 2])])
    tangent = tangents(curve[:, :2], along)
    left: Floats = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normal = left if sign > 0 else -left
    reach = SIGHT * float(np.nan_to_num(spacing[i]))
    rays = np.array([shapely.LineString(ends) for ends in np.stack([xyz[:, :2], xyz[:, :2] + reach * normal], axis=1)])
    place, row = tree.query(rays, predicate="intersects")
    place, row = place[row != i], row[row != i]
    points = shapely.points(xyz[place, :2])
    seen = np.asarray(shapely.distance(points, shapely.intersection(rays[place], tree.geometries[row])))
    facing: Ints = np.full(len(along), -1)
    distance: Floats = np.full(len(along), np.inf)
    for k in np.argsort(-seen):  # the nearest comes last, and stays
        facing[place[k]], distance[place[k]] = row[k], seen[k]
    return Side(i, along, xyz, normal, facing, distance)


def pair_rows(sides: dict[Pair, Side], spacing: Floats, blocks: NDArray[np.generic]) -> dict[Pair, int]:
    """Number of the lane of each two neighbours; pairs share one where a row goes on after a gap."""
    runs: dict[tuple[int, int], list[tuple[Pair, float, float]]] = {}
    for (i, sign), side in sides.items():
        for j in dict.fromkeys(side.facing[side.facing >= 0].tolist()):
            seen = side.distance[side.facing == j]
            long = len(seen) * STEP >= min(spacing[i], side.along[-1])
            if blocks[i] == blocks[j] and long and np.median(seen) <= NEIGHBOURS * (spacing[i] + spacing[j]) / 2:
                pair = (i, j) if sign > 0 else (j, i)
                runs.setdefault((i, sign), []).append((pair, seen[0], seen[-1]))
    pairs = sorted({pair for run in runs.values() for pair, *_ in run})
    number = {pair: k for k, pair in enumerate(pairs)}
    for (i, _), run in runs.items():
        for (one, _, last), (other, first, _) in pairwise(run):
            if abs(last - first) < spacing[i] / 2:
                old, new = number[other], number[one]
                number = {pair: new if k == old else k for pair, k in number.items()}
    return number


def belonging(side: Side, sign: int, lanes: dict[Pair, int]) -> Ints:
    """Number of the lane of each place: where nothing is faced, that of the nearest place with one; -1 if none has."""
    pairs = [(side.row, j) if sign > 0 else (j, side.row) for j in side.facing.tolist()]
    number = np.array([lanes.get(pair, -1) for pair in pairs])
    known = np.flatnonzero(number >= 0)
    if len(known) == 0:
        return number
    nearest = known[np.abs(np.arange(len(number))[:, None] - known).argmin(axis=1)]
    out: Ints = number[nearest]
    return out
