"""The files that a run leaves, but its record and its pages."""

from __future__ import annotations

import json
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap import paths
from vinemap.canopy.mesh import audit as audit_mesh
from vinemap.compute.threads import in_threads
from vinemap.errors import DependencyError
from vinemap.product.geopackage import write_geopackage
from vinemap.product.globe import parcel_tileset
from vinemap.product.gltf import read_glb, write_glb
from vinemap.product.layers import conform
from vinemap.product.pages.parcel import write_page
from vinemap.product.qgis.project import project as qgis_project

if TYPE_CHECKING:
    from collections.abc import Callable

    import geopandas as gpd

    from vinemap.canopy.mesh import Mesh
    from vinemap.cloud.tiles import Cloud
    from vinemap.geo.raster import Raster


def write_product(
    folder: Path,
    record: dict[str, Any],
    layers: dict[str, gpd.GeoDataFrame],
    rasters: dict[str, Raster],
    meshes: list[Mesh],
    points: Cloud,
    *,
    plain: bool = False,
    geoid: float | None = None,
    audit: bool = False,
) -> list[str]:
    """Write the files of a product but ``run.json``, of which the ``record`` is all else, and its rasters.

    ``plain`` meshes need no extension of glTF. The ``geoid`` is added to heights on the globe, m
    (:func:`vinemap.geo.geoid.find_geoid`). An ``audit`` of the meshes, as they were written, goes to the record's
    warnings. What is to be known of what was written is returned: a sentence each.

    Raises
    ------
    OSError
        If one can't be written.
    """
    parcel, date = record["parcel"], datetime.fromisoformat(record["flown"])
    tables = {name: conform(layer, name) for name, layer in layers.items()}

    def canopies_and_page() -> list[str]:
        _write_meshes(folder, parcel, meshes, points, plain=plain, geoid=geoid)
        flaws = audit_meshes(paths.canopy_mesh(folder, parcel)) if audit else []
        record["warnings"] += flaws  # before the page that tells them
        return write_page(folder, record, layers, rasters["dtm"], rasters["chm"])

    writers: list[Callable[[], list[str] | None]] = [
        partial(write_geopackage, tables, paths.geopackage(folder, parcel), date=date),
        canopies_and_page,
        partial(_write_project, folder, parcel, tables, rasters, date=date, vertical=points.vertical),
    ]
    return [remark for told in in_threads(lambda write: write(), writers) for remark in told or ()]


def audit_meshes(path: Path) -> list[str]:
    """What Open3D finds wrong with the meshes of a product's glTF, a sentence a row, or that it can't be asked."""
    found = []
    for mesh in read_glb(path).meshes:
        if len(mesh.faces) == 0:
            continue
        try:
            said = audit_mesh(mesh)
        except DependencyError as error:
            return [f"the meshes were not audited: {error}"]
        flaws = {"isn't closed": not said.edge_manifold, "intersects itself": said.self_intersecting}
        told = [flaw for flaw, holds in flaws.items() if holds]
        if told or not said.watertight:
            found.append(f"the mesh of row {mesh.label} {' and '.join(told) or 'meets itself at a vertex'}")
    return found


def _write_meshes(
    folder: Path, parcel: str, meshes: list[Mesh], points: Cloud, *, plain: bool, geoid: float | None
) -> None:
    path, origin = paths.canopy_mesh(folder, parcel), np.round(np.mean(points.extent, axis=0))
    extras = {"vertical": points.vertical}
    write_glb(meshes, path, origin=origin, crs=points.crs.to_string(), extras=extras, plain=plain)
    tileset = parcel_tileset(meshes, path.name, origin=origin, crs=points.crs, vertical=points.vertical, geoid=geoid)
    if tileset:
        paths.tileset(folder).write_text(json.dumps(tileset, indent=1), encoding="utf-8")


def _write_project(
    folder: Path,
    parcel: str,
    layers: dict[str, gpd.GeoDataFrame],
    rasters: dict[str, Raster],
    *,
    date: datetime,
    vertical: str | None,
) -> None:
    here = Path()
    document = qgis_project(
        parcel,
        layers,
        rasters,
        geopackage=f"./{paths.geopackage(here, parcel)}",
        tif={kind: f"./{paths.raster(here, parcel, kind)}" for kind in rasters},
        notes=[f"Survey of {date:%Y-%m-%d}", *([vertical] if vertical else [])],
    )
    paths.project(folder, parcel).write_bytes(document)
