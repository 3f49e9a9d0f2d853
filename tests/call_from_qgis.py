"""What a QGIS without windows sees of the plugin: a program for QGIS's own Python, told of files by their paths.

It loads the layers of a product as QGIS does after an algorithm, stops a run, has one refused, and tells of it as JSON.
"""

import json
import os
import sys
from pathlib import Path
from threading import Thread

from qgis.core import (
    QgsApplication,
    QgsFeature,
    QgsGeometry,
    QgsLayerTreeRegistryBridge,
    QgsProcessingContext,
    QgsProcessingFeatureSourceDefinition,
    QgsProcessingFeedback,
    QgsProject,
    QgsVectorLayer,
)


class Feedback(QgsProcessingFeedback):
    """Notes what is said, and is cancelled from another thread, as by a dialog, when a stage is reached."""

    def __init__(self, until=""):
        super().__init__(logFeedback=False)
        self.until, self.words, self.stages, self.errors = until, "", [], []

    def pushCommandInfo(self, info):
        self.words = info

    def setProgressText(self, text):
        self.stages.append(text)
        if text == self.until:
            Thread(target=self.cancel).start()

    def reportError(self, error, fatalError=False):
        self.errors.append(error)


def run(name, parameters, feedback, project):
    context = QgsProcessingContext()
    context.setProject(project)
    algorithm = QgsApplication.processingRegistry().createAlgorithmById(f"vinemap:{name}")
    results, well = algorithm.run(parameters, context, feedback)
    return {"results": results, "well": well, "stages": feedback.stages, "errors": feedback.errors}


def loaded(product, project):
    """Layers from the top down, as they are after an algorithm of whose group one is the current layer."""
    from processing.gui.Postprocessing import handleAlgorithmResults
    from vinemap.loading import LAYERS, load

    context, root = QgsProcessingContext(), project.layerTreeRoot()
    context.setProject(project)
    place = QgsLayerTreeRegistryBridge.InsertionPoint(root.addGroup("A"), 0)
    project.layerTreeRegistryBridge().setLayerInsertionPoint(place)
    for rank, layer in enumerate(LAYERS):
        load(Path(product), layer, context, name=layer, group="A", rank=rank)
    handleAlgorithmResults(QgsApplication.processingRegistry().algorithmById("vinemap:mapparcel"), context)
    nodes = root.findLayers()
    return [[n.parent().name(), n.name(), n.layer().renderer().type(), n.layer().crs().authid()] for n in nodes]


def selected(wkt, crs, project):
    """A layer in memory of which one polygon of two is selected."""
    layer = QgsVectorLayer(f"Polygon?crs={crs}", "drawn", "memory")
    for shape in (wkt, "POLYGON((0 0, 1 0, 1 1, 0 0))"):
        feature = QgsFeature()
        feature.setGeometry(QgsGeometry.fromWkt(shape))
        layer.dataProvider().addFeature(feature)
    layer.selectByIds([1])
    project.addMapLayer(layer)
    return QgsProcessingFeatureSourceDefinition(layer.id(), selectedFeaturesOnly=True)


def look(plugins, cloud, product, wkt, crs, out):
    sys.path[:0] = [plugins, f"{QgsApplication.pkgDataPath()}/python/plugins"]
    from vinemap.command import environment

    from vinemap import classFactory

    plugin = classFactory(None)
    plugin.initProcessing()
    project, feedback = QgsProject.instance(), Feedback(until="DTM")
    boundary = selected(wkt, crs, project)
    stopped = run("mapparcel", {"CLOUD": cloud, "BOUNDARY": boundary, "OUTPUT": out}, feedback, project)
    written = feedback.words.split("--boundary ")[1].split()[0]
    drawn = QgsVectorLayer(written)
    stopped["boundary"] = [drawn.featureCount(), drawn.crs().authid(), drawn.getFeature(1).geometry().area()]
    project.clear()
    qgis = {"PATH": "C/OSGeo4W/bin:/bin", "OSGEO4W_ROOT": "C/OSGeo4W", "PYTHONHOME": "q", "PROJ_LIB": "q", "HOME": "h"}
    seen = {
        "stopped": stopped,
        "refused": run("mapparcel", {"CLOUD": f"{cloud}x", "OUTPUT": out}, Feedback(), project),
        "loaded": loaded(product, project),
        "environment": environment(qgis, "/usr/bin/vinemap"),
    }
    project.clear()
    plugin.unload()
    return seen


if __name__ == "__main__":
    QgsApplication.setPrefixPath("/usr", useDefaultPaths=True)
    application = QgsApplication([], GUIenabled=False)
    application.initQgis()
    sys.stdout.write(json.dumps(look(*sys.argv[1:])) + "\n")
    sys.stdout.flush()
    os._exit(0)  # PyQGIS crashes when it is left the usual way
