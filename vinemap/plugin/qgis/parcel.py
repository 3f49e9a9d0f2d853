"""Map a parcel: ``vinemap run``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from qgis.core import (
    QgsProcessing,
    QgsProcessingException,
    QgsProcessingOutputVectorLayer,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterString,
)

from .algorithm import MAPPING, Command, add_cloud, add_common, files
from .command import call
from .loading import LAYERS, geopackages, load


class MapParcel(Command):
    """Rows and canopies of one parcel."""

    NAME, TITLE = "mapparcel", "Map a parcel"
    HELP = (
        "Maps the vine rows and canopies in a point cloud, and loads them: rows by canopy volume, gaps, vines, and "
        "what stands in no row. The folder holds more: rasters, a 3D model, a project and a page to read.\n"
        "Without a boundary all of the cloud is one parcel. The first run takes half a minute longer."
    )
    FLAGS: ClassVar[dict[str, str]] = {
        **MAPPING,
        "BOUNDARY": "--boundary",
        "PARCEL": "--parcel",
        "CLASSIFIED": "--classified",
        "PLAIN": "--plain",
    }

    def initAlgorithm(self, configuration: Any = None) -> None:
        """Parameters and outputs."""
        del configuration
        add_cloud(self)
        polygons = [QgsProcessing.TypeVectorPolygon]
        self.add(
            QgsProcessingParameterFeatureSource("BOUNDARY", "Boundary of the parcel", polygons, optional=True),
            "Polygon to clip to, in any CRS: of several the one with the parcel's name, or all.",
        )
        self.add(
            QgsProcessingParameterString("PARCEL", "Name of the parcel", optional=True),
            "The cloud's by default; as it stands in a column of the boundary.",
        )
        add_common(self)
        self.add(
            QgsProcessingParameterBoolean("CLASSIFIED", "Write the points, too", defaultValue=False),
            "Every point with its class and its row.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterBoolean("PLAIN", "Plain meshes", defaultValue=False),
            "For readers of glTF that know no extension: larger files.",
            advanced=True,
        )
        self.add(QgsProcessingParameterFolderDestination("OUTPUT", "Folder of the product"), "For all that is made.")
        self.addOutput(QgsProcessingOutputVectorLayer("ROWS_LAYER", "Rows"))

    def processAlgorithm(self, parameters: dict[str, Any], context: Any, feedback: Any) -> dict[str, Any]:
        """Run the command."""
        options = self.options(parameters, context, feedback)
        folder = Path(options[options.index("--out") + 1])
        call(["run", *options, *files(self, "CLOUD", parameters, context)], feedback)
        if feedback.isCanceled():
            return {}
        made = geopackages(folder)
        if not made:
            raise QgsProcessingException(f"{folder}: holds no product")
        path = made[-1]
        sources = [
            load(path, layer, context, name=layer, group=path.stem, rank=rank) for rank, layer in enumerate(LAYERS)
        ]
        return {"OUTPUT": str(folder), "ROWS_LAYER": sources[LAYERS.index("rows")]}
