"""Families that differ by how their vines are grown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from shapely.ops import substring

from vinemap.simulate.families.blocks import block, survey_of
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Sheet
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.yard import posts

if TYPE_CHECKING:
    from vinemap.simulate.survey import Survey

LONG_GAPS = {"gaps": (8, 8, 8, 8, 8, 17), "vine_spacing": 0.9}
BEFORE_FLOWERING = {"height": 1.3, "half_width": 0.15, "leafiness": 4.0}
CLOSE_PLANTED = {"height": 1.15, "half_width": 0.17, "bottom": 0.35}
FULL_CROWNS = {"height": 3.1, "bottom": 0.6, "vine_spacing": 1.8, "leafiness": 4.0, "gaps": (1, 2, 2)}
TALL = {"height": 3.1, "half_width": 0.35, "bottom": 0.8}
PLANTED_THIS_YEAR = {"height": 0.6, "half_width": 0.09, "bottom": 0.1, "leafiness": 20.0, "dead": 0.02, "gaps": (2, 3)}


def touching(rng: np.random.Generator) -> Survey:
    """Untrained shoots: canopies that leave a third of the spacing open at their widest, and less at places."""
    spacing = rng.uniform(1.9, 2.6)
    vines = {"height": 1.75, "half_width": spacing * rng.uniform(0.31, 0.35), "leafiness": 6.0, "gaps": (2, 3, 4)}
    return survey_of(rng, block(rng, n=10, spacing=spacing), canopy=vines)


def square(rng: np.random.Generator) -> Survey:
    """Bush vines as far apart along as across, some rows a vine or two shorter; rows are the longer lines."""
    azimuth, spacing, n = rng.uniform(0, 180), rng.uniform(1.5, 2.5), int(rng.integers(7, 10))
    crown = min(rng.uniform(0.9, 1.2), 0.7 * spacing)
    vines = n + rng.integers(5, 9)
    rows = rows_of(n, length=(vines - 1) * spacing + crown, spacing=spacing, azimuth=azimuth)
    short = rng.integers(0, 3, (n, 2)) * spacing
    lines = [shapely.LineString(row) for row in rows]
    cut = [substring(line, a, line.length - b) for line, (a, b) in zip(lines, short, strict=True)]
    rows = [np.array(line.coords) for line in cut]
    heads: dict[str, Any] = {"height": rng.uniform(0.9, 1.3), "half_width": crown / 2, "bottom": 0.2, "crown": crown}
    heads |= {"vine_spacing": spacing, "dead": 0.04, "gaps": (2, 2, 3)}
    stakes = posts(rows, every=2 * spacing, top=rng.uniform(1.2, 2.0), beyond=1.0)
    return survey_of(rng, rows, canopy=heads, obstacles=stakes, ragged=0)


def pergola(rng: np.random.Generator) -> Survey:
    """A closed roof of leaves, a little higher over the rows of its posts."""
    azimuth, spacing, height = rng.uniform(0, 180), rng.uniform(2.8, 4.0), rng.uniform(1.8, 2.2)
    rows = block(rng, n=rng.integers(5, 8), spacing=spacing, azimuth=azimuth, length=rng.uniform(25, 35))
    outline = shapely.MultiLineString(rows).convex_hull.buffer(spacing / 2, join_style="mitre")
    roof = Sheet(outline, height, caught=rng.uniform(0.7, 0.8))
    over_rows = {"height": height + 0.12, "bottom": height - 0.35, "half_width": rng.uniform(0.4, 0.6), "dead": 0.03}
    trunks = posts(rows, every=5, top=height + 0.1)
    return survey_of(rng, rows, canopy=over_rows, sheets=[roof], obstacles=trunks, ragged=0.3)


def strips(rng: np.random.Generator) -> Survey:
    """Strips of a cover crop half as high and twice as wide as the rows, in every alley or every other one."""
    n, spacing, azimuth, length = 8, rng.uniform(2.4, 2.9), rng.uniform(0, 180), rng.uniform(30, 40)
    vines = {"height": rng.uniform(1.7, 2.0), "half_width": rng.uniform(0.23, 0.28)}
    rows = rows_of(n, length=length, spacing=spacing, azimuth=azimuth)
    alleys = rows_of(n - 1, length=length, spacing=spacing, azimuth=azimuth)[:: rng.integers(1, 3)]
    crop = Vineyard("", alleys, vines["height"] / 2, 2 * vines["half_width"], bottom=0.0, dead=0.03)
    return survey_of(rng, rows, canopy=vines, beside=[crop])


def cover_crop(rng: np.random.Generator) -> Survey:
    """A cover crop of half a metre and more in every alley or every other one, seen by few points that half pass it."""
    n, spacing, azimuth, length = 8, rng.uniform(2.2, 2.6), rng.uniform(0, 180), rng.uniform(30, 40)
    rows = rows_of(n, length=length, spacing=spacing, azimuth=azimuth)
    alleys = rows_of(n - 1, length=length, spacing=spacing, azimuth=azimuth)[:: rng.integers(1, 3)]
    sown: dict[str, Any] = {"height": rng.uniform(0.5, 0.7), "half_width": rng.uniform(0.5, 0.7), "leafiness": 2.0}
    crop = Vineyard("", alleys, bottom=0.0, dead=0.03, **sown)
    return survey_of(rng, rows, beside=[crop], weeds=0.1, density=rng.uniform(80, 120))


def double(rng: np.random.Generator) -> Survey:
    """Geneva double curtain: two curtains hang about a metre apart over one line of trunks."""
    rows = block(rng, n=6, spacing=rng.uniform(3.6, 4.2))
    curtains = {"curtains": rng.uniform(0.9, 1.2), "height": rng.uniform(1.5, 1.8), "bottom": 0.8}
    return survey_of(rng, rows, canopy=curtains | {"half_width": rng.uniform(0.2, 0.3)}, obstacles=posts(rows, top=1.7))


def double_slim(rng: np.random.Generator) -> Survey:
    """Two slim curtains a third of the rows' spacing apart, or somewhat more, over posts that aren't seen."""
    spacing = rng.uniform(3.4, 4.2)
    curtains = {"curtains": spacing * rng.uniform(0.3, 0.4), "height": rng.uniform(1.5, 1.8), "bottom": 0.8}
    return survey_of(rng, block(rng, n=6, spacing=spacing), canopy=curtains | {"half_width": rng.uniform(0.13, 0.2)})


def sprawl(rng: np.random.Generator) -> Survey:
    """Untrained shoots 1.6 m wide, which all but touch in the alleys."""
    rows = block(rng, spacing=rng.uniform(2.2, 2.6), length=rng.uniform(30, 40))
    vines = {"height": rng.uniform(1.6, 1.9), "half_width": rng.uniform(0.76, 0.82), "leafiness": 6.0}
    return survey_of(rng, rows, canopy=vines | {"gaps": (2, 3)}, obstacles=posts(rows))


def net(rng: np.random.Generator) -> Survey:
    """A net above the vines that a third of the rays don't pass."""
    rows = block(rng, length=rng.uniform(28, 35), n=7)
    outline = shapely.MultiLineString(rows).convex_hull.buffer(1.0)
    sheet = Sheet(outline, rng.uniform(3.0, 3.4), depth=0.03, caught=rng.uniform(0.3, 0.4))
    return survey_of(rng, rows, sheets=[sheet], obstacles=posts(rows, top=sheet.height))
