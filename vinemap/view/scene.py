"""What is shown of products: points, rows and meshes about one origin, in colours."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pyogrio
import rasterio
import shapely
from pyogrio.errors import DataLayerError, DataSourceError
from rasterio.errors import RasterioIOError

from vinemap import naming, paths
from vinemap.cloud.las import read_cloud
from vinemap.errors import InputError
from vinemap.product.gltf import read_glb
from vinemap.product.seasons.products import products_of, read_record

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Floats, Ints

MOST = 2_000_000
"""Points that are shown; of more, one in so many."""
SOIL, LEAVES = (0.45, 0.37, 0.28), (0.62, 0.72, 0.36)
"""RGB of points on the ground and at the height of vines; what is between is mixed."""
TALL = 2.0
"""Metres above ground from which points are as the leaves are."""
AROUND = 2.0
"""Metres about a parcel within which points are shown."""
LIFT = 0.15
"""Metres by which rows are lifted off the ground that they lie on."""


class Scene(NamedTuple):
    """Parcels about one origin: x east, y north, z up, m."""

    points: Floats
    """(n, 3)."""
    colours: Floats
    """RGB (n, 3) of the points, 0 to 1."""
    rows: list[Floats]
    """Vertices (k, 3) of each row."""
    vertices: Floats
    """(m, 3) of the meshes."""
    faces: Ints
    """(f, 3)."""


def scene_of(products: Sequence[Path], cloud: Path | None = None, *, most: int = MOST) -> Scene:
    """What is shown of products.

    Parameters
    ----------
    products : sequence of Path
        Their folders or GeoPackages, or a survey's folder: all of its parcels. All must be in one CRS.
    cloud : Path, optional
        Points of all of them, in any format; by default the products' own classified clouds, where they have them.
    most : int
        Points that are shown.

    Raises
    ------
    InputError
        If one is no whole product, or isn't in the CRS of the others.
    """
    lines, meshes, clouds, place = [], [], [], None
    for product in [one for given in products for one in products_of(given)]:
        folder, record = read_record(product)
        path = paths.geopackage(folder, record["parcel"])
        try:
            rows = pyogrio.read_dataframe(path, layer="rows", columns=[])
            outline = pyogrio.read_dataframe(path, layer="parcel", columns=[])
        except (DataSourceError, DataLayerError) as error:
            raise InputError(f"{naming.shown(path)}: can't be read ({error}): map the parcel again") from error
        if place is None:
            place = outline.crs
        elif outline.crs != place:
            raise InputError(f"{naming.shown(product)}: lies in another CRS than those before it: view it alone")
        lines += [shapely.get_coordinates(line, include_z=True) for line in rows.geometry]
        meshes += read_glb(paths.canopy_mesh(folder, record["parcel"])).meshes
        own = paths.classified_cloud(folder, record["parcel"])
        terrain = paths.raster(folder, record["parcel"], "dtm")
        if cloud:
            about = shapely.union_all(outline.geometry.to_numpy()).buffer(AROUND)
            clouds.append((read_cloud(cloud, boundary=(about, place)), terrain))
        elif own.is_file():
            clouds.append((read_cloud(own, crs=place), terrain))
    step = max(-(-sum(cloud.size for cloud, _ in clouds) // most), 1)
    points = np.concatenate([np.empty((0, 4)), *(_above(cloud, terrain, step) for cloud, terrain in clouds)])
    xyz, share = points[:, :3], np.clip(points[:, 3:] / TALL, 0, 1)
    known = [*lines, *(mesh.vertices for mesh in meshes), xyz[:1]]
    zero = np.mean([part.mean(axis=0) for part in known if len(part)], axis=0) if any(map(len, known)) else np.zeros(3)
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Scene(
        xyz - zero,
        (1 - share) * np.array(SOIL) + share * np.array(LEAVES),
        [line - zero + [0.0, 0.0, LIFT] for line in lines],
        np.concatenate([np.empty((0, 3)), *(mesh.vertices - zero for mesh in meshes)]),
        np.concatenate([np.empty((0, 3), int), *(m.faces + k for m, k in zip(meshes, first[:-1], strict=True))]),
    )


def _above(cloud: Cloud, terrain: Path, step: int) -> Floats:
    """One in so many points of a cloud, and their heights above the terrain, or 0: (n, 4)."""
    try:
        with rasterio.open(terrain) as file:
            elevation = file.read(1, masked=True).astype(float).filled(np.nan)
            grid = file.transform
    except RasterioIOError as error:
        raise InputError(f"{naming.shown(terrain)}: can't be read: map the parcel anew") from error
    xyz = np.concatenate([np.empty((0, 3)), *(part.xyz[::step] for part in cloud.parts())])
    j = np.floor((xyz[:, 0] - grid.c) / grid.a).astype(int)
    i = np.floor((xyz[:, 1] - grid.f) / grid.e).astype(int)
    known = (i >= 0) & (j >= 0) & (i < elevation.shape[0]) & (j < elevation.shape[1])
    height = np.zeros(len(xyz))
    height[known] = xyz[known, 2] - elevation[i[known], j[known]]
    return np.column_stack([xyz, np.nan_to_num(height)])
