"""Polygons of parcels, read from people's files."""

from __future__ import annotations

import difflib
import unicodedata
import warnings
from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import pyogrio
import shapely

from vinemap.errors import InputError
from vinemap.geo.crs import project

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    import pandas as pd
    from pyproj import CRS

PARCEL_LAYER = "parcel"
NAME_COLUMNS = ("parcel", "name", "label", "id", "code")
Boundary = tuple[shapely.Geometry, "CRS"]
"""A polygon and its CRS."""


def read_boundary(path: Path, *, parcel: str | None = None) -> Boundary:
    """Read the polygon of a parcel from GeoPackage, GeoJSON or Shapefile.

    Parameters
    ----------
    path : Path
        File whose only layer of polygons, or whose layer ``parcel``, is read.
    parcel : str, optional
        Name that one of the polygon's columns holds, where there are several; without a name all of them count. The
        column is that of :func:`read_parcels`, or the next one that holds the name.

    Raises
    ------
    InputError
        If the file can't be read, has no polygon or no CRS, or none with the parcel's name.
    """
    if parcel is None:
        frame = _read_polygons(path)
        return _polygon(frame.geometry, path), frame.crs
    (found,) = read_parcels(path, [parcel]).values()
    if isinstance(found, InputError):
        raise found
    return found


def read_parcels(path: Path, names: Sequence[str] | None = None) -> dict[str, Boundary | InputError]:
    """Read the polygons of parcels, or what is wrong with one.

    Parameters
    ----------
    path : Path
        As for :func:`read_boundary`.
    names : sequence of str, optional
        Names of parcels; by default those in the first column, a likely one before others, that tells all polygons
        apart. A single polygon is the parcel's, whatever it is called.

    Raises
    ------
    InputError
        If the file can't be read, has no polygon or no CRS, or no column that has a name for each.
    """
    frame = _read_polygons(path)
    columns = {name: _words(frame[name]) for name in _name_columns(frame)}
    if names is None:
        first = next(iter(columns.values()), None)
        if first is None or not _tells_apart(first):
            raise InputError(
                f"{path}: no column has a name of its own for each of its {len(frame)} polygons: add one, 'name'"
            )
        names = list(first)
    places = [words.groupby(words).indices for words in columns.values()]
    found: dict[str, Boundary | InputError] = {}
    for name in names:
        word = unicodedata.normalize("NFC", name)
        rows = next((place[word] for place in places if word in place), None) if len(frame) > 1 else [0]
        try:
            if rows is None:
                raise _no_such(path, name, frame, columns.values())
            found[name] = _polygon(frame.geometry.iloc[rows], path), frame.crs
        except InputError as error:
            found[name] = error
    return found


def _no_such(path: Path, name: str, frame: gpd.GeoDataFrame, columns: Iterable[pd.Series]) -> InputError:
    words = sorted({str(word) for column in columns for word in column.dropna()})
    close = difflib.get_close_matches(name, words, n=1, cutoff=0.5)
    hint = f"did you mean {close[0]!r}?" if close else "check the name"
    return InputError(f"{path}: none of its {len(frame)} polygons has {name!r} in a column: {hint}")


def _polygon(shapes: gpd.GeoSeries, path: Path) -> shapely.Geometry:
    """All of some shapes, valid and flat."""
    polygon = _areas(shapely.make_valid(shapely.union_all(shapely.make_valid(shapes.to_numpy()))))
    if not np.isfinite(shapely.bounds(polygon)).all():
        raise InputError(f"{path}: its polygon is empty or has coordinates that are no numbers")
    return shapely.force_2d(polygon)


def _areas(geometry: shapely.Geometry) -> shapely.Geometry:
    """The polygons of a geometry, without the lines and points that are left of spikes and double edges."""
    parts = shapely.get_parts(shapely.get_parts(geometry))
    areas = parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON]
    return geometry if len(areas) == len(parts) else shapely.union_all(areas)


def _name_columns(frame: gpd.GeoDataFrame) -> list[str]:
    """Columns that may name polygons: such as have a name for each first, and of these, likely ones."""
    columns = [str(name) for name in frame.columns if name != "geometry"]
    return sorted(columns, key=lambda name: (not _tells_apart(_words(frame[name])), name.lower() not in NAME_COLUMNS))


def _words(column: pd.Series) -> pd.Series:
    """Names as words, their Unicode composed, without those that are empty."""
    words = column.dropna().astype(str).str.strip().str.normalize("NFC")
    return words[words != ""].reindex(column.index)


def _tells_apart(words: pd.Series) -> bool:
    return bool(words.is_unique and words.notna().all())


def _read_polygons(path: Path) -> gpd.GeoDataFrame:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GDAL's remarks on odd files
            frame = gpd.read_file(path, layer=_polygon_layer(path))
    except InputError:
        raise
    except Exception as error:  # GDAL's errors come in several classes
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: can't be read as GeoPackage, GeoJSON or Shapefile ({reason})") from error
    if not isinstance(frame, gpd.GeoDataFrame) or frame.crs is None:
        raise InputError(f"{path}: has no geometry or no CRS: save the polygons with their CRS")
    frame = frame[frame.geom_type.isin(["Polygon", "MultiPolygon"])]
    if len(frame) == 0:
        raise InputError(f"{path}: holds no polygon")
    return frame


def _polygon_layer(path: Path) -> str:
    kinds = {str(name): str(kind) for name, kind in pyogrio.list_layers(path)}
    polygons = [name for name, kind in kinds.items() if "Polygon" in kind] or list(kinds)
    if len(polygons) > 1 and PARCEL_LAYER not in polygons:
        raise InputError(f"{path}: has several layers of polygons ({', '.join(polygons)}): save the parcels' alone")
    return PARCEL_LAYER if PARCEL_LAYER in polygons else polygons[0]


def boundary_in(boundary: Boundary, target: CRS, path: Path) -> shapely.Geometry:
    """A boundary's polygon in the CRS to which a file is brought.

    Raises
    ------
    InputError
        If it can't be brought there.
    """
    polygon = project(*boundary, target)
    if not np.isfinite(shapely.bounds(polygon)).all():
        raise InputError(f"the boundary can't be brought to {target.name}, the CRS of {path}: check its CRS")
    return polygon
