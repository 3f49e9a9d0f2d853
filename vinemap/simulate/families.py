"""Families of vineyards on which accuracy is measured: of each as many surveys as there are seeds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from scipy.interpolate import PchipInterpolator
from shapely.ops import substring

from vinemap.simulate.matching import Matching
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle, Sheet
from vinemap.simulate.scenes import rows_in, rows_of
from vinemap.simulate.survey import Survey, simulate
from vinemap.simulate.terrain import PLACE, hillside, terraced
from vinemap.simulate.yard import POSTS, place, posts, yard

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vinemap.simulate.terrain import Array, Terrain


def _touching(rng: np.random.Generator) -> Survey:
    """Untrained shoots: canopies that leave a third of the spacing open at their widest, and less at places."""
    spacing = rng.uniform(1.9, 2.6)
    vines = {"height": 1.75, "half_width": spacing * rng.uniform(0.31, 0.35), "leafiness": 6.0, "gaps": (2, 3, 4)}
    return _survey(rng, _block(rng, n=10, spacing=spacing), canopy=vines)


LONG_GAPS = {"gaps": (8, 8, 8, 8, 8, 17), "vine_spacing": 0.9}
BEFORE_FLOWERING = {"height": 1.3, "half_width": 0.15, "leafiness": 4.0}


def family(name: str, seed: int) -> Survey:
    """Survey of one of the ``FAMILIES``; slopes, directions, spacings, canopies and densities vary with the seed."""
    return FAMILIES[name](np.random.default_rng([seed, *name.encode()]))._replace(name=name)


def _block(rng: np.random.Generator, **shape: Any) -> list[Array]:
    """Rows as vineyards have them, of any direction, but for what is given."""
    usual: dict[str, Any] = {
        "n": rng.integers(6, 10),
        "length": rng.uniform(35, 55),
        "spacing": rng.uniform(2.2, 2.9),
        "azimuth": rng.uniform(0, 180),
    }
    return rows_of(**(usual | shape))


def _survey(
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


def _beyond(block: Sequence[Array], other: Sequence[Array], *, azimuth: float, track: float) -> list[Array]:
    """Move ``other`` towards an azimuth until a track of so many metres divides it from ``block``."""
    way = np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
    shift = (np.concatenate(list(block)) @ way).max() + track - (np.concatenate(list(other)) @ way).min()
    return [row + shift * way for row in other]


def _terraces(rng: np.random.Generator) -> Survey:
    azimuth = rng.uniform(0, 180)
    rows = _block(rng, n=9, spacing=1.8, azimuth=azimuth, radius=rng.choice([math.inf, 80.0]))
    slope = hillside(0.45, uphill=azimuth + 90, undulation=0.1, seed=int(rng.integers(1 << 31)))
    terrain = terraced(slope, rows, spacing=1.8, riser=rng.uniform(0.6, 0.8))
    return _survey(rng, rows, terrain=terrain, canopy={"half_width": rng.uniform(0.18, 0.25)})


def _two_blocks(rng: np.random.Generator) -> Survey:
    azimuth, spacing = rng.uniform(0, 180), rng.uniform(2.0, 2.4)
    one = _block(rng, azimuth=azimuth, spacing=spacing, length=35)
    other = _block(rng, azimuth=azimuth + rng.uniform(30, 150), spacing=spacing + rng.uniform(0.3, 0.7), length=35)
    return _survey(rng, one, _beyond(one, other, azimuth=rng.uniform(0, 360), track=5))


def _headland(rng: np.random.Generator) -> Survey:
    azimuth, spacing, n = rng.uniform(0, 180), rng.uniform(2.2, 2.9), rng.integers(6, 9)
    one, other = (_block(rng, n=n, azimuth=azimuth, spacing=spacing, length=rng.uniform(24, 32)) for _ in range(2))
    return _survey(rng, one, _beyond(one, other, azimuth=azimuth, track=6), ragged=0.3)


def _close(rng: np.random.Generator) -> Survey:
    """A row that starts 1.5 m from its neighbour, which makes room for it, as row 15 does beside row 14."""
    azimuth, spacing, length = rng.uniform(0, 180), rng.uniform(2.3, 2.8), 50.0
    rows = rows_of(7, length=length, spacing=spacing, azimuth=azimuth)
    left = np.array([-math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))])
    along = np.linspace(0, 1, len(rows[0]))
    start = rng.uniform(0.2, 0.5)
    rows[3] = rows[3] - PchipInterpolator([0, start, 1], [0, 0.5, 0])(along)[:, None] * left
    late = np.clip((along - start) / (1 - start), 0, 1)
    rows[4] = (rows[4] - ((spacing - 1.0) * (1 - late))[:, None] * left)[along >= start]
    return _survey(rng, rows, ragged=0.1)


def _clutter(rng: np.random.Generator) -> Survey:
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
    return _survey(rng, rows_of(n, length=length, spacing=spacing, azimuth=azimuth), obstacles=obstacles)


def _none(rng: np.random.Generator) -> Survey:
    """A meadow in high grass with trees, bushes, a hedge and a hut."""
    x, y = np.add(PLACE, rng.uniform(-24, 24, (12, 2))).T
    crown, height = rng.uniform(0.6, 2.8, (10, 2)), rng.uniform(1, 8, 10)
    obstacles = [Obstacle(x[k], y[k], crown[k, 0], crown[k, 1], height[k], bottom=height[k] / 5) for k in range(10)]
    obstacles += [Obstacle(x[10], y[10], 6.0, 0.7, 1.8, azimuth=rng.uniform(0, 180))]
    obstacles += [Obstacle(x[11], y[11], 4.0, 3.0, 4.5, solid=True, azimuth=rng.uniform(0, 180))]
    outline = shapely.box(*np.add(PLACE, -30), *np.add(PLACE, 30))
    return _survey(rng, [], canopy={"gaps": (), "outline": outline}, density=200.0, weeds=0.4, obstacles=obstacles)


def _square(rng: np.random.Generator) -> Survey:
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
    return _survey(rng, rows, canopy=heads, obstacles=stakes, ragged=0)


def _pergola(rng: np.random.Generator) -> Survey:
    """A closed roof of leaves, a little higher over the rows of its posts."""
    azimuth, spacing, height = rng.uniform(0, 180), rng.uniform(2.8, 4.0), rng.uniform(1.8, 2.2)
    rows = _block(rng, n=rng.integers(5, 8), spacing=spacing, azimuth=azimuth, length=rng.uniform(25, 35))
    outline = shapely.MultiLineString(rows).convex_hull.buffer(spacing / 2, join_style="mitre")
    roof = Sheet(outline, height, caught=rng.uniform(0.7, 0.8))
    over_rows = {"height": height + 0.12, "bottom": height - 0.35, "half_width": rng.uniform(0.4, 0.6), "dead": 0.03}
    trunks = posts(rows, every=5, top=height + 0.1)
    return _survey(rng, rows, canopy=over_rows, sheets=[roof], obstacles=trunks, ragged=0.3)


def _strips(rng: np.random.Generator) -> Survey:
    """Strips of a cover crop half as high and twice as wide as the rows, in every alley or every other one."""
    n, spacing, azimuth, length = 8, rng.uniform(2.4, 2.9), rng.uniform(0, 180), rng.uniform(30, 40)
    vines = {"height": rng.uniform(1.7, 2.0), "half_width": rng.uniform(0.23, 0.28)}
    rows = rows_of(n, length=length, spacing=spacing, azimuth=azimuth)
    alleys = rows_of(n - 1, length=length, spacing=spacing, azimuth=azimuth)[:: rng.integers(1, 3)]
    crop = Vineyard("", alleys, vines["height"] / 2, 2 * vines["half_width"], bottom=0.0, dead=0.03)
    return _survey(rng, rows, canopy=vines, beside=[crop])


def _double(rng: np.random.Generator) -> Survey:
    """Geneva double curtain: two curtains hang about a metre apart over one line of trunks."""
    rows = _block(rng, n=6, spacing=rng.uniform(3.6, 4.2))
    curtains = {"curtains": rng.uniform(0.9, 1.2), "height": rng.uniform(1.5, 1.8), "bottom": 0.8}
    return _survey(rng, rows, canopy=curtains | {"half_width": rng.uniform(0.2, 0.3)}, obstacles=posts(rows, top=1.7))


def _sprawl(rng: np.random.Generator) -> Survey:
    """Untrained shoots 1.6 m wide, which all but touch in the alleys."""
    rows = _block(rng, spacing=rng.uniform(2.2, 2.6), length=rng.uniform(30, 40))
    vines = {"height": rng.uniform(1.6, 1.9), "half_width": rng.uniform(0.76, 0.82), "leafiness": 6.0}
    return _survey(rng, rows, canopy=vines | {"gaps": (2, 3)}, obstacles=posts(rows))


def _net(rng: np.random.Generator) -> Survey:
    """A net above the vines that a third of the rays don't pass."""
    rows = _block(rng, length=rng.uniform(28, 35), n=7)
    outline = shapely.MultiLineString(rows).convex_hull.buffer(1.0)
    net = Sheet(outline, rng.uniform(3.0, 3.4), depth=0.03, caught=rng.uniform(0.3, 0.4))
    return _survey(rng, rows, sheets=[net], obstacles=posts(rows, top=net.height))


