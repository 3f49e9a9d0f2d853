"""What a parcel's run leaves: layers, rasters, meshes, and what is known of its inputs."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import shapely

from vinemap import paths
from vinemap.canopy.mesh import Mesh, write_glb
from vinemap.compute.threads import in_threads
from vinemap.geo.crs import project
from vinemap.geo.raster import Raster, RowField, write_cog
from vinemap.product.geopackage import conform, write_geopackage
from vinemap.product.globe import parcel_tileset
from vinemap.product.qgis.project import project as qgis_project
from vinemap.product.qgis.style import raster_style
from vinemap.rows.blocks import outline_blocks

if TYPE_CHECKING:
    from collections.abc import Callable
    from datetime import datetime

    from pyproj import CRS

    from vinemap.cloud.tiles import Cloud

    Boundary = tuple[shapely.Geometry, CRS]


RASTERS = {
    "dtm": ("Terrain elevation", "m"),
    "chm": ("Height above terrain", "m"),
    "row_direction": ("Row direction, anticlockwise from east", "degree"),
    "row_spacing": ("Inter-row spacing", "m"),
    "vineyard_likelihood": ("Vineyard likelihood", "1"),
}
"""Rasters of a product: what they hold, and its unit."""


def labelled(table: gpd.GeoDataFrame, rows: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Give what belongs to rows, by ``row_id``, their ``label``."""
    return table.assign(label=table["row_id"].map(dict(zip(rows["row_id"], rows["label"], strict=True))).astype(str))


def parcel_layer(parcel: str, rows: gpd.GeoDataFrame, boundary: Boundary | None, points: Cloud) -> gpd.GeoDataFrame:
    """The parcel's polygon and totals; without a boundary those of its blocks, "F 1", "F 2" if there are several."""
    blocks = outline_blocks(rows)
    if boundary or len(blocks) == 0:
        polygon = project(*boundary, points.crs) if boundary else _extent(points)
        totals = [_totals(parcel, rows, polygon, points)]
        polygons = [polygon]
    else:
        polygons = list(blocks.geometry)
        names = [parcel] if len(blocks) == 1 else [f"{parcel} {block}" for block in blocks["block"]]
        totals = [
            _totals(name, rows[rows["block"] == block], polygon, points)
            for name, block, polygon in zip(names, blocks["block"], polygons, strict=True)
        ]
    parts = [[p for p in shapely.get_parts(polygon) if p.geom_type == "Polygon"] for polygon in polygons]
    return gpd.GeoDataFrame(totals, geometry=[shapely.multipolygons(p) for p in parts], crs=points.crs)


def _extent(points: Cloud) -> shapely.Geometry:
    polygon: shapely.Geometry = shapely.box(*points.extent[0][:2], *points.extent[1][:2])
    return polygon


def _totals(name: str, rows: gpd.GeoDataFrame, polygon: shapely.Geometry, points: Cloud) -> dict[str, Any]:
    angle = np.exp(2j * np.radians(rows["orientation_deg"])) @ rows["length_m"]
    return {
        "parcel": name,
        "n_rows": len(rows),
        "rows_length_m": rows["length_m"].sum(),
        "area_m2": float(shapely.area(polygon)),
        "spacing_m": rows["spacing_m"].median(),
        "orientation_deg": np.degrees(np.angle(angle)) / 2 if len(rows) else np.nan,
        "gap_m": rows["gap_m"].sum(),
        "n_missing": rows["n_missing"].sum(),
        "vine_spacing_m": rows["vine_spacing_m"].median(),
        "vertical_datum": points.vertical or "",
    }


def write_product(
    folder: Path,
    parcel: str,
    layers: dict[str, gpd.GeoDataFrame],
    surfaces: tuple[Raster, Raster],
    field: RowField,
    meshes: list[Mesh],
    points: Cloud,
    *,
    date: datetime,
    plain: bool = False,
    geoid: float | None = None,
) -> None:
    """Write the files of a product but ``run.json``; ``surfaces`` are terrain and canopy height.

    The ``date`` is the survey's. ``plain`` meshes need no extension of glTF. The ``geoid`` is added to heights on the
    globe, m (:func:`vinemap.geo.geoid.find_geoid`).

    Raises
    ------
    OSError
        If one can't be written.
    """
    kinds = dict(zip(RASTERS, (*surfaces, field.direction, field.spacing, field.likelihood), strict=True))
    writers: list[Callable[[], None]] = [
        partial(write_geopackage, layers, paths.geopackage(folder, parcel), date=date),
        partial(_write_rasters, folder, parcel, kinds),
        partial(_write_meshes, folder, parcel, meshes, points, plain=plain, geoid=geoid),
        partial(_write_project, folder, parcel, layers, kinds, date=date, vertical=points.vertical),
    ]
    in_threads(lambda write: write(), writers)


def _write_rasters(folder: Path, parcel: str, rasters: dict[str, Raster]) -> None:
    for kind, raster in rasters.items():
        description, unit = RASTERS[kind]
        path, resampling = paths.raster(folder, parcel, kind), "nearest" if unit == "degree" else "average"
        write_cog(raster, path, description=description, unit=unit, resampling=resampling)
        paths.raster_style(path).write_text(raster_style(kind, raster.values).qml(), encoding="utf-8")


def _write_meshes(
    folder: Path, parcel: str, meshes: list[Mesh], points: Cloud, *, plain: bool, geoid: float | None
) -> None:
    path, origin = paths.canopy_mesh(folder, parcel), np.round(np.mean(points.extent, axis=0))
    extras = {"vertical": points.vertical}
    write_glb(meshes, path, origin=origin, crs=points.crs.to_string(), extras=extras, plain=plain)
    where: dict[str, Any] = {"origin": origin, "crs": points.crs, "vertical": points.vertical, "geoid": geoid}
    if tileset := parcel_tileset(meshes, path.name, **where):
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
        {name: conform(layer, name) for name, layer in layers.items()},
        rasters,
        geopackage=f"./{paths.geopackage(here, parcel)}",
        tif={kind: f"./{paths.raster(here, parcel, kind)}" for kind in rasters},
        notes=[f"Survey of {date:%Y-%m-%d}", *([vertical] if vertical else [])],
    )
    paths.project(folder, parcel).write_bytes(document)
