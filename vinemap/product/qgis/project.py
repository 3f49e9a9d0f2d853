"""The QGIS project of a product: its layers and rasters in groups, styled, opening at the parcel.

It names the files beside it by relative paths, so that the folder can be moved and copied as it is.
"""

from __future__ import annotations

import io
import zipfile
from typing import TYPE_CHECKING, NamedTuple
from xml.etree.ElementTree import Element, tostring

from vinemap import paths
from vinemap.geo.crs import WGS84
from vinemap.product.qgis.print_layout import print_layout
from vinemap.product.qgis.style import Style, raster_style, relief_style, vector_style
from vinemap.product.qgis.symbology import QGIS, node

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import geopandas as gpd
    from pyproj import CRS

    from vinemap.geo.raster import Raster

MARGIN = 0.06
"""Share of the parcel's size that the map shows about it."""
GEOMETRY = {"parcel": "Polygon", "unmapped": "Polygon", "row_ends": "Point", "key_points": "Point", "vines": "Point"}
LEGEND = ("rows", "gaps", "unmapped", "parcel", "chm")
EXPANDED = ("rows", "unmapped", "chm")
"""Layers whose classes the tree shows."""


class Entry(NamedTuple):
    """A line of the layer tree."""

    name: str
    """Of the layer in the GeoPackage, or of the raster's kind; "relief" is the terrain once more."""
    title: str
    shown: bool = True


TREE: dict[str, list[Entry]] = {
    "Rows": [
        Entry("row_ends", "Ends (zoom in)"),
        Entry("gaps", "Gaps"),
        Entry("rows", "Rows: canopy volume per metre"),
        Entry("unmapped", "In no row"),
    ],
    "Details": [
        Entry("vines", "Vines (zoom in)"),
        Entry("key_points", "Key points (zoom in)", shown=False),
        Entry("sections", "Sections: canopy height (zoom in)"),
    ],
    "Parcel": [Entry("parcel", "Parcel")],
    "Canopy and terrain": [
        Entry("chm", "Height above terrain"),
        Entry("relief", "Relief"),
        Entry("dtm", "Terrain elevation", shown=False),
    ],
    "Row field": [
        Entry("row_direction", "Row direction, anticlockwise from east", shown=False),
        Entry("row_spacing", "Inter-row spacing", shown=False),
        Entry("vineyard_likelihood", "Vineyard likelihood", shown=False),
    ],
}


