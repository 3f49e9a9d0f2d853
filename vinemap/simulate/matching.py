"""Image matching: what it makes of rays from photographs, clump by clump, in the sun and in the shade.

Leaves that look alike are matched in clumps or not at all; a clump is off as a whole. Tops are matched more often than
sides, the sunny side more often than the other, towards which canopies are drawn. In the shade the ground is rough.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import ndtri

from vinemap.simulate.terrain import Array

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vinemap.simulate.plants import Stations
    from vinemap.simulate.rays import Cells

Spoilt = Callable[[Array, Array, "NDArray[np.bool_]"], tuple[Array, "NDArray[np.bool_]"]]
STEP = 0.2  # of the way to the sun along which foliage is looked for that gives shade (m)
LATTICE = (96, 96, 48)  # cells after which clumps repeat


@dataclass(frozen=True)
class Matching:
    """The light and the quality of a flight; metres."""

    sun: float = 240.0
    """Direction in which the sun stands, degrees anticlockwise from east."""
    elevation: float = 50.0
    """Of the sun, degrees."""
    clump: float = 0.2
    """Size of what is matched, or isn't, and is off as a whole."""
    depth: float = 0.04
    """Standard deviation of clumps."""
    pull: float = 0.01
    """How far foliage is drawn towards the sun, beyond what its better matched side does."""
    matched: float = 0.8
    """Share of the rays to the tops that are matched; fewer to the sides, fewest in the shade."""
    shade: float = 0.02
    """Standard deviation of the ground in the shade."""


def matcher(sensor: Matching, stations: Stations, cells: Cells, rng: np.random.Generator) -> Spoilt:
    """What matching makes of points.

    Returns
    -------
    callable
        Of points (n, 3), of the ground (n,) below or at them, and of whether they are above ground (n,); gives the
        points that are found, and whether they are.
    """
    clumps = [_clumps(rng, sensor.clump) for _ in range(4)]
    rough = _clumps(rng, 0.6 * sensor.clump)
    towards = np.array([math.cos(math.radians(sensor.sun)), math.sin(math.radians(sensor.sun))])
    shaded = _in_shade(sensor, towards, stations, cells)

    def spoil(points: Array, ground: Array, leaf: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
        out, found = points.copy(), np.ones(len(points), dtype=bool)
        up, flat = np.flatnonzero(leaf), np.flatnonzero(~leaf)
        at = points[up]
        station = cells.station_at(at[:, :2])
        known = station < len(stations.arc)
        chance = np.full(len(up), sensor.matched)
        near = station[known]
        sunny = (at[known, :2] - stations.xy[near]) @ towards / np.maximum(stations.half_width[near], 0.1)
        high = np.clip((at[known, 2] - ground[up][known]) / stations.top[near], 0, 1)
        chance[known] *= (0.35 + 0.65 * high**2) * (1 + 0.2 * np.clip(sunny, -1, 1))
        found[up] = clumps[0](at) > ndtri(1 - np.clip(chance, 0, 0.99))
        # A pixel is a little of what is beside it: corners are soft.
        out[up] += sensor.depth * np.column_stack([0.5 * clumps[1](at), 0.5 * clumps[2](at), clumps[3](at)])
        out[up, :2] += sensor.pull * towards
        dark = flat[shaded[cells.of(points[flat, :2])]]
        out[dark, 2] += sensor.shade * rough(points[dark])
        return out, found

    return spoil


def _in_shade(sensor: Matching, towards: Array, stations: Stations, cells: Cells) -> NDArray[np.bool_]:
    """Cells from which foliage stands before the sun."""
    foliage = cells.distance < np.append(stations.half_width, -1.0)[cells.nearest]
    top, bottom = (np.append(side, 0.0)[cells.nearest] for side in (stations.top, stations.bottom))
    shaded = foliage.copy()
    climb = math.tan(math.radians(sensor.elevation))
    for way in np.arange(STEP, top.max(initial=0.0) / climb, STEP):
        ahead = cells.of(cells.centres + way * towards)
        shaded |= foliage[ahead] & (bottom[ahead] < way * climb) & (way * climb < top[ahead])
    return shaded


def _clumps(rng: np.random.Generator, size: float) -> Callable[[Array], Array]:
    """Field of points (n, 3), normal with variance 1, alike within about ``size`` m."""
    field = gaussian_filter(rng.normal(size=LATTICE), 1.2, mode="wrap")
    field /= field.std()
    return lambda at: np.asarray(field[tuple((np.floor(at / (size / 3)).astype(int) % LATTICE).T)])
