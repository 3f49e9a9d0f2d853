"""Grounds that are made: noise, and what lies about in vineyards and on tracks, strewn at random."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from vinemap.compute.arrays import Ints, Values

    Shape = tuple[int, int]

RESOLUTION = 0.4
"""Millimetres in a pixel of a ground."""
SUBPIXEL = 3
"""Bits of fractions of a pixel at which corners are drawn."""


class Kind(NamedTuple):
    """Things that are strewn."""

    per_m2: float
    length_mm: tuple[float, float]
    """Least and most, small ones as often as their share of the logarithm."""
    breadth: tuple[float, float]
    """As a share of the length."""
    grey: tuple[float, float]
    """Mean and standard deviation in grey levels."""
    thick_mm: float
    """How far its shadow falls."""
    corners: Values
    """Outline (n, 2), ±1 for the size; each corner lies somewhat off it."""


STALK = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
CANE = np.array([(-1, -1), (-0.4, 2), (0.4, 2.5), (1, 0), (1, 2), (0.4, 4.5), (-0.4, 4), (-1, 1)], float)
"""Bent, and as thick all along."""


def _lobed(lobes: int, deep: float) -> Values:
    """Outline of a leaf, or of a rosette's leaves, with lobes as deep as a share of its size."""
    away = np.linspace(0, 2 * np.pi, 8 * lobes, endpoint=False)
    reach = 1 - deep + deep * np.abs(np.cos(lobes * away / 2))
    return np.column_stack([reach * np.cos(away), reach * np.sin(away)])


def noise(shape: tuple[int, ...], sigma: float, rng: np.random.Generator) -> Values:
    """Gaussian noise of unit variance, smooth, sigma in pixels."""
    import cv2

    values = np.asarray(cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), sigma))
    out: Values = (values - values.mean()) / values.std()
    return out


def _grains(layers: tuple[tuple[float, float, float], ...], shape: Shape, rng: np.random.Generator) -> Values:
    """Ground of noise: each layer's size of grain in mm, contrast in grey levels, and how sharp its edges are."""
    values = np.full(shape, 125.0, np.float32)
    for grain, contrast, edge in layers:
        values += contrast * np.tanh(edge * noise(shape, grain / RESOLUTION, rng)) / np.tanh(edge)
    return values


def _swell(shape: Shape, grain_mm: float, rng: np.random.Generator) -> Values:
    """Smooth noise of unit variance and large grain, made coarsely."""
    import cv2

    coarse = max(1, round(grain_mm / RESOLUTION / 4))
    values = noise((shape[0] // coarse + 3, shape[1] // coarse + 3), grain_mm / RESOLUTION / coarse, rng)
    size = values.shape[1] * coarse, values.shape[0] * coarse
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_CUBIC)[: shape[0], : shape[1]])


def _earth(shape: Shape, rng: np.random.Generator, *, grey: float, contrast: float) -> Values:
    """Crumbs of soil, lit from one side."""
    crumbs = noise(shape, 1.0 / RESOLUTION, rng) + 2.5 * _swell(shape, 4.0, rng)
    return np.asarray(grey + contrast * (_lit(crumbs) + 0.35 * noise(shape, 1.0, rng)), np.float32)


def _lit(heights: Values) -> Values:
    """Slopes towards the upper left, of unit variance."""
    slopes = np.zeros_like(heights)
    slopes[1:, 1:] = heights[1:, 1:] - heights[:-1, :-1]
    out: Values = slopes / slopes.std()
    return out