def project(
    title: str,
    layers: Mapping[str, gpd.GeoDataFrame],
    rasters: Mapping[str, Raster],
    *,
    geopackage: str,
    tif: Mapping[str, str],
    notes: Sequence[str] = (),
) -> bytes:
    """A QGIS project (``.qgz``).

    Parameters
    ----------
    title : str
        Its title.
    layers : mapping of str to GeoDataFrame
        The GeoPackage's layers, ``parcel`` among them.
    rasters : mapping of str to Raster
        The rasters by kind.
    geopackage : str
        Path of the GeoPackage, as seen from the project.
    tif : mapping of str to str
        Paths of the rasters by kind, likewise.
    notes : sequence of str
        Lines at the foot of the page to print.
    """
    crs = layers["parcel"].crs
    listed = {entry.name: entry for entries in TREE.values() for entry in entries}
    drawn, sources = [], {}
    for entry in listed.values():
        if entry.name in layers:
            sources[entry.name] = f"{geopackage}|layername={entry.name}"
            drawn.append(_vector(entry, sources[entry.name], layers[entry.name]))
        else:
            kind = "dtm" if entry.name == "relief" else entry.name
            sources[entry.name] = tif[kind]
            style = relief_style() if entry.name == "relief" else raster_style(kind, rasters[kind].values)
            drawn.append(_map_layer(entry, tif[kind], style, crs, provider="gdal", type="raster"))
    bounds = _extent(layers["parcel"])
    extent = node("extent", *(node(name, value) for name, value in bounds.items()))
    canvas = [node("units", "meters"), extent, node("rotation", "0"), node("destinationsrs", _srs(crs))]
    lines = {"head": _totals(layers["parcel"]), "foot": [crs.name, *notes]}
    legend = [
        (_id(listed[name]), listed[name].title, "vector" if name in layers else "raster")
        for name in LEGEND
        if name not in layers or len(layers[name])
    ]
    root = node(
        "qgis",
        node("homePath", path=""),
        node("title", title),
        node("projectCrs", _srs(crs)),
        node("layer-tree-group", *(_group(name, entries, sources) for name, entries in TREE.items())),
        node("mapcanvas", *canvas, name="theMapCanvas", annotationsVisible=1),
        node("projectlayers", *drawn),
        node("ProjectViewSettings", node("DefaultViewExtent", _srs(crs), **bounds)),
        node("properties", *_properties()),
        node("Layouts", print_layout(title, lines, layers["parcel"].total_bounds, legend)),
        projectname=title,
        version=QGIS,
    )
    text = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root, encoding="unicode")
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        # Without a date of its own it would have today's.
        name = zipfile.ZipInfo(paths.QGIS_PROJECT, date_time=(1980, 1, 1, 0, 0, 0))
        archive.writestr(name, text, compress_type=zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def _totals(parcel: gpd.GeoDataFrame) -> list[str]:
    """The parcel in a few words."""
    total = parcel[["n_rows", "rows_length_m", "area_m2", "n_missing"]].sum()
    n, missing = int(total["n_rows"]), int(total["n_missing"])
    return [
        f"{n or 'no'} row{'' if n == 1 else 's'}",
        f"{total['rows_length_m']:,.0f} m in all",
        f"{total['area_m2'] / 1e4:.2f} ha",
        f"{missing or 'no'} missing {'vine' if missing == 1 else 'vines'}",
    ]


def _vector(entry: Entry, source: str, table: gpd.GeoDataFrame) -> Element:
    style = vector_style(entry.name, table)
    how = {"type": "vector", "geometry": GEOMETRY.get(entry.name, "Line")}
    return _map_layer(entry, source, style, table.crs or WGS84, provider="ogr", **how)


def _map_layer(entry: Entry, source: str, style: Style, crs: CRS, *, provider: str, **kind: str) -> Element:
    encoded = {"encoding": "UTF-8"} if provider == "ogr" else {}
    return node(
        "maplayer",
        node("id", _id(entry)),
        node("datasource", source),
        node("layername", entry.title),
        node("provider", provider, **encoded),
        node("srs", _srs(crs)),
        *style.body,
        **kind,
        **style.attributes,
    )


def _group(name: str, entries: Sequence[Entry], sources: Mapping[str, str]) -> Element:
    """A group of the layer tree, shown if something in it is."""
    shown = any(entry.shown for entry in entries)
    leaves = [_leaf(entry, sources[entry.name]) for entry in entries]
    return node("layer-tree-group", *leaves, name=name, checked=_checked(shown=shown), expanded=int(shown))


def _leaf(entry: Entry, source: str) -> Element:
    return node(
        "layer-tree-layer",
        id=_id(entry),
        name=entry.title,
        source=source,
        checked=_checked(shown=entry.shown),
        expanded=int(entry.name in EXPANDED),
    )


def _checked(*, shown: bool) -> str:
    return "Qt::Checked" if shown else "Qt::Unchecked"


def _id(entry: Entry) -> str:
    return f"vinemap_{entry.name}"


def _srs(crs: CRS) -> Element:
    authority = crs.to_authority()
    known = [node("authid", ":".join(authority))] if authority else []
    # WKT 2 has a datum or its ensemble, as PROJ's state will have it; WKT 1 is the same each time.
    return node("spatialrefsys", node("wkt", crs.to_wkt("WKT1_GDAL")), *known, node("description", crs.name))


def _extent(parcel: gpd.GeoDataFrame) -> dict[str, str]:
    west, south, east, north = parcel.total_bounds
    margin = MARGIN * max(east - west, north - south)
    bounds = {"xmin": west - margin, "ymin": south - margin, "xmax": east + margin, "ymax": north + margin}
    return {name: f"{value:.2f}" for name, value in bounds.items()}


def _properties() -> Iterator[Element]:
    def group(name: str, values: Mapping[str, tuple[str, str]]) -> Element:
        return node(name, *(node(key, text, type=kind) for key, (kind, text) in values.items()))

    yield group("SpatialRefSys", {"ProjectionsEnabled": ("int", "1")})
    yield group("Paths", {"Absolute": ("bool", "false")})
    yield group("Measure", {"Ellipsoid": ("QString", "EPSG:7030")})
    yield group("Measurement", {"DistanceUnits": ("QString", "meters"), "AreaUnits": ("QString", "ha")})
