"""A product as a model and a world for Gazebo: terrain and canopies about the origin of {Main}."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np
from pyproj import CRS

from vinemap import paths
from vinemap.canopy.mesh import Mesh
from vinemap.errors import InputError
from vinemap.export.meshes import place_canopies, write_obj
from vinemap.geo.main import Corner, Origin, to_main

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.export.field import Field

TERRAIN_CELL = 1.0
"""Metres, about, between the vertices of the terrain."""
MATERIALS = """newmtl canopy
Kd 0.40 0.61 0.29
newmtl terrain
Kd 0.55 0.45 0.33
"""
CONFIG = """<?xml version="1.0"?>
<model>
  <name>{title}</name>
  <version>1.0</version>
  <sdf version="1.9">model.sdf</sdf>
  <description>Vine rows and terrain, mapped by vinemap: x east, y north, z up from the origin of {{Main}}</description>
</model>
"""
LINK = """
      <visual name="{part}">
        <geometry><mesh><uri>model://{model}/meshes/{part}.obj</uri></mesh></geometry>
      </visual>
      <collision name="{part}">
        <geometry><mesh><uri>model://{model}/meshes/{part}.obj</uri></mesh></geometry>
      </collision>"""
MODEL = """<?xml version="1.0"?>
<sdf version="1.9">
  <model name="{model}">
    <static>true</static>
    <link name="vineyard">{links}
    </link>
  </model>
</sdf>
"""
SPHERE = """
    <spherical_coordinates>
      <surface_model>EARTH_WGS84</surface_model>
      <world_frame_orientation>ENU</world_frame_orientation>
      <latitude_deg>{lat!r}</latitude_deg>
      <longitude_deg>{lon!r}</longitude_deg>
      <elevation>{alt!r}</elevation>
      <heading_deg>0</heading_deg>
    </spherical_coordinates>"""
WORLD = """<?xml version="1.0"?>
<sdf version="1.9">
  <world name="{model}">{sphere}
    <light type="directional" name="sun">
      <direction>-0.5 0.3 -0.8</direction>
    </light>
    <include><uri>model://{model}</uri></include>
  </world>
</sdf>
"""


def write_gazebo(field: Field, folder: Path) -> None:
    """Write a product as a static model for Gazebo, terrain and canopies as OBJ, and a world that holds it.

    The world's frame is {Main}, and its spherical coordinates are {Main}'s origin, so that a robot's GNSS is right;
    there are none where coordinates are local.

    Raises
    ------
    InputError
        If the product's meshes or terrain can't be read.
    OSError
        If nothing can be written.

    References
    ----------
    http://sdformat.org/spec?ver=1.9
    """
    canopy = place_canopies(field)
    ground = terrain_mesh(paths.raster(field.folder, field.parcel, "dtm"), field.origin)
    name = re.sub(r"\W+", "_", f"{field.parcel}_vineyard", flags=re.ASCII)
    model = folder / name
    (model / "meshes").mkdir(parents=True)
    (model / "meshes" / paths.MATERIALS).write_text(MATERIALS, encoding="utf-8")
    parts = {kind: meshes for kind, meshes in {"canopy": canopy.meshes, "terrain": [ground]}.items() if _faces(meshes)}
    for kind, meshes in parts.items():
        how: dict[str, Any] = {"comments": canopy.comments(), "material": (paths.MATERIALS, kind)}
        write_obj(meshes, paths.gazebo_mesh(model / "meshes", kind), **how)
    links = "".join(LINK.format(part=part, model=name) for part in parts)
    title = escape(f"Vineyard {field.parcel}")
    (model / paths.MODEL_CONFIG).write_text(CONFIG.format(title=title), encoding="utf-8")
    (model / paths.MODEL).write_text(MODEL.format(model=name, links=links), encoding="utf-8")
    sphere = SPHERE.format(**field.origin._asdict()) if isinstance(field.origin, Origin) else ""
    world = WORLD.format(model=name, sphere=sphere)
    paths.gazebo_world(folder, name).write_text(world, encoding="utf-8")


def _faces(meshes: list[Mesh]) -> bool:
    return any(len(mesh.faces) for mesh in meshes)


def terrain_mesh(dtm: Path, origin: Origin | Corner) -> Mesh:
    """A raster of elevations as a mesh in {Main}, facing up.

    Raises
    ------
    InputError
        If the raster can't be read.
    """
    import rasterio  # half a second of start-up, needed only here
    from rasterio.enums import Resampling
    from rasterio.errors import RasterioIOError

    try:
        with rasterio.open(dtm) as source:
            ny, nx = (max(2, round(n * source.res[0] / TERRAIN_CELL)) for n in source.shape)
            z = source.read(1, out_shape=(ny, nx), masked=True, resampling=Resampling.average).filled(np.nan)
            crs, (west, south, east, north) = CRS(source.crs), source.bounds
    except RasterioIOError as error:
        raise InputError(f"{dtm}: can't be read: map the parcel anew") from error
    x = west + (east - west) * (np.arange(nx) + 0.5) / nx
    y = north - (north - south) * (np.arange(ny)[:, None] + 0.5) / ny
    at = np.arange(ny * nx).reshape(ny, nx)
    nw, ne, sw, se = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    faces = np.concatenate([np.column_stack([nw, sw, se]), np.column_stack([nw, se, ne])])
    faces = faces[np.isfinite(z.ravel()[faces]).all(axis=1)]
    used, corners = np.unique(faces, return_inverse=True)
    nodes = np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3)[used]
    return Mesh(to_main(nodes, crs, origin), corners.reshape(-1, 3), label="terrain")
