"""Canopy told from terrain and noise in every section (thesis, section 3.2.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.canopy.points import MARGIN, NO_SECTIONS, STICKING, USUAL_AREA, canopy_floor, canopy_size, is_post
from vinemap.compute.compiled import compiled
from vinemap.compute.threads import in_threads, stretches

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.canopy.points import Sections
    from vinemap.compute.arrays import Flags, Ints, Values

BIN = 0.05
"""Metres: bins δs of the histograms of Eq. 8–9."""
LEVELS = round(3 / BIN)
"""Bins of elevations, from 1.5 m below a section's soil to as much above it."""
NOISE_CELL = 0.1
"""Metres: cells of a section in which a point has neighbours or is noise."""
USUAL_CELLS = round(USUAL_AREA / NOISE_CELL**2)
"""Such cells of a canopy of usual size."""
TALL = 0.1
"""Share of a section's canopy that must be high."""
UPPER = 0.5
"""Share of a row's height from which points are high."""
GROUND = 0.3
"""Metres above or below the terrain model within which points tell the inter-row's elevation."""


class Canopy(NamedTuple):
    """Canopy points of m sections, whether they are enough or not."""

    sections: Sections
    soil: Values
    """The thesis's fixed vertices (m, 3, 2) of the c-gon: v1 on γ, v2 and vc under both walls at the inter-row."""
    tall: Values
    """Share (m,) of a section's points that are high."""


NO_CANOPY = Canopy(NO_SECTIONS, np.empty((0, 3, 2)), np.empty(0))


def separate_canopy(
    sections: Sections,
    *,
    margin: float = MARGIN,
    half_width: float | None = None,
    high: float = 3.6,
    min_neighbours: float = 0.02,
    min_height: float = 0.8,
) -> Canopy:
    """Keep the canopy's points of sections.

    On each side of γ a plane runs from the foot of the vines to the canopy's wall at the elevation of the inter-row
    (Eq. 4–10). A point is canopy if it lies ``margin`` above that plane, where the printed plane cuts through the
    soil's own noise on flat ground, and as far above the terrain model. Posts that stick out of low vines are cut off.

    Parameters
    ----------
    sections : Sections
        All points of every section of a row.
    margin : float
        Metres above plane and terrain at which canopy begins, or less where the row is low, or more where weeds stand
        in it.
    half_width : float, optional
        Metres to the side of γ at which canopy ends; by default what holds the row's, half its spacing at the most.
    high : float
        Metres above terrain at which canopy ends.
    min_neighbours : float
        Share of a section's canopy points that must lie around a point (in 3 x 3 cells of 0.1 m), or it is noise; less
        in canopies of more than a square metre.
    min_height : float
        Metres from which points are high, or less where the row is low.
    """
    m, top = len(sections.row_id), high
    if m:
        spacing = float(sections.spacing.max())
        across = sections.points[:, 0].copy()
        top, half = canopy_size(across, sections.height, spacing, high)
        half_width = half if half_width is None else half_width
        margin = canopy_floor(across, sections.height, (top, half), spacing, margin)
        min_height = min(min_height, UPPER * top)
    keep = np.zeros(len(sections.points), dtype=bool)
    walls, tall = np.zeros((m, 2, 2)), np.zeros(m)
    limits = (margin, half_width or 0.0, high, min_neighbours, min_height, top)
    in_threads(
        lambda part: _separate(*part, sections.start, sections.points, sections.height, limits, keep, walls, tall),
        stretches(m),
    )
    soil = np.concatenate([np.zeros((m, 1, 2)), walls * np.array([[1.0, 1.0], [-1.0, 1.0]])], axis=1)
    return Canopy(sections.subset(keep), soil, tall)


def living_canopies(canopies: Sequence[Canopy], *, min_points: int = 8, min_share: float = 0.15) -> list[Canopy]:
    """Keep the sections that have a canopy, and the rows that have such sections.

    Parameters
    ----------
    canopies : sequence of Canopy
        One a row.
    min_points : int
        Points that a section must have.
    min_share : float
        Share of the median section's points that a section must have.
    """
    n = np.concatenate([np.empty(0), *(np.diff(canopy.sections.start) for canopy in canopies)])
    least = max(float(min_points), min_share * float(np.median(n[n > 0])) if n.any() else 0.0)
    out = []
    for sections, soil, tall in canopies:
        own = np.diff(sections.start)
        enough = (own >= least) & (tall >= TALL)
        if enough.all():
            out.append(Canopy(sections, soil, tall))
        elif enough.any():
            out.append(Canopy(sections.subset(np.repeat(enough, own), enough), soil[enough], tall[enough]))
    return out


