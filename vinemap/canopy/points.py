"""Sections of all rows with their points: what flows between the steps of this room."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.compute.compiled import compiled
from vinemap.compute.order import quantile
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.compute.arrays import Flags, Ints, Values

BIN = 0.05
"""Metres: bins of heights, and across, in which a row's canopy is measured."""
LEAST, TOP, BULK = 0.2, 0.95, 0.9
"""Metres above which points may be a canopy's, and the orders of their heights that are its height, and the least that
it may be where posts stick out."""
STICKING, THIN = 1.3, 0.1
"""Height, in the row's own, from which points are a post's if half of them lie within so many metres across the row."""
LOWEST, FOOT = 0.15, 0.36
"""Metres, and share of a row's height over ``LEAST``, from which its canopy is told from weeds."""
UPPER, EDGE = 0.5, 0.1
"""Share of its height above which a canopy's width is told, and share of its density, from its middle, at its sides."""
WIDER, BESIDE = 1.5, 0.2
"""By how much, and by how many metres, a canopy may be wider than it is on the whole."""
USUAL_AREA = 1.0
"""Square metres across it that a canopy of usual size fills at the most; larger ones spread their points over more."""
LOWLY = 1.3
"""Metres below which a row is low."""
SOLID, RISE, CLEAR = 0.25, 1.5, 0.15
"""Foliage goes on downwards at a height if its density there is this share, at the least, of the mean above; is no more
than so many times the least above, as it is where another plant begins; and if no more than this share of it stands
beside the row."""
SURE = 3.0
"""Standard deviations of the number of points by which a rise is none of chance."""
AS_DENSE = 0.35
"""Share of a row's density, at a height, that stands on both sides of its canopy where these are weeds."""
MARGIN = 0.4
"""Metres above ground from which points are a canopy's, unless they say otherwise."""


def above_weeds(height: Values | float) -> Values:
    """Metres above ground (n,) from which points are taken for canopy rather than weeds, by the rows' heights (n,)."""
    out: Values = np.maximum(LOWEST, FOOT * (np.asarray(height) - LEAST))
    return out


def canopy_floor(
    left: Values, height: Values, size: tuple[float, float], spacing: float, margin: float = MARGIN
) -> float:
    """Metres above ground from which a row's points are its canopy's.

    That is a margin, or in low rows where canopies are told from weeds by their height alone. In these it is lower, as
    far as their foliage goes on and next to nothing stands beside it that could be weeds or the soil's noise; or
    higher, where foliage has thinned out and something denser begins below. In others, whose walls photographs draw
    down to the ground, and whose foliage may be thin where it hides itself, it is only higher, where weeds stand:
    something on both sides that doesn't stand there higher up.

    Parameters
    ----------
    left, height : (n,) array
        Points of a row: metres to its left, and above ground.
    size : float, float
        Height and half width of the row, as of :func:`canopy_size`.
    spacing : float
        Metres to the next row.
    margin : float
        Metres above ground at which the canopy of a row that isn't low begins.
    """
    top, half = size
    floor = min(margin, float(above_weeds(top)))
    inner = _edge(half)
    strips = np.array([0.0, inner, WIDER * inner, half, max(half, 0.5 * spacing)])
    density = _densities(left, height, strips, round(top / BIN))
    inside, beside = density[0], density[2:].max(axis=0)
    level = int(round(floor / BIN, 6))
    above = inside[level + 1 :]
    if not above.any():
        return floor
    upper = max(int(UPPER * top / BIN) - level - 1, 0)
    if top >= LOWLY:
        weeds = _weeds(left, height, strips[[0, 2, 3]], inside)[level : level + upper + 2]
        if weeds.any() and not weeds[-1]:
            highest = int(np.flatnonzero(weeds)[-1])
            free = above[highest : upper + 1]
            return max(floor, (level + highest + int((free <= RISE * free.min()).argmax()) + 1) * BIN)
        return floor
    lower = above[: upper + above[upper:].argmax() + 1]
    usual, least = above.mean(), lower.min()
    if inner * (inside[level] - RISE * least) > SURE * np.sqrt(inner * inside[level]):
        return max(floor, (level + 1 + int((lower <= RISE * least).argmax())) * BIN)
    while level > 0 and SOLID * usual <= inside[level] <= RISE * least and beside[level] <= CLEAR * inside[level]:
        floor, least, level = min(floor, level * BIN), min(least, inside[level]), level - 1
    return floor


