"""Open projects or GeoPackages' layers as QGIS does, tell what it sees, and draw the map.

usage: QT_QPA_PLATFORM=offscreen PYTHON_OF_QGIS open_in_qgis.py

It runs with the Python that QGIS is installed for, and first says its version. Each line that comes in is the JSON of
[FILE, PNG, PAGE], where PAGE is for the project's page to print, as PNG, or null; one with what was seen goes out.
"""

import json
import os
import sys

from qgis.core import (
    Qgis,
    QgsApplication,
    QgsCoordinateTransform,
    QgsLayoutExporter,
    QgsLayoutItem,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsProject,
    QgsProviderRegistry,
    QgsRasterLayer,
    QgsRectangle,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor


def opened(path):
    """The layers of a file, what is drawn first last."""
    if path.endswith(".tif"):
        return [QgsRasterLayer(path, "raster")]
    found = [one for one in QgsProviderRegistry.instance().querySublayers(path) if one.name() != "layer_styles"]
    layers = [QgsVectorLayer(one.uri(), one.name(), "ogr") for one in found]
    return sorted(layers, key=lambda layer: layer.geometryType())


def told(layer):
    about = {
        "name": layer.name(),
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "error": layer.error().message(),
    }
    if isinstance(layer, QgsRasterLayer):
        provider = layer.dataProvider()
        return about | {"kind": "raster", "renderer": layer.renderer().type(), "nodata": provider.sourceNoDataValue(1)}
    renderer = layer.renderer()
    classes = [
        {"low": r.lowerValue(), "high": r.upperValue(), "label": r.label(), "colour": r.symbol().color().name()}
        for r in (renderer.ranges() if renderer.type() == "graduatedSymbol" else [])
    ]
    if renderer.type() == "categorizedSymbol":
        classes = [{"label": c.label(), "colour": c.symbol().color().name()} for c in renderer.categories()]
    return about | {
        "kind": "vector",
        "n": layer.featureCount(),
        "renderer": renderer.type(),
        "classes": classes,
        "colour": "" if classes else renderer.symbol().color().name(),
        "labels": layer.labelsEnabled(),
        "scale": layer.minimumScale() if layer.hasScaleBasedVisibility() else None,
        "styled": layer.loadDefaultStyle()[1],
        "tip": layer.mapTipTemplate(),
        "about": layer.metadata().abstract(),
        "aliases": {f.name(): layer.attributeDisplayName(k) for k, f in enumerate(layer.fields())},
    }


def print_page(project, png):
    layout = project.layoutManager().layoutByName("Map")
    settings = QgsLayoutExporter.ImageExportSettings()
    settings.dpi, settings.generateWorldFile = 120, False
    exporter = QgsLayoutExporter(layout)
    done = exporter.exportToImage(png, settings) == QgsLayoutExporter.Success
    return {"page": done, "items": sorted(type(i).__name__ for i in layout.items() if isinstance(i, QgsLayoutItem))}


def draw(layers, extent, crs, png, width=1400, dpi=144):
    settings = QgsMapSettings()
    settings.setLayers(layers)
    settings.setDestinationCrs(crs)
    settings.setTransformContext(QgsProject.instance().transformContext())
    settings.setBackgroundColor(QColor("white"))
    settings.setOutputDpi(dpi)
    settings.setOutputSize(QSize(width, round(width * extent.height() / extent.width())))
    settings.setExtent(extent)
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    image = job.renderedImage()
    image.save(png)
    colours = {image.pixel(x, y) for x in range(0, image.width(), 3) for y in range(0, image.height(), 3)}
    return {"drawn_at": round(settings.scale()), "errors": [e.message for e in job.errors()], "colours": len(colours)}


def look(path, png, page):
    project = QgsProject.instance()
    project.clear()
    if path.endswith((".qgz", ".qgs")):
        read = project.read(path)
        tree = project.layerTreeRoot()
        everything = [n.layer() for n in tree.findLayers()]
        layers = [n.layer() for n in tree.findLayers() if n.isVisible()]
        extent, crs = project.viewSettings().defaultViewExtent(), project.crs()
    else:
        read, layers = True, opened(path)
        everything = layers
        crs = next(layer.crs() for layer in layers if not layer.crs().isGeographic())
        extent = QgsRectangle()
        for layer in layers:
            here = QgsCoordinateTransform(layer.crs(), crs, project)
            extent.combineExtentWith(here.transformBoundingBox(layer.extent()))
    report = {"read": read, "title": project.title(), "crs": crs.authid()}
    report["extent"] = [extent.xMinimum(), extent.yMinimum(), extent.xMaximum(), extent.yMaximum()]
    report["layers"] = [told(layer) for layer in everything]
    if path.endswith(".qgz"):
        report["stored"] = [layer.publicSource() for layer in everything]
        report["visible"] = [layer.name() for layer in layers]
    if page:
        report |= print_page(project, page)
    return report | draw(layers, extent, crs, png)


def say(what):
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    QgsApplication.setPrefixPath("/usr", useDefaultPaths=True)
    application = QgsApplication([], GUIenabled=False)
    application.initQgis()
    say(Qgis.QGIS_VERSION)
    for line in sys.stdin:
        say(look(*json.loads(line)))
    os._exit(0)  # PyQGIS crashes when it is left the usual way
