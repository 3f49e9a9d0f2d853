"""An algorithm that is a command of vinemap's: its parameters, and the words that they are on the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from qgis.core import (
    QgsProcessing,
    QgsProcessingAlgorithm,
    QgsProcessingParameterCrs,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterFile,
    QgsProcessingParameterMultipleLayers,
    QgsProcessingParameterString,
)
from qgis.PyQt.QtGui import QIcon

ICON = Path(__file__).with_name("icon.svg")
ENDS = "*.las *.laz *.json *.e57 *.ply *.pcd *.xyz *.pts *.csv *.txt *.asc *.tif *.tiff"
"""Of files that hold points."""


class Command(QgsProcessingAlgorithm):
    """What the algorithms have in common. Each names its ``FLAGS``: options of the command by parameter."""

    NAME = TITLE = HELP = ""
    FLAGS: ClassVar[dict[str, str]] = {}

    def name(self) -> str:
        """How models and scripts call it."""
        return self.NAME

    def displayName(self) -> str:
        """How people call it."""
        return self.TITLE

    def shortHelpString(self) -> str:
        """What stands beside the parameters."""
        return self.HELP

    def icon(self) -> QIcon:
        """The provider's."""
        return QIcon(str(ICON))

    def createInstance(self) -> Command:
        """Another one."""
        return type(self)()

    def add(self, definition: Any, told: str, *, advanced: bool = False) -> None:
        """Add a parameter with a text of help, which names the option that it stands for."""
        flag = self.FLAGS.get(definition.name())
        definition.setHelp(f"{told} ({flag})" if flag else told)
        if advanced:
            definition.setFlags(definition.flags() | QgsProcessingParameterDefinition.FlagAdvanced)
        self.addParameter(definition)

    def options(self, parameters: dict[str, Any], context: Any, feedback: Any) -> list[str]:
        """Options of the command, of what is given."""
        words: list[str] = []
        for name, flag in self.FLAGS.items():
            if parameters.get(name) not in (None, "", []):
                values = self._values(name, parameters, context, feedback)
                words += [flag] if values is None else [word for value in values for word in (flag, value)]
        return words

    def _values(self, name: str, parameters: dict[str, Any], context: Any, feedback: Any) -> list[str] | None:
        """Values of a parameter as the command takes them; none of a switch that is on."""
        kind = self.parameterDefinition(name).type()
        if kind == "boolean":
            return None if self.parameterAsBoolean(parameters, name, context) else []
        if kind == "source":
            return [self.layer(name, parameters, context, feedback)]
        if kind == "crs":
            crs = self.parameterAsCrs(parameters, name, context)
            return [crs.authid() if crs.authid().startswith("EPSG:") else crs.toWkt()] if crs.isValid() else []
        if kind == "enum":
            return list(self.parameterAsEnumStrings(parameters, name, context))
        if kind in ("folderDestination", "vectorDestination"):
            return [self.parameterAsFileOutput(parameters, name, context)]
        text = self.parameterAsString(parameters, name, context)
        return [line.strip() for line in text.splitlines() if line.strip()]

    def layer(self, name: str, parameters: dict[str, Any], context: Any, feedback: Any) -> str:
        """A GeoPackage of a layer as QGIS has it: with the CRS that it has there, and what is selected and edited."""
        return str(self.parameterAsCompatibleSourceLayerPath(parameters, name, context, [], "gpkg", feedback))


def files(algorithm: Command, first: str, parameters: dict[str, Any], context: Any) -> list[str]:
    """The file of a parameter and further ones, as a command's last words."""
    more = algorithm.parameterAsFileList(parameters, "MORE", context)
    return ["--", algorithm.parameterAsFile(parameters, first, context), *filter(None, more)]


MAPPING = {
    "ROWS": "--rows",
    "VINES": "--vines",
    "CRS": "--crs",
    "CRS_TEXT": "--crs",
    "ORIGIN": "--origin",
    "SETTINGS": "--settings",
    "OUTPUT": "--out",
}
"""Options of both commands that map clouds."""


def add_cloud(algorithm: Command) -> None:
    """The first parameter of both."""
    algorithm.add(
        QgsProcessingParameterFile(
            "CLOUD", "Point cloud", fileFilter=f"Point clouds and surface models ({ENDS});;All files (*)"
        ),
        "LAS, LAZ, COPC, EPT, E57, PLY, PCD, XYZ or CSV, a surface model as GeoTIFF, a folder of such, or https://…",
    )


def add_common(algorithm: Command) -> None:
    """Further parameters of both."""
    lines, points = QgsProcessing.TypeVectorLine, QgsProcessing.TypeVectorPoint
    algorithm.add(
        QgsProcessingParameterFeatureSource("ROWS", "Known rows", [lines, points], optional=True),
        "Lines of rows, or their posts: they are measured under their names, and none are sought.",
    )
    algorithm.add(
        QgsProcessingParameterCrs("CRS", "CRS of the cloud", optional=True),
        "Where the cloud states none, or a wrong one.",
    )
    algorithm.add(
        QgsProcessingParameterString("CRS_TEXT", "CRS of the cloud with heights, or local", optional=True),
        "In place of the CRS above: EPSG:26910+6360, say, the second of which is of heights; local for local metres.",
        advanced=True,
    )
    algorithm.add(
        QgsProcessingParameterMultipleLayers(
            "MORE", "Further files of the cloud", QgsProcessing.TypeFile, optional=True
        ),
        "Tiles or flights that are worked as one with it.",
        advanced=True,
    )
    algorithm.add(
        QgsProcessingParameterFeatureSource("VINES", "Known vines", [points], optional=True),
        "Points of vines: where they stand isn't estimated.",
        advanced=True,
    )
    algorithm.add(
        QgsProcessingParameterString("ORIGIN", "Origin of the local frame", optional=True),
        "Latitude, longitude and altitude, as 44.61167,7.92442,428.7; the parcel's corner by default.",
        advanced=True,
    )
    algorithm.add(
        QgsProcessingParameterFile("SETTINGS", "Settings", fileFilter="YAML (*.yaml *.yml)", optional=True),
        "YAML file with settings of the stages.",
        advanced=True,
    )
