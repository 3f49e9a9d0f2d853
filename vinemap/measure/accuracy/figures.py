"""Tables of accuracy: their numbers, and the bars that these must meet."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap.measure.accuracy.rows import mean, quantile

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from vinemap.measure.accuracy.canopies import CanopyErrors
    from vinemap.measure.accuracy.meshes import MeshErrors
    from vinemap.measure.accuracy.rows import Errors

ALONG = ["e1_along_m", "en_along_m"]
TRUE_FOLIAGE = "against the true foliage"
EASED = {
    ("thin", "DEP m", "mean"): 0.10,
    ("terraces", "DTM m", "median"): 0.03,
    ("terraces", "DTM m", "95%"): 0.20,
    ("sparse", "width m", "worst row"): 0.10,
}
EASED |= {(family, TRUE_FOLIAGE, "G"): 0.85 for family in ("thin", "sparse")}
EASED |= {(family, TRUE_FOLIAGE, "U"): 0.15 for family in ("thin", "sparse")}
EASED |= {(family, TRUE_FOLIAGE, "G − U − O"): 0.55 for family in ("thin", "sparse")}
LINES = ("DEK m", "COF m")
EASED |= {("square", "DEP m", "mean"): 0.10}
EASED |= {("square", index, key): bar for index in LINES for key, bar in (("mean", 0.03), ("worst", 0.06))}
EASED |= {("estate", index, "mean"): 0.02 for index in LINES} | {("net", index, "mean"): 0.02 for index in LINES}
EASED |= {("matched-poorly", "DEP m", "mean"): 0.15, ("matched-poorly", "DEP m", "worst"): 0.40}
EASED |= {("matched-poorly", index, key): bar for index in LINES for key, bar in (("mean", 0.04), ("worst", 0.08))}
EASED |= {("lidar", "DEP m", "mean"): 0.35, ("lidar", "DEP m", "worst"): 0.6}
EASED |= {("lidar", index, key): bar for index in LINES for key, bar in (("mean", 0.06), ("worst", 0.12))}
EASED |= {("matched-gaps", "rows %", "good"): 95, ("matched-gaps", "rows %", "extra"): 5}
EASED |= {("matched-gaps", "rows %", "missed"): 5}
EASED |= {("pergola", "rows %", "good"): 0, ("pergola", "rows %", "missed"): 100}
EASED |= {("pergola", raster, key): np.inf for raster in ("direction °", "spacing %") for key in ("median", "95%")}
EASED |= {("pergola", "gaps", key): 0 for key in ("recall", "precision")}
"""Bars that are lower for a family. Under a closed roof no row need be found, but none may be wrong."""


class Measure(NamedTuple):
    """A number of the table, and the bar that it must meet."""

    value: Callable[[Any], float]
    """Of :class:`Errors`, :class:`CanopyErrors` or :class:`MeshErrors`."""
    bar: float
    digits: int = 3
    at_least: bool = False


Columns = dict[str, dict[str, Measure]]

COLUMNS: Columns = {
    "rows": {
        "true": Measure(lambda e: e.rows, np.inf, 0),
        "found": Measure(lambda e: e.found, np.inf, 0),
    },
    "rows %": {
        "good": Measure(lambda e: 100 * len(e.pairs) / e.rows if e.rows else np.nan, 100, 1, at_least=True),
        "extra": Measure(lambda e: 100 * (e.found - len(e.pairs)) / max(e.rows, 1), 0, 1),
        "missed": Measure(lambda e: 100 * (e.rows - len(e.pairs)) / max(e.rows, 1), 0, 1),
    },
    "DEP m": {
        "mean": Measure(lambda e: mean(e.pairs["dep_m"]), 0.07),
        "worst": Measure(lambda e: quantile(e.pairs["dep_m"], 1), 0.20),
    },
    "DEK m": {
        "mean": Measure(lambda e: mean(e.pairs["dek_m"]), 0.015),
        "worst": Measure(lambda e: quantile(e.pairs["dek_m"], 1), 0.03),
    },
    "COF m": {
        "mean": Measure(lambda e: mean(e.pairs["cof_m"]), 0.015),
        "worst": Measure(lambda e: quantile(e.pairs["cof_m"], 1), 0.03),
    },
    "ends m": {"mean": Measure(lambda e: mean(e.pairs[ALONG]), 0.03)},
    "DTM m": {
        "median": Measure(lambda e: quantile(e.terrain, 0.5), 0.025),
        "95%": Measure(lambda e: quantile(e.terrain, 0.95), 0.06),
    },
    "direction °": {
        "median": Measure(lambda e: quantile(e.direction, 0.5), 0.4, 2),
        "95%": Measure(lambda e: quantile(e.direction, 0.95), 1.5, 2),
    },
    "spacing %": {
        "median": Measure(lambda e: 100 * quantile(e.spacing, 0.5), 3, 1),
        "95%": Measure(lambda e: 100 * quantile(e.spacing, 0.95), 10, 1),
    },
    "gaps": {
        "recall": Measure(lambda e: mean(e.recalled), 0.95, at_least=True),
        "precision": Measure(lambda e: mean(e.right), 0.95, at_least=True),
        "length m": Measure(lambda e: quantile(e.gap_length, 0.5), 0.3, 2),
    },
}
"""Numbers of the table of rows, by heading and name."""

CANOPY_COLUMNS: Columns = {
    TRUE_FOLIAGE: {
        "G": Measure(lambda e: mean(e.good), 0.88, at_least=True),
        "U": Measure(lambda e: mean(e.under), 0.12),
        "O": Measure(lambda e: mean(e.over), 0.18),
        "G − U − O": Measure(lambda e: mean(e.good) - mean(e.under) - mean(e.over), 0.65, at_least=True),
    },
    "the thesis's feet": {"G − U − O": Measure(lambda e: mean(e.soil), -np.inf, at_least=True)},
    "against the foliage's outline": {"O": Measure(lambda e: mean(e.hull_over), 0.09)},
    "height m": {
        "mean": Measure(lambda e: mean(e.height), 0.05),
        "worst row": Measure(lambda e: quantile(np.abs(e.height), 1), 0.05),
    },
    "width m": {
        "mean": Measure(lambda e: mean(e.width), 0.05),
        "worst row": Measure(lambda e: quantile(np.abs(e.width), 1), 0.05),
    },
    "volume %": {
        "mean": Measure(lambda e: 100 * mean(e.volume), 12, 1),
        "worst row": Measure(lambda e: 100 * quantile(np.abs(e.volume), 1), 15, 1),
    },
}
"""Numbers of the table of canopies."""


MESH_COLUMNS: Columns = {
    "rows": {
        "all": Measure(lambda e: len(e.told), np.inf, 0),
        "told": Measure(lambda e: int(np.isfinite(e.told).sum()), np.inf, 0),
    },
    "mesh error m": {
        "told": Measure(lambda e: mean(e.told[e.both]), np.inf),
        "true": Measure(lambda e: mean(e.true[e.both]), np.inf),
        "off": Measure(lambda e: mean((e.told - e.true)[e.both]), 0.01),
        "worst row": Measure(lambda e: quantile(np.abs((e.told - e.true)[e.both]), 1), np.inf),
    },
}
"""Numbers of the table of meshes."""


def table(results: Mapping[str, Errors | CanopyErrors | MeshErrors], columns: Columns = COLUMNS) -> list[list[str]]:
    """Lines of a table of accuracy, headings first: a line a family, "!" after what misses its bar."""
    lines = [["family", *[f"{heading}: {', '.join(measures)}" for heading, measures in columns.items()]]]
    for name, errors in results.items():
        cells = [
            ", ".join(
                _cell(measure.value(errors), measure, EASED.get((name, heading, key))) for key, measure in m.items()
            )
            for heading, m in columns.items()
        ]
        lines.append([name, *cells])
    return lines


def _cell(value: float, measure: Measure, eased: float | None) -> str:
    if np.isnan(value):
        return "–"
    bar = measure.bar if eased is None else eased
    # As precise as it is printed, so that a value that reads like the bar meets it.
    shown = round(value, measure.digits)
    missed = shown < bar if measure.at_least else abs(shown) > bar
    return f"{shown:.{measure.digits}f}{'!' if missed else ''}"
