"""Layers of polygons in people's files, and in archives of such."""

from __future__ import annotations

import warnings
import zipfile
from typing import TYPE_CHECKING

import geopandas as gpd
import pandas as pd
import pyogrio
import shapely

from vinemap.errors import InputError
from vinemap.geo.crs import WGS84

if TYPE_CHECKING:
    from pathlib import Path

    from shapely.geometry.base import BaseGeometry

PARCEL_LAYER = "parcel"
ZIPPED = (".shp", ".gpkg", ".geojson", ".kml")
"""Files of polygons in a ``.zip``."""
AREAS, OTHERS = ("Polygon", "Surface"), ("Point", "LineString", "Curve", "None")
"""What kinds of layers are called that hold polygons, and that hold none; in the rest there may be some."""


def read_layers(path: Path) -> gpd.GeoDataFrame:
    """Read what a file holds in its only layer of polygons, or in its layer ``parcel``; of KML in all layers.

    Raises
    ------
    InputError
        If it can't be read, or it isn't clear which layer is meant.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder: name the file of polygons in it")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GDAL's remarks on odd files
            return _read(path)
    except InputError:
        raise
    except Exception as error:  # GDAL's errors come in several classes
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: can't be read as GeoPackage, GeoJSON, KML, KMZ or Shapefile ({reason})") from error


def _read(path: Path) -> gpd.GeoDataFrame:
    if path.suffix.lower() == ".kmz":  # of which GDAL reads one file alone
        inner = _names(path, (".kml",))
        tables = [_read_kml(f"/vsizip/{path}/{name}") for name in inner]
        return _joined(tables or [_read_kml(str(path))])
    if path.suffix.lower() == ".kml":
        return _read_kml(str(path))
    source = _inside(path)
    kinds = {str(name): str(kind) for name, kind in pyogrio.list_layers(source)}
    sure = [name for name, kind in kinds.items() if any(word in kind for word in AREAS)]
    open_ = [name for name, kind in kinds.items() if name not in sure and not any(word in kind for word in OTHERS)]
    if len(sure) + len(open_) > 1:
        open_ = [name for name in open_ if any(map(polygons_of, gpd.read_file(source, layer=name).geometry))]
    polygons = sure + open_ or list(kinds)
    if len(polygons) > 1 and PARCEL_LAYER not in polygons:
        raise InputError(f"{path}: has several layers of polygons ({', '.join(polygons)}): save the parcels' alone")
    return gpd.read_file(source, layer=PARCEL_LAYER if PARCEL_LAYER in polygons else polygons[0])


def _read_kml(source: str) -> gpd.GeoDataFrame:
    """All layers of a KML, which are its folders."""
    return _joined([gpd.read_file(source, layer=str(name)) for name, _ in pyogrio.list_layers(source)])


def _joined(tables: list[gpd.GeoDataFrame]) -> gpd.GeoDataFrame:
    nothing = gpd.GeoDataFrame(geometry=[], crs=WGS84)
    return pd.concat([table for table in tables if len(table)] or [nothing], ignore_index=True)


def _inside(path: Path) -> str:
    """A file as GDAL finds it, or the one of polygons in a ``.zip``."""
    if path.suffix.lower() != ".zip":
        return str(path)
    inner = polygons_in(path)
    if len(inner) != 1:
        known = ", ".join(inner) or "none"
        raise InputError(f"{path}: holds {len(inner)} files of polygons ({known}), and must hold one: unpack it")
    return f"/vsizip/{path}/{inner[0]}"


def polygons_in(path: Path) -> list[str]:
    """Names of the files of polygons in a ``.zip``; none of what is no such file."""
    return _names(path, ZIPPED)


def _names(path: Path, kinds: tuple[str, ...]) -> list[str]:
    """Names of the files of some kinds in an archive, as GDAL has them: some programs write them with backslashes."""
    try:
        with zipfile.ZipFile(path) as packed:
            names = packed.namelist()
    except (OSError, zipfile.BadZipFile):
        return []
    found = [name.replace("\\", "/") for name in names if name.lower().endswith(kinds)]
    return [name for name in found if not name.startswith("__MACOSX")]


def parts_of(geometry: shapely.Geometry | None) -> list[BaseGeometry]:
    """What a geometry is made of, down to the last collection in a collection."""
    parts: list[BaseGeometry] = shapely.get_parts(geometry).tolist()
    return [inner for part in parts for inner in parts_of(part)] if hasattr(geometry, "geoms") else parts


def polygons_of(geometry: shapely.Geometry | None) -> list[shapely.Polygon]:
    """The polygons that a geometry is made of."""
    return [part for part in parts_of(geometry) if isinstance(part, shapely.Polygon)]
