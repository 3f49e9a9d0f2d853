"""Families that differ by how their rows lie."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import shapely
from scipy.interpolate import PchipInterpolator

from vinemap.simulate.families.blocks import beyond, block, polyline, survey_of
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.terrain import PLACE, hillside, terraced
from vinemap.simulate.yard import place

if TYPE_CHECKING:
    from vinemap.simulate.survey import Survey
    from vinemap.simulate.terrain import Array


def terraces(rng: np.random.Generator) -> Survey:
    """Terraces at 45%, a row on each."""
    azimuth = rng.uniform(0, 180)
    rows = block(rng, n=9, spacing=1.8, azimuth=azimuth, radius=rng.choice([math.inf, 80.0]))
    slope = hillside(0.45, uphill=azimuth + 90, undulation=0.1, seed=int(rng.integers(1 << 31)))
    terrain = terraced(slope, rows, spacing=1.8, riser=rng.uniform(0.6, 0.8))
    return survey_of(rng, rows, terrain=terrain, canopy={"half_width": rng.uniform(0.18, 0.25)})


def two_blocks(rng: np.random.Generator) -> Survey:
    """Two blocks of unlike direction and spacing, divided by a track."""
    azimuth, spacing = rng.uniform(0, 180), rng.uniform(2.0, 2.4)
    one = block(rng, azimuth=azimuth, spacing=spacing, length=35)
    other = block(rng, azimuth=azimuth + rng.uniform(30, 150), spacing=spacing + rng.uniform(0.3, 0.7), length=35)
    return survey_of(rng, one, beyond(one, other, azimuth=rng.uniform(0, 360), track=5))


def headland(rng: np.random.Generator) -> Survey:
    """Two blocks of one direction, end to end, with a track or a headland between them."""
    azimuth, spacing, n = rng.uniform(0, 180), rng.uniform(2.2, 2.9), rng.integers(6, 9)
    one, other = (block(rng, n=n, azimuth=azimuth, spacing=spacing, length=rng.uniform(24, 32)) for _ in range(2))
    return survey_of(rng, one, beyond(one, other, azimuth=azimuth, track=rng.uniform(3.2, 6)), ragged=0.3)


def close(rng: np.random.Generator) -> Survey:
    """A row that starts 1.5 m from its neighbour, which makes room for it, as row 15 does beside row 14."""
    azimuth, spacing, length = rng.uniform(0, 180), rng.uniform(2.3, 2.8), 50.0
    rows = rows_of(7, length=length, spacing=spacing, azimuth=azimuth)
    left = np.array([-math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))])
    along = np.linspace(0, 1, len(rows[0]))
    start = rng.uniform(0.2, 0.5)
    rows[3] = rows[3] - PchipInterpolator([0, start, 1], [0, 0.5, 0])(along)[:, None] * left
    late = np.clip((along - start) / (1 - start), 0, 1)
    rows[4] = (rows[4] - ((spacing - 1.0) * (1 - late))[:, None] * left)[along >= start]
    return survey_of(rng, rows, ragged=0.1)


def contour(rng: np.random.Generator) -> Survey:
    """Rows along the contour lines of a slope with spurs and hollows, with bends of 8 m radius and wider."""
    azimuth, spacing, n = rng.uniform(0, 360), rng.uniform(2.0, 2.6), 8
    length, height = rng.uniform(40, 50), rng.uniform(2.0, 3.5)
    along = np.linspace(-0.55, 0.55, 225) * length
    # Offset rows bend tighter on the inside by half of the block's width.
    tightest = 8 + n / 2 * spacing
    wave = 2 * np.pi * max(np.sqrt(height * tightest), length / 7.5)
    middle = shapely.LineString(np.column_stack([along, height * np.sin(2 * np.pi * along / wave + rng.uniform(0, 6))]))
    rows = [middle.offset_curve((k + 0.5 - n / 2) * spacing).segmentize(0.25) for k in range(n)]
    lines = [shapely.get_coordinates(row) for row in rows]
    return survey_of(rng, [np.column_stack(place(PLACE, azimuth, *line.T)) for line in lines], slope=0.2)


def kinked(rng: np.random.Generator) -> Survey:
    """Rows that turn by 12–25° at one line, as along a road, and miss vines there as elsewhere."""
    azimuth, spacing, turn = rng.uniform(0, 180), rng.uniform(2.0, 2.6), math.radians(rng.uniform(12, 25))

    def row(across: float) -> Array:
        at = -across * math.tan(turn / 2)
        corners = [(-22.0, across), (at, across), (at + 22 * math.cos(turn), across + 22 * math.sin(turn))]
        return polyline(azimuth, *corners)

    return survey_of(rng, [row((k - 3.5) * spacing) for k in range(8)], ragged=0.5)
