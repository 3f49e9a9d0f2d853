"""Scenes to simulate: shapes of rows and ground, the example survey, and the families on which accuracy is measured."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from scipy.interpolate import PchipInterpolator
from scipy.linalg import block_diag
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial import cKDTree
from shapely.ops import substring

from vinemap.geo.crs import Origin, from_wgs84, main_to_wgs84, parse_crs
from vinemap.simulate.survey import Obstacle, Survey, Vineyard, simulate, waves

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vinemap.simulate.survey import Array, Terrain

PLACE = (414750.0, 4940780.0)
"""Where scenes lie unless told otherwise: in Barolo, EPSG:32632."""
TABLE_2_1 = Path(__file__).parents[2] / "data" / "table_2_1.csv"
TABLE_2_1_ORIGIN = Origin(44.611669149, 7.924423195, 428.735)
ROW_14_BEND = 0.6
"""How far row 14 keeps off its chord (m): row 15's start lies 0.9 m off that chord, and the rows 1.5 m apart."""


def rows_of(
    n: int = 8,
    *,
    length: float = 40.0,
    spacing: float = 2.5,
    azimuth: float = 0.0,
    radius: float = math.inf,
    fan: float = 0.0,
    centre: tuple[float, float] = PLACE,
) -> list[Array]:
    """Rows side by side: parallel, fanned, or on concentric arcs.

    Parameters
    ----------
    n, length, spacing : int, float, float
        Number of rows, length of the middle one and distance between them (m).
    azimuth : float
        Direction of the rows, degrees anticlockwise from east. Rows are numbered towards its left.
    radius : float
        Of the middle row (m); positive bends to the left. Rows on arcs subtend the same angle.
    fan : float
        Angle between the first and the last row (degrees), each turned about its middle.
    centre : tuple
        Middle of the block, x and y (m).

    Returns
    -------
    list of array (m, 2)
    """
    u = np.linspace(-length / 2, length / 2, int(length / 0.25) + 2)
    rows = []
    for i in range(n):
        v = (i - (n - 1) / 2) * spacing
        if math.isfinite(radius):
            along, across = (radius - v) * np.sin(u / radius), radius - (radius - v) * np.cos(u / radius)
        else:
            turn = math.radians(fan) * (i / max(n - 1, 1) - 0.5)
            along, across = u * math.cos(turn), v + u * math.sin(turn)
        cos, sin = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        rows.append(np.column_stack([centre[0] + along * cos - across * sin, centre[1] + along * sin + across * cos]))
    return rows


def hillside(
    slope: float = 0.1,
    *,
    uphill: float = 90.0,
    undulation: float = 0.1,
    elevation: float = 300.0,
    centre: tuple[float, float] = PLACE,
    seed: int = 0,
) -> Terrain:
    """Plane of ``slope`` (rise over run) that rises towards ``uphill`` (degrees anticlockwise from east).

    ``undulation`` is the standard deviation (m) of waves of about 25 m on it, ``elevation`` its height at ``centre``.
    """
    bumps = waves(np.random.default_rng(seed), 25.0)
    dx, dy = slope * math.cos(math.radians(uphill)), slope * math.sin(math.radians(uphill))
    return lambda x, y: elevation + dx * (x - centre[0]) + dy * (y - centre[1]) + undulation * bumps(x, y)


def terraced(terrain: Terrain, rows: Sequence[Array], *, spacing: float = 2.5, riser: float = 0.8) -> Terrain:
    """Cut a slope into treads, level across each row, and risers ``riser`` m wide half way between rows."""
    points = np.concatenate(rows)
    tangents = np.concatenate([np.gradient(row, axis=0) for row in rows])
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]]) / np.linalg.norm(tangents, axis=1, keepdims=True)
    tree = cKDTree(points)

    def surface(x: Array, y: Array) -> Array:
        xy = np.column_stack([np.ravel(x), np.ravel(y)])
        nearest = tree.query(xy)[1]
        across = np.sum((xy - points[nearest]) * normals[nearest], axis=1)
        edge = np.clip((np.abs(across) - (spacing - riser) / 2) / (riser / 2), 0, 1)
        cut = np.minimum(np.abs(across), spacing / 2) * (1 - edge**2 * (3 - 2 * edge)) * np.sign(across)
        foot = xy - cut[:, None] * normals[nearest]
        return terrain(foot[:, 0], foot[:, 1]).reshape(np.shape(x))

    return surface


