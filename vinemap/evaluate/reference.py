"""Lines in people's files, against which rows are held."""

from __future__ import annotations

import warnings
from pathlib import Path

import geopandas as gpd
import pandas as pd
import pyogrio
from pyogrio.errors import DataLayerError, DataSourceError
from shapely.errors import ShapelyError

from vinemap import naming
from vinemap.errors import InputError
from vinemap.geo.layers import read_layer, words_of
from vinemap.geo.lines import ROW_LAYER


def read_lines(path: str | Path, layer: str | None = None, *, parcel: str | None = None) -> gpd.GeoDataFrame:
    """Read the lines of a vector file.

    Parameters
    ----------
    path : str or Path
        GeoPackage, GeoJSON, Shapefile or whatever else GDAL reads.
    layer : str, optional
        Layer to read; else ``rows``, else the only layer of lines.
    parcel : str, optional
        Keep the lines in which a column holds this name.

    Raises
    ------
    InputError
        If the file can't be read, or the layer isn't there, isn't the only one, or isn't one of lines; or if no line
        has the parcel's name.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; give a GeoPackage, GeoJSON or Shapefile of row lines")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # GDAL's remarks on a file's odd header
            layer = _line_layer(naming.uncut(path), layer)
            lines = read_layer(str(path), layer)
    except (DataSourceError, DataLayerError, ShapelyError, OSError) as error:
        reason = str(error).split("; ", maxsplit=1)[0].replace("\n", " ")
        raise InputError(f"{path}: can't be read ({reason}); write it again as a GeoPackage, in QGIS say") from error
    kinds = set(lines.geom_type.dropna()) if isinstance(lines, gpd.GeoDataFrame) else {"no geometry"}
    if other := sorted(kinds - {"LineString", "MultiLineString"}):
        raise InputError(f"{path}: layer {layer} holds {', '.join(other)}; give a layer of lines, one a vine row")
    if parcel is None:
        return lines
    words = lines.drop(columns="geometry").apply(words_of)
    named = lines[words.eq(words_of(pd.Series([parcel]))[0]).any(axis=1)]
    if len(named) == 0:
        raise InputError(f"{path}: no line of layer {layer} has {parcel!r} in a column: check the parcel's name")
    return named


def _line_layer(path: Path, layer: str | None) -> str:
    kinds = {str(name): str(kind) for name, kind in pyogrio.list_layers(path)}
    names = ", ".join(kinds) or "none"
    if layer is not None:
        if layer not in kinds:
            raise InputError(f"{path}: no layer {layer}; it has {names}")
        return layer
    if ROW_LAYER in kinds:
        return ROW_LAYER
    # An empty layer's kind may be unknown: it serves where no layer says that it holds lines.
    lines = [name for name, kind in kinds.items() if "LineString" in kind]
    lines = lines or [name for name, kind in kinds.items() if kind == "Unknown"]
    if len(lines) != 1:
        what = "several layers" if lines else "no layer"
        raise InputError(f"{path}: {what} of lines among {names}; name the layer of vine rows {ROW_LAYER}")
    return lines[0]