def _matched(rng: np.random.Generator, *, gaps: bool = False) -> Survey:
    """A good flight whose photographs are matched; with gaps, rows of which half is left, bare side by side too."""
    azimuth, sun = rng.uniform(0, 180), rng.uniform(0, 360)
    spacing, length = rng.uniform(2.2, 2.6), rng.uniform(34, 40)
    rows = _block(rng, n=9, azimuth=azimuth, spacing=spacing, length=length)
    flight = Matching(sun, rng.uniform(40, 60), pull=rng.uniform(0.0, 0.01), matched=rng.uniform(0.7, 0.85))
    vines: dict[str, Any] = {}
    if gaps:
        across = rng.choice([-1, 1]) * np.array([-rng.uniform(4, 10), 15.0])
        # Posts stand in it: between two of them it would be a track to anybody.
        beside = 0.0 if round(length / POSTS) % 2 == 0 else POSTS / 2
        bare = shapely.LineString([place(PLACE, azimuth, beside, end) for end in across])
        vines = {"bare": bare.buffer(rng.uniform(2, 3)), "gaps": rng.integers(3, 9, 2 * len(rows))}
    return _survey(rng, rows, canopy=vines, obstacles=posts(rows), sensor=flight, density=500.0, noise=0.012)


def _matched_poorly(rng: np.random.Generator) -> Survey:
    """A cheap flight in the wind: large pixels, low sun, long shade."""
    rows = _block(rng, n=8, length=rng.uniform(30, 40))
    flight = Matching(
        rng.uniform(0, 360),
        rng.uniform(28, 40),
        clump=rng.uniform(0.28, 0.38),
        depth=rng.uniform(0.06, 0.08),
        pull=rng.uniform(0.01, 0.04),
        matched=rng.uniform(0.55, 0.7),
        shade=rng.uniform(0.05, 0.09),
    )
    return _survey(rng, rows, obstacles=posts(rows), sensor=flight, density=500.0, noise=0.015)


