"""Families where something stands among vines or beside them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from vinemap.simulate.families.blocks import polyline, survey_of
from vinemap.simulate.families.growing import PLANTED_THIS_YEAR
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle
from vinemap.simulate.scenes import rows_in, rows_of
from vinemap.simulate.terrain import PLACE
from vinemap.simulate.yard import place, posts, yard

if TYPE_CHECKING:
    from vinemap.simulate.survey import Survey
    from vinemap.simulate.terrain import Array


def clutter(rng: np.random.Generator) -> Survey:
    """Trees, a hut and a hedge around, and between the rows posts and a wire."""
    n, length, spacing, azimuth = 7, 45.0, rng.uniform(2.3, 2.8), rng.uniform(0, 180)
    side = n / 2 * spacing

    def at(along: float, across: float, size: tuple[float, float], top: float, **kind: Any) -> Obstacle:
        return Obstacle(*place(PLACE, azimuth, along, across), *size, top, azimuth=azimuth, **kind)

    lanes = (rng.integers(1, n - 1, 6) - n / 2) * spacing
    obstacles = [at(rng.uniform(-22, 22), lane, (0.05, 0.05), 2.2, solid=True) for lane in lanes[1:]]
    obstacles += [at(along, lanes[0], (0.5, 0.012), 1.62, bottom=1.6, solid=True) for along in range(-12, 12)]
    obstacles += [
        at(length / 2 + 4, rng.uniform(-side, side), (2.2, 1.9), 5.5, bottom=1.3),
        at(-length / 2 - 3.5, rng.uniform(-side, side), (1.6, 1.8), 4.0, bottom=0.8),
        at(rng.uniform(-15, 15), side + 3.5, (2.0, 1.6), 2.7, solid=True),
        at(rng.uniform(-10, 10), -side - 2.5, (5.0, 0.7), 1.7),
    ]
    return survey_of(rng, rows_of(n, length=length, spacing=spacing, azimuth=azimuth), obstacles=obstacles)


def none(rng: np.random.Generator) -> Survey:
    """A meadow in high grass with trees, bushes, a hedge and a hut."""
    x, y = np.add(PLACE, rng.uniform(-24, 24, (12, 2))).T
    crown, height = rng.uniform(0.6, 2.8, (10, 2)), rng.uniform(1, 8, 10)
    obstacles = [Obstacle(x[k], y[k], crown[k, 0], crown[k, 1], height[k], bottom=height[k] / 5) for k in range(10)]
    obstacles += [Obstacle(x[10], y[10], 6.0, 0.7, 1.8, azimuth=rng.uniform(0, 180))]
    obstacles += [Obstacle(x[11], y[11], 4.0, 3.0, 4.5, solid=True, azimuth=rng.uniform(0, 180))]
    outline = shapely.box(*np.add(PLACE, -30), *np.add(PLACE, 30))
    return survey_of(rng, [], canopy={"gaps": (), "outline": outline}, density=200.0, weeds=0.4, obstacles=obstacles)


def estate(rng: np.random.Generator) -> Survey:
    """Blocks of two directions at a track, two more across a road, some rows wide, some young; a yard and a hedge."""
    azimuth, track, road = rng.uniform(0, 180), rng.uniform(3, 5), rng.uniform(5, 7)
    slant, half = rng.uniform(-0.4, 0.4), 14.0

    def at(along: float, across: float) -> tuple[float, float]:
        return place(PLACE, azimuth, along, across)

    def row(across: float, start: float, end: float) -> Array:
        return polyline(azimuth, (start, across), (end, across))

    spacing, close = rng.uniform(1.8, 2.3), rng.uniform(1.65, 1.8)
    steps = [spacing] * 4 + [(spacing + close) / 2] + [close] * 3 + [(spacing + close) / 2] + [spacing] * 3
    across = np.cumsum([0, *steps]) - sum(steps) / 2
    main = [row(v, -half + slant * v, half) for v in across]
    north = across[-1] + 1
    far = [-half - track - 14.0 + slant * v for v in (-north, north)]
    near = [-half - track + slant * v for v in (-north, north)]
    west = shapely.Polygon([at(u, v) for u, v in zip([*far, *near[::-1]], [-north, north, north, -north], strict=True)])
    turn = azimuth + rng.choice([-1, 1]) * rng.uniform(12, 60)
    other = rows_in(west, spacing=rng.uniform(1.8, 2.4), azimuth=turn)
    east, end = half + road, half + road + rng.uniform(12, 15)
    old = [row(v, east, end) for v in np.arange(north, 1.5, -rng.uniform(1.8, 2.2))]
    young = [row(v, east, end) for v in np.arange(-1.5, -8, -rng.uniform(1.8, 2.2))]
    canopies: list[dict[str, Any]] = [
        {},
        {"half_width": close * rng.uniform(0.3, 0.34), "height": 1.7, "leafiness": 6.0, "gaps": (3,)},
        {},
        {"gaps": (2, 3)},
        {"gaps": (2,)},
        PLANTED_THIS_YEAR | {"height": rng.uniform(0.6, 1.0)},
    ]
    blocks = [main[:5], main[5:9], main[9:], other, old, young]
    trees = [Obstacle(*at(u, north + 4), 1.8, 1.6, 4.5, bottom=0.9) for u in rng.uniform(-half, east, 3)]
    border = row(-north - rng.uniform(2.5, 4), -half, half)
    hedge = Vineyard("", [border], rng.uniform(1.2, 2), rng.uniform(0.5, 0.8), bottom=0.0)
    trellis = posts([line for block in blocks for line in block])
    stand = [*yard(at(east, -11.5), azimuth, rng), *trees, *trellis]
    seen: dict[str, Any] = {"density": 200.0, "density_outside": 150.0, "surroundings": 7.0}
    slope = rng.uniform(0.02, 0.1)
    return survey_of(rng, *blocks, canopy=canopies, obstacles=stand, beside=[hedge], slope=slope, ragged=0.8, **seen)


def hedged(rng: np.random.Generator) -> Survey:
    """Rows of two heights, a hedge along them and one across their ends, fruit trees and a house among them."""
    azimuth, spacing, n = rng.uniform(0, 180), rng.uniform(2.2, 2.6), 10
    side = (n - 1) / 2 * spacing

    def at(along: float, across: float) -> tuple[float, float]:
        return place(PLACE, azimuth, along, across)

    def row(k: int) -> list[Array]:
        across = k * spacing - side
        if k not in (2, 3):
            return [polyline(azimuth, (-22, across), (22, across))]
        return [polyline(azimuth, (-22, across), (-6, across)), polyline(azimuth, (6, across), (22, across))]

    rows = [part for k in range(n) for part in row(k)]
    beside, beyond = side + rng.uniform(3.0, 3.6), 22 + rng.uniform(1.8, 3.0)
    along_them, across_them = ((-22, -beside), (22, -beside)), ((beyond, -side), (beyond, side))
    borders = [polyline(azimuth, *ends) for ends in (along_them, across_them)]
    hedges = Vineyard("", borders, rng.uniform(1.5, 3.0), rng.uniform(0.5, 0.8), bottom=0.0)
    house = Obstacle(*at(0.0, 2.5 * spacing - side), 4.0, 0.9 * spacing, 5.0, solid=True, azimuth=azimuth)
    lanes = (rng.choice(np.arange(5, n), 3, replace=False)) * spacing - side
    along, wide, tall = rng.uniform([-15, 1.0, 3.0], [15, 1.6, 4.5], (3, 3)).T
    trees = [Obstacle(*at(along[k], lanes[k]), wide[k], wide[k], tall[k], bottom=1.0) for k in range(3)]
    grown = [{}, {"height": rng.uniform(2.3, 2.6), "half_width": rng.uniform(0.4, 0.5)}]
    split = len(rows) - rng.integers(2, 4)
    blocks = rows[:split], rows[split:]
    return survey_of(rng, *blocks, canopy=grown, obstacles=[house, *trees], beside=[hedges], ragged=0.4)


def bushes(rng: np.random.Generator) -> Survey:
    """Bushes in no order: no rows."""
    x, y = np.add(PLACE, rng.uniform(-22, 22, (250, 2))).T
    sizes, tops = rng.uniform(0.4, 0.7, (250, 2)), rng.uniform(0.8, 1.6, 250)
    obstacles = [Obstacle(x[k], y[k], sizes[k, 0], sizes[k, 1], tops[k], bottom=0.2) for k in range(250)]
    outline = shapely.box(*np.add(PLACE, -25), *np.add(PLACE, 25))
    return survey_of(rng, [], canopy={"gaps": (), "outline": outline}, obstacles=obstacles, density=250.0)
