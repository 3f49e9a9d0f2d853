"""Layers of products for QGIS to load, with the styles in their GeoPackages."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qgis.core import Qgis, QgsProcessingContext, QgsProcessingLayerPostProcessorInterface

if TYPE_CHECKING:
    from pathlib import Path

LAYERS = ("parcel", "unmapped", "rows", "gaps", "vines")
"""Of a parcel, the lowest first."""
KEPT: list[_Dresser] = []
"""Those that have been handed to QGIS, which keeps none of them from Python's collector."""


class _Dresser(QgsProcessingLayerPostProcessorInterface):
    """Gives a layer its style and, before QGIS 3.32, which does that by itself, its place in a group."""

    def __init__(self, group: str, rank: int) -> None:
        super().__init__()
        self.group, self.rank = group, rank

    def postProcessLayer(self, layer: Any, context: Any, feedback: Any) -> None:
        """Do so, once QGIS has loaded it."""
        del feedback
        layer.loadDefaultStyle()
        if Qgis.QGIS_VERSION_INT >= 33200:
            return
        layer.setCustomProperty("vinemap/rank", self.rank)
        root = context.project().layerTreeRoot()
        group = root.findGroup(self.group) or root.insertGroup(0, self.group)
        node, ranks = root.findLayer(layer.id()), [_rank(one.layer()) for one in group.findLayers()]
        # QGIS drops a layer of which no node is left.
        group.insertChildNode(next((k for k, rank in enumerate(ranks) if rank < self.rank), len(ranks)), node.clone())
        node.parent().removeChildNode(node)


def _rank(layer: Any) -> int:
    return int(layer.customProperty("vinemap/rank", -1))


def geopackages(folder: Path) -> list[Path]:
    """GeoPackages of the products in a folder, the newest last: each has a project beside it."""
    projects = sorted(folder.glob("*.qgz"), key=lambda path: path.stat().st_mtime)
    return [path.with_suffix(".gpkg") for path in projects if path.with_suffix(".gpkg").is_file()]


def load(path: Path, layer: str, context: Any, *, name: str, group: str, rank: int = 0) -> str:
    """Have QGIS load a layer of a GeoPackage when the algorithm is done; gives its source."""
    source = f"{path}|layername={layer}"
    details = QgsProcessingContext.LayerDetails(name, context.project())
    details.forceName = True
    details.groupName, details.layerSortKey = group, rank
    KEPT.append(_Dresser(group, rank))
    details.setPostProcessor(KEPT[-1])
    context.addLayerToLoadOnCompletion(source, details)
    return source
