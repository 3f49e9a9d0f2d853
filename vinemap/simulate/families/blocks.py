"""Blocks of rows, and surveys of them that are as they often are but for what a family gives."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from shapely.ops import substring

from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import Survey, simulate
from vinemap.simulate.terrain import PLACE, hillside
from vinemap.simulate.yard import place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.simulate.terrain import Array, Terrain


def block(rng: np.random.Generator, **shape: Any) -> list[Array]:
    """Rows as vineyards have them, of any direction, but for what is given."""
    usual: dict[str, Any] = {
        "n": rng.integers(6, 10),
        "length": rng.uniform(35, 55),
        "spacing": rng.uniform(2.2, 2.9),
        "azimuth": rng.uniform(0, 180),
    }
    return rows_of(**(usual | shape))


def survey_of(
    rng: np.random.Generator,
    *blocks: Sequence[Array],
    canopy: dict[str, Any] | Sequence[dict[str, Any]] | None = None,
    slope: float | None = None,
    terrain: Terrain | None = None,
    ragged: float = 1.2,
    **options: Any,
) -> Survey:
    """Survey blocks, a parcel each, whose rows end up to ``ragged`` m early; what isn't given is as it often is.

    ``canopy`` is that of all blocks, or one for each.
    """
    vines: dict[str, Any] = {
        "height": rng.uniform(1.6, 2.1),
        "half_width": rng.uniform(0.2, 0.32),
        "vine_spacing": rng.uniform(0.8, 1.1),
        "gaps": (2, 3, 4, 5),
    }
    own = [canopy or {}] * len(blocks) if canopy is None or isinstance(canopy, dict) else canopy
    lines: list[list[Any]] = [[shapely.LineString(row) for row in block] for block in blocks]
    if ragged:
        lines = [[substring(line, *rng.uniform(0, ragged, 2) * (1, -1)) for line in block] for block in lines]
    vineyards = [
        Vineyard(chr(65 + k), [np.array(c.coords) for c in block], **(vines | its))
        for k, (block, its) in enumerate(zip(lines, own, strict=True))
    ]
    steepness = rng.uniform(0.03, 0.3) if slope is None else slope
    hill = hillside(
        steepness, uphill=rng.uniform(0, 360), undulation=rng.uniform(0.05, 0.2), seed=int(rng.integers(1 << 31))
    )
    usual: dict[str, Any] = {
        "density": rng.uniform(200, 450),
        "weeds": rng.uniform(0.1, 0.25),
        "noise": rng.uniform(0.02, 0.03),
        "seed": int(rng.integers(1 << 31)),
    }
    return simulate(vineyards, terrain or hill, **(usual | options))


def beyond(block: Sequence[Array], other: Sequence[Array], *, azimuth: float, track: float) -> list[Array]:
    """Move ``other`` towards an azimuth until a track of so many metres divides it from ``block``."""
    way = np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
    shift = (np.concatenate(list(block)) @ way).max() + track - (np.concatenate(list(other)) @ way).min()
    return [row + shift * way for row in other]


def polyline(azimuth: float, *corners: tuple[float, float]) -> Array:
    """Row through corners, metres along an azimuth from the middle of the place and to its left, in steps of 0.25 m."""
    return np.array(shapely.LineString([place(PLACE, azimuth, *at) for at in corners]).segmentize(0.25).coords)
