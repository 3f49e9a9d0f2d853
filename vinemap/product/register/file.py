"""The register as a GeoPackage: read at one stroke, and written in one transaction of SQLite.

QGIS may have the file open meanwhile. It is never replaced, as what is saved there would go to the one that is gone.
"""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing, contextmanager, suppress
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import shapely
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError
from pyproj import CRS
from pyproj.exceptions import CRSError

from vinemap import paths
from vinemap.compute.locks import held
from vinemap.errors import BusyError, InputError, OutputError, reason_of
from vinemap.geo.crs import project
from vinemap.geo.lines import LAST_NUMBER, ROW_LAYER, as_rows
from vinemap.product.geopackage import write_geopackage
from vinemap.product.layers import REAL, TEXT, WHOLE, Layer
from vinemap.product.store import drafted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path, PurePath

    from vinemap.compute.arrays import Values

HISTORY, CANDIDATES = "history", "candidates"
NAMED = {"parcel": TEXT, "row_id": WHOLE, "label": TEXT}
REGISTER = {
    ROW_LAYER: Layer("LineString", NAMED | {"uid": WHOLE, "survey": TEXT}, "Rows of the estate, from e1 to en"),
    CANDIDATES: Layer(
        "LineString", NAMED | {"survey": TEXT, "confidence": REAL}, "Rows that were found where the register has none"
    ),
    HISTORY: Layer("LineString", {"uid": WHOLE} | NAMED | {"what": TEXT, "by": TEXT}, "What each row was, and when"),
}
"""Layers of a register, without their dates."""
DATES = {
    ROW_LAYER: ("planted", "grubbed", "since", "edited"),
    CANDIDATES: ("flown",),
    HISTORY: ("planted", "grubbed", "date"),
}
"""Columns of dates, as SQLite's text 2026-05-31."""
PATIENCE = 10.0
"""Seconds for which another program may keep a register to itself."""
ENVELOPES = (0, 32, 48, 48, 64)
"""Bytes of the kinds of envelope before a GeoPackage's geometry."""
BUSY = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}
UNWRITABLE = {sqlite3.SQLITE_FULL, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM}


class Register(NamedTuple):
    """What a register holds."""

    crs: CRS
    rows: pd.DataFrame
    """``fid``, ``uid``, ``parcel``, ``row_id``, ``label``, ``survey``, dates as text, all None where they aren't known,
    and ``line`` (LineString in plan, or in words what there is instead)."""
    past_crs: CRS
    past: pd.DataFrame
    """What rows were, the oldest first: the same with ``what``, ``by`` and ``date``."""
    offered: dict[str, str]
    """When those parcels were flown of whose rows there are candidates."""


class Update(NamedTuple):
    """What is to be written into a register."""

    rows: pd.DataFrame
    """As of :class:`Register`; with ``dirty``, and without a ``fid`` where a row is new."""
    entries: pd.DataFrame
    """What is to be added to the past, with ``line`` in the CRS of the rows."""
    candidates: Sequence[pd.DataFrame] = ()
    """``parcel``, ``row_id``, ``label``, ``survey``, ``flown``, ``confidence``, ``line``: of a parcel each."""
    settled: Sequence[str] = ()
    """Parcels of which no candidates are to stay."""


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
        return _read(database, path)


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
            database.create_function(f"ST_{name}", 1, _of_index(kind), deterministic=True)
        for layer, dates in DATES.items():
            there = _columns(database, layer)
            for column, kind in (*REGISTER[layer].columns.items(), *((date, "") for date in dates)):
                if column not in there:
                    sort = {TEXT: "TEXT", WHOLE: "INTEGER", REAL: "REAL"}.get(kind, "DATE")
                    database.execute(f'ALTER TABLE "{layer}" ADD COLUMN "{column}" {sort}')
        _write(database, change(_read(database, path)), path)


