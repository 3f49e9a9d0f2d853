"""The register as a GeoPackage: read at one stroke, and written in one transaction of SQLite.

QGIS may have the file open meanwhile. It is never replaced, as what is saved there would go to the one that is gone.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, contextmanager, suppress
from functools import lru_cache
from typing import TYPE_CHECKING

import geopandas as gpd
import pandas as pd
import pyogrio
import shapely
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError

from vinemap import naming, paths
from vinemap.compute.locks import held
from vinemap.errors import BusyError, InputError, OutputError, reason_of
from vinemap.geo.lines import ROW_LAYER
from vinemap.product.geopackage import write_geopackage
from vinemap.product.layers import REAL, TEXT, WHOLE
from vinemap.product.register.tables import (
    DATES,
    REGISTER,
    columns_of,
    layer_of,
    of_index,
    read_tables,
    write_update,
)
from vinemap.product.store import FULL, drafted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path, PurePath

    from pyproj import CRS

    from vinemap.product.layers import Layer
    from vinemap.product.register.tables import Register, Update

PATIENCE = 10.0
"""Seconds for which another program may keep a register to itself."""
BUSY = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}
UNWRITABLE = {sqlite3.SQLITE_FULL, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM}


def read_register(path: Path) -> Register:
    """Read a register, once for all who ask until it changes.

    Raises
    ------
    InputError
        If it can't be read, or is none.
    BusyError
        If another program keeps it to itself.
    """
    return _read_once(path, stamps_of(path))


@lru_cache(maxsize=1)
def _read_once(path: Path, stamps: tuple[int, ...]) -> Register:
    del stamps
    with _opened(path) as database:
        return read_tables(database, path)


def stamps_of(path: Path) -> tuple[int, ...]:
    """What tells that a register has changed, in SQLite's log beside it even."""
    found: list[int] = []
    for file in (path, path.with_name(f"{path.name}-wal")):
        with suppress(OSError):
            stat = file.stat()
            found += [stat.st_size, stat.st_mtime_ns, stat.st_ino]
    return tuple(found)


def update_register(path: Path, change: Callable[[Register], Update]) -> None:
    """Change a register in one transaction, from what it holds then.

    Raises
    ------
    InputError, BusyError
        As of :func:`read_register`.
    OutputError
        If it can't be written.
    """
    _add_layers(path)
    with _opened(path, write=True) as database:
        for name, kind in (("IsEmpty", shapely.is_empty), *((f"{m}{a}", (m, a)) for m in ("Min", "Max") for a in "XY")):
            database.create_function(f"ST_{name}", 1, of_index(kind), deterministic=True)
        for layer, dates in DATES.items():
            there = columns_of(database, layer)
            for column, kind in (*REGISTER[layer].columns.items(), *((date, "") for date in dates)):
                if column not in there:
                    sort = {TEXT: "TEXT", WHOLE: "INTEGER", REAL: "REAL"}.get(kind, "DATE")
                    database.execute(f'ALTER TABLE "{layer}" ADD COLUMN "{column}" {sort}')
        write_update(database, change(read_tables(database, path)), path)


def make_register(path: Path, crs: CRS) -> None:
    """Make a register without rows, unless there is one, or another run makes it meanwhile.

    Raises
    ------
    BusyError
        If another run doesn't come to an end with it.
    OutputError
        If it can't be written.
    """
    if naming.uncut(path).exists():
        return
    tables = {name: _empty(layer, crs) for name, layer in REGISTER.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with held(paths.lock_beside(path), f"{path}: another run is at work here", patience=PATIENCE):
            if not path.exists():
                with drafted(path, ".gpkg") as draft:
                    write_geopackage(tables, draft, contract=REGISTER)
    except OSError as error:
        advice = "make room there" if error.errno in FULL else "choose another file"
        raise OutputError(f"{path}: can't be written ({error.strerror or error}): {advice}") from error


def _empty(layer: Layer, crs: CRS) -> gpd.GeoDataFrame:
    columns = {name: pd.Series(dtype=kind) for name, kind in layer.columns.items()}
    return gpd.GeoDataFrame(columns, geometry=gpd.GeoSeries([], crs=crs))


def _add_layers(path: Path) -> None:
    """Give a register the layers that it lost, as when its rows alone were saved anew."""
    with _opened(path) as database:
        crs, lost = (
            layer_of(database, ROW_LAYER, path)[1],
            [name for name in REGISTER if not columns_of(database, name)],
        )
    try:
        for name in lost:
            layer = REGISTER[name]
            how = {"geometry_type": layer.geometry, "layer_options": {"GEOMETRY_NAME": "geom"}}
            pyogrio.write_dataframe(_empty(layer, crs), path, layer=name, driver="GPKG", append=True, **how)
    except (DataSourceError, DataLayerError, FeatureError) as error:
        reason = reason_of(error)
        raise OutputError(f"{path}: can't be written ({reason}): the register stays as it was") from error


@contextmanager
def _opened(path: Path, *, write: bool = False) -> Iterator[sqlite3.Connection]:
    """Give a transaction, which is taken back if anything goes wrong."""
    if not path.is_file():
        raise InputError(f"{path}: no such file: vinemap register makes it of products")
    try:
        place = f"{_uri(path.resolve())}?mode={'rw' if write else 'ro'}"
        with closing(sqlite3.connect(place, uri=True, timeout=PATIENCE, isolation_level=None)) as database:
            database.execute("BEGIN IMMEDIATE" if write else "BEGIN")
            yield database
            database.execute("COMMIT")
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in BUSY:
            raise BusyError(
                f"{path}: another program keeps the register to itself, as QGIS does while it saves: close it there"
            ) from error
        if code in UNWRITABLE:
            raise OutputError(f"{path}: can't be written ({error}): the register stays as it was") from error
        raise InputError(f"{path}: can't be read as a register ({error}): put a copy back, or move it away") from error


def _uri(path: PurePath) -> str:
    """A path as SQLite takes it, which knows no host: a share of Windows is a path of two slashes."""
    uri = path.as_uri()
    return uri if uri.startswith("file:///") else uri.replace("file://", "file:////", 1)
