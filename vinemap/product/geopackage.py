"""Layers written as a GeoPackage, with the styles that QGIS applies by itself."""

from __future__ import annotations

import errno
import os
import shutil
import warnings
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import pyogrio
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError

from vinemap import naming
from vinemap.errors import OutputError
from vinemap.product.layers import LAYERS, Layer, conform
from vinemap.product.qgis.style import layer_styles
from vinemap.product.store import drafted

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping
    from pathlib import Path

    import geopandas as gpd

EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
WITHOUT_LOCKS = {"SQLITE_USE_OGR_VFS": "YES"}
"""How GDAL writes SQLite's files by itself: nobody else has a draft, and some disks have no locks."""
SMALLEST = 1 << 20
"""Bytes that a GeoPackage needs: with fewer on the disk, SQLite fails in many ways."""


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
    try:
        with _gdal(OGR_CURRENT_DATE=f"{date.astimezone(UTC):%Y-%m-%dT%H:%M:%S.000Z}", **WITHOUT_LOCKS):
            _write_layers(layers, path, contract)
    except (DataSourceError, DataLayerError, FeatureError) as error:
        if "full" in str(error) or shutil.disk_usage(path.parent).free < SMALLEST:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
        raise OSError(f"GeoPackage: {_reason(error)}") from error


@contextmanager
def _gdal(**options: str) -> Iterator[None]:
    """Have GDAL work with some options."""
    pyogrio.set_gdal_config_options(options)
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options(dict.fromkeys(options))


def _reason(error: Exception) -> str:
    """What GDAL says, without SQL."""
    said = " ".join(str(error).partition(": sqlite3")[0].split())
    return said.rpartition("failed: ")[2][:200]


def _write_layers(layers: Mapping[str, gpd.GeoDataFrame], path: Path, contract: Mapping[str, Layer]) -> None:
    tables = {name: conform(layers[name], name, contract=contract) for name in contract}
    for name, layer in contract.items():
        with warnings.catch_warnings():
            # An empty column of text has no type of its own to infer.
            warnings.simplefilter("ignore", UserWarning)
            warnings.simplefilter("ignore", RuntimeWarning)  # GDAL's remarks where the disk is full
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


def check_replaced(path: Path, what: str, *, known: Collection[str], needed: Collection[str]) -> None:
    """Make sure that a file that is there, if one is, may be replaced.

    Raises
    ------
    OutputError
        If it isn't ``what`` it is said to be: a GeoPackage with the layers ``needed``, and with none but the ``known``.
    """
    if not path.exists():
        return
    try:
        with _gdal(**WITHOUT_LOCKS):
            layers = {str(name) for name, _ in pyogrio.list_layers(path)} - {"layer_styles"}
    except Exception as error:  # GDAL's errors come in several classes
        raise OutputError(f"{path}: is there, and isn't {what}: choose another file") from error
    if not set(needed) <= layers <= set(known):
        raise OutputError(f"{path}: holds other layers ({', '.join(sorted(layers))}): choose another file")


def write_layer(frame: gpd.GeoDataFrame, path: Path, *, layer: str) -> None:
    """Write one layer as a GeoPackage of its own, in place of an earlier one.

    Raises
    ------
    OutputError
        If it can't be written, or something else is there.
    """
    check_replaced(naming.uncut(path), f"a GeoPackage of {layer}", known=[layer], needed=[layer])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with drafted(path, ".gpkg") as draft, _gdal(**WITHOUT_LOCKS):
            pyogrio.write_dataframe(frame, draft, layer=layer, driver="GPKG", dataset_options={"VERSION": "1.2"})
    except (DataSourceError, DataLayerError, FeatureError, OSError) as error:
        reason = getattr(error, "strerror", None) or _reason(error)
        raise OutputError(f"{path}: can't be written ({reason}): choose another file") from error
