"""Canopies on the globe: 3D Tiles 1.1 that place a parcel's glTF, and those of a survey that gather its parcels'.

References
----------
https://docs.ogc.org/cs/22-025r4/22-025r4.html
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import numpy as np
from pyproj import CRS

import vinemap
from vinemap.geo.crs import is_local, to_wgs84, transformer
from vinemap.geo.geoid import find_geoid
from vinemap.product.json_values import read_object

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike

    from vinemap.canopy.mesh import Mesh
    from vinemap.compute.arrays import Floats
    from vinemap.geo.geoid import Geoid

GEODETIC, GEOCENTRIC = CRS.from_epsg(4979), CRS.from_epsg(4978)
STEP = 10.0
"""Metres to both sides of a point over which derivatives are taken."""
PAD = 0.01
"""Metres by which a volume is larger than what it holds, whose vertices are rounded to millimetres."""
MOST_CHILDREN = 16
FRAME = np.eye(3)
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def to_globe(xyz: ArrayLike, crs: CRS, geoid: Geoid) -> Floats:
    """Earth-centred, earth-fixed coordinates (n, 3; EPSG:4978) of points (n, 3) in a projected CRS."""
    points = np.atleast_2d(np.asarray(xyz, dtype=float))
    lat, lon, alt = to_wgs84(points, crs).T
    return np.column_stack(transformer(GEODETIC, GEOCENTRIC).transform(lon, lat, alt + geoid.height(points)))


def placement(origin: ArrayLike, crs: CRS, geoid: Geoid) -> Floats:
    """Affine matrix (4, 4) from metres about a point of a projected CRS (east, north, up) to the globe.

    Its columns are the derivatives of :func:`to_globe`, so that the projection's grid convergence and scale, and the
    geoid's slope, are kept. The globe leaves it by d²/2R: 0.8 mm at 100 m, 2 cm at 500 m.
    """
    steps = STEP * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    points = to_globe(np.asarray(origin) + steps, crs, geoid)
    matrix = np.eye(4)
    matrix[:3, :3] = (points[1:4] - points[4:]).T / (2 * STEP)
    matrix[:3, 3] = points[0]
    return matrix


def parcel_tileset(
    meshes: Sequence[Mesh],
    content: str,
    *,
    origin: ArrayLike,
    crs: CRS,
    vertical: str | None,
    geoid: float | None = None,
) -> dict[str, Any] | None:
    """Describe a parcel's canopies as a tileset of one tile; None where there are none, or no place on the globe.

    Parameters
    ----------
    meshes : sequence of Mesh
        The canopies, in ``crs``.
    content : str
        Name of the file beside the tileset that :func:`vinemap.product.gltf.write_glb` made of them. It turns Z up to
        Y up, as glTF wants it; 3D Tiles turn that back, so that a tile's frame is east, north, up.
    origin : array_like of shape (3,)
        The file's.
    crs : CRS
        The horizontal, projected CRS.
    vertical, geoid : str, float, optional
        As for :func:`vinemap.geo.geoid.find_geoid`.
    """
    meshes = [mesh for mesh in meshes if len(mesh.faces)]
    if not meshes or is_local(crs):
        return None
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    ends = np.vstack([origin, vertices.min(axis=0), vertices.max(axis=0)])
    found = find_geoid(vertical, crs, ends, given=geoid)
    matrix = placement(origin, crs, found)
    local: Floats = vertices - np.asarray(origin)
    error = np.linalg.norm(_moved(local, matrix) - to_globe(vertices, crs, found), axis=1).max()
    box = _enclose(local)
    extras = {
        "generator": f"vinemap {vinemap.__version__}",
        "crs": crs.to_string(),
        "vertical": vertical,
        "geoid_m": round(float(found.height(np.atleast_2d(origin))[0]), 3),
        "geoid_source": found.source,
        "placement_error_m": math.ceil(error * 1000) / 1000,
    }
    return {
        "asset": {"version": "1.1", "extras": extras},
        "geometricError": _span(box),
        "root": {
            "transform": matrix.T.round(10).ravel().tolist(),
            "boundingVolume": {"box": box.ravel().tolist()},
            "geometricError": 0.0,
            "refine": "ADD",
            "content": {"uri": quote(content)},
        },
    }


def survey_tileset(tilesets: Sequence[Path]) -> dict[str, Any] | None:
    """Describe the canopies of a survey's parcels as a tileset of theirs; None where there are none.

    Parameters
    ----------
    tilesets : sequence of Path
        Tilesets of :func:`parcel_tileset`, each in a folder beside the survey's; those that can't be read are left out.
    """
    tiles = []
    for path in tilesets:
        try:
            root = read_object(path)["root"]
            box = np.array(root["boundingVolume"]["box"], dtype=float).reshape(4, 3)
            matrix = np.array(root["transform"], dtype=float).reshape(4, 4).T
        except (ValueError, KeyError, TypeError):
            continue
        uri = f"{quote(path.parent.name)}/{quote(path.name)}"
        tiles.append(_Tile(np.vstack([_moved(box[:1], matrix), box[1:] @ matrix[:3, :3].T]), uri))
    if not tiles:
        return None
    root = _gather(tiles) | {"refine": "ADD"}
    extras = {"generator": f"vinemap {vinemap.__version__}"}
    return {"asset": {"version": "1.1", "extras": extras}, "geometricError": root["geometricError"], "root": root}


class _Tile(NamedTuple):
    box: Floats
    """Centre and half axes (4, 3) on the globe."""
    uri: str


def _gather(tiles: Sequence[_Tile]) -> dict[str, Any]:
    """A tile of tiles; many are put together first by columns and rows of a grid."""
    axes = _east_north_up(np.mean([tile.box[0] for tile in tiles], axis=0))
    children: list[dict[str, Any]]
    if len(tiles) <= MOST_CHILDREN:
        children = [_node(tile.box) | {"content": {"uri": tile.uri}} for tile in tiles]
    else:
        n = math.isqrt(MOST_CHILDREN)
        cells = [cell for column in _split(tiles, n, axes[0]) for cell in _split(column, n, axes[1])]
        children = [_gather(cell) for cell in cells]
    boxes = np.reshape([child["boundingVolume"]["box"] for child in children], (-1, 4, 3))
    corners = boxes[:, :1] + CORNERS @ boxes[:, 1:]
    return _node(_enclose(corners.reshape(-1, 3), axes)) | {"children": children}


def _node(box: Floats) -> dict[str, Any]:
    return {"boundingVolume": {"box": box.round(4).ravel().tolist()}, "geometricError": _span(box)}


def _split(tiles: Sequence[_Tile], n: int, axis: Floats) -> list[list[_Tile]]:
    """Tiles in n parts of as many, one behind the other along an axis."""
    order = sorted(tiles, key=lambda tile: float(tile.box[0] @ axis))
    return [order[len(order) * k // n : len(order) * (k + 1) // n] for k in range(n)]


def _moved(points: Floats, matrix: Floats) -> Floats:
    moved: Floats = points @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def _enclose(points: Floats, axes: Floats = FRAME) -> Floats:
    """Centre and half axes (4, 3) of the box along three axes, in rows, around points (n, 3)."""
    along = points @ axes.T
    low, high = along.min(axis=0) - PAD, along.max(axis=0) + PAD
    return np.vstack([(low + high) / 2 @ axes, (high - low)[:, None] / 2 * axes]).round(4)


def _east_north_up(point: Floats) -> Floats:
    """Axes (3, 3), in rows, of the topocentric frame at a point on the globe."""
    lon, lat, _ = transformer(GEOCENTRIC, GEODETIC).transform(point[0], point[1], point[2], radians=True)
    east = [-math.sin(lon), math.cos(lon), 0.0]
    up = [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)]
    return np.array([east, np.cross(up, east), up])


def _span(box: Floats) -> float:
    """Metres across a box."""
    return round(2 * float(np.linalg.norm(box[1:])), 1)