def _weeds(left: Values, height: Values, strips: Values, inside: Values) -> Flags:
    """Whether weeds stand at levels (k,) of height on both sides of a row, in the outer of two strips.

    They are ``AS_DENSE`` of what stands ``inside`` (k,), at the least, not by chance, with the levels below and above.
    """
    width, window = strips[2] - strips[1], np.ones(3)
    sides = [_densities(left[side], height[side], strips, len(inside))[1] for side in (left < 0, left >= 0)]
    aside = 2 * width * np.minimum(*(np.convolve(side, window, "same") for side in sides))
    out: Flags = aside - AS_DENSE * width * np.convolve(inside, window, "same") > SURE * np.sqrt(aside)
    return out


def canopy_area(size: tuple[float, float], floor: float) -> float:
    """Area in m² of a row's cross-section, roughly: by its height and half width, and the floor of its canopy."""
    top, half = size
    return 2 * _edge(half) * max(top - floor, 0.0)


def _edge(half: float) -> float:
    """Metres to the side of a row at which most of its canopy ends, of the half width that holds it all."""
    return max((half - BESIDE) / WIDER, BIN)


class Sections(NamedTuple):
    """Sections S_k of all rows, ordered by row and position, with their points one after the other.

    Points ``start[k]`` to ``start[k + 1]`` are those of section k; a point may be in two sections (a > b).
    """

    row_id: Ints
    """Row (m,) of each section."""
    position: Values
    """Metres (m,) along γ."""
    origin: Values
    """Points (m, 3) of γ at soil level in the parcel's CRS: the origins of {LOC_k}."""
    tangent: Values
    """Horizontal unit vectors (m, 2) along γ: the x axes of {LOC_k}."""
    spacing: Values
    """Local inter-row spacing δ (m,) in metres."""
    extent: Values
    """Metres (m,) along γ from which each has its points."""
    start: Ints
    """First point (m + 1,) of each section."""
    points: NDArray[np.float32]
    """Points (n, 2) as y and z of {LOC_k}: metres to the left of γ, metres above its soil beside them."""
    height: Values
    """Height above the terrain model (n,) in metres."""
    member: NDArray[np.int32]
    """Index (n,) of each point in the cloud; it climbs within a section."""

    def subset(self, points: Flags, sections: Flags | None = None) -> Sections:
        """The points (n,) and sections (m,; by default all) that are flagged; no point of another section may be."""
        sections = np.ones(len(self.row_id), dtype=bool) if sections is None else sections
        n = np.zeros(len(sections), dtype=np.int64)
        in_threads(lambda part: _count_flags(*part, points, self.start, n), stretches(len(n)))
        start = np.concatenate([[0], np.cumsum(n)])
        kept = np.empty((start[-1], 2), dtype=self.points.dtype)
        height = np.empty(start[-1], dtype=self.height.dtype)
        member = np.empty(start[-1], dtype=self.member.dtype)
        old, new = (self.points, self.height, self.member), (kept, height, member)
        in_threads(lambda part: _take_flagged(*part, points, self.start, start, old, new), stretches(len(n)))
        return Sections(
            self.row_id[sections],
            self.position[sections],
            self.origin[sections],
            self.tangent[sections],
            self.spacing[sections],
            self.extent[sections],
            np.concatenate([[0], np.cumsum(n[sections])]),
            kept,
            height,
            member,
        )

    def without_points(self) -> Sections:
        """The sections as places."""
        return Sections(*self[:6], np.zeros_like(self.start), self.points[:0], self.height[:0], self.member[:0])


NO_SECTIONS = Sections(
    np.empty(0, dtype=np.int64),
    np.empty(0),
    np.empty((0, 3)),
    np.empty((0, 2)),
    np.empty(0),
    np.empty(0),
    np.zeros(1, dtype=np.int64),
    np.empty((0, 2), dtype=np.float32),
    np.empty(0, dtype=np.float32),
    np.empty(0, dtype=np.int32),
)


def join(parts: Sequence[Sections]) -> Sections:
    """Sections of several rows, or groups of rows, as one; there must be one group at the least."""
    table = {name: np.concatenate([getattr(part, name) for part in parts]) for name in Sections._fields}
    n = np.concatenate([np.diff(part.start) for part in parts])
    return Sections(**table | {"start": np.concatenate([[0], np.cumsum(n)])})


@compiled
def _count_flags(first: int, last: int, flags: Flags, start: Ints, n: Ints) -> None:
    for k in range(first, last):
        for p in range(start[k], start[k + 1]):
            n[k] += flags[p]


