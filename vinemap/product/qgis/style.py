"""How a product looks in QGIS: the styles of its layers and rasters, and the words for its columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from vinemap.evaluate.unmapped import ALONE, LOW, ROWLESS, TALL, WIDE
from vinemap.evaluate.vines import VINE, WEAK
from vinemap.product.qgis.symbology import (
    by_value,
    categorised,
    classes_of,
    graduated,
    hillshade,
    labels_at_start,
    node,
    pseudocolour,
    qml,
    ramp,
    rgba,
    single,
)
from vinemap.rows.standing.gaps import MISSING, UNSEEN

if TYPE_CHECKING:
    from collections.abc import Mapping
    from xml.etree.ElementTree import Element

    import geopandas as gpd
    from numpy.typing import NDArray

UNITS = {"m": "m", "deg": "°", "m2": "m²", "m3": "m³"}
WORDS = {
    "row_id": "Row",
    "n_rows": "Rows",
    "n_key_points": "Key points",
    "n_points": "Points",
    "extent_m": "Length of row that the points are from (m)",
    "n_missing": "Missing vines",
    "support": "Share of the length with canopy",
    "confidence": "Confidence that it is a row",
    "canopy_confidence": "Confidence in the canopy's numbers",
    "mesh_error_m": "Distance of the foliage's surface to the mesh (m)",
    "elevation_diff_m": "Elevation difference en − e1 (m)",
    "gap_m": "Length of gaps (m)",
    "unseen_m": "Length that was not seen (m)",
    "state": "State: what stands there",
    "beyond": "What is beyond that end",
    "number": "Number from e1",
    "position_sd_m": "Standard deviation of the position (m)",
    "share": "Share of the parcel",
    "rows_length_m": "Length of all rows (m)",
    "bottom_m": "Bottom of the foliage (m)",
    "trv_m3_ha": "Tree-row volume (m³/ha)",
    "lwa_m2_ha": "Leaf-wall area (m²/ha)",
    "good": "Good modelling",
    "under": "Under-modelling",
    "over": "Over-modelling",
    "reduction": "Complexity reduction",
    "quality": "Quality score",
    "n_poses": "Poses",
    "lat": "Latitude (°)",
    "lon": "Longitude (°)",
    "seconds": "Time (s)",
    "time": "Date and time (UTC)",
    "x_m": "East of the start (m)",
    "y_m": "North of the start (m)",
    "heading_deg": "Heading, clockwise from north (°)",
    "measured_from": "Pose it was measured from",
    "height_mm": "Camera above ground (mm)",
    "tilt_deg": "Tilt of the ground (°)",
    "sd_m": "Standard deviation of the place (m)",
    "sd_heading_deg": "Standard deviation of the heading (°)",
    "row": "Nearest row",
    "row_distance_m": "Distance from that row (m)",
    "row_position_m": "Position along that row (m)",
}
END_UNITS = {"x": "m", "y": "m", "z": "m", "lat": "°", "lon": "°", "alt": "m"}

INK, PAPER, RED, TRACK, GREY = "#1d2b24", "#ffffff", "#d7263d", "#1b6ca8", "#8b8f96"
VIGOUR = ("#f7f06d", "#c2e06b", "#7cc96a", "#36a463", "#10775a", "#064b4a")
"""From little to much foliage, told apart by lightness alone as well."""
TERRAIN = ("#3b5f4c", "#6c8c5a", "#a9b87a", "#dccfa0", "#c69f74", "#9a6b50", "#f4efe9")
SPACINGS = ("#f6eff7", "#d0d1e6", "#a6bddb", "#67a9cf", "#1c9099", "#016c59")
LIKELIHOODS = ("#ffffff", "#fee8c8", "#fdbb84", "#e34a33", "#7f0000")
DIRECTIONS = ("#e0558d", "#e88a3c", "#b3b43a", "#4bb56b", "#3aa7c4", "#7377d9", "#e0558d")
"""A round of colours, as 180° is 0°."""
CANOPY = ("#ccd9bf", "#ccd9bf", "#a9c19b", "#84a67c", "#5f8a61", "#3c6a4b")
REASONS = {ROWLESS: "#c2185b", ALONE: "#ef6fa5", LOW: "#f0a202", WIDE: "#96582a", TALL: "#566a8c"}
"""Colours of what is in no row, by the reason."""
VINES = {VINE: INK, WEAK: "#f0a202", MISSING: RED, UNSEEN: GREY}
"""Colours of vines, by what stands in their places."""
CATEGORIES = {"unmapped": ("reason", REASONS), "vines": ("state", VINES)}
LOWEST_CANOPY, HIGHEST_CANOPY = 0.5, 2.5
"""Metres between which the canopies' height has its colours, the same in all parcels and surveys."""