def _estate(rng: np.random.Generator) -> Survey:
    """Blocks of two directions at a track, two more across a road, some rows wide, some young; a yard and a hedge."""
    azimuth, track, road = rng.uniform(0, 180), rng.uniform(3, 5), rng.uniform(5, 7)
    slant, half = rng.uniform(-0.4, 0.4), 14.0

    def at(along: float, across: float) -> tuple[float, float]:
        return place(PLACE, azimuth, along, across)

    def row(across: float, start: float, end: float) -> Array:
        return np.array(shapely.LineString([at(start, across), at(end, across)]).segmentize(0.25).coords)

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
    return _survey(rng, *blocks, canopy=canopies, obstacles=stand, beside=[hedge], slope=slope, ragged=0.8, **seen)


CLOSE_PLANTED = {"height": 1.15, "half_width": 0.17, "bottom": 0.35}
FULL_CROWNS = {"height": 3.1, "bottom": 0.6, "vine_spacing": 1.8, "leafiness": 4.0, "gaps": (1, 2, 2)}
TALL = {"height": 3.1, "half_width": 0.35, "bottom": 0.8}
PLANTED_THIS_YEAR = {"height": 0.6, "half_width": 0.09, "bottom": 0.1, "leafiness": 20.0, "dead": 0.02, "gaps": (2, 3)}
FAMILIES: dict[str, Callable[[np.random.Generator], Survey]] = {
    "straight": lambda rng: _survey(rng, _block(rng)),
    "curved": lambda rng: _survey(rng, _block(rng, radius=rng.choice([-40, 40]))),
    "fan": lambda rng: _survey(rng, _block(rng, fan=rng.uniform(5, 9))),
    "long-gaps": lambda rng: _survey(rng, _block(rng), canopy=LONG_GAPS),
    "dead": lambda rng: _survey(rng, _block(rng), canopy={"dead": 0.4, "gaps": ()}),
    "terraces": _terraces,
    "steep": lambda rng: _survey(rng, _block(rng), slope=0.45),
    "weeds": lambda rng: _survey(rng, _block(rng), weeds=0.5),
    "sparse": lambda rng: _survey(rng, _block(rng), density=rng.uniform(60, 150)),
    "thin": lambda rng: _survey(rng, _block(rng), canopy=BEFORE_FLOWERING),
    "two-blocks": _two_blocks,
    "wide": lambda rng: _survey(rng, _block(rng, spacing=3.5)),
    "short": lambda rng: _survey(rng, _block(rng, length=10), ragged=0.5),
    "single": lambda rng: _survey(rng, _block(rng, n=1)),
    "headland": _headland,
    "close": _close,
    "clutter": _clutter,
    "none": _none,
    "narrow": lambda rng: _survey(rng, _block(rng, n=16, spacing=rng.uniform(0.9, 1.2)), canopy=CLOSE_PLANTED),
    "broad": lambda rng: _survey(rng, _block(rng, n=6, spacing=rng.uniform(4.5, 6))),
    "touching": _touching,
    "tall": lambda rng: _survey(rng, _block(rng, spacing=3), canopy=TALL),
    "young": lambda rng: _survey(rng, _block(rng), canopy=PLANTED_THIS_YEAR, weeds=0.1, ragged=0.5),
    "square": _square,
    "pergola": _pergola,
    "estate": _estate,
    "strips": _strips,
    "double": _double,
    "full-crowns": lambda rng: _survey(
        rng,
        _block(rng, n=6, spacing=rng.uniform(4.0, 4.5), length=rng.uniform(30, 40)),
        canopy=FULL_CROWNS | {"half_width": rng.uniform(1.0, 1.2)},
    ),
    "sprawl": _sprawl,
    "net": _net,
    "matched": _matched,
    "matched-gaps": lambda rng: _matched(rng, gaps=True),
    "matched-poorly": _matched_poorly,
    "lidar": lambda rng: _survey(rng, _block(rng), weeds=0.1, density=rng.uniform(8, 14), density_outside=10.0),
}
"""Kinds of vineyards, none kinder than a real one: curved at 40 m radius, gaps of 8 vines and of 15 m, 40% of the vines
dead, terraces at 45% and 1.8 m apart, weeds to 0.5 m, 60–150 points a square metre, two blocks divided by a track,
bush vines in a square, a closed roof, canopies of 0.2 to 2.4 m, photographs that are matched poorly, …"""
