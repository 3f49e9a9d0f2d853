"""Vector layers: what a product's GeoPackage holds, reading boundaries, and writing it with its styles."""

from __future__ import annotations

import difflib
import errno
import os
import shutil
import unicodedata
import warnings
from datetime import UTC, datetime
from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import pyogrio
import shapely
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError

from vinemap.errors import InputError, OutputError
from vinemap.product.qgis.style import layer_styles

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    import pandas as pd
    from pyproj import CRS

EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
SMALLEST = 1 << 20
"""Bytes that a GeoPackage needs: with fewer on the disk, SQLite fails in many ways."""
PARCEL_LAYER = "parcel"
NAME_COLUMNS = ("parcel", "name", "label", "id", "code")
TEXT, WHOLE, REAL, TIME = "str", "int64", "float64", "datetime64[ms, UTC]"


class Layer(NamedTuple):
    """Contract of a layer: OGR geometry type, columns in order with their dtype, what it holds."""

    geometry: str
    columns: dict[str, str]
    description: str


_END = ("x", "y", "z"), ("lat", "lon", "alt")
_ROW = {"row_id": WHOLE, "label": TEXT}

LAYERS: dict[str, Layer] = {
    "rows": Layer(
        "LineString Z",
        _ROW
        | dict.fromkeys(("length_m", "orientation_deg", "elevation_m", "elevation_diff_m"), REAL)
        | {"n_key_points": WHOLE}
        | {f"{end}_{axis}": REAL for axes in _END for end in ("e1", "en") for axis in axes}
        | dict.fromkeys(("spacing_m", "height_m", "width_m", "volume_m3", "gap_m"), REAL)
        | {"n_missing": WHOLE, "block": WHOLE, "support": REAL, "confidence": REAL, "flags": TEXT}
        | dict.fromkeys(("bottom_m", "trv_m3_ha", "lwa_m2_ha"), REAL),
        "Vine rows: the curve of each row on the ground, with the numbers of Table 2.1",
    ),
    "row_ends": Layer("Point Z", _ROW | {"end": TEXT}, "Ends of the rows in WGS84, e1 the western one"),
    "key_points": Layer("Point Z", _ROW | {"order": WHOLE, "position_m": REAL}, "Enhanced key points along the rows"),
    "sections": Layer(
        "LineString Z",
        _ROW
        | dict.fromkeys(("position_m", "height_m", "bottom_m", "width_m", "area_m2"), REAL)
        | {"n_points": WHOLE}
        | dict.fromkeys(("trv_m3_ha", "lwa_m2_ha", "good", "under", "over", "reduction", "quality"), REAL),
        "Sections across the canopy",
    ),
    "gaps": Layer(
        "LineString Z",
        _ROW | dict.fromkeys(("start_m", "end_m", "length_m"), REAL) | {"n_missing": WHOLE},
        "Stretches of rows without canopy",
    ),
    "parcel": Layer(
        "MultiPolygon",
        {"parcel": TEXT, "n_rows": WHOLE}
        | dict.fromkeys(("rows_length_m", "area_m2", "spacing_m", "orientation_deg", "gap_m"), REAL)
        | {"n_missing": WHOLE, "vine_spacing_m": REAL, "vertical_datum": TEXT},
        "The parcel, or its blocks of one direction and spacing where it was given no boundary",
    ),
}

TRACK_LAYERS: dict[str, Layer] = {
    "track": Layer(
        "LineString",
        {"stretch": WHOLE, "n_poses": WHOLE} | dict.fromkeys(("length_m", "seconds", "score"), REAL),
        "The robot's track: a line for each stretch within which every pose was measured",
    ),
    "poses": Layer(
        "Point",
        {"pose": WHOLE, "frame": TEXT, "time": TIME, "seconds": REAL}
        | dict.fromkeys(("x_m", "y_m", "heading_deg", "lat", "lon", "score", "agreement", "overlap"), REAL)
        | {"flag": TEXT, "measured_from": WHOLE, "stretch": WHOLE}
        | {"row": TEXT, "row_distance_m": REAL, "row_position_m": REAL},
        "Poses of the robot, one a frame",
    ),
}
"""What the GeoPackage of a robot's track holds."""


def conform(frame: gpd.GeoDataFrame, layer: str) -> gpd.GeoDataFrame:
    """Bring a table to a layer's columns, in order and with their types.

    Raises
    ------
    ValueError
        If a column is missing.
    """
    columns = (LAYERS | TRACK_LAYERS)[layer].columns
    missing = sorted(set(columns) - set(frame.columns))
    if missing:
        raise ValueError(f"layer {layer} lacks {', '.join(missing)}")
    return frame[[*columns, "geometry"]].astype(columns)


def write_geopackage(
    layers: Mapping[str, gpd.GeoDataFrame],
    path: Path,
    *,
    contract: Mapping[str, Layer] = LAYERS,
    date: datetime = EPOCH,
) -> None:
    """Write all layers of a contract, and the styles that QGIS applies by itself.

    Parameters
    ----------
    layers : mapping of str to GeoDataFrame
        The layers by name.
    path : Path
        The file.
    contract : mapping of str to Layer
        What it must hold; a product's layers by default.
    date : datetime
        Stands in it as that of the last change, so that the same layers always give the same file.

    Raises
    ------
    OSError
        If it can't be written.
    """
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": f"{date.astimezone(UTC):%Y-%m-%dT%H:%M:%S.000Z}"})
    try:
        _write_layers(layers, path, contract)
    except (DataSourceError, DataLayerError, FeatureError) as error:
        if "full" in str(error) or shutil.disk_usage(path.parent).free < SMALLEST:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
        raise OSError(f"GeoPackage: {' '.join(str(error).partition(': sqlite3')[0].split())}") from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


def _write_layers(layers: Mapping[str, gpd.GeoDataFrame], path: Path, contract: Mapping[str, Layer]) -> None:
    tables = {name: conform(layers[name], name) for name in contract}
    for name, layer in contract.items():
        with warnings.catch_warnings():
            # An empty column of text has no type of its own to infer.
            warnings.simplefilter("ignore", UserWarning)
            pyogrio.write_dataframe(
                tables[name],
                path,
                layer=name,
                driver="GPKG",
                geometry_type=layer.geometry,
                dataset_options={"VERSION": "1.2"},
                layer_options={"GEOMETRY_NAME": "geom", "DESCRIPTION": layer.description},
                append=path.exists(),
            )
    pyogrio.write_dataframe(layer_styles(tables), path, layer="layer_styles", driver="GPKG", append=True)


def write_layer(frame: gpd.GeoDataFrame, path: Path, *, layer: str) -> None:
    """Write one layer as a GeoPackage of its own, in place of what was there.

    Raises
    ------
    OutputError
        If it can't be written.
    """
    draft = path.with_name(f".{path.name}.part.gpkg")
    try:
        pyogrio.write_dataframe(frame, draft, layer=layer, driver="GPKG", dataset_options={"VERSION": "1.2"})
        draft.replace(path)
    except (DataSourceError, DataLayerError, FeatureError, OSError) as error:
        raise OutputError(f"{path}: can't be written ({' '.join(str(error).split())}): choose another file") from error
    finally:
        draft.unlink(missing_ok=True)


def read_boundary(path: Path, *, parcel: str | None = None) -> tuple[shapely.Geometry, CRS]:
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


def read_parcels(
    path: Path, names: Sequence[str] | None = None
) -> dict[str, tuple[shapely.Geometry, CRS] | InputError]:
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
    found: dict[str, tuple[shapely.Geometry, CRS] | InputError] = {}
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