def make_register(path: Path, crs: CRS) -> None:
    """Make a register without rows, unless there is one, or another run makes it meanwhile.

    Raises
    ------
    BusyError
        If another run doesn't come to an end with it.
    OutputError
        If it can't be written.
    """
    if path.exists():
        return
    tables = {name: _empty(layer, crs) for name, layer in REGISTER.items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with held(paths.lock_beside(path), f"{path}: another run is at work here", patience=PATIENCE):
            if not path.exists():
                with drafted(path, ".gpkg") as draft:
                    write_geopackage(tables, draft, contract=REGISTER)
    except OSError as error:
        raise OutputError(f"{path}: can't be written ({error.strerror or error}): choose another file") from error


def _empty(layer: Layer, crs: CRS) -> gpd.GeoDataFrame:
    columns = {name: pd.Series(dtype=kind) for name, kind in layer.columns.items()}
    return gpd.GeoDataFrame(columns, geometry=gpd.GeoSeries([], crs=crs))


def _add_layers(path: Path) -> None:
    """Give a register the layers that it lost, as when its rows alone were saved anew."""
    with _opened(path) as database:
        crs, lost = _layer(database, ROW_LAYER, path)[1], [name for name in REGISTER if not _columns(database, name)]
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


def _columns(database: sqlite3.Connection, layer: str) -> set[str]:
    return {row[1] for row in database.execute(f'PRAGMA table_info("{layer}")')}


def _layer(database: sqlite3.Connection, layer: str, path: Path) -> tuple[str, CRS, str]:
    """Column of a layer's geometries, their CRS, and the column of its key."""
    found = database.execute(
        "SELECT column_name, organization, organization_coordsys_id, definition FROM gpkg_geometry_columns "
        "JOIN gpkg_spatial_ref_sys USING (srs_id) WHERE table_name = ?",
        (layer,),
    ).fetchone()
    columns = [(row[1], row[5]) for row in database.execute(f'PRAGMA table_info("{layer}")')]
    if not found or (layer == ROW_LAYER and "uid" not in dict(columns) and not _columns(database, HISTORY)):
        raise InputError(f"{path}: is no register of rows: vinemap register makes one, name another file")
    column, authority, number, words = found
    try:
        crs = CRS.from_authority(authority, number) if authority.upper() == "EPSG" else CRS.from_user_input(words)
    except CRSError as error:
        raise InputError(f"{path}: its layer {layer} has no CRS: set it in QGIS") from error
    return column, crs, next((name for name, key in columns if key), "rowid")


def _read(database: sqlite3.Connection, path: Path) -> Register:
    rows, crs = _table(database, ROW_LAYER, path)
    rows["line"] = pd.Series(as_rows(rows["line"].tolist()), dtype=object)
    if not _columns(database, HISTORY):
        return Register(crs, rows, crs, _frame([], HISTORY), {})
    past, past_crs = _table(database, HISTORY, path)
    offered: dict[str, str] = {}
    if "flown" in _columns(database, CANDIDATES):
        found = database.execute("SELECT parcel, max(flown) FROM candidates GROUP BY parcel").fetchall()
        offered = {parcel: day for parcel, flown in found if parcel is not None and (day := _date(flown))}
    past = past[past["uid"].notna()].sort_values("fid", ignore_index=True)
    return Register(crs, rows, past_crs, past, offered)


def _table(database: sqlite3.Connection, layer: str, path: Path) -> tuple[pd.DataFrame, CRS]:
    (column, crs, key), there = _layer(database, layer, path), _columns(database, layer)
    chosen = [f'"{name}"' if name in there else "NULL" for name in _read_columns(layer)]
    found = database.execute(f'SELECT "{key}", {", ".join(chosen)}, "{column}" FROM "{layer}" ORDER BY 1').fetchall()  # noqa: S608 - names of its own
    return _frame(found, layer), crs


def _read_columns(layer: str) -> list[str]:
    """Columns of a layer that are read, beside its key and its lines."""
    return list(dict.fromkeys(["uid", *NAMED, *REGISTER[layer].columns, *DATES[layer]]))


def _frame(found: list[tuple[Any, ...]], layer: str) -> pd.DataFrame:
    """A table of features as SQLite gives them: their key, the columns that are read, and their lines."""
    names = ("fid", *_read_columns(layer), "line")
    of = dict(zip(names, map(list, zip(*found, strict=True)) if found else ([] for _ in names), strict=True))
    how = {"fid": _whole, "uid": _whole, "row_id": _number} | dict.fromkeys(DATES[layer], _date)
    frame = pd.DataFrame(
        {name: pd.Series([how.get(name, _word)(v) for v in of[name]], dtype=object) for name in of if name != "line"}
    )
    frame["line"] = pd.Series(_shapes(of["line"]), dtype=object)
    return frame


def _word(value: Any) -> str | None:
    return " ".join(str(value).split()) or None if value is not None else None


def _date(value: Any) -> str | None:
    return (_word(value) or "")[:10].replace("/", "-") or None


def _whole(value: Any) -> int | None:
    try:
        return int(value) if float(value) == int(value) else None
    except (TypeError, ValueError, OverflowError):
        return None


def _number(value: Any) -> int | None:
    number = _whole(value)
    return number if number and 0 < number <= LAST_NUMBER else None


def _shapes(blobs: list[bytes | None]) -> list[Any]:
    """Geometries in plan from the binary that GeoPackage keeps them in."""
    wkb = [blob[8 + ENVELOPES[min(blob[3] >> 1 & 7, 4)] :] if blob and blob[:2] == b"GP" else None for blob in blobs]
    found: list[Any] = shapely.force_2d(shapely.from_wkb(np.array(wkb, dtype=object), on_invalid="ignore")).tolist()
    return found


def _of_index(kind: Any) -> Callable[[bytes | None], Any]:
    """A function that a layer's spatial index wants, of the binary of a geometry."""

    def found(blob: bytes | None) -> Any:
        shape = _shapes([blob])[0]
        if shape is None or callable(kind):
            return shape is None or bool(kind(shape))
        most, axis = kind
        return float(shapely.bounds(shape)[2 * (most == "Max") + (axis == "Y")])

    return found


def _write(database: sqlite3.Connection, update: Update, path: Path) -> None:
    _, crs, key = _layer(database, ROW_LAYER, path)
    names = _read_columns(ROW_LAYER)
    is_new = update.rows["fid"].isna().to_numpy()
    changed = update.rows[update.rows["dirty"].to_numpy(dtype=bool) & ~is_new]
    settings = ", ".join(f'"{name}" = ?' for name in names)
    sql = f'UPDATE "{ROW_LAYER}" SET {settings} WHERE "{key}" = ?'  # noqa: S608 - names of its own
    database.executemany(sql, changed[[*names, "fid"]].to_numpy().tolist())
    _insert(database, ROW_LAYER, update.rows[is_new], crs, path)
    _insert(database, HISTORY, update.entries, crs, path)
    parcels = {*update.settled, *(name for table in update.candidates for name in table["parcel"])}
    database.executemany("DELETE FROM candidates WHERE parcel = ?", [(name,) for name in sorted(parcels)])
    for table in update.candidates:
        _insert(database, CANDIDATES, table, crs, path)


def _insert(database: sqlite3.Connection, layer: str, table: pd.DataFrame, crs: CRS, path: Path) -> None:
    """Add features whose ``line`` is in a CRS."""
    if len(table) == 0:
        return
    column, own, _ = _layer(database, layer, path)
    (number,) = database.execute("SELECT srs_id FROM gpkg_geometry_columns WHERE table_name = ?", (layer,)).fetchone()
    names = [*REGISTER[layer].columns, *DATES[layer]]
    lines: Values = table["line"].to_numpy()
    lines = lines if own == crs else project(lines, crs, own)
    head = struct.pack("<2sBBi", b"GP", 0, 1, number)
    blobs = [head + wkb for wkb in shapely.to_wkb(lines, byte_order=1).tolist()]
    values = table[names].astype(object).where(table[names].notna(), None).to_numpy().tolist()
    places = ", ".join("?" * (len(names) + 1))
    words = ", ".join(f'"{name}"' for name in (*names, column))
    sql = f'INSERT INTO "{layer}" ({words}) VALUES ({places})'  # noqa: S608 - names of its own
    database.executemany(sql, [(*row, blob) for row, blob in zip(values, blobs, strict=True)])
    database.execute(
        "UPDATE gpkg_contents SET min_x = NULL, min_y = NULL, max_x = NULL, max_y = NULL, "
        "last_change = strftime('%Y-%m-%dT%H:%M:%fZ', 'now') WHERE table_name = ?",
        (layer,),
    )