VOLUME_PER_METRE = 'coalesce("volume_m3" / ("length_m" - "unseen_m"), 0)'
CASING = {"line_color": rgba("#1d2b24c8"), "line_width": "1.3", "capstyle": "flat"}
SYMBOLS = {
    "rows": ("line", [CASING, {"line_width": "0.9", "capstyle": "flat"}]),
    "gaps": ("line", [{"line_width": "1.9", "capstyle": "flat"}]),
    "sections": ("line", [{"line_width": "0.4", "capstyle": "flat"}]),
    "row_ends": ("marker", [{"color": rgba(PAPER), "outline_color": rgba(INK), "outline_width": "0.3", "size": "1.6"}]),
    "key_points": ("marker", [{"color": rgba(INK), "outline_style": "no", "size": "0.9"}]),
    "candidates": ("line", [{"line_color": rgba("#f0a202"), "line_width": "0.7", "line_style": "dash"}]),
    "history": ("line", [{"line_color": rgba(GREY), "line_width": "0.3", "line_style": "dot"}]),
    "track": ("line", [CASING | {"line_color": rgba(PAPER)}, {"line_color": rgba(TRACK), "line_width": "0.7"}]),
    "band": ("fill", [{"color": rgba(TRACK + "40"), "outline_style": "no"}]),
    "poses": ("marker", [{"outline_style": "no", "size": "1.3"}]),
    "vines": ("marker", [{"outline_width": "0.3", "size": "1.5"}]),
    "unmapped": ("fill", [{"outline_width": "0.4"}]),
    "parcel": (
        "fill",
        [{"style": "no", "outline_color": rgba("#5b3f8c"), "outline_width": "0.6", "outline_style": "dash"}],
    ),
}
GAPS = {MISSING: {"line_color": rgba(RED)}, UNSEEN: {"line_color": rgba(GREY)}}
FLAGGED = "if(\"flag\" = '', 0, 1)"
MEASURED_OR_NOT = [(-0.5, 0.5, "measured", TRACK), (0.5, 1.5, "flagged", RED)]
SMALLEST_SCALE = {"sections": 800, "vines": 800, "key_points": 1500, "row_ends": 4000, "poses": 500}
"""Layers of small things show from this scale denominator on."""
LABEL_SCALE = 4000
MAP_TIPS = {
    "rows": "<b>Row [% label %]</b><br>[% round(length_m, 1) %] m, [% round(volume_m3 / (length_m - unseen_m), 2) %] "
    "m³/m<br>[% round(height_m, 2) %] m high, [% round(width_m, 2) %] m wide<br>missing vines: [% n_missing %]"
    "[% if(unseen_m > 0, '<br>not seen: ' || round(unseen_m, 1) || ' m', '') %]"
    "<br>confidence: [% round(confidence, 2) %] in the row[% if(canopy_confidence is null, '', ', ' || "
    "round(canopy_confidence, 2) || ' in its canopy') %][% if(flags = '', '', '<br>' || flags) %]",
    "candidates": "<b>[% label %]</b>, found by [% survey %]<br>confidence: [% round(confidence, 2) %]",
    "history": "<b>[% label %]</b><br>[% date %]: [% what %] ([% by %])",
    "gaps": "<b>Gap in row [% label %]</b><br>[% round(length_m, 1) %] m, "
    "[% if(state = 'unseen', 'not seen', 'missing vines: ' || n_missing) %]",
    "vines": "<b>Row [% label %], [% number %]</b> at [% round(position_m, 1) %] m<br>[% state %]"
    "[% if(height_m is null, '', '<br>' || round(height_m, 2) || ' m high, ' || round(width_m, 2) || ' m wide, ' || "
    "round(volume_m3, 2) || ' m³') %]",
    "sections": "<b>Row [% label %]</b> at [% round(position_m, 1) %] m<br>[% round(height_m, 2) %] m high, "
    "[% round(width_m, 2) %] m wide",
    "row_ends": "<b>Row [% label %]</b>, end [% end %][% if(beyond = 'seen', '', '<br>it may go on: ' || beyond) %]",
    "unmapped": "<b>In no row: [% reason %]</b><br>[% round(area_m2) %] m², [% round(height_m, 1) %] m high, "
    "closed over [% round(width_m, 1) %] m",
    "track": "<b>Stretch [% stretch %]</b><br>[% round(length_m, 2) %] m, [% n_poses %] poses",
    "poses": "<b>[% frame %]</b><br>heading [% round(heading_deg, 1) %]°<br>score [% round(score, 2) %]"
    "[% if(flag = '', '', '<br>flagged: ' || flag) %]",
}


KNOWN = ("line", [CASING, {"line_width": "0.9", "capstyle": "flat", "line_color": rgba(CANOPY[-2])}])
"""Symbol of a row that nothing was measured of."""
REGISTERED = "<b>Row [% label %]</b> of [% parcel %]<br>since [% since %][% coalesce(', edited ' || edited, '') %]"
"""Its map tip."""


class Style(NamedTuple):
    """A layer's definition: elements, and attributes of what holds them (a style or a project's layer)."""

    body: list[Element]
    attributes: dict[str, str]

    def qml(self) -> str:
        """The definition as a style of its own, in QML."""
        return qml(self.body, self.attributes)