def _strewn(values: Values, kind: Kind, rng: np.random.Generator, *, along: Values | None = None) -> Values:
    """Ground with things on it, the later over the earlier, each with its shadow and its lit side.

    They lie any way, or about the directions in radians (ny, nx) of ``along``.
    """
    import cv2

    ny, nx = values.shape
    n = round(kind.per_m2 * values.size * (RESOLUTION / 1000) ** 2)
    at = rng.uniform(0, 1, (n, 2)) * [nx, ny]
    least, most = kind.length_mm
    lengths = least * (most / least) ** rng.uniform(0, 1, n) / RESOLUTION
    sizes = lengths[:, None] * np.column_stack([np.ones(n), rng.uniform(*kind.breadth, n)]) / 2
    turns = rng.uniform(0, 2 * np.pi, n)
    if along is not None:
        turns = along[at[:, 1].astype(int), at[:, 0].astype(int)] + rng.normal(0, 0.3, n)
    outlines = kind.corners * rng.uniform(0.9, 1.1, (n, len(kind.corners), 2))
    c, s = np.cos(turns), np.sin(turns)
    turned = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=1)
    bodies = (outlines * sizes[:, None]) @ turned
    thick = kind.thick_mm / RESOLUTION
    parts = [(bodies, thick, -60.0), (bodies, 0.0, 0.0), (0.6 * bodies, -0.15 * thick, 14.0)]
    drawn = [np.rint((part + at[:, None] + offset) * 2**SUBPIXEL).astype(np.int32) for part, offset, _ in parts]
    greys = rng.normal(*kind.grey, n)
    for i in range(n):
        for corners, (_, _, lighter) in zip(drawn, parts, strict=True):
            cv2.fillPoly(values, [corners[i]], float(greys[i] + lighter), cv2.LINE_8, SUBPIXEL)
    return np.asarray(cv2.GaussianBlur(values, (0, 0), 0.7))


def _cells(shape: Shape, across_mm: float, rng: np.random.Generator) -> tuple[Ints, Values]:
    """Which cell (ny, nx) of some across each pixel is of, and millimetres from there to the next cell."""
    import cv2

    coarse = 2
    small = shape[0] // coarse + 1, shape[1] // coarse + 1
    n = max(1, round(small[0] * small[1] * (coarse * RESOLUTION / across_mm) ** 2))
    seeds = np.full(small, 255, np.uint8)
    seeds[rng.integers(small[0], size=n), rng.integers(small[1], size=n)] = 0
    _, labels = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    edges = cv2.morphologyEx(labels.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0
    inside = cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 5) * coarse * RESOLUTION
    size = small[1] * coarse, small[0] * coarse
    whole = np.s_[: shape[0], : shape[1]]
    cells = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST))[whole]
    return cells.astype(np.int64), np.asarray(cv2.resize(inside, size, interpolation=cv2.INTER_LINEAR), np.float32)[
        whole
    ]


def _places(shape: Shape) -> tuple[Values, Values]:
    """Millimetres to the right (1, nx) and down (ny, 1)."""
    rows, columns = (RESOLUTION * np.arange(size, dtype=np.float32) for size in shape)
    return columns[None], rows[:, None]


def _straw(shape: Shape, rng: np.random.Generator) -> Values:
    stalks = Kind(8000, (40, 180), (0.014, 0.03), (165, 32), thick_mm=1.6, corners=STALK)
    return _strewn(_earth(shape, rng, grey=70, contrast=10), stalks, rng)


def _chips(shape: Shape, rng: np.random.Generator) -> Values:
    chips = Kind(8000, (8, 45), (0.25, 0.6), (135, 30), thick_mm=1.6, corners=STALK)
    return np.asarray(_strewn(_earth(shape, rng, grey=60, contrast=9), chips, rng) + 4 * noise(shape, 1.0, rng))


def _clay(shape: Shape, rng: np.random.Generator) -> Values:
    """Dry, its plates apart by cracks, curled up a little at their edges."""
    cells, inside = _cells(shape, 55.0, rng)
    plates = rng.normal(0, 7, int(cells.max()) + 1).astype(np.float32)[cells]
    width = 1.5 + 0.6 * _swell(shape, 15.0, rng)
    crack = 1 / (1 + np.exp(np.clip((inside - width) / 0.3, -20, 20)))
    curled = 9 * np.exp(-inside / 6)
    ground = np.asarray(155 + plates + curled + 5 * _swell(shape, 3.0, rng) + 4 * noise(shape, 1.2, rng))
    return np.asarray(ground * (1 - crack) + 45 * crack)


def _pebbles(shape: Shape, rng: np.random.Generator) -> Values:
    pebbles = Kind(9000, (5, 45), (0.6, 0.95), (130, 28), thick_mm=1.8, corners=_lobed(1, 0.0))
    return np.asarray(_strewn(_earth(shape, rng, grey=75, contrast=10), pebbles, rng) + 4 * noise(shape, 1.2, rng))


