"""What stands about a vineyard and is no vine: posts of the trellis, and a yard's cars, pallets, hall and walls."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vinemap.geo.curve import at, way_along
from vinemap.simulate.rays import Obstacle

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.simulate.terrain import Array


Spot = tuple[float, float]
"""x and y, m."""
POSTS = 5.0
"""Metres between a row's posts."""


def place(centre: Spot, azimuth: float, along: float, across: float) -> Spot:
    """Point that lies so far along an azimuth (degrees anticlockwise from east) from a centre, and to its left."""
    cos, sin = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
    return centre[0] + along * cos - across * sin, centre[1] + along * sin + across * cos


def posts(rows: Sequence[Array], *, every: float = POSTS, top: float = 2.0, beyond: float = 0.0) -> list[Obstacle]:
    """Posts of 8 cm in rows, every so many metres; the outermost stand ``beyond`` m outside of the rows' ends."""
    spots = []
    for row in rows:
        length = way_along(row)[-1]
        ends = row[[0, -1]] + beyond * (row[[0, -1]] - row[[1, -2]]) / way_along(row)[1]
        spots += [*ends, *at(row, np.linspace(0, length, max(round(length / every), 1) + 1)[1:-1])]
    return [Obstacle(x, y, 0.04, 0.04, top, solid=True) for x, y in spots]


def yard(at: Spot, azimuth: float, rng: np.random.Generator) -> list[Obstacle]:
    """Parked cars from a spot towards an azimuth, to their right stacks of pallets and a hall, at the end a wall."""
    out = []
    apart = rng.uniform(2.4, 2.9)
    for k in range(rng.integers(4, 7)):
        height, half_length, askew = rng.uniform(1.4, 1.9), rng.uniform(1.9, 2.3), azimuth + 90 + rng.normal(0, 2)
        x, y = place(at, azimuth, k * apart, rng.normal(0, 0.2))
        out.append(Obstacle(x, y, half_length, 0.87, 0.6 * height, bottom=0.2, solid=True, azimuth=askew))
        x, y = place((x, y), askew, -0.15 * half_length, 0.0)
        out.append(Obstacle(x, y, 0.6 * half_length, 0.8, height, bottom=0.2, solid=True, azimuth=askew))
    apart = rng.uniform(1.3, 2.5)
    for k in range(rng.integers(3, 6)):
        x, y = place(at, azimuth, k * apart - 2, rng.normal(-3.5, 0.1))
        out.append(Obstacle(x, y, 0.6, 0.5, rng.uniform(0.6, 2.0), solid=True, azimuth=azimuth))
    half_length, half_width, eaves = rng.uniform(5, 7), rng.uniform(2, 3), 2.6
    x, y = place(at, azimuth, 9, -7)
    top = eaves + half_width / 2
    out.append(Obstacle(x, y, half_length, half_width, top, solid=True, azimuth=azimuth, eaves=eaves))
    x, y = place(at, azimuth, 16, 8.5)
    return [*out, Obstacle(x, y, 10, 0.15, rng.uniform(1.2, 2), solid=True, azimuth=azimuth + 90)]
