"""vinemap in the Processing toolbox of QGIS."""

from __future__ import annotations

from typing import Any

from qgis.core import QgsApplication

from .provider import Provider


class Plugin:
    """What QGIS loads: the provider of the algorithms, and nothing in menus or toolbars."""

    def __init__(self) -> None:
        self.provider: Any = None

    def initProcessing(self) -> None:
        """Offer the algorithms."""
        self.provider = Provider()
        QgsApplication.processingRegistry().addProvider(self.provider)

    def initGui(self) -> None:
        """Begin, in QGIS with windows."""
        self.initProcessing()

    def unload(self) -> None:
        """End."""
        if self.provider:
            QgsApplication.processingRegistry().removeProvider(self.provider)
            self.provider = None


def classFactory(iface: Any) -> Plugin:
    """What QGIS asks a plugin for."""
    del iface
    return Plugin()
