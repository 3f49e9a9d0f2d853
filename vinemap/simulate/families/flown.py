"""Families whose photographs are matched."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from vinemap.simulate.families.blocks import block, survey_of
from vinemap.simulate.matching import Matching
from vinemap.simulate.terrain import PLACE
from vinemap.simulate.yard import POSTS, place, posts

if TYPE_CHECKING:
    from vinemap.simulate.survey import Survey


def matched(rng: np.random.Generator, *, gaps: bool = False) -> Survey:
    """A good flight whose photographs are matched; with gaps, rows of which half is left, bare side by side too."""
    azimuth, sun = rng.uniform(0, 180), rng.uniform(0, 360)
    spacing, length = rng.uniform(2.2, 2.6), rng.uniform(34, 40)
    rows = block(rng, n=9, azimuth=azimuth, spacing=spacing, length=length)
    flight = Matching(sun, rng.uniform(40, 60), pull=rng.uniform(0.0, 0.01), matched=rng.uniform(0.7, 0.85))
    vines: dict[str, Any] = {}
    if gaps:
        across = rng.choice([-1, 1]) * np.array([-rng.uniform(4, 10), 15.0])
        # Posts stand in it: between two of them it would be a track to anybody.
        beside = 0.0 if round(length / POSTS) % 2 == 0 else POSTS / 2
        bare = shapely.LineString([place(PLACE, azimuth, beside, end) for end in across])
        vines = {"bare": bare.buffer(rng.uniform(2, 3)), "gaps": rng.integers(3, 9, 2 * len(rows))}
    return survey_of(rng, rows, canopy=vines, obstacles=posts(rows), sensor=flight, density=500.0, noise=0.012)


def matched_poorly(rng: np.random.Generator) -> Survey:
    """A cheap flight in the wind: large pixels, low sun, long shade."""
    rows = block(rng, n=8, length=rng.uniform(30, 40))
    flight = Matching(
        rng.uniform(0, 360),
        rng.uniform(28, 40),
        clump=rng.uniform(0.28, 0.38),
        depth=rng.uniform(0.06, 0.08),
        pull=rng.uniform(0.01, 0.04),
        matched=rng.uniform(0.55, 0.7),
        shade=rng.uniform(0.05, 0.09),
    )
    return survey_of(rng, rows, obstacles=posts(rows), sensor=flight, density=500.0, noise=0.015)