def _leaves(shape: Shape, rng: np.random.Generator) -> Values:
    leaves = Kind(420, (50, 110), (0.8, 1.05), (125, 38), thick_mm=3.0, corners=_lobed(5, 0.4))
    withered = 6 * np.abs(_swell(shape, 2.0, rng)) + 4 * noise(shape, 1.0, rng)
    return np.asarray(_strewn(_earth(shape, rng, grey=80, contrast=14), leaves, rng) + withered)


def _mown(shape: Shape, rng: np.random.Generator) -> Values:
    """Grass that lies in swaths."""
    blades = Kind(9000, (25, 90), (0.02, 0.05), (105, 24), thick_mm=1.2, corners=STALK)
    along = np.asarray(0.9 * _swell(shape, 90.0, rng))
    return _strewn(_earth(shape, rng, grey=60, contrast=9), blades, rng, along=along)


def _weeds(shape: Shape, rng: np.random.Generator) -> Values:
    """Bare soil, and here and there a rosette."""
    ground = _earth(shape, rng, grey=140, contrast=9)
    small = Kind(25, (10, 22), (0.5, 0.8), (85, 12), thick_mm=2.0, corners=_lobed(2, 0.6))
    rosettes = Kind(35, (30, 75), (0.8, 1.0), (75, 14), thick_mm=3.0, corners=_lobed(7, 0.8))
    return _strewn(_strewn(ground, rosettes, rng), small, rng)


def _tyres(shape: Shape, rng: np.random.Generator) -> Values:
    """The lugs of a tractor's tyres, pressed into moist soil along x."""
    x, y = _places(shape)
    lane = (y + 40 * _swell(shape, 250.0, rng)[:, :1] + 300) % 600 - 300
    across = np.clip((150 - np.abs(lane)) / 6, 0, 1)
    phase = 2 * np.pi * (x + 0.6 * np.abs(lane) + rng.uniform(0, 90)) / 90 + 0.25 * _swell(shape, 40.0, rng)
    lugs = across * np.tanh(4 * (np.cos(phase) - 0.2))
    crumbs = noise(shape, 1.0 / RESOLUTION, rng) + 2.5 * _swell(shape, 4.0, rng)
    ground = (
        105 + (10 - 6 * across) * _lit(crumbs) - 14 * lugs + 2 * noise(shape, 1.0, rng) + 5 * _swell(shape, 12, rng)
    )
    return np.asarray(ground + 6 * _lit(np.asarray(lugs + 0.01 * _swell(shape, 10.0, rng))))


def _wet(shape: Shape, rng: np.random.Generator) -> Values:
    """Dark soil that glistens, with puddles."""
    crumbs = _lit(np.asarray(noise(shape, 1.6 / RESOLUTION, rng) + 2 * _swell(shape, 6.0, rng)))
    soil = 70 + 9 * crumbs + 5 * _swell(shape, 20.0, rng)
    gleam = np.clip(crumbs - 1.9, 0, 1.2) * 120 * (_swell(shape, 25.0, rng) > -0.3)
    depth = _swell(shape, 35.0, rng) + 0.12 * _swell(shape, 5.0, rng)
    water = 1 / (1 + np.exp(-12 * (depth - 0.8)))
    mirrored = 165 + 14 * _swell(shape, 60.0, rng)
    return np.asarray((soil + gleam) * (1 - water) + mirrored * water)


def _sand(shape: Shape, rng: np.random.Generator) -> Values:
    """Ripples of wind, which fork now and then, on fine grains."""
    x, y = _places(shape)
    away = rng.uniform(0, 2 * np.pi)
    phase = 2 * np.pi * (x * np.cos(away) + y * np.sin(away)) / 60 + 2.2 * _swell(shape, 70.0, rng)
    crest = np.sin(phase + 0.5 * np.sin(phase)) * (1 + 0.3 * _swell(shape, 50.0, rng))
    return np.asarray(
        165 + 16 * crest + 5 * noise(shape, 0.5 / RESOLUTION, rng) + 3 * noise(shape, 1.2 / RESOLUTION, rng)
    )


