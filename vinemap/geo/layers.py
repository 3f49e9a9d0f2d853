"""Layers of people's files, and of archives of such: opened whatever their format, their names as words."""

from __future__ import annotations

import warnings
import zipfile
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from vinemap import naming
from vinemap.errors import InputError, reason_of
from vinemap.geo.crs import LOCAL, WGS84, is_local

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import geopandas as gpd
    import pandas as pd
    from pyproj import CRS
    from shapely.geometry.base import BaseGeometry


KML = (".kml", ".kmz")
"""Files whose folders are layers."""
ZIPPED = (".shp", ".gpkg", ".geojson", ".kml")
"""Files of layers in a ``.zip``."""
WHOLE = 2**53
"""Number from which on not every whole one has a float."""
ENCODINGS: tuple[str | None, ...] = ("UTF-8", None, "CP1252")
"""How the words of a Shapefile may be written, which often states nothing of it, or something else (None)."""
MOST_NAMED = 5
"""Things that are named where many are left out."""


class Layer(NamedTuple):
    """A layer of a file, as GDAL finds it."""

    source: str
    name: str
    kind: str
    """What its geometries are called."""

    def read(self) -> gpd.GeoDataFrame:
        """What it holds."""
        return read_layer(self.source, self.name)


def read_layer(source: str, name: str) -> gpd.GeoDataFrame:
    """What a layer of a file holds, of a Shapefile in the first encoding in which its words can be read."""
    import geopandas as gpd  # a quarter of a second of start-up, needed for people's files only

    read = partial(gpd.read_file, source, layer=name, on_invalid="fix")  # as outlines that don't end where they begin
    for encoding in ENCODINGS if source.lower().endswith(".shp") else ():
        with suppress(UnicodeDecodeError):
            return read(encoding=encoding)
    return read()


def read_layers(
    path: Path,
    choose: Callable[[Sequence[Layer]], Sequence[Layer]],
    things: str,
    *,
    drawn: bool = False,
    crs: CRS | None = None,
    local: bool = False,
) -> gpd.GeoDataFrame:
    """Read what some layers of a file hold, as one table.

    Parameters
    ----------
    path : Path
        The file, or a ``.zip`` with one.
    choose : callable
        Tells which of its layers are read.
    things : str
        What is looked for, in words.
    drawn : bool
        Whether it may stand in drawings, DXF.
    crs : CRS, optional
        CRS of coordinates for which the file states none.
    local : bool
        Whether coordinates are local, and need no CRS.

    Raises
    ------
    InputError
        If it can't be read, or has no CRS.
    """
    import geopandas as gpd
    import pandas as pd

    if path.is_dir():
        raise InputError(f"{path}: is a folder: name the file of {things} in it")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GDAL's remarks on odd files
            tables = [layer.read() for layer in choose(_layers(path, things))]
    except InputError:
        raise
    except Exception as error:  # GDAL's errors come in several classes
        reason = reason_of(error).partition("; It might help")[0].rstrip(".")  # what does isn't an option of ours
        formats = f"GeoPackage, GeoJSON, KML, KMZ{', DXF' if drawn else ''} or Shapefile"
        raise InputError(f"{path}: can't be read as {formats} ({reason})") from error
    nothing = gpd.GeoDataFrame(geometry=[], crs=WGS84 if path.suffix.lower() in KML else None)
    frame = pd.concat([table for table in tables if len(table)] or tables or [nothing], ignore_index=True)
    if local and isinstance(frame, gpd.GeoDataFrame) and (frame.crs is None or is_local(frame.crs)):
        frame = frame.set_crs(LOCAL, allow_override=True)
    elif crs and isinstance(frame, gpd.GeoDataFrame) and frame.crs is None:
        frame = frame.set_crs(crs)
    if not isinstance(frame, gpd.GeoDataFrame) or frame.crs is None:
        ways = "save it with its CRS, give it with --rows-crs," if drawn else "save it with its CRS,"
        raise InputError(f"{path}: has no geometry or no CRS: {ways} or say --crs local of local ones")
    return frame


def read_points(path: Path, things: str, *, crs: CRS | None = None, local: bool = False) -> gpd.GeoSeries:
    """Read points in plan, each once: those of the layer that is called as they are, or of the only one of points.

    Parameters are as of :func:`read_layers`.

    Raises
    ------
    InputError
        If the file can't be read, has no CRS or no point, or more than one layer that may be meant.
    """
    import geopandas as gpd

    def choose(layers: Sequence[Layer]) -> Sequence[Layer]:
        named = [layer for layer in layers if layer.name.lower() == things]
        points = [layer for layer in layers if "Point" in layer.kind]
        if named or len(points) == 1:
            return named or points
        if len(layers) > 1 and path.suffix.lower() not in KML:
            names = ", ".join(layer.name for layer in layers)
            raise InputError(f"{path}: any of its layers may be meant ({names}): name that of the {things} so")
        return layers

    table = read_layers(path, choose, things, drawn=True, crs=crs, local=local)
    parts = [part for shape in table.geometry for part in parts_of(shape) if isinstance(part, shapely.Point)]
    xy = shapely.get_coordinates(parts)
    xy = xy[np.sort(np.unique(xy, axis=0, return_index=True)[1])]
    xy = xy[np.isfinite(xy).all(axis=1)]
    if len(xy) == 0:
        raise InputError(f"{path}: holds no point: {things} are points, one each")
    return gpd.GeoSeries(shapely.points(xy), crs=table.crs)


def _layers(path: Path, things: str) -> list[Layer]:
    import pyogrio

    if path.suffix.lower() == ".kmz":  # of which GDAL reads one file alone
        sources = [f"/vsizip/{path}/{name}" for name in _names(path, (".kml",))] or [str(path)]
    else:
        sources = [_inside(path, things)]
    return [Layer(source, str(name), str(kind)) for source in sources for name, kind in pyogrio.list_layers(source)]


def _inside(path: Path, things: str) -> str:
    """A file as GDAL finds it, or the one of layers in a ``.zip``."""
    if path.suffix.lower() != ".zip":
        return str(naming.uncut(path))
    inner = layers_in(path)
    if len(inner) != 1:
        known = ", ".join(inner) or "none"
        raise InputError(f"{path}: holds {len(inner)} files of {things} ({known}), and must hold one: unpack it")
    return f"/vsizip/{path}/{inner[0]}"


def layers_in(path: Path) -> list[str]:
    """Names of the files of layers in a ``.zip``; none of what is no such file."""
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


def words_of(column: pd.Series) -> pd.Series:
    """Names as words, their Unicode composed, None where there is none; whole numbers without decimals."""
    import pandas as pd

    if pd.api.types.is_float_dtype(column):
        known = column.dropna()
        column = column.astype("Int64") if ((known % 1 == 0) & (known.abs() < WHOLE)).all() else column
    words = column.dropna().astype(str).str.split().str.join(" ").str.normalize("NFC")
    return words[words != ""].reindex(column.index).astype(object)


def kind_of(geometry: BaseGeometry | None) -> str:
    """What a geometry is, in words."""
    return "an empty geometry" if geometry is None or geometry.is_empty else f"a {geometry.geom_type}"


def some_of(things: Sequence[str]) -> str:
    """Things in words, the first of them where they are many."""
    more = f" and {len(things) - MOST_NAMED} more" if len(things) > MOST_NAMED else ""
    return f"{', '.join(things[:MOST_NAMED])}{more}"
