"""The page of a parcel: its rows on the map, in numbers, along the row and in 3D, and how far to trust them."""

from __future__ import annotations

import base64
import json
from typing import TYPE_CHECKING, Any

import numpy as np
from affine import Affine

from vinemap import paths
from vinemap.errors import own_fault
from vinemap.geo.raster import block_sum
from vinemap.product.pages.page import as_json, mean_of, page, polylines, repacked, rings, whole_numbers
from vinemap.product.seasons.products import read_product
from vinemap.product.store import alone, write_whole

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import geopandas as gpd

    from vinemap.geo.raster import Raster
    from vinemap.product.seasons.products import Product

TALLEST = 3.0
"""Height above ground, in metres, from which on the canopy's picture is darkest."""
SHADES = 40
INK = (52, 60, 46)
"""RGB of the canopy's picture, whose opacity tells the height."""
LARGEST = 1600
"""Pixels of the picture, along its longer side."""
NODES = 6000
"""Points of the terrain in 3D."""
LONGEST = 700
"""Sections of a row that are drawn; of more, runs are averaged."""
TOLERANCE = 0.03
"""Metres by which lines on the map may leave the rows."""
TABLE = {
    "length_m": 2,
    "orientation_deg": 2,
    "elevation_m": 2,
    "elevation_diff_m": 2,
    "n_key_points": 0,
    **{f"{end}_{axis}": 2 for end in ("e1", "en") for axis in "xyz"},
    **{f"{end}_{axis}": digits for end in ("e1", "en") for axis, digits in (("lat", 8), ("lon", 8), ("alt", 2))},
    **dict.fromkeys(("spacing_m", "height_m", "bottom_m", "width_m"), 3),
    **dict.fromkeys(("volume_m3", "gap_m", "unseen_m"), 2),
    "n_missing": 0,
    "block": 0,
    **dict.fromkeys(("support", "confidence", "canopy_confidence", "mesh_error_m"), 3),
    **dict.fromkeys(("trv_m3_ha", "lwa_m2_ha"), 0),
}
"""Columns of ``rows`` on the page, and their decimals."""
UNMAPPED = {"area_m2": 1, "share": 4, "height_m": 1, "width_m": 1}
"""Columns of ``unmapped`` on the page, and their decimals."""
MEANS = ("height_m", "width_m", "support", "confidence", "canopy_confidence", "mesh_error_m")
"""Columns of ``rows`` whose mean the page tells."""
HISTORY = "history"
"""Where the page holds the numbers of its rows on all dates, once there is more than one."""
RECORD = (
    "vinemap",
    "survey",
    "parcel",
    "flown",
    "inputs",
    "settings",
    "crs",
    "vertical_datum",
    "origin",
    "counts",
    "modelling",
    "shift",
    "warnings",
    "versions",
)
"""What the page tells of the run: nothing that differs from one run to the next."""


def parcel_page(
    record: Mapping[str, Any], layers: Mapping[str, gpd.GeoDataFrame], dtm: Raster, chm: Raster, canopies: bytes
) -> str:
    """Page of a parcel as one HTML file that needs no other.

    Parameters
    ----------
    record : mapping
        The run's, as in ``run.json``.
    layers : mapping of str to GeoDataFrame
        Those of the GeoPackage; without rows the page says so.
    dtm, chm : Raster
        Terrain, and height above it, m.
    canopies : bytes
        The meshes, as binary glTF.
    """
    rows, gaps, unmapped, parcel = (layers[name] for name in ("rows", "gaps", "unmapped", "parcel"))
    grid = chm.grid
    zero = np.array([grid.west, grid.north - grid.ny * grid.resolution])
    picture, across, down = canopy_picture(chm)
    data = {name: record.get(name) for name in RECORD} | {
        "origin": record["origin"] if "lat" in (record.get("origin") or ()) else None,
        "zero": zero,
        "outlines": [rings(polygon, zero, tolerance=TOLERANCE) for polygon in parcel.geometry],
        "totals": totals(rows, parcel),
        "rows": {
            "row_id": rows["row_id"].to_numpy(),
            "label": rows["label"].tolist(),
            "flags": rows["flags"].tolist(),
            **{name: np.round(rows[name].to_numpy(dtype=float), digits) for name, digits in TABLE.items()},
            "line": polylines(rows.geometry, zero, tolerance=TOLERANCE),
        },
        "gaps": {name: np.round(gaps[name], 2).to_numpy() for name in ("row_id", "start_m", "end_m", "n_missing")}
        | {"state": gaps["state"].tolist()},
        "unmapped": {
            "reason": unmapped["reason"].tolist(),
            **{name: np.round(unmapped[name].to_numpy(), digits) for name, digits in UNMAPPED.items()},
            "outline": [rings(polygon, zero, tolerance=TOLERANCE) for polygon in unmapped.geometry],
        },
        "picture": {
            "png": base64.b64encode(picture).decode(),
            "bounds": [0.0, grid.ny * grid.resolution - down, across, grid.ny * grid.resolution],
            "tallest": TALLEST,
        },
    }
    details = {"profiles": profiles(layers["sections"]), "terrain": terrain(dtm)}
    packed = {"details": as_json(details).encode(), "canopies": canopies, HISTORY: b"null"}
    title = f"{record['parcel']} · vine rows"
    return page("report", title, data, packed=packed, scripts=["canopies"])