def _snow(shape: Shape, rng: np.random.Generator) -> Values:
    """Faint, with crystals that sparkle."""
    crust = _lit(np.asarray(noise(shape, 2.0 / RESOLUTION, rng) + 4 * _swell(shape, 9.0, rng)))
    sparkle = 18 * (noise(shape, 0.8, rng) > 3.0)
    return np.asarray(215 + 4 * crust + 3 * _swell(shape, 40.0, rng) + sparkle)


def _paving(shape: Shape, rng: np.random.Generator) -> Values:
    """Stones of 200 × 100 mm in running bond, joints full of sand."""
    x, y = (place + rng.uniform(0, 204) for place in _places(shape))
    course = np.floor(y / 104)
    x = x + 102 * (course % 2) + rng.uniform(-2, 2, int(course.max()) + 1)[course.astype(int)]
    stone = np.floor(x / 204)
    edge = np.minimum(np.minimum(x % 204, 204 - x % 204), np.minimum(y % 104, 104 - y % 104) + 0 * x)
    joint = 1 / (1 + np.exp(np.clip((edge - 2.2 - 0.4 * _swell(shape, 8.0, rng)) / 0.35, -20, 20)))
    tones = rng.normal(0, 9, (int(course.max()) + 1, int(stone.max()) + 1))[course.astype(int), stone.astype(int)]
    faces = 145 + tones + 5 * noise(shape, 0.6 / RESOLUTION, rng) + 4 * _swell(shape, 5.0, rng)
    return np.asarray(faces * (1 - joint) + (70 + 8 * noise(shape, 1.0, rng)) * joint)


def _prunings(shape: Shape, rng: np.random.Generator) -> Values:
    """Canes on the earth that were cut in winter."""
    ground = _earth(shape, rng, grey=115, contrast=10)
    canes = Kind(60, (250, 700), (0.012, 0.018), (100, 22), thick_mm=4.0, corners=CANE)
    tendrils = Kind(120, (50, 120), (0.02, 0.04), (95, 18), thick_mm=1.5, corners=CANE)
    return _strewn(_strewn(ground, tendrils, rng), canes, rng)


def _furrows(shape: Shape, rng: np.random.Generator) -> Values:
    """Ploughed: clods of all sizes in furrows 300 mm apart, their far sides in the shade."""
    import cv2

    _, y = _places(shape)
    heights = 1.2 * _swell(shape, 14.0, rng) + 0.35 * noise(shape, 1.5 / RESOLUTION, rng)
    for across in (18.0, 45.0):
        cells, inside = _cells(shape, across, rng)
        sizes = rng.exponential(across / 8, int(cells.max()) + 1).astype(np.float32)
        heights += cv2.GaussianBlur(sizes[cells] * np.tanh(inside / across * 4), (0, 0), 3.0)
    furrow = np.cos(2 * np.pi * (y + 12 * _swell(shape, 80.0, rng)) / 300)
    return np.asarray(95 + 20 * np.tanh(0.7 * _lit(np.asarray(heights, np.float32))) + 12 * furrow + heights)


MADE: dict[str, Callable[[Shape, np.random.Generator], Values]] = {
    "soil": partial(_grains, ((0.5, 9, 1), (1.5, 12, 3), (4.0, 12, 2), (12.0, 8, 1))),
    "asphalt": partial(_grains, ((0.4, 6, 1), (0.8, 10, 4), (2.0, 16, 4))),
    "concrete": partial(_grains, ((0.4, 3, 1), (0.7, 5, 2), (4.0, 3, 1), (25.0, 4, 1))),
    "straw": _straw,
    "wood chips": _chips,
    "cracked clay": _clay,
    "pebbles": _pebbles,
    "leaves": _leaves,
    "mown grass": _mown,
    "weeds": _weeds,
    "tyre tracks": _tyres,
    "wet soil": _wet,
    "sand": _sand,
    "snow": _snow,
    "paving": _paving,
    "prunings": _prunings,
    "furrows": _furrows,
}
"""How grounds that have no photograph are made, (ny, nx) grey levels each."""
