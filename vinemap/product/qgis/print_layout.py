"""The page to print in a product's QGIS project: A4, a map at a round scale, legend, scale bar and north arrow."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vinemap.product.qgis.symbology import fill, node, options, rgba

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from xml.etree.ElementTree import Element

NAME = "Map"
PAGE = (297.0, 210.0)
MAP = (10.0, 26.0, 212.0, 174.0)
"""Left, top, width and height on the page, mm."""
COLUMN = 228.0
"""Left of what stands beside the map, mm."""
SCALES = tuple(n * 10**k for k in (2, 3, 4) for n in (1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8))
LETTERS = 36
"""Of a title at full size; as many fit even where all are as wide as high."""
MARGIN = 1.06
"""What is shown over the parcel's size."""
INK = "#1d2b24"
BAR = 25.0
"""Least length of a half of the scale bar, mm."""
MAP_ITEM, PICTURE, LABEL, LEGEND, SCALE_BAR, PAGE_ITEM = (str(65638 + k) for k in (1, 2, 3, 4, 8, 0))
"""QGIS's numbers of the items' types."""
MAP_ID = "{7f1a3c52-5a4e-4d0c-9a4b-2d7a6f0c9e11}"


def map_scale(bounds: Sequence[float]) -> int:
    """Denominator of the largest round scale at which bounds (west, south, east, north; m) fit on the map."""
    width, height = bounds[2] - bounds[0], bounds[3] - bounds[1]
    least = 1000 * MARGIN * max(width / MAP[2], height / MAP[3])
    return round(next((scale for scale in SCALES if scale >= least), least))


def print_layout(
    title: str,
    lines: Mapping[str, Sequence[str]],
    bounds: Sequence[float],
    legend: Sequence[tuple[str, str, str]],
) -> Element:
    """A layout for :func:`vinemap.product.qgis.project.project`.

    Parameters
    ----------
    title : str
        What stands above the map.
    lines : mapping of str to sequence of str
        Lines below the title ("head") and at the foot of the column beside the map ("foot").
    bounds : sequence of float
        West, south, east and north of what is shown (m).
    legend : sequence of tuple
        Id, title and kind (vector, raster) of the layers in the legend.
    """
    scale = map_scale(bounds)
    return node(
        "Layout",
        node("PageCollection", fill({"color": "255,255,255,255", "outline_style": "no"}), _page()),
        _map(bounds, scale),
        _text(title, (MAP[0], 7, PAGE[0] - MAP[0] - 30, 10), size=min(20, LETTERS * 20 / len(title)), bold=True),
        _text(" · ".join(lines["head"]), (MAP[0], 17.5, MAP[2], 7), size=10),
        _legend(legend),
        _scale_bar(scale),
        _arrow(),
        _text("\n".join([f"1 : {scale:,}", *lines["foot"]]), (COLUMN, 172, PAGE[0] - COLUMN - 8, 28), size=8),
        name=NAME,
        units="mm",
        printResolution=300,
    )


def _item(kind: str, place: tuple[float, float, float, float], /, *children: Element, **attributes: object) -> Element:
    left, top, width, height = place
    return node(
        "LayoutItem",
        *children,
        type=kind,
        position=f"{left},{top},mm",
        positionOnPage=f"{left},{top},mm",
        size=f"{width},{height},mm",
        referencePoint=0,
        visibility=1,
        opacity=1,
        **({"frame": "false", "background": "false"} | attributes),
    )


def _page() -> Element:
    return _item(PAGE_ITEM, (0, 0, *PAGE), background="true")


def _map(bounds: Sequence[float], scale: int) -> Element:
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    across, up = (side * scale / 2000 for side in MAP[2:])
    extent = node("Extent", xmin=x - across, ymin=y - up, xmax=x + across, ymax=y + up)
    return _item(MAP_ITEM, MAP, extent, uuid=MAP_ID, frame="true", background="true", outlineWidthM="0.2,mm")