@compiled
def _separate(
    first: int,
    last: int,
    start: Ints,
    points: Values,
    height: Values,
    limits: tuple[float, float, float, float, float, float],
    keep: Flags,
    walls: Values,
    tall: Values,
) -> None:
    """Flag the canopy's points of sections; write wall w and level h of both sides, and the share of high points."""
    margin, half_width, high, share, min_height, top = limits
    for k in range(first, last):
        mine = slice(start[k], start[k + 1])
        y, z, up, kept = points[mine, 0], points[mine, 1], height[mine], keep[mine]
        for p in range(len(y)):
            kept[p] = margin <= up[p] <= high and abs(y[p]) <= half_width
        if _sticks_out(y, up, kept, STICKING * top):
            for p in range(len(y)):
                kept[p] = kept[p] and up[p] <= top
        for side in range(2):
            sign = 1 - 2 * side
            w, h, distance = _plane(y, z, up, kept, sign, half_width)
            walls[k, side, 0], walls[k, side, 1] = w, h
            slope = h / max(distance, 0.2)
            for p in range(len(y)):
                if (y[p] >= 0) == (side == 0):
                    kept[p] = kept[p] and z[p] >= slope * abs(y[p]) + margin
        _drop_noise(y, z, kept, share)
        n = 0
        for p in range(len(y)):
            n += kept[p]
            tall[k] += kept[p] and up[p] >= min_height
        tall[k] /= max(n, 1)


@compiled
def _sticks_out(y: Values, up: Values, canopy: Flags, low: float) -> bool:
    """Whether what stands above some height is a post."""
    above, n = np.empty(len(y)), int(np.int64(0))  # with a plain 0 `is_post` would be compiled twice
    for p in range(len(y)):
        if canopy[p] and up[p] > low:
            above[n] = y[p]
            n += 1
    return is_post(above, n)


@compiled
def _plane(y: Values, z: Values, up: Values, canopy: Flags, sign: int, widest: float) -> tuple[float, float, float]:
    """Wall w and elevation h of the inter-row on the side of a sign of y (Eq. 6–9), and the inter-row's distance.

    The elevation is that of the inter-row's middle: the plane through it must not be steeper than the ground.
    """
    walls, levels = np.zeros(int(widest / BIN) + 1), np.zeros(LEVELS)
    total, leaves = 0.0, 0
    for p in range(len(y)):
        if canopy[p]:
            total, leaves = total + up[p], leaves + 1
    for p in range(len(y)):
        # The upper half of a canopy seen from above is its top rather than its walls.
        if sign * y[p] >= 0 and canopy[p] and up[p] * leaves <= total:
            walls[min(int(abs(y[p]) / BIN), len(walls) - 1)] += 1
    wall = _peak(walls) * BIN
    way, n = 0.0, 0
    for p in range(len(y)):
        if sign * y[p] > wall and abs(up[p]) < GROUND:
            levels[min(max(int((z[p] + 1.5) / BIN), 0), len(levels) - 1)] += 1
            way, n = way + abs(y[p]), n + 1
    return wall, _peak(levels) * BIN - 1.5 if n else 0.0, way / n if n else 1.0


@compiled
def _peak(histogram: Values) -> float:
    """Position of the peak of a histogram, smoothed, in bins; 0 where it is empty."""
    best, most = -0.5, 0.0
    for i in range(len(histogram)):
        left, right = histogram[max(i - 1, 0)], histogram[min(i + 1, len(histogram) - 1)]
        height = 2 * histogram[i] + left + right
        if height > most:
            best, most = float(i), height
    return best + 0.5


@compiled
def _drop_noise(y: Values, z: Values, kept: Flags, share: float) -> None:
    """Unflag points with less than a share of the flagged, or fewer than two others, in the cells around.

    Where more than ``USUAL_CELLS`` have points, the share is as much less.
    """
    n, low, high, west, east = 0, np.inf, -np.inf, np.inf, -np.inf
    for p in range(len(y)):
        if kept[p]:
            n += 1
            low, high = min(low, z[p]), max(high, z[p])
            west, east = min(west, y[p]), max(east, y[p])
    if n == 0:
        return
    used = 0
    cells = np.zeros((int((east - west) / NOISE_CELL) + 3, int((high - low) / NOISE_CELL) + 3))
    for p in range(len(y)):
        if kept[p]:
            i, j = int((y[p] - west) / NOISE_CELL) + 1, int((z[p] - low) / NOISE_CELL) + 1
            used += cells[i, j] == 0
            cells[i, j] += 1
    least = max(3.0, share * n * min(1.0, USUAL_CELLS / used))
    for p in range(len(y)):
        if kept[p]:
            i, j = int((y[p] - west) / NOISE_CELL) + 1, int((z[p] - low) / NOISE_CELL) + 1
            around = 0.0
            for a in range(-1, 2):
                around += cells[i + a, j - 1] + cells[i + a, j] + cells[i + a, j + 1]
            kept[p] = around >= least
