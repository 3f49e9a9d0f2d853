"""Map a survey: ``vinemap survey``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from qgis.core import (
    QgsProcessing,
    QgsProcessingException,
    QgsProcessingOutputMultipleLayers,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterFile,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

from .algorithm import MAPPING, Command, add_cloud, add_common, files
from .command import call
from .loading import geopackages, load


class MapSurvey(Command):
    """Rows and canopies of many parcels of a cloud."""

    NAME, TITLE = "mapsurvey", "Map a survey"
    HELP = (
        "Maps many parcels of one point cloud, each into a folder of its own, and loads their rows by canopy volume. "
        "What is up to date in the folder is not mapped again. One parcel's failure costs no other: it is told in red."
    )
    FLAGS: ClassVar[dict[str, str]] = {
        **MAPPING,
        "BOUNDARIES": "--boundaries",
        "PARCELS": "--parcel",
        "REGISTER": "--register",
        "AGAIN": "--again",
        "WORKERS": "--workers",
        "LIMIT": "--limit",
        "MEMORY": "--memory",
    }

    def initAlgorithm(self, configuration: Any = None) -> None:
        """Parameters and outputs."""
        del configuration
        number, real = QgsProcessingParameterNumber.Integer, QgsProcessingParameterNumber.Double
        add_cloud(self)
        self.add(
            QgsProcessingParameterFeatureSource(
                "BOUNDARIES", "Boundaries of the parcels", [QgsProcessing.TypeVectorPolygon]
            ),
            "Polygons in any CRS, named in one of their columns.",
        )
        add_common(self)
        self.add(
            QgsProcessingParameterString("PARCELS", "Names of parcels, one a line", multiLine=True, optional=True),
            "All by default.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterFile("REGISTER", "Register of known rows", extension="gpkg", optional=True),
            "That of the estate, whose numbers rows keep.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterBoolean("AGAIN", "Map anew what is up to date", defaultValue=False),
            "Map parcels that are up to date, too.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterNumber("WORKERS", "Parcels at once", number, optional=True, minValue=1),
            "As many as there are cores by default.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterNumber("LIMIT", "Seconds a parcel", real, optional=True, minValue=1),
            "That a parcel may take; an hour by default.",
            advanced=True,
        )
        self.add(
            QgsProcessingParameterNumber("MEMORY", "Memory a parcel (GB)", real, optional=True, minValue=0),
            "That a parcel may take; its share of what there is by default.",
            advanced=True,
        )
        self.add(QgsProcessingParameterFolderDestination("OUTPUT", "Folder of the products"), "With a folder a parcel.")
        self.addOutput(QgsProcessingOutputMultipleLayers("ROWS_LAYERS", "Rows of each parcel"))

    def processAlgorithm(self, parameters: dict[str, Any], context: Any, feedback: Any) -> dict[str, Any]:
        """Run the command; how far it is, is told by the parcels that are settled."""
        options = self.options(parameters, context, feedback)
        folder = Path(options[options.index("--out") + 1])
        n = options.count("--parcel") or self.parameterAsSource(parameters, "BOUNDARIES", context).featureCount()
        settled: list[str] = []

        def heard(line: str) -> None:
            settled.append(line)
            feedback.setProgress(min(100.0, 100 * len(settled) / max(n, 1)))

        call(["survey", *options, *files(self, "CLOUD", parameters, context)], feedback, heard=heard)
        if feedback.isCanceled():
            return {}
        made = [path for one in sorted(folder.iterdir()) if one.is_dir() for path in geopackages(one)]
        if not made:
            raise QgsProcessingException(settled[-1] if settled else f"{folder}: holds no product")
        rows = [load(path, "rows", context, name=path.stem, group=folder.name) for path in made]
        return {"OUTPUT": str(folder), "ROWS_LAYERS": rows}
