"""What the layers of a product's GeoPackage hold: columns in order, their types, and the tables that fill them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import geopandas as gpd
import numpy as np
import shapely

from vinemap.geo.crs import is_local
from vinemap.geo.layers import polygons_of
from vinemap.rows.blocks import outline_blocks

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vinemap.cloud.tiles import Cloud

TEXT, WHOLE, REAL, TIME = "str", "int64", "float64", "datetime64[ms, UTC]"
_END = ("x", "y", "z"), ("lat", "lon", "alt")
_ROW = {"row_id": WHOLE, "label": TEXT}
GLOBAL = {f"{end}_{axis}" for end in ("e1", "en") for axis in _END[1]}
"""Columns of WGS 84."""


class Layer(NamedTuple):
    """Contract of a layer: OGR geometry type, columns in order with their dtype, what it holds."""

    geometry: str
    columns: dict[str, str]
    description: str


LAYERS: dict[str, Layer] = {
    "rows": Layer(
        "LineString Z",
        _ROW
        | dict.fromkeys(("length_m", "orientation_deg", "elevation_m", "elevation_diff_m"), REAL)
        | {"n_key_points": WHOLE}
        | {f"{end}_{axis}": REAL for axes in _END for end in ("e1", "en") for axis in axes}
        | dict.fromkeys(("spacing_m", "height_m", "width_m", "volume_m3", "gap_m"), REAL)
        | {"n_missing": WHOLE, "block": WHOLE, "support": REAL, "confidence": REAL, "flags": TEXT}
        | dict.fromkeys(("bottom_m", "trv_m3_ha", "lwa_m2_ha", "canopy_confidence", "unseen_m", "mesh_error_m"), REAL),
        "Vine rows: the curve of each row on the ground, with the numbers of Table 2.1",
    ),
    "row_ends": Layer(
        "Point Z",
        _ROW | {"end": TEXT, "beyond": TEXT},
        "Ends of the rows in WGS84; e1 is the western one, or a known row's first",
    ),
    "key_points": Layer("Point Z", _ROW | {"order": WHOLE, "position_m": REAL}, "Enhanced key points along the rows"),
    "sections": Layer(
        "LineString Z",
        _ROW
        | dict.fromkeys(("position_m", "height_m", "bottom_m", "width_m", "area_m2"), REAL)
        | {"n_points": WHOLE}
        | dict.fromkeys(("extent_m", "trv_m3_ha", "lwa_m2_ha", "good", "under", "over", "reduction", "quality"), REAL),
        "Sections across the canopy",
    ),
    "gaps": Layer(
        "LineString Z",
        _ROW | dict.fromkeys(("start_m", "end_m", "length_m"), REAL) | {"n_missing": WHOLE, "state": TEXT},
        "Stretches of rows without canopy, or that were not seen",
    ),
    "vines": Layer(
        "Point Z",
        _ROW
        | {"number": WHOLE, "position_m": REAL, "state": TEXT}
        | dict.fromkeys(("height_m", "width_m", "volume_m3", "position_sd_m"), REAL),
        "Vines one by one, missing ones among them; none where nothing tells their spacing",
    ),
    "unmapped": Layer(
        "MultiPolygon",
        {"reason": TEXT} | dict.fromkeys(("area_m2", "share", "height_m", "width_m"), REAL),
        "What stands as high as vines, or higher, in no row, and why",
    ),
    "parcel": Layer(
        "MultiPolygon",
        {"parcel": TEXT, "n_rows": WHOLE}
        | dict.fromkeys(("rows_length_m", "area_m2", "spacing_m", "orientation_deg", "gap_m"), REAL)
        | {"n_missing": WHOLE, "vine_spacing_m": REAL, "vertical_datum": TEXT, "unseen_m": REAL},
        "The parcel, or its blocks of one direction and spacing where it was given no boundary",
    ),
}


def conform(frame: gpd.GeoDataFrame, layer: str, *, contract: Mapping[str, Layer] = LAYERS) -> gpd.GeoDataFrame:
    """Bring a table to the columns of a layer of a contract, in order and with their types.

    Those of WGS 84 are left out where coordinates are local.

    Raises
    ------
    ValueError
        If a column is missing.
    """
    local = frame.crs is not None and is_local(frame.crs)
    columns = {name: kind for name, kind in contract[layer].columns.items() if not (local and name in GLOBAL)}
    missing = sorted(set(columns) - set(frame.columns))
    if missing:
        raise ValueError(f"layer {layer} lacks {', '.join(missing)}")
    found = frame[[*columns, "geometry"]]
    kinds = found.dtypes
    other = {name: found[name].astype(kind) for name, kind in columns.items() if kinds[name] != kind}
    return found.assign(**other) if other else found


def labelled(table: gpd.GeoDataFrame, rows: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Give what belongs to rows, by ``row_id``, their ``label``."""
    return table.assign(label=table["row_id"].map(dict(zip(rows["row_id"], rows["label"], strict=True))).astype(str))


def parcel_layer(
    parcel: str, rows: gpd.GeoDataFrame, polygon: shapely.Geometry | None, points: Cloud
) -> gpd.GeoDataFrame:
    """The parcel's polygon and totals; without one those of its blocks, "F 1", "F 2" if there are several."""
    blocks = outline_blocks(rows)
    if polygon or len(blocks) == 0:
        polygons = [polygon or _extent(points)]
        totals = [_totals(parcel, rows, polygons[0], points)]
    else:
        polygons = list(blocks.geometry)
        names = [parcel] if len(blocks) == 1 else [f"{parcel} {block}" for block in blocks["block"]]
        totals = [
            _totals(name, rows[rows["block"] == block], polygon, points)
            for name, block, polygon in zip(names, blocks["block"], polygons, strict=True)
        ]
    shapes = [shapely.multipolygons(polygons_of(polygon)) for polygon in polygons]
    return gpd.GeoDataFrame(totals, geometry=shapes, crs=points.crs)


def _extent(points: Cloud) -> shapely.Geometry:
    polygon: shapely.Geometry = shapely.box(*points.extent[0][:2], *points.extent[1][:2])
    return polygon


def _totals(name: str, rows: gpd.GeoDataFrame, polygon: shapely.Geometry, points: Cloud) -> dict[str, Any]:
    angle = np.exp(2j * np.radians(rows["orientation_deg"])) @ rows["length_m"]
    return {
        "parcel": name,
        "n_rows": len(rows),
        "rows_length_m": rows["length_m"].sum(),
        "area_m2": float(shapely.area(polygon)),
        "spacing_m": rows["spacing_m"].median(),
        "orientation_deg": np.degrees(np.angle(angle)) / 2 if len(rows) else np.nan,
        "gap_m": rows["gap_m"].sum(),
        "n_missing": rows["n_missing"].sum(),
        "vine_spacing_m": rows["vine_spacing_m"].median(),
        "vertical_datum": points.vertical or "",
        "unseen_m": rows["unseen_m"].sum(),
    }
