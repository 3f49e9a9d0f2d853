"""What people have changed of a product in QGIS."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from typing import TYPE_CHECKING
from zipfile import BadZipFile, ZipFile

from vinemap import paths
from vinemap.product.json_values import read_object

if TYPE_CHECKING:
    from pathlib import Path

GEOPACKAGE, PROJECT = ".gpkg", ".qgz"
"""Endings of what can be changed there."""


def changed(folder: Path) -> dict[str, str]:
    """Files of a product that somebody has changed since it was made, and what they are called beside a new one.

    Of a GeoPackage the dates of its layers tell, which are alike when it is made, of a project its size. Damaged ones
    aren't among them.
    """
    try:
        files = read_object(paths.run_record(folder))["files"]
        found = [folder / name for name, size in files.items() if _is_changed(folder / name, size)]
        times = [datetime.fromtimestamp(path.stat().st_mtime, UTC) for path in found]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    return {
        path.name: f"{path.stem}_{time:%Y%m%dT%H%M%S}{path.suffix}" for path, time in zip(found, times, strict=True)
    }


def _is_changed(path: Path, size: int) -> bool:
    try:
        if path.suffix == GEOPACKAGE:
            with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
                (dates,) = database.execute("SELECT count(DISTINCT last_change) FROM gpkg_contents").fetchone()
                return bool(dates > 1 and database.execute("PRAGMA quick_check(1)").fetchone() == ("ok",))
        return path.suffix == PROJECT and path.stat().st_size != size and ZipFile(path).testzip() is None
    except (OSError, sqlite3.Error, BadZipFile):
        return False
