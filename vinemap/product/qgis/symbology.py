"""Pieces of QGIS's layer definitions (QML): symbols, classes of colour, labels, and colours of rasters.

They are XML elements, so that the same go into a style of a GeoPackage, a ``.qml`` file and a project.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element, tostring

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

QGIS = "3.22.0-Białowieża"
"""Version of QGIS from which on these definitions are understood."""
LAYER_CLASS = {"line": "SimpleLine", "marker": "SimpleMarker", "fill": "SimpleFill"}

Symbol = tuple[str, list[dict[str, str]]]
"""Kind (line, marker, fill) and the properties of its layers, the lowest first."""
Class = tuple[float, float, str, str]
"""Lower and upper bound, label, colour."""


def node(tag: str, /, *children: Element | str, **attributes: object) -> Element:
    """An XML element."""
    element = Element(tag, {name.rstrip("_"): str(value) for name, value in attributes.items()})
    for child in children:
        if isinstance(child, str):
            element.text = child
        else:
            element.append(child)
    return element


def qml(body: Sequence[Element], attributes: Mapping[str, str]) -> str:
    """A whole style."""
    root = node("qgis", *body, version=QGIS, styleCategories="AllStyleCategories", **attributes)
    return "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root, encoding="unicode")


def single(symbol: Symbol) -> Element:
    """One symbol for all features."""
    return node("renderer-v2", node("symbols", _symbol("0", symbol)), type="singleSymbol", symbollevels=0)


def graduated(expression: str, classes: Sequence[Class], symbol: Symbol) -> Element:
    """A symbol whose last layer has the colour of the class in which an expression's value lies."""
    kind, layers = symbol
    colour = "color" if kind == "marker" else "line_color"
    symbols = [
        _symbol(str(k), (kind, [*layers[:-1], layers[-1] | {colour: rgba(shade)}]))
        for k, (_, _, _, shade) in enumerate(classes)
    ]
    ranges = [
        node("range", lower=repr(low), upper=repr(high), symbol=k, label=label, render="true")
        for k, (low, high, label, _) in enumerate(classes)
    ]
    return node(
        "renderer-v2",
        node("ranges", *ranges),
        node("symbols", *symbols),
        node("classificationMethod", id="Custom"),
        type="graduatedSymbol",
        attr=expression,
        graduatedMethod="GraduatedColor",
        symbollevels=0,
    )


def categorised(column: str, colours: Mapping[str, str], symbol: Symbol) -> Element:
    """A fill whose last layer has the colour of a column's value, see-through but for its edge."""
    shades = {value: {"color": rgba(f"{shade}70"), "outline_color": rgba(shade)} for value, shade in colours.items()}
    return by_value(column, shades, symbol)


def by_value(column: str, properties: Mapping[str, Mapping[str, str]], symbol: Symbol) -> Element:
    """A symbol whose last layer has further properties by a column's value."""
    kind, layers = symbol
    symbols = [
        _symbol(str(k), (kind, [*layers[:-1], layers[-1] | dict(own)])) for k, own in enumerate(properties.values())
    ]
    categories = [
        node("category", value=value, label=value, symbol=k, render="true") for k, value in enumerate(properties)
    ]
    return node(
        "renderer-v2",
        node("categories", *categories),
        node("symbols", *symbols),
        type="categorizedSymbol",
        attr=column,
        symbollevels=0,
    )


def _symbol(name: str, symbol: Symbol) -> Element:
    kind, layers = symbol
    drawn = [
        node("layer", options(properties), class_=LAYER_CLASS[kind], enabled=1, locked=0, pass_=0)
        for properties in layers
    ]
    return node("symbol", *drawn, type=kind, name=name, alpha=1, clip_to_extent=1, force_rhr=0)


def fill(properties: Mapping[str, str]) -> Element:
    """A fill of its own."""
    return _symbol("", ("fill", [dict(properties)]))


def options(values: Mapping[str, Any]) -> Element:
    """Options by name, and options within them."""
    kinds = {bool: "bool", int: "int", str: "QString"}
    children = []
    for name, value in values.items():
        if isinstance(value, dict):
            child = options(value)
            child.set("name", name)
        else:
            text = str(value).lower() if isinstance(value, bool) else value
            child = node("Option", name=name, type=kinds[type(value)], value=text)
        children.append(child)
    return node("Option", *children, type="Map")


