"""Rows for opennav_row_coverage, the Nav2 task server that has robots cover a vineyard row by row.

The file is the GML of a field that Fields2Cover reads (``Parser::importFieldGml``), with rows as in
https://github.com/open-navigation/opennav_coverage (``util::parseRows``). Both read with a plain XML parser: prefixes
stand as they are expected, coordinates are separated by single spaces, and every row has as many as the next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree as ET

import numpy as np
import shapely

from vinemap import paths
from vinemap.errors import InputError
from vinemap.export.lanes import resampled
from vinemap.export.neighbours import aligned
from vinemap.rows.numbers import order_across

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.export.field import Field

GML = "http://www.opengis.net/gml"
STEP = 0.5
"""Metres between vertices, unless another number of them is asked for."""


def write_opennav_coverage(field: Field, folder: Path, *, frame: str, grid: bool, vertices: int | None) -> None:
    """Write a file of the rows of each block, and one of its lanes, for the server's ``gml_field``.

    Lanes are for mode ``ROWSARESWATHS``: the robot drives on them. Rows are for ``CENTER`` and ``OFFSET``, in which the
    server itself takes the middle between the vertices of two rows, so all run in one direction. Either way it goes by
    the order of the ids, from 1, which is that across the rows, whatever their numbers are; and it would take the last
    row of a block and the first of the next for neighbours, hence a file a block.

    Parameters
    ----------
    field : Field
        The parcel.
    folder : Path
        Where the files go.
    frame : str
        Name of the frame in which the robot knows the coordinates ("map").
    grid : bool
        Whether coordinates are those of the product's CRS, and not of {Main}.
    vertices : int, optional
        Vertices of every line; by default as many as put them half a metre apart on the longest.

    Raises
    ------
    InputError
        If no block has two rows, or lanes: the server wants two.
    OSError
        If it can't be written.
    """
    polygons = shapely.get_parts(field.plane(field.outline, grid=grid).geometry.to_numpy())
    written = 0
    for block, part in field.blocks():
        of = "" if block is None else f"{block}_"
        name = field.parcel if block is None else f"{field.parcel}_{block}"
        for kind, layer in (("rows", part.rows), ("lanes", part.lanes)):
            if len(layer) < 2:
                continue
            number = vertices or int(np.ceil(layer.length.max() / STEP)) + 1
            curves = aligned(field.plane(layer.iloc[order_across(layer)], grid=grid))
            lines = resampled([shapely.LineString(curve[:, :2]) for curve in curves], number)
            document = _document(name, polygons, lines, frame)
            path = paths.exported(folder, field.parcel, of + kind, ".xml")
            document.write(path, encoding="unicode", xml_declaration=True)
            written += 1
    if not written:
        raise InputError(f"{field.parcel}: opennav_coverage wants two rows of a block or more")


def _document(
    name: str, polygons: np.ndarray[Any, Any], lines: np.ndarray[Any, Any], frame: str
) -> ET.ElementTree[ET.Element]:
    every = shapely.multilinestrings(lines)
    around = max(polygons, key=lambda polygon: float(shapely.length(shapely.intersection(polygon, every))))
    root = ET.Element("GAOS_parcel", {"xmlns:gml": GML, "id": name})
    ring = ET.SubElement(_geometry(root, "Field", "boundary", "gml:Polygon", frame), "gml:outerBoundaryIs")
    ET.SubElement(ET.SubElement(ring, "gml:LinearRing"), "gml:coordinates").text = _coordinates(around.exterior)
    for k, line in enumerate(lines, start=1):
        geometry = _geometry(root, "Row", str(k), "gml:LineString", frame)
        ET.SubElement(geometry, "gml:coordinates").text = _coordinates(line)
    ET.indent(root)
    return ET.ElementTree(root)


def _geometry(root: ET.Element, tag: str, number: str, kind: str, frame: str) -> ET.Element:
    geometry = ET.SubElement(ET.SubElement(root, tag, {"id": number}), "geometry")
    return ET.SubElement(geometry, kind, {"srsName": frame})


def _coordinates(line: shapely.Geometry) -> str:
    return " ".join(f"{x:.3f},{y:.3f}" for x, y in shapely.get_coordinates(line))