@compiled
def _take_flagged(
    first: int,
    last: int,
    flags: Flags,
    start: Ints,
    place: Ints,
    old: tuple[Values, Values, NDArray[np.int32]],
    new: tuple[Values, Values, NDArray[np.int32]],
) -> None:
    points, height, member = old
    kept, kept_height, kept_member = new
    for k in range(first, last):
        at = place[k]
        for p in range(start[k], start[k + 1]):
            if flags[p]:
                kept[at, 0], kept[at, 1] = points[p, 0], points[p, 1]  # a row at once would be far slower
                kept_height[at], kept_member[at] = height[p], member[p]
                at += 1


def canopy_size(left: Values, height: Values, spacing: float, highest: float) -> tuple[float, float]:
    """Height and half width in metres that hold a row's canopy, on the whole: what lies beyond is not the row's.

    The height is that of most points within a quarter of the spacing, but for posts that stick out; the half width is
    where those of its upper half, which neither weeds nor a cover crop reach, have thinned out, and half as much again,
    at the most half the spacing.

    Parameters
    ----------
    left, height : (n,) array
        Points of a row: metres to its left, and above ground.
    spacing, highest : float
        Metres to the next row, and of height above which there is no canopy.
    """
    top = _top(left, height, 0.25 * spacing, highest)
    if not top:
        return highest, 0.5 * spacing
    edge = _edge_at(left, height, 0.5 * spacing, (UPPER * top, highest))
    return top, min(WIDER * edge + BESIDE, 0.5 * spacing)


@compiled
def _top(left: Values, height: Values, reach: float, highest: float) -> float:
    """Height in metres of most points within reach of a row, but for posts; 0 without any."""
    levels, total = np.zeros(int(highest / BIN) + 1), 0
    for p in range(len(left)):
        if LEAST <= height[p] <= highest and abs(left[p]) <= reach:
            levels[int(height[p] / BIN)] += 1
            total += 1
    if total == 0:
        return 0.0
    bins = _order(levels, TOP * total)
    post = STICKING * BIN * _order(levels, BULK * total)
    if BIN * bins > post:
        above, n = np.empty(len(left)), int(np.int64(0))  # with a plain 0 `is_post` would be compiled twice
        for p in range(len(left)):
            if post < height[p] <= highest and abs(left[p]) <= reach:
                above[n] = left[p]
                n += 1
        if is_post(above, n):
            bins = _order(levels, TOP * (total - n))
    return BIN * bins


@compiled
def _edge_at(left: Values, height: Values, reach: float, levels: tuple[float, float]) -> float:
    """Metres to the side of a row, up to reach, at which its points between two heights have thinned out."""
    across = np.zeros(int(reach / BIN) + 3)
    low, high = levels
    for p in range(len(left)):
        if low <= height[p] <= high and abs(left[p]) < reach:
            across[int(abs(left[p]) / BIN)] += 1
    edge = 0
    for i in range(len(across)):
        if across[i] > across[edge]:
            edge = i
    least = EDGE * across[edge]
    while edge + 2 < len(across) and across[edge] + across[edge + 1] >= 2 * least:
        edge += 1
    return BIN * edge


@compiled
def _order(levels: Values, n: float) -> int:
    """Bins of height below which n of the points of a histogram lie."""
    bins, below = 1, levels[0]
    while below < n:
        below += levels[bins]
        bins += 1
    return bins


@compiled
def is_post(above: Values, n: int) -> bool:
    """Whether the first n points that stand above some height, by metres across, are thin, if there are any.

    Strays beside it don't make it wide. They lose their order.
    """
    if n == 0:
        return False
    first = int(np.int64(0))  # a plain 0 would have `quantile` compiled twice
    middle = quantile(above, first, n, 0.5)
    for i in range(n):
        above[i] = abs(above[i] - middle)
    return quantile(above, first, n, 0.5) <= THIN


@compiled
def _densities(left: Values, height: Values, strips: Values, levels: int) -> Values:
    """Points (k, levels) per metre of width in strips between k + 1 distances from a row, by heights of ``BIN``."""
    out = np.zeros((len(strips) - 1, levels))
    for p in range(len(left)):
        away, level = abs(left[p]), math.floor(height[p] / BIN)
        if 0 <= level < levels and away < strips[-1]:
            k = 0
            while away >= strips[k + 1]:
                k += 1
            out[k, level] += 1
    for k in range(len(out)):
        for level in range(levels):
            out[k, level] /= max(strips[k + 1] - strips[k], 1e-9)
    return out
