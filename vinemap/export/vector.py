"""Layers for whatever reads them: GeoJSON (RFC 7946), and shapefiles for terminals that read nothing else.

https://www.rfc-editor.org/rfc/rfc7946; ESRI Shapefile Technical Description, 1998.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pyogrio

from vinemap import paths

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.export.field import Field

DECIMALS, FIGURES = 9, 11
"""Decimals of a degree (a tenth of a millimetre), and figures of a number among the properties."""
# Names of columns of shapefiles have ten characters at the most.
COLUMNS = {
    "rows": ("row_id", "label", "block", "length_m", "spacing_m", "height_m", "width_m", "gap_m"),
    "lanes": ("lane_id", "label", "block", "right_rows", "left_rows", "length_m", "width_m", "narrowest_m", "clear_m"),
    "outline": ("parcel", "n_rows", "area_m2", "spacing_m"),
}
SHORT = {"narrowest_m": "narrow_m"}
GEOMETRY = {"rows": "LineString Z", "lanes": "LineString Z", "outline": "MultiPolygon"}


def write_geojson(field: Field, folder: Path) -> None:
    """Write a file for each layer that isn't empty: ``rows``, ``lanes``, ``row_ends``, ``gaps`` and ``parcel``.

    Longitude, latitude and height, in this order; the height is above the datum of the product's cloud.

    Raises
    ------
    InputError
        If coordinates are local.
    OSError or pyogrio.errors.DataSourceError
        If one can't be written.
    """
    for layer in ("rows", "lanes", "row_ends", "gaps", "outline"):
        frame = field.wgs84(layer)
        name = "parcel" if layer == "outline" else layer
        if len(frame):
            options = {"RFC7946": "YES", "COORDINATE_PRECISION": DECIMALS, "SIGNIFICANT_FIGURES": FIGURES}
            path = paths.exported(folder, field.parcel, name, ".geojson")
            pyogrio.write_dataframe(frame, path, driver="GeoJSON", layer=name, layer_options=options)


def write_shapefile(field: Field, folder: Path) -> None:
    """Write ``rows``, ``lanes`` and ``parcel``, as far as they aren't empty, in WGS 84 and with names in UTF-8.

    Raises
    ------
    InputError
        If coordinates are local.
    OSError or pyogrio.errors.DataSourceError
        If one can't be written.
    """
    for layer, columns in COLUMNS.items():
        frame = field.wgs84(layer)[[*columns, "geometry"]].rename(columns=SHORT)
        if len(frame):
            pyogrio.write_dataframe(
                frame,
                paths.exported(folder, field.parcel, "parcel" if layer == "outline" else layer, ".shp"),
                driver="ESRI Shapefile",
                geometry_type=GEOMETRY[layer],
                encoding="UTF-8",
                layer_options={"DBF_DATE_LAST_UPDATE": field.flown},
            )
