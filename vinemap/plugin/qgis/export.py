"""Export: ``vinemap export``."""

from __future__ import annotations

from typing import Any, ClassVar

from qgis.core import (
    QgsProcessing,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

from .algorithm import Command, files
from .command import call

FORMATS = ["agopengps", "geojson", "isoxml", "nav2", "opennav_coverage", "shapefile", "gazebo", "obj", "ply", "table"]
LINES = ["lanes", "rows", "both"]


class Export(Command):
    """Rows, lanes, canopies and tables for other programs."""

    NAME, TITLE = "export", "Export"
    HELP = (
        "Writes the rows of products, and lanes between them, for tractors (isoxml, agopengps), robots (nav2, "
        "opennav_coverage), GIS (geojson, shapefile), simulators (gazebo, obj, ply) and spreadsheets (table)."
    )
    FLAGS: ClassVar[dict[str, str]] = {
        "FORMATS": "--format",
        "LINES": "--lines",
        "HEADLAND": "--headland",
        "OUTER": "--outer",
        "FRAME": "--frame",
        "GRID": "--grid",
        "VERTICES": "--vertices",
        "OUTPUT": "--out",
    }

    def initAlgorithm(self, configuration: Any = None) -> None:
        """Parameters and outputs."""
        del configuration
        folder, number = QgsProcessingParameterFile.Folder, QgsProcessingParameterNumber
        self.add(
            QgsProcessingParameterFile("PRODUCT", "Folder of a product, or of a survey's", behavior=folder),
            "What Map a parcel or Map a survey has written.",
        )
        self.add(
            QgsProcessingParameterEnum("FORMATS", "Formats", FORMATS, allowMultiple=True, usesStaticStrings=True),
            "Any number.",
        )
        self.add(
            QgsProcessingParameterEnum("LINES", "Lines", LINES, defaultValue="lanes", usesStaticStrings=True),
            "What guidance follows: lanes between rows, or rows.",
        )
        self.add(
            QgsProcessingParameterNumber(
                "HEADLAND", "Headland (m)", number.Double, defaultValue=3.0, minValue=0, maxValue=50
            ),
            "Metres of lanes beyond rows.",
        )
        self.add(
            QgsProcessingParameterBoolean("OUTER", "Outer lanes", defaultValue=False),
            "Lanes beside the first row of a block and its last, too.",
        )
        self.add(
            QgsProcessingParameterMultipleLayers("MORE", "Further products", QgsProcessing.TypeFile, optional=True),
            "GeoPackages of products.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterString("FRAME", "Robot's frame", defaultValue="map", optional=True),
            "Name of the frame of a robot's coordinates.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterBoolean("GRID", "Coordinates of the product's CRS", defaultValue=False),
            "For robots and meshes; in the local frame by default.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterNumber(
                "VERTICES", "Vertices of every lane", number.Integer, optional=True, minValue=2, maxValue=10_000
            ),
            "Few by default.",
            advanced=True,
        )
        self.add(QgsProcessingParameterFolderDestination("OUTPUT", "Folder of exports"), "With a folder a parcel.")

    def processAlgorithm(self, parameters: dict[str, Any], context: Any, feedback: Any) -> dict[str, Any]:
        """Run the command."""
        options = self.options(parameters, context, feedback)
        call(["export", *options, *files(self, "PRODUCT", parameters, context)], feedback)
        return {} if feedback.isCanceled() else {"OUTPUT": options[options.index("--out") + 1]}
