"""Lanes: the lines that a machine drives on, midway between neighbouring rows."""

from __future__ import annotations

from collections import Counter
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any, NamedTuple

import geopandas as gpd
import numpy as np
import shapely

from vinemap.export.neighbours import STEP, aligned, belonging, look, pair_rows
from vinemap.geo.curve import extend, unit, way_along
from vinemap.geo.holes import comes_back, room_before, way_out

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from vinemap.compute.arrays import Flags, Floats
    from vinemap.export.neighbours import Pair, Side

TANGENT = 2.0
"""Metres at the end of a lane that give its direction there."""
FINE = 0.001
"""Metres to which the other row is taken."""
ROUNDS = 10
"""Of halving: at 20° between two rows, each leaves a thirtieth of the error or less."""
OPENING = 0.1
"""Metres across per metre along by which a lane goes away from a row that is alone, up to its usual width."""
PLAN_TOLERANCE, HEIGHT_TOLERANCE = 0.01, 0.03
"""Metres by which a lane may leave its course once vertices are left out."""
BESIDE = 1.5
"""Half widths of a lane within which the rows are that it runs beside."""


class _Course(NamedTuple):
    """Places on a lane: the points, and half the distance between the rows there, NaN where only one is there."""

    xyz: Floats
    half: Floats


def lanes_between(
    rows: gpd.GeoDataFrame,
    within: shapely.Geometry | None = None,
    *,
    headland: float = 3.0,
    outer: bool = False,
    vertices: int | None = None,
) -> gpd.GeoDataFrame:
    """Draw the lane between each two neighbouring rows of a block.

    From a place p on one row with unit normal n, the lane runs through p + h n, where h is also the distance from there
    to the other row: a point as far from one row as from the other (of their medial axis), whether they are parallel,
    curved or converge. h is found by halving: h ← (h + distance(p + h n, other row)) / 2. Beyond the end of the shorter
    row h is that of its last place, and in a gap that a track has left in a row it is in between; so a lane is as long
    as the longer of its rows. Where the shorter row ended close by, h opens to what is usual.

    Rows are neighbours if one sees the other along its normals, for at least a spacing of its length and over no more
    than 1.6 spacings. What is in between is seen first, be it of another block.

    Parameters
    ----------
    rows : GeoDataFrame
        LineStringZ with ``row_id``, ``block``, ``spacing_m``, and the canopy's ``width_m`` if it is known.
    within : Geometry, optional
        The parcel's polygon, where it is known: no lane leads through a hole or a notch of it.
    headland : float
        Metres by which lanes run straight on beyond their rows, so that a machine is clear of them as it turns; fewer
        where another row, or a hole or notch of the parcel, is in the way.
    outer : bool
        Whether there is a lane half a spacing beside the first row of a block and its last, too.
    vertices : int, optional
        Vertices of every lane, at equal distances; by default as few as keep its course within a centimetre.

    Returns
    -------
    GeoDataFrame
        LineStringZ with ``lane_id`` (1 … n, in order of the rows), ``label`` ("3-4", "3-4+5" beside a parted row, "3-4
        a" and "3-4 b" of a lane in parts), ``block``, ``right_rows`` and ``left_rows`` (their ``row_id``, "4+5", empty
        beside none), ``length_m`` (in plan, headlands included), ``width_m`` (mean distance of the rows),
        ``narrowest_m`` and ``clear_m`` (mean distance of the canopies). Lanes run as the rows do, from e1 to en; z is
        the mean of the two rows'.
    """
    curves = aligned(rows)
    tree = shapely.STRtree([shapely.LineString(curve[:, :2]) for curve in curves])
    spacing = rows["spacing_m"].to_numpy(dtype=float)
    sides = {(i, sign): look(i, sign, curves, spacing, tree) for i in range(len(rows)) for sign in (1, -1)}
    lanes = pair_rows(sides, spacing, rows["block"].to_numpy())
    courses = [(*_members(pairs), _course(*_members(pairs), sides, lanes, curves)) for pairs in _groups(lanes)]
    if outer:
        courses += list(_beside(sides, lanes, spacing))
    if within is not None:
        courses = [part for course in courses for part in _inside(*course, within, tree)]
    table = [_describe(right, left, course, rows, headland, tree, within) for right, left, course in courses]
    order = sorted(range(len(table)), key=lambda k: _rank(courses[k][:2], rows))
    _name_parts([table[k] for k in order])
    lines = [table[k].pop("line") for k in order]
    lines = list(resampled(lines, vertices)) if vertices else lines
    columns = ("label", "block", "right_rows", "left_rows", "length_m", "width_m", "narrowest_m", "clear_m")
    described = {name: [table[k][name] for k in order] for name in columns}
    return gpd.GeoDataFrame(
        {"lane_id": np.arange(1, len(lines) + 1)} | described, geometry=gpd.GeoSeries(lines, crs=rows.crs), crs=rows.crs
    )