def totals(rows: gpd.GeoDataFrame, parcel: gpd.GeoDataFrame) -> dict[str, float]:
    """Key numbers of a parcel; means are weighted by the length of the rows."""
    length = rows["length_m"].to_numpy(dtype=float)
    means = {name: mean_of(rows[name], length) for name in MEANS}
    return {
        "rows": len(rows),
        "length_m": float(length.sum()),
        "area_m2": float(parcel.area.sum()),
        "spacing_m": float(rows["spacing_m"].mean()) if len(rows) > 1 else np.nan,
        "volume_m3": float(rows["volume_m3"].sum()),
        "n_missing": int(rows["n_missing"].sum()),
        **{name: float(rows[name].sum()) for name in ("gap_m", "unseen_m")},
        **means,
    }


def canopy_picture(chm: Raster) -> tuple[bytes, float, float]:
    """Heights above ground as PNG, of one ink whose opacity tells the height, and its size in metres (east, south).

    Cells without points are clear. A large raster becomes a picture of fewer pixels.
    """
    import rasterio  # half a second of start-up, needed only here
    from rasterio.io import MemoryFile

    n = -(-max(chm.grid.shape) // LARGEST)
    known = np.isfinite(chm.values)
    count = block_sum(known, n)
    mean = block_sum(np.where(known, chm.values, 0.0), n) / np.maximum(count, 1)
    shade = np.rint(np.clip(mean / TALLEST, 0, 1) * (SHADES - 1))
    levels = np.where(count > 0, shade + 1, 0).astype(np.uint8)
    inks = {0: (*INK, 0)} | {k + 1: (*INK, round(10 + 215 * k / (SHADES - 1))) for k in range(SHADES)}
    size = {"height": levels.shape[0], "width": levels.shape[1], "count": 1, "dtype": "uint8"}
    with rasterio.Env(GDAL_PAM_ENABLED=False), MemoryFile() as file:
        # An odd transform, as rasterio warns of none; PNG has no place for one.
        with file.open(driver="PNG", transform=Affine.scale(2.0), zlevel=6, **size) as target:
            target.write(levels, 1)
            target.write_colormap(1, inks)
        down, across = (side * n * chm.grid.resolution for side in levels.shape)
        return file.read(), across, down


def profiles(sections: gpd.GeoDataFrame) -> dict[str, dict[str, list[int | None]]]:
    """Canopies along the rows: ``position``, ``height``, ``bottom``, ``width`` (cm), ``area`` (dm²), by ``row_id``."""
    names = ("position", "height", "bottom", "width", "area")
    values = sections[["position_m", "height_m", "bottom_m", "width_m", "area_m2"]].to_numpy(dtype=float)
    order = np.lexsort((values[:, 0], sections["row_id"]))
    row_ids, values = sections["row_id"].to_numpy()[order], values[order]
    first = np.flatnonzero(np.diff(row_ids, prepend=-1))
    found = {}
    for row_id, row in zip(row_ids[first].tolist(), np.split(values, first[1:]), strict=bool(len(first))):
        n = -(-len(row) // LONGEST)
        runs = np.arange(0, len(row), n)
        means = np.add.reduceat(row, runs) / np.diff(runs, append=len(row))[:, None]
        found[str(row_id)] = {
            name: whole_numbers(column, unit=0.01) for name, column in zip(names, means.T, strict=True)
        }
    return found


def terrain(dtm: Raster) -> dict[str, Any]:
    """Elevations (cm, above the lowest) at some nodes of a raster, from the north-west on, row by row."""
    grid = dtm.grid
    n = max(1, int(np.ceil(np.sqrt(grid.ny * grid.nx / NODES))))
    values = dtm.values[n // 2 :: n, n // 2 :: n]
    x, y = (centres[n // 2 :: n] for centres in grid.centres())
    lowest = float(np.floor(np.nanmin(values))) if np.isfinite(values).any() else 0.0
    return {
        "west": float(x[0]) if len(x) else 0.0,
        "north": float(y[0]) if len(y) else 0.0,
        "step": n * grid.resolution,
        "nx": values.shape[1],
        "lowest": lowest,
        "z": whole_numbers(values.ravel() - lowest, unit=0.01),
    }


def write_page(
    folder: Path, record: dict[str, Any], layers: dict[str, gpd.GeoDataFrame], dtm: Raster, chm: Raster
) -> list[str]:
    """Write a product's page, or tell why there is none: a fault of our own in a page costs no product.

    Parameters are as of :func:`parcel_page`, with the product's folder.
    """
    parcel = record["parcel"]
    canopies = paths.canopy_mesh(folder, parcel).read_bytes()
    try:
        text = parcel_page(record, layers, dtm, chm, canopies)
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - as said
        return [f"it has no page: {own_fault(error)}"]
    paths.report(folder, parcel).write_text(text, encoding="utf-8")
    return []


def tell_seasons(product: Product, seasons: Mapping[str, Any] | None, key: str) -> None:
    """Have a product's page show what :func:`vinemap.product.seasons.history.history` gives, or nothing any more.

    The product's record tells the page's new size, and the key of what it shows. What another run has put in the
    product's place stays as it is.

    Raises
    ------
    BusyError
        If another run is at work on the product.
    OSError
        If it can't be read or written.
    """
    path, run = paths.report(product.folder, product.parcel), paths.run_record(product.folder)
    with alone(product.folder):
        there = read_product(product.folder)
        if not there or there.key != product.key:
            return
        record = json.loads(run.read_text(encoding="utf-8"))
        write_whole(path, repacked(path.read_text(encoding="utf-8"), HISTORY, as_json(seasons).encode()))
        record["files"][path.name] = path.stat().st_size
        write_whole(run, json.dumps(record | {"seasons": key}, indent=2, ensure_ascii=False))
