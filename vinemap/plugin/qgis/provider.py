"""The provider: its name and icon, its algorithms, and the setting of where vinemap is."""

from __future__ import annotations

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from .algorithm import ICON
from .command import SETTING, written_in
from .evaluate import Evaluate
from .export import Export
from .parcel import MapParcel
from .survey import MapSurvey


class Provider(QgsProcessingProvider):
    """Algorithms that call vinemap."""

    def load(self) -> bool:
        """Add the algorithms, and the setting to Processing's options."""
        ProcessingConfig.settingIcons[self.name()] = self.icon()
        told = "Command vinemap, or the Python that has it; empty for the one that wrote this plugin, or is on PATH"
        where = Setting(self.name(), SETTING, told, "", valuetype=Setting.FILE, placeholder=written_in())
        ProcessingConfig.addSetting(where)
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        """Take the setting away."""
        ProcessingConfig.removeSetting(SETTING)

    def loadAlgorithms(self) -> None:
        """Add the algorithms."""
        for algorithm in (MapParcel, MapSurvey, Export, Evaluate):
            self.addAlgorithm(algorithm())

    def id(self) -> str:
        """How models and scripts call it."""
        return "vinemap"

    def name(self) -> str:
        """How people call it."""
        return "vinemap"

    def icon(self) -> QIcon:
        """Rows, one with a gap."""
        return QIcon(str(ICON))

    def svgIconPath(self) -> str:
        """File of the same."""
        return str(ICON)

    def supportedOutputVectorLayerExtensions(self) -> list[str]:
        """What vinemap writes."""
        return ["gpkg"]