def layer_styles(layers: Mapping[str, gpd.GeoDataFrame]) -> pd.DataFrame:
    """Table ``layer_styles`` for a GeoPackage's layers, by which QGIS 3 shows them."""
    records = [
        {
            "f_table_catalog": "",
            "f_table_schema": "",
            "f_table_name": name,
            "f_geometry_column": "geom",
            "styleName": "vinemap",
            "styleQML": vector_style(name, table).qml(),
            "styleSLD": "",
            "useAsDefault": True,
            "description": "vinemap",
            "owner": "",
            "ui": "",
            "update_time": pd.Timestamp("2000-01-01"),
        }
        for name, table in layers.items()
    ]
    return pd.DataFrame(records)


def alias(column: str) -> str:
    """Column name as a person reads it: ``length_m`` is "Length (m)"."""
    if column in WORDS:
        return WORDS[column]
    stem, _, unit = column.rpartition("_")
    if stem in ("e1", "en"):
        return f"{stem} {unit} ({END_UNITS[unit]})"
    words, suffix = (stem, f" ({UNITS[unit]})") if unit in UNITS else (column, "")
    return words.replace("_", " ").capitalize() + suffix


def vector_style(layer: str, table: gpd.GeoDataFrame) -> Style:
    """Style of a layer of the contract; rows, sections and what is in no row have classes that fit their own values.

    Parameters
    ----------
    layer : str
        Its name.
    table : GeoDataFrame
        Its features.
    """
    registered = layer == "rows" and "volume_m3" not in table
    tip = REGISTERED if registered else MAP_TIPS.get(layer)
    renderer = single(KNOWN) if registered else _renderer(layer, table)
    columns = [str(name) for name in table.columns if name != "geometry"]
    aliases = [node("alias", field=name, index=k, name=alias(name)) for k, name in enumerate(columns, start=1)]
    body = [renderer, node("aliases", *aliases)]
    attributes = {"labelsEnabled": "0"}
    if layer == "rows":
        # Rows are drawn in the grid's frame, and their attribute is from true east.
        direction = "degrees(azimuth(start_point($geometry), end_point($geometry))) - 90"
        body.append(labels_at_start("row_id", rotation=direction, scale=LABEL_SCALE, colour=INK))
        attributes["labelsEnabled"] = "1"
    if tip:
        body.append(node("mapTip", tip))
    if "label" in columns:
        body.append(node("previewExpression", '"label"'))
    if layer in SMALLEST_SCALE:
        attributes |= {"hasScaleBasedVisibilityFlag": "1", "minScale": str(SMALLEST_SCALE[layer]), "maxScale": "0"}
    return Style(body, attributes)


def _renderer(layer: str, table: gpd.GeoDataFrame) -> Element:
    """What draws a layer of a product or a track."""
    symbol = SYMBOLS[layer]
    if layer == "rows":
        volume = (table["volume_m3"] / (table["length_m"] - table["unseen_m"])).to_numpy()
        return graduated(VOLUME_PER_METRE, classes_of(volume, VIGOUR, step=0.05, unit="m³/m"), symbol)
    if layer == "sections":
        return graduated("height_m", classes_of(table["height_m"].to_numpy(), VIGOUR, step=0.1, unit="m"), symbol)
    if layer in CATEGORIES:
        column, colours = CATEGORIES[layer]
        there = {value: shade for value, shade in colours.items() if (table[column] == value).any()}
        return categorised(column, there or colours, symbol)
    if layer == "gaps":
        states = {state: own for state, own in GAPS.items() if state == MISSING or (table["state"] == state).any()}
        return by_value("state", states, symbol)
    if layer == "poses":
        return graduated(FLAGGED, MEASURED_OR_NOT, symbol)
    return single(symbol)


def raster_style(kind: str, values: NDArray[np.floating]) -> Style:
    """Style of a product's raster: ``dtm``, ``chm``, ``row_direction``, ``row_spacing`` or ``vineyard_likelihood``."""
    if kind == "chm":
        stops = [(LOWEST_CANOPY - 0.1, CANOPY[0]), *ramp(CANOPY[1:], LOWEST_CANOPY, HIGHEST_CANOPY)]
        return Style([pseudocolour(stops, unit="m", clear=True)], {})
    if kind == "row_direction":
        return Style([pseudocolour(ramp(DIRECTIONS, 0, 180), unit="°")], {})
    if kind == "vineyard_likelihood":
        return Style([pseudocolour(ramp(LIKELIHOODS, 0, 1), unit="")], {})
    colours, step = (TERRAIN, 1.0) if kind == "dtm" else (SPACINGS, 0.1)
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, [0.02, 0.98]) if len(finite) else (0.0, 0.0)
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    return Style([pseudocolour(ramp(colours, low, max(high, low + step)), unit="m")], {})


def relief_style() -> Style:
    """Style of the terrain as relief, beneath a map."""
    return Style([hillshade(opacity=0.4)], {})
