"""Evaluate: ``vinemap evaluate``."""

from __future__ import annotations

from typing import Any, ClassVar

from qgis.core import (
    QgsProcessing,
    QgsProcessingOutputString,
    QgsProcessingParameterFeatureSource,
    QgsProcessingParameterString,
    QgsProcessingParameterVectorDestination,
)

from .algorithm import Command
from .command import call


class Evaluate(Command):
    """A map held against lines that were drawn."""

    NAME, TITLE = "evaluate", "Evaluate"
    HELP = (
        "Compares the rows of a map with reference lines, drawn or surveyed: which match, are extra or missed, and how "
        "far they lie apart. The indices stand in the log; the layer has them for every pair."
    )
    FLAGS: ClassVar[dict[str, str]] = {"PARCEL": "--parcel", "PAIRS": "--pairs"}

    def initAlgorithm(self, configuration: Any = None) -> None:
        """Parameters and outputs."""
        del configuration
        lines = [QgsProcessing.TypeVectorLine]
        self.add(QgsProcessingParameterFeatureSource("RESULT", "Rows of a map", lines), "Layer rows of a product.")
        self.add(QgsProcessingParameterFeatureSource("REFERENCE", "Reference lines", lines), "In any CRS.")
        self.add(
            QgsProcessingParameterString("PARCEL", "Name of the parcel", optional=True),
            "Only the reference lines in which a column holds this name.",
        )
        self.add(
            QgsProcessingParameterVectorDestination(
                "PAIRS", "Matched, extra and missed rows", QgsProcessing.TypeVectorLine, optional=True
            ),
            "With their indices.",
        )
        self.addOutput(QgsProcessingOutputString("INDICES", "Indices"))

    def processAlgorithm(self, parameters: dict[str, Any], context: Any, feedback: Any) -> dict[str, Any]:
        """Run the command."""
        pairs = self.parameterAsOutputLayer(parameters, "PAIRS", context) if parameters.get("PAIRS") else None
        options = self.options({**parameters, "PAIRS": pairs}, context, feedback)
        result, reference = (self.layer(name, parameters, context, feedback) for name in ("RESULT", "REFERENCE"))
        said: list[str] = []
        call(["evaluate", *options, "--", result, reference], feedback, heard=said.append)
        return {} if feedback.isCanceled() else {"INDICES": "\n".join(said), "PAIRS": pairs}
