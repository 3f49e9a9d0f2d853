"""What a register holds: tables read from SQLite's features, and written as such."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError

from vinemap.errors import InputError
from vinemap.geo.crs import project
from vinemap.geo.lines import LAST_NUMBER, ROW_LAYER, as_rows
from vinemap.product.layers import REAL, TEXT, WHOLE, Layer

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Sequence
    from pathlib import Path

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
ENVELOPES = (0, 32, 48, 48, 64)
"""Bytes of the kinds of envelope before a GeoPackage's geometry."""


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


def columns_of(database: sqlite3.Connection, layer: str) -> set[str]:
    """Names of the columns of a layer; none where there is no such layer."""
    return {row[1] for row in database.execute(f'PRAGMA table_info("{layer}")')}


def layer_of(database: sqlite3.Connection, layer: str, path: Path) -> tuple[str, CRS, str]:
    """Column of a layer's geometries, their CRS, and the column of its key.

    Raises
    ------
    InputError
        If the layer isn't there, or is none of a register, or has no CRS.
    """
    found = database.execute(
        "SELECT column_name, organization, organization_coordsys_id, definition FROM gpkg_geometry_columns "
        "JOIN gpkg_spatial_ref_sys USING (srs_id) WHERE table_name = ?",
        (layer,),
    ).fetchone()
    columns = [(row[1], row[5]) for row in database.execute(f'PRAGMA table_info("{layer}")')]
    if not found or (layer == ROW_LAYER and "uid" not in dict(columns) and not columns_of(database, HISTORY)):
        raise InputError(f"{path}: is no register of rows: vinemap register makes one, name another file")
    column, authority, number, words = found
    try:
        crs = CRS.from_authority(authority, number) if authority.upper() == "EPSG" else CRS.from_user_input(words)
    except CRSError as error:
        raise InputError(f"{path}: its layer {layer} has no CRS: set it in QGIS") from error
    return column, crs, next((name for name, key in columns if key), "rowid")


def read_tables(database: sqlite3.Connection, path: Path) -> Register:
    """All that a register holds; InputError if it is none."""
    rows, crs = _table(database, ROW_LAYER, path)
    rows["line"] = pd.Series(as_rows(rows["line"].tolist()), dtype=object)
    if not columns_of(database, HISTORY):
        return Register(crs, rows, crs, _frame([], HISTORY), {})
    past, past_crs = _table(database, HISTORY, path)
    offered: dict[str, str] = {}
    if "flown" in columns_of(database, CANDIDATES):
        found = database.execute("SELECT parcel, max(flown) FROM candidates GROUP BY parcel").fetchall()
        offered = {parcel: day for parcel, flown in found if parcel is not None and (day := _date(flown))}
    past = past[past["uid"].notna()].sort_values("fid", ignore_index=True)
    return Register(crs, rows, past_crs, past, offered)


def _table(database: sqlite3.Connection, layer: str, path: Path) -> tuple[pd.DataFrame, CRS]:
    (column, crs, key), there = layer_of(database, layer, path), columns_of(database, layer)
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


def of_index(kind: Any) -> Callable[[bytes | None], Any]:
    """A function that a layer's spatial index wants, of the binary of a geometry."""

    def found(blob: bytes | None) -> Any:
        shape = _shapes([blob])[0]
        if shape is None or callable(kind):
            return shape is None or bool(kind(shape))
        most, axis = kind
        return float(shapely.bounds(shape)[2 * (most == "Max") + (axis == "Y")])

    return found


def write_update(database: sqlite3.Connection, update: Update, path: Path) -> None:
    """Write what has changed and what is new, in the CRS of each layer."""
    _, crs, key = layer_of(database, ROW_LAYER, path)
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
    column, own, _ = layer_of(database, layer, path)
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