def resampled(lines: Sequence[shapely.LineString], vertices: int) -> NDArray[np.object_]:
    """Lines with so many vertices each, at equal distances in plan, ends kept."""
    share = np.linspace(0, 1, vertices)
    points = [shapely.line_interpolate_point(line, share, normalized=True) for line in lines]
    coordinates = [shapely.get_coordinates(p, include_z=True) for p in points]
    for line, xyz in zip(lines, coordinates, strict=True):
        xyz[[0, -1]] = shapely.get_coordinates(line, include_z=True)[[0, -1]]
    return np.array([shapely.LineString(xyz) for xyz in coordinates], dtype=object)


def _groups(lanes: dict[Pair, int]) -> list[list[Pair]]:
    return [[pair for pair, k in lanes.items() if k == number] for number in dict.fromkeys(lanes.values())]


def _members(pairs: list[Pair]) -> tuple[list[int], list[int]]:
    """Rows on the right of a lane, and on its left."""
    return sorted({i for i, _ in pairs}), sorted({j for _, j in pairs})


def _course(
    right: list[int], left: list[int], sides: dict[Pair, Side], lanes: dict[Pair, int], curves: list[Floats]
) -> _Course:
    """Places on a lane in order: from its right rows, and where there is none, from its left ones."""
    number = next(lanes[i, j] for i in right for j in left if (i, j) in lanes)
    parts = []
    for own, others, sign in ((right, left, 1), (left, right, -1)):
        for i in own:
            side = sides[i, sign]
            mine = belonging(side, sign, lanes) == number
            if sign < 0:
                mine &= ~np.isin(side.facing, others)
            if mine.any():
                place = _midway(side, [curves[j] for j in others])
                parts.append(_Course(place.xyz[mine], place.half[mine]))
    xyz, half = np.concatenate([p.xyz for p in parts]), np.concatenate([p.half for p in parts])
    longest = max((curves[i][:, :2] for i in (*right, *left)), key=lambda curve: float(way_along(curve)[-1]))
    line = shapely.LineString(extend(longest, 500.0))
    station = np.asarray(shapely.line_locate_point(line, shapely.points(xyz[:, :2])))
    order = np.argsort(station)
    keep = order[_apart(station[order])]
    return _Course(xyz[keep], half[keep])


def _midway(side: Side, others: list[Floats]) -> _Course:
    """Points as far from a row as from the other, or others that go on after one another."""
    lines = [shapely.simplify(shapely.LineString(curve[:, :2]), FINE) for curve in others]
    every = shapely.multilinestrings(lines)
    half = np.asarray(shapely.distance(shapely.points(side.xyz[:, :2]), every)) / 2
    for _ in range(ROUNDS):
        points = shapely.points(side.xyz[:, :2] + half[:, None] * side.normal)
        half = (half + shapely.distance(points, every)) / 2
    points = shapely.points(side.xyz[:, :2] + half[:, None] * side.normal)
    nearest = np.argmin([shapely.distance(points, line) for line in lines], axis=0)
    met, z = np.zeros(len(half), dtype=bool), np.zeros(len(half))
    for k, (line, curve) in enumerate(zip(lines, others, strict=True)):
        there = np.asarray(shapely.line_locate_point(line, points))
        mine = nearest == k
        met |= mine & (there > 0) & (there < line.length)
        z[mine] = np.interp(there, way_along(curve[:, :2]), curve[:, 2])[mine]
    if met.any():
        first, last = side.along[met][[0, -1]]
        beyond = np.maximum(0, np.maximum(first - side.along, side.along - last) - TANGENT)
        usual = np.median(half[met])
        half = np.interp(side.along, side.along[met], half[met])
        half = np.maximum(half, np.minimum(usual, half + OPENING * beyond))
        rise = np.interp(side.along, side.along[met], (z - side.xyz[:, 2])[met])
    else:
        rise = np.zeros(len(half))
    xy = side.xyz[:, :2] + half[:, None] * side.normal
    return _Course(np.column_stack([xy, side.xyz[:, 2] + rise / 2]), np.where(met, half, np.nan))


