"""All families by their names."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.simulate.families.blocks import block, survey_of
from vinemap.simulate.families.flown import matched, matched_poorly
from vinemap.simulate.families.growing import (
    BEFORE_FLOWERING,
    CLOSE_PLANTED,
    FULL_CROWNS,
    LONG_GAPS,
    PLANTED_THIS_YEAR,
    TALL,
    cover_crop,
    double,
    double_slim,
    net,
    pergola,
    sprawl,
    square,
    strips,
    touching,
)
from vinemap.simulate.families.lying import close, contour, headland, kinked, terraces, two_blocks
from vinemap.simulate.families.standing import bushes, clutter, estate, hedged, none

if TYPE_CHECKING:
    from collections.abc import Callable

    from vinemap.simulate.survey import Survey


def family(name: str, seed: int) -> Survey:
    """Survey of one of the ``FAMILIES``; slopes, directions, spacings, canopies and densities vary with the seed."""
    return FAMILIES[name](np.random.default_rng([seed, *name.encode()]))._replace(name=name)


FAMILIES: dict[str, Callable[[np.random.Generator], Survey]] = {
    "straight": lambda rng: survey_of(rng, block(rng)),
    "curved": lambda rng: survey_of(rng, block(rng, radius=rng.choice([-40, 40]))),
    "fan": lambda rng: survey_of(rng, block(rng, fan=rng.uniform(5, 9))),
    "long-gaps": lambda rng: survey_of(rng, block(rng), canopy=LONG_GAPS),
    "dead": lambda rng: survey_of(rng, block(rng), canopy={"dead": 0.4, "gaps": ()}),
    "terraces": terraces,
    "steep": lambda rng: survey_of(rng, block(rng), slope=0.45),
    "weeds": lambda rng: survey_of(rng, block(rng), weeds=0.5),
    "sparse": lambda rng: survey_of(rng, block(rng), density=rng.uniform(60, 150)),
    "thin": lambda rng: survey_of(rng, block(rng), canopy=BEFORE_FLOWERING),
    "two-blocks": two_blocks,
    "wide": lambda rng: survey_of(rng, block(rng, spacing=3.5)),
    "short": lambda rng: survey_of(rng, block(rng, length=10), ragged=0.5),
    "single": lambda rng: survey_of(rng, block(rng, n=1)),
    "headland": headland,
    "close": close,
    "contour": contour,
    "kinked": kinked,
    "clutter": clutter,
    "hedged": hedged,
    "none": none,
    "bushes": bushes,
    "narrow": lambda rng: survey_of(rng, block(rng, n=16, spacing=rng.uniform(0.9, 1.2)), canopy=CLOSE_PLANTED),
    "broad": lambda rng: survey_of(rng, block(rng, n=6, spacing=rng.uniform(4.5, 6))),
    "touching": touching,
    "tall": lambda rng: survey_of(rng, block(rng, spacing=3), canopy=TALL),
    "young": lambda rng: survey_of(rng, block(rng), canopy=PLANTED_THIS_YEAR, weeds=0.1, ragged=0.5),
    "square": square,
    "pergola": pergola,
    "estate": estate,
    "strips": strips,
    "cover-crop": cover_crop,
    "double": double,
    "double-slim": double_slim,
    "full-crowns": lambda rng: survey_of(
        rng,
        block(rng, n=6, spacing=rng.uniform(4.0, 4.5), length=rng.uniform(30, 40)),
        canopy=FULL_CROWNS | {"half_width": rng.uniform(1.0, 1.2)},
    ),
    "sprawl": sprawl,
    "net": net,
    "matched": matched,
    "matched-gaps": lambda rng: matched(rng, gaps=True),
    "matched-poorly": matched_poorly,
    "lidar": lambda rng: survey_of(rng, block(rng), weeds=0.1, density=rng.uniform(8, 14), density_outside=10.0),
}
"""Kinds of vineyards, none kinder than a real one: curved at 40 m radius, gaps of 8 vines and of 15 m, 40% of the vines
dead, terraces at 45% and 1.8 m apart, weeds to 0.5 m, 60–150 points a square metre, two blocks divided by a track,
bush vines in a square, a closed roof, canopies of 0.2 to 2.4 m, photographs that are matched poorly, …"""
