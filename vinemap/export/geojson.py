"""GeoJSON (RFC 7946), for web maps and whatever else reads it: https://www.rfc-editor.org/rfc/rfc7946."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pyogrio

from vinemap import paths

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.export.field import Field

DECIMALS, FIGURES = 9, 11
"""Decimals of a degree (a tenth of a millimetre), and figures of a number among the properties."""


def write_geojson(field: Field, folder: Path) -> None:
    """Write a file for each layer that isn't empty: ``rows``, ``lanes``, ``row_ends``, ``gaps`` and ``parcel``.

    Longitude, latitude and height, in this order; the height is above the datum of the product's cloud.

    Raises
    ------
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