def _apart(station: Floats) -> list[int]:
    """Positions of sorted stations that are at least half a step apart, the last one among them."""
    keep = [0]
    for k in range(1, len(station)):
        if station[k] - station[keep[-1]] >= STEP / 2:
            keep.append(k)
    if keep[-1] != len(station) - 1:
        keep[-1 if len(keep) > 1 else len(keep) :] = [len(station) - 1]
    return keep


def _beside(
    sides: dict[Pair, Side], lanes: dict[Pair, int], spacing: Floats
) -> Iterator[tuple[list[int], list[int], _Course]]:
    """Lanes along the sides of rows that have no neighbour."""
    for (i, sign), side in sides.items():
        if np.isfinite(spacing[i]) and (belonging(side, sign, lanes) < 0).all():
            half = np.full(len(side.along), spacing[i] / 2)
            xyz = side.xyz + np.column_stack([half[:, None] * side.normal, np.zeros(len(half))])
            yield ([i], [], _Course(xyz, half)) if sign > 0 else ([], [i], _Course(xyz, half))


def _inside(
    right: list[int], left: list[int], course: _Course, within: shapely.Geometry, tree: shapely.STRtree
) -> Iterator[tuple[list[int], list[int], _Course]]:
    """A lane in the parts that are in a polygon, or beside it and in no hole or notch.

    Between two rows it may lead out of it at its ends for its width, as where rows end along a slanting headland.
    """
    xy, lines = course.xyz[:, :2], tree.geometries
    half = course.half[np.isfinite(course.half)]
    reach = float(half.max()) if len(half) else STEP
    free = np.asarray(shapely.contains_xy(within, xy))
    if right and left:
        for way, inside in ((xy, free), (xy[::-1], free[::-1])):
            _lead_out(way, inside, 2 * reach, within)
    else:
        row = lines[(right or left)[0]]
        foot = shapely.get_coordinates(shapely.line_interpolate_point(row, shapely.line_locate_point(row, _points(xy))))
        away = unit(xy - foot)
        rays = np.asarray(shapely.linestrings(np.stack([foot, xy + way_out(within) * away], axis=1)), dtype=object)
        free |= ~comes_back(rays, within)
    if free.all():
        yield right, left, course
        return
    for run in np.split(np.arange(len(xy)), np.flatnonzero(np.diff(free)) + 1):
        if free[run[0]] and float(way_along(xy[run])[-1]) > reach:
            line = shapely.LineString(xy[run])
            near = [[i for i in group if shapely.dwithin(lines[i], line, BESIDE * reach)] for group in (right, left)]
            yield near[0] or right, near[1] or left, _Course(course.xyz[run], course.half[run])


def _lead_out(xy: Floats, free: Flags, longest: float, within: shapely.Geometry) -> None:
    """Free the places (n,) at a lane's end that lie outside of a polygon, if it leads so far at the most, and away."""
    last = int(np.flatnonzero(free).max(initial=-1))
    beyond = xy[last:]
    if last < 0 or len(beyond) < 2 or way_along(beyond)[-1] > longest:
        return
    outward = (beyond[-1] - beyond[0]) / np.hypot(*(beyond[-1] - beyond[0]))
    line = shapely.LineString([*beyond, beyond[-1] + way_out(within) * outward])
    free[last:] = not comes_back(np.array([line], dtype=object), within)[0]


def _points(xy: Floats) -> NDArray[np.object_]:
    return np.asarray(shapely.points(xy), dtype=object)


def _name_parts(table: list[dict[str, Any]]) -> None:
    """Tell parts of one lane apart by letters."""
    often, so_far = Counter(lane["label"] for lane in table), Counter[str]()
    for lane in table:
        name = lane["label"]
        if often[name] > 1:
            lane["label"] = f"{name} {_letters(so_far[name])}"
            so_far[name] += 1


def _letters(n: int) -> str:
    """The nth of a … z, aa, ab …, the first for 0."""
    before, last = divmod(n, len(ascii_lowercase))
    return (_letters(before - 1) if before else "") + ascii_lowercase[last]