def surface_through(
    means: Sequence[tuple[Array, float]], base: Terrain, *, cell: float = 1.5, margin: float = 50.0
) -> Terrain:
    """Bend ``base`` as little as possible (thin plate) until its mean over each set of points is as given.

    Parameters
    ----------
    means : sequence of (array (k, 2), float)
        Points and the mean elevation over them (m); a single point fixes the surface there.
    base : callable
        Surface to start from.
    cell, margin : float
        The surface is held on a grid of this cell (m), wider than the points by ``margin`` (m) all round.
    """
    points = np.concatenate([xy for xy, _ in means])
    origin, upper = points.min(axis=0) - margin, points.max(axis=0) + margin
    averaging = block_diag(*[np.full((1, len(xy)), 1 / len(xy)) for xy, _ in means])

    def kernel(a: Array) -> Array:
        squared = np.sum((a[:, None] - points[None]) ** 2, axis=-1)
        return np.asarray(squared * np.log(np.maximum(squared, 1e-12)))

    def plane(a: Array) -> Array:
        return np.column_stack([np.ones(len(a)), (a - origin) / 100])

    wanted = np.array([z for _, z in means]) - averaging @ base(*points.T)
    flat = averaging @ plane(points)
    system = np.block([[averaging @ kernel(points) @ averaging.T, flat], [flat.T, np.zeros((3, 3))]])
    weights = np.linalg.solve(system, np.concatenate([wanted, np.zeros(3)]))
    nx, ny = np.ceil((upper - origin) / cell).astype(int) + 1
    nodes = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), axis=-1).reshape(-1, 2) * cell + origin
    bend = [kernel(part) @ (averaging.T @ weights[:-3]) for part in np.array_split(nodes, len(nodes) // 1000 + 1)]
    grid = np.concatenate(bend) + plane(nodes) @ weights[-3:] + base(*nodes.T)
    spline = spline_filter(grid.reshape(nx, ny), order=3, mode="nearest")

    def surface(x: Array, y: Array) -> Array:
        at = np.stack([(x - origin[0]) / cell, (y - origin[1]) / cell])
        return np.asarray(map_coordinates(spline, at, order=3, mode="nearest", prefilter=False))

    return surface


def barolo(*, density: float = 380.0, density_outside: float = 60.0, seed: int = 1, table: Path = TABLE_2_1) -> Survey:
    """Survey of three parcels in Barolo, EPSG:32632: Table 2.1's parcel F, a contour vineyard, two blocks.

    F's rows end where the thesis's do and keep its mean elevations; the rest of the hillside is made up.

    Parameters
    ----------
    density, density_outside : float
        Rays a square metre inside parcels and outside.
    table : path
        Table 2.1 as CSV.
    """
    data = np.genfromtxt(table, delimiter=",", names=True)
    crs = parse_crs("EPSG:32632")
    main = [np.column_stack([data[f"{axis}{end}"] for axis in "xyz"]) for end in ("1", "n_corrected")]
    e1, en = (from_wgs84(main_to_wgs84(end, TABLE_2_1_ORIGIN), crs) for end in main)
    along = np.linspace(0, 1, 61)[:, None]
    rows = [first + (last - first) * along for first, last in zip(e1[:, :2], en[:, :2], strict=True)]
    chord = en[13, :2] - e1[13, :2]
    length = float(np.linalg.norm(chord))
    nearest = (e1[14, :2] - e1[13, :2]) @ chord / length**2
    bend = PchipInterpolator([0, nearest, 1], [0, -ROW_14_BEND, 0])(np.linspace(0, 1, 241))[:, None]
    rows[13] = e1[13, :2] + chord * np.linspace(0, 1, 241)[:, None] + bend * np.array([-chord[1], chord[0]]) / length

    curved = rows_of(10, length=60, radius=50, azimuth=20, centre=(414865, 4940773))
    blocks = rows_of(8, length=40, spacing=2.4, azimuth=-80, centre=(414764, 4940736))
    blocks += rows_of(9, length=35, spacing=2.8, azimuth=-35, centre=(414800, 4940733))
    # {Main} is a tangent plane: what lies 0.4 km from its origin stands 1 cm higher above the ellipsoid.
    lift = np.mean([e1[:, 2] - main[0][:, 2], en[:, 2] - main[1][:, 2]], axis=0)
    means = [(end[None, :2], float(end[2])) for end in np.concatenate([e1, en])]
    means += [(row, float(z)) for row, z in zip(rows, data["elevation_as_printed_m"] + lift, strict=True)]
    contours = np.concatenate([row[::24] for row in curved[::3]])
    apex = np.array([414865 - 50 * math.sin(math.radians(20)), 4940773 + 50 * math.cos(math.radians(20))])
    up = 474 + 0.25 * (50 - np.linalg.norm(contours - apex, axis=1)) + 0.03 * (contours[:, 0] - 414865)
    means += [(xy[None], float(z)) for xy, z in zip(contours, up, strict=True)]
    terrain = surface_through(means, hillside(0.15, uphill=100, undulation=0.06, elevation=467, seed=seed))
    return simulate(
        [
            Vineyard("F", rows, gaps=(2, 3, 3, 4, 5)),
            Vineyard("curved", curved, height=1.85, half_width=0.25, gaps=(2, 3, 4, 5)),
            Vineyard("blocks", blocks, height=2.0, half_width=0.3, dead=0.04, gaps=(2, 3, 5)),
        ],
        terrain,
        name="barolo",
        density=density,
        density_outside=density_outside,
        obstacles=[
            Obstacle(414784, 4940725, 2.2, 2.0, 5.2, bottom=1.4),
            Obstacle(414783, 4940750, 2.0, 1.6, 2.7, solid=True),
        ],
        seed=seed,
    )


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
    canopy: dict[str, Any] | None = None,
    slope: float | None = None,
    terrain: Terrain | None = None,
    ragged: float = 1.2,
    **options: Any,
) -> Survey:
    """Survey blocks, a parcel each, whose rows end up to ``ragged`` m early; what isn't given is as it often is."""
    vines: dict[str, Any] = {
        "height": rng.uniform(1.6, 2.1),
        "half_width": rng.uniform(0.2, 0.32),
        "vine_spacing": rng.uniform(0.8, 1.1),
        "gaps": (2, 3, 4, 5),
    }
    vines |= canopy or {}
    lines = [[shapely.LineString(row) for row in block] for block in blocks]
    cut = [[substring(line, *rng.uniform(0, ragged, 2) * (1, -1)) for line in block] for block in lines]
    vineyards = [Vineyard(chr(65 + k), [np.array(c.coords) for c in block], **vines) for k, block in enumerate(cut)]
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
    cos, sin = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
    side = n / 2 * spacing

    def at(along: float, across: float, size: tuple[float, float], top: float, **kind: Any) -> Obstacle:
        x, y = PLACE[0] + along * cos - across * sin, PLACE[1] + along * sin + across * cos
        return Obstacle(x, y, *size, top, azimuth=azimuth, **kind)

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


LONG_GAPS = {"gaps": (8, 8, 8, 8, 8, 17), "vine_spacing": 0.9}
BEFORE_FLOWERING = {"height": 1.3, "half_width": 0.15, "leafiness": 4.0}
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
}
"""Kinds of vineyards, none kinder than a real one: curved at 40 m radius, gaps of 8 vines and of 15 m, 40% of the vines
dead, terraces at 45% and 1.8 m apart, weeds to 0.5 m, 60–150 points a square metre, two blocks divided by a track, …"""