def labels_at_start(expression: str, *, rotation: str, scale: int, colour: str) -> Element:
    """Labels before the first point of each line, in its direction, from a scale denominator on.

    ``rotation`` is an expression in degrees clockwise.
    """
    turned = {"active": True, "expression": rotation, "type": 3}
    settings = node(
        "settings",
        node(
            "text-style",
            node("text-buffer", bufferDraw=1, bufferSize="0.7", bufferColor="255,255,255,220", bufferOpacity=1),
            fieldName=expression,
            isExpression=1,
            fontSize="6.5",
            fontSizeUnit="Point",
            fontWeight=63,
            textColor=rgba(colour),
        ),
        node(
            "placement",
            placement=1,
            quadOffset=3,
            xOffset="-1",
            offsetUnits="MM",
            geometryGenerator="start_point($geometry)",
            geometryGeneratorEnabled=1,
            geometryGeneratorType="PointGeometry",
            layerType="LineGeometry",
        ),
        node("rendering", drawLabels=1, scaleVisibility=1, scaleMin=0, scaleMax=scale, obstacle=0),
        node("dd_properties", options({"name": "", "properties": {"LabelRotation": turned}, "type": "collection"})),
    )
    return node("labeling", settings, type="simple")


def classes_of(values: NDArray[np.floating], colours: Sequence[str], *, step: float, unit: str) -> list[Class]:
    """Classes of round bounds, as many as there are colours at most, of which the outer ones are open.

    The bounds lie at multiples of 1, 2, 5, 10 … steps, within the middle 90% of the values.

    Parameters
    ----------
    values : ndarray, shape (n,)
        What is classed; NaN doesn't count.
    colours : sequence of str
        From low to high; few classes have those of the middle, as they differ little.
    step : float
        Least width of a class.
    unit : str
        Follows the numbers in the labels.
    """
    finite = np.asarray(values, dtype=float)
    finite = finite[np.isfinite(finite)]
    low, high = np.quantile(finite, [0.05, 0.95]) if len(finite) else (0.0, 0.0)
    inner: list[float] = []
    for width in (step * k * 10.0**power for power in itertools.count() for k in (1, 2, 5)):
        first, last = math.floor(low / width + 1e-9) + 1, math.ceil(high / width - 1e-9) - 1
        if last - first + 2 <= len(colours):
            inner = [round(k * width, 9) for k in range(first, last + 1)]
            break
    spare = (len(colours) - len(inner) - 1) // 2
    names = [f"{low:g} – {high:g} {unit}" for low, high in itertools.pairwise(inner)]
    names = [f"below {inner[0]:g} {unit}", *names, f"{inner[-1]:g} {unit} and more"] if inner else ["all"]
    bounds = [-1e9, *inner, 1e9]
    return [
        (*pair, name, shade)
        for pair, name, shade in zip(itertools.pairwise(bounds), names, colours[spare:], strict=False)
    ]


def pseudocolour(stops: Sequence[tuple[float, str]], *, unit: str, clear: bool = False) -> Element:
    """Colours of a raster by value, mixed between stops; with ``clear`` the lowest is see-through."""
    items = [
        node(
            "item",
            value=repr(float(value)),
            label=f"{value:g} {unit}".rstrip(),
            color=shade,
            alpha=0 if clear and k == 0 else 255,
        )
        for k, (value, shade) in enumerate(stops)
    ]
    low, high = repr(float(stops[0][0])), repr(float(stops[-1][0]))
    legend = node("rampLegendSettings", suffix=f" {unit}".rstrip(), useContinuousLegend=1)
    shader = node(
        "colorrampshader",
        *items,
        legend,
        colorRampType="INTERPOLATED",
        classificationMode=1,
        clip=0,
        minimumValue=low,
        maximumValue=high,
    )
    renderer = node(
        "rasterrenderer",
        node("rasterTransparency"),
        node("rastershader", shader),
        type="singlebandpseudocolor",
        band=1,
        opacity=1,
        alphaBand=-1,
        classificationMin=low,
        classificationMax=high,
        nodataColor="",
    )
    return node("pipe", _resampling("nearestNeighbour"), renderer, node("resamplingStage", "provider"))


def hillshade(*, opacity: float) -> Element:
    """A raster of elevations as relief, lit from several sides."""
    renderer = node(
        "rasterrenderer",
        node("rasterTransparency"),
        type="hillshade",
        band=1,
        opacity=opacity,
        alphaBand=-1,
        azimuth=315,
        angle=45,
        zfactor=1,
        multidirection=1,
        nodataColor="",
    )
    return node("pipe", _resampling("cubic"), renderer, node("resamplingStage", "provider"))


def _resampling(zoomed_in: str) -> Element:
    """Smooth where the map is finer than the raster; averages where it is coarser."""
    how = {"zoomedInResamplingMethod": zoomed_in, "zoomedOutResamplingMethod": "average", "maxOversampling": 2}
    return node("provider", node("resampling", enabled="true", **how))


def ramp(colours: Sequence[str], low: float, high: float) -> list[tuple[float, str]]:
    """Stops at even distances."""
    values = np.round(np.linspace(low, high, len(colours)), 6)
    return list(zip(values.tolist(), colours, strict=True))


def rgba(colour: str) -> str:
    """A colour ``#rrggbb`` or ``#rrggbbaa`` as QGIS writes it in symbols."""
    parts = [int(colour[k : k + 2], 16) for k in range(1, len(colour), 2)]
    return ",".join(str(part) for part in [*parts, 255][:4])