def _describe(
    right: list[int],
    left: list[int],
    course: _Course,
    rows: gpd.GeoDataFrame,
    headland: float,
    tree: shapely.STRtree,
    within: shapely.Geometry | None,
) -> dict[str, Any]:
    """A lane with what is known of it."""
    ids = rows["row_id"].to_numpy()
    width = 2 * course.half[np.isfinite(course.half)]
    names = ["+".join(str(ids[i]) for i in sorted(group)) for group in (right, left)]
    ordered = sorted((name for name in names if name), key=lambda name: int(name.split("+")[0]))
    canopy = rows["width_m"].to_numpy(dtype=float) if "width_m" in rows else np.full(len(rows), np.nan)
    halves = [np.nanmean(canopy[group]) / 2 if np.isfinite(canopy[group]).any() else np.nan for group in (right, left)]
    taken = sum(half for half, group in zip(halves, (right, left), strict=True) if group)
    mean = float(width.mean()) if len(width) else float(rows["spacing_m"].iloc[(right or left)[0]])
    line = _driven(course.xyz, headland, mean / 2, tree, within)
    return {
        "label": "-".join(ordered) if len(ordered) == 2 else f"{'left' if right else 'right'} of {ordered[0]}",
        "block": rows["block"].iloc[(right or left)[0]],
        "right_rows": names[0],
        "left_rows": names[1],
        "length_m": float(line.length),
        "width_m": mean,
        "narrowest_m": float(width.min()) if len(width) else mean,
        "clear_m": mean - taken,
        "line": line,
    }


def _driven(
    xyz: Floats, headland: float, clearance: float, tree: shapely.STRtree, within: shapely.Geometry | None
) -> shapely.LineString:
    """A lane in few vertices, carried straight on at both ends, and nowhere across a row, or a hole of a polygon."""
    line = shapely.LineString(xyz)
    crossed = tree.geometries[tree.query(line, predicate="intersects")]
    if len(crossed):
        parts = shapely.get_parts(shapely.difference(line, shapely.union_all(shapely.buffer(crossed, clearance))))
        xyz = shapely.get_coordinates(max(parts, key=lambda part: part.length, default=line), include_z=True)
    ends = []
    for end in (xyz, xyz[::-1]):
        way = way_along(end[:, :2])
        inner = end[min(int(np.searchsorted(way, TANGENT)), len(end) - 1)]
        outward = (end[0] - inner) / np.hypot(*(end[0] - inner)[:2])
        ray = shapely.LineString([end[0, :2], end[0, :2] + (headland + clearance) * outward[:2]])
        near = tree.geometries[tree.query(ray, predicate="dwithin", distance=clearance / 2)]
        taken = shapely.intersection(ray, shapely.buffer(near, clearance / 2))
        free = np.min(
            shapely.distance(shapely.points(end[0, :2]), taken), initial=np.inf, where=~shapely.is_empty(taken)
        )
        room = room_before(end[0, :2], outward[:2], within) if within else np.inf
        on = min(headland, float(free) - clearance / 2, room)
        ends.append((end[0] + on * outward)[None] if on > 0 else end[:0])
    return _light(np.concatenate([ends[0], xyz, ends[1]]))


def _light(xyz: Floats) -> shapely.LineString:
    """A line with the vertices that its course in plan and its profile need (Douglas and Peucker 1973)."""
    number = np.arange(len(xyz))
    profile = np.column_stack([way_along(xyz[:, :2]), xyz[:, 2], number])
    plan = np.column_stack([xyz[:, :2], number])
    kept = [
        shapely.get_coordinates(shapely.simplify(shapely.linestrings(line), tolerance), include_z=True)[:, 2]
        for line, tolerance in ((plan, PLAN_TOLERANCE), (profile, HEIGHT_TOLERANCE))
    ]
    return shapely.LineString(xyz[np.unique(np.concatenate(kept)).astype(int)])


def _rank(sides: tuple[list[int], list[int]], rows: gpd.GeoDataFrame) -> tuple[float, ...]:
    """Where a lane comes in the order of the rows; the one beside the first row comes first."""
    right, left = sides
    ids, members = rows["row_id"].to_numpy(), [*right, *left]
    block = rows["block"].iloc[members[0]]
    alone = not (right and left)
    first = alone and ids[members[0]] == rows["row_id"][rows["block"] == block].min()
    return (float(block), float(ids[members].min()) - first, float(ids[members].max()))
