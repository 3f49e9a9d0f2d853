"""Styles that QGIS shows without a click: the rows of a GeoPackage's ``layer_styles`` table, as QML."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import pandas as pd

if TYPE_CHECKING:
    from collections.abc import Mapping

UNITS = {"m": "m", "deg": "°", "m2": "m²", "m3": "m³"}
WORDS = {
    "row_id": "Row",
    "n_rows": "Rows",
    "n_key_points": "Key points",
    "n_points": "Points",
    "n_missing": "Missing vines",
    "support": "Share of the length with canopy",
    "elevation_diff_m": "Elevation difference en − e1 (m)",
    "gap_m": "Length without canopy (m)",
    "rows_length_m": "Length of all rows (m)",
    "bottom_m": "Bottom of the foliage (m)",
    "trv_m3_ha": "Tree-row volume (m³/ha)",
    "lwa_m2_ha": "Leaf-wall area (m²/ha)",
    "good": "Good modelling",
    "under": "Under-modelling",
    "over": "Over-modelling",
    "reduction": "Complexity reduction",
    "quality": "Quality score",
}
SYMBOLS = {
    "rows": ("line", "SimpleLine", {"line_color": "26,122,58,255", "line_width": "0.6", "capstyle": "round"}),
    "gaps": ("line", "SimpleLine", {"line_color": "227,66,52,255", "line_width": "1.1", "capstyle": "flat"}),
    "sections": ("line", "SimpleLine", {"line_color": "120,180,90,160", "line_width": "0.15"}),
    "row_ends": ("marker", "SimpleMarker", {"color": "255,255,255,255", "outline_color": "26,122,58,255", "size": "2"}),
    "key_points": ("marker", "SimpleMarker", {"color": "26,122,58,255", "outline_style": "no", "size": "0.9"}),
    "parcel": (
        "fill",
        "SimpleFill",
        {"style": "no", "color": "255,255,255,0", "outline_color": "110,80,160,255", "outline_width": "0.5"},
    ),
}
LABELS = {"rows": "label"}
SMALLEST_SCALE = {"sections": 600, "key_points": 2500}
"""Layers of small things show from this scale denominator on."""


def layer_styles(layers: Mapping[str, Mapping[str, str]]) -> pd.DataFrame:
    """Table ``layer_styles`` for layers and their columns, as QGIS 3 reads it from a GeoPackage."""
    records = [
        {
            "f_table_catalog": "",
            "f_table_schema": "",
            "f_table_name": name,
            "f_geometry_column": "geom",
            "styleName": "vinemap",
            "styleQML": qml(name, list(columns)),
            "styleSLD": "",
            "useAsDefault": True,
            "description": "vinemap",
            "owner": "",
            "ui": "",
            "update_time": pd.Timestamp("2000-01-01"),
        }
        for name, columns in layers.items()
    ]
    return pd.DataFrame(records)


def alias(column: str) -> str:
    """Column name as a person reads it: ``length_m`` is "Length (m)"."""
    if column in WORDS:
        return WORDS[column]
    stem, _, unit = column.rpartition("_")
    if stem in ("e1", "en"):
        return f"{stem} {unit}"
    words, suffix = (stem, f" ({UNITS[unit]})") if unit in UNITS else (column, "")
    return words.replace("_", " ").capitalize() + suffix


def qml(layer: str, columns: list[str]) -> str:
    """Style of a layer as QML."""
    kind, symbol, properties = SYMBOLS[layer]
    options = "".join(
        f'<Option name={quoteattr(k)} type="QString" value={quoteattr(v)}/>' for k, v in properties.items()
    )
    aliases = "".join(
        f'<alias field={quoteattr(column)} index="{k}" name={quoteattr(alias(column))}/>'
        for k, column in enumerate(columns, start=1)
    )
    labelled = int(layer in LABELS)
    scale = SMALLEST_SCALE.get(layer)
    visibility = f'hasScaleBasedVisibilityFlag="1" minScale="{scale}" maxScale="0"' if scale else ""
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
        f'<qgis version="3.22" styleCategories="AllStyleCategories" labelsEnabled="{labelled}" {visibility}>'
        '<renderer-v2 type="singleSymbol" symbollevels="0" enableorderby="0"><symbols>'
        f'<symbol type="{kind}" name="0" alpha="1" clip_to_extent="1" force_rhr="0">'
        f'<layer class="{symbol}" enabled="1" locked="0" pass="0"><Option type="Map">{options}</Option></layer>'
        f"</symbol></symbols></renderer-v2>{_labels(LABELS[layer]) if layer in LABELS else ''}"
        f"<aliases>{aliases}</aliases></qgis>"
    )


def _labels(field: str) -> str:
    return (
        '<labeling type="simple"><settings>'
        f'<text-style fieldName={quoteattr(field)} fontSize="8" textColor="20,70,35,255" isExpression="0">'
        '<text-buffer bufferDraw="1" bufferSize="0.8" bufferColor="255,255,255,255"/></text-style>'
        '<placement placement="2" placementFlags="9" repeatDistance="0"/>'
        '<rendering drawLabels="1" obstacle="0"/></settings></labeling>'
    )