def _text(text: str, place: tuple[float, float, float, float], *, size: float, bold: bool = False) -> Element:
    font = node("LabelFont", description=_font(size, bold=bold), style="")
    ink = _colour("FontColor", INK)
    literal = text.replace("[%", "[%'['%]%")  # else QGIS takes it for an expression
    return _item(LABEL, place, font, ink, labelText=literal, htmlState=0, halign=1, valign=32, marginX=0, marginY=0)


def _colour(tag: str, colour: str) -> Element:
    red, green, blue, alpha = rgba(colour).split(",")
    return node(tag, red=red, green=green, blue=blue, alpha=alpha)


def _font(size: float, *, bold: bool) -> str:
    return f"Sans Serif,{size:g},-1,5,{75 if bold else 50},0,0,0,0,0"


def _legend(layers: Sequence[tuple[str, str, str]]) -> Element:
    shown = [_legend_layer(*layer) for layer in layers]
    sizes = {"title": 10, "group": 9, "subgroup": 9, "symbol": 8, "symbolLabel": 8}
    margins: dict[str, dict[str, float]] = {
        "subgroup": {"marginTop": 4},
        "symbol": {"marginTop": 1.5},
        "symbolLabel": {"marginLeft": 2},
    }
    styles = [
        node(
            "style",
            node("styleFont", description=_font(size, bold=name == "subgroup"), style=""),
            name=name,
            alignment=1,
            **margins.get(name, {}),
        )
        for name, size in sizes.items()
    ]
    return _item(
        LEGEND,
        (COLUMN, 24, 60, 110),
        node("styles", *styles),
        node("layer-tree-group", *shown),
        map_uuid=MAP_ID,
        resizeToContents=1,
        symbolWidth=7,
        symbolHeight=3.5,
        boxSpace=0,
        columnCount=1,
        columnSpace=2,
        lineSpacing=1,
        symbolAlignment=1,
        titleAlignment=1,
        fontColor=INK,
    )


def _legend_layer(name: str, title: str, kind: str) -> Element:
    # A raster's first line is the name of its band.
    kept = [node("customproperties", options({"legend/node-order": "1"}))] if kind == "raster" else []
    return node("layer-tree-layer", *kept, id=name, name=title, checked="Qt::Checked", expanded=1)


def _scale_bar(scale: int) -> Element:
    half = next(n for k in range(9) for n in (10**k, 2 * 10**k, 5 * 10**k) if n >= BAR * scale / 2000)
    millimetres = 1000 * half / scale
    return _item(
        SCALE_BAR,
        (COLUMN, 155, 2 * millimetres + 8, 12),
        node(
            "text-style", fontFamily="Sans Serif", fontSize=8, fontSizeUnit="Point", textColor=rgba(INK), textOpacity=1
        ),
        _colour("fillColor", INK),
        _colour("fillColor2", "#ffffff"),
        _colour("strokeColor", INK),
        mapUuid=MAP_ID,
        style="Single Box",
        unitType="meters",
        unitLabel="m",
        numMapUnitsPerScaleBarUnit=1,
        numUnitsPerSegment=half,
        numSegments=2,
        numSegmentsLeft=0,
        segmentMillimeters=millimetres,
        segmentSizeMode=0,
        height=2,
        labelBarSpace=1.5,
        boxContentSpace=0,
        outlineWidth=0.2,
        labelVerticalPlacement=0,
        labelHorizontalPlacement=0,
        alignment=0,
    )


def _arrow() -> Element:
    return _item(
        PICTURE,
        (PAGE[0] - 24, 7, 14, 16),
        file="arrows/NorthArrow_04.svg",
        mode=2,
        resizeMode=0,
        northMode=0,
        mapUuid=MAP_ID,
        svgFillColor=rgba(INK),
        svgBorderColor=rgba(INK),
        svgBorderWidth=0.2,
    )
