"""Tables of the benchmark, and their place in a document."""

from __future__ import annotations

import math
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from vinemap import __version__
from vinemap.measure.bench.bars import (
    ALL,
    EXPONENT,
    GROWTH,
    HECTARE,
    Bar,
    Run,
    bars,
    dense_bars,
    growth_exponent,
    growth_ratio,
    of_bar,
)
from vinemap.measure.tables import as_markdown, fill

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

Lines = list[list[str]]
"""A table, headings first."""
LIBRARIES = ("numpy", "scipy", "numba", "laspy", "lazrs")


def size_of(run: Run) -> str:
    """A size as a heading says it."""
    return f"{run.points / 1e6:.1f} M points, {run.area / HECTARE:.2f} ha"


def bar_table(runs: Sequence[Run]) -> Lines:
    """Table of what is promised of F's shape: a line a bar, a column a size."""
    lines, rest = _promised(runs, bars), [""] * (len(runs) - 1)
    ratio, exponent = growth_ratio(runs), _exponent(runs)
    growth = "–" if math.isnan(ratio) else of_bar(Bar("", "", ratio, GROWTH))
    lines.append(["seconds a point, over those at 2 M", f"{GROWTH} at the largest", *rest, growth])
    lines.append(["growth exponent of the whole", "", *rest, "–" if math.isnan(exponent) else f"{exponent:.2f}"])
    return lines


def dense_table(runs: Sequence[Run]) -> Lines:
    """Table of what is promised of vineyards that are planted densely: a line a bar, a column a size."""
    lines, rest = _promised(runs, dense_bars), [""] * (len(runs) - 1)
    exponent = _exponent(runs)
    growth = "–" if math.isnan(exponent) else of_bar(Bar("", "", exponent, EXPONENT))
    lines.append(["km of row found", "", *[f"{run.found.length / 1000:.1f}" for run in runs]])
    lines.append(["laspy.read, xyz, s", "", *[f"{run.reading:.2f}" for run in runs]])
    lines.append(["growth exponent of the whole", f"{EXPONENT}", *rest, growth])
    return lines


def _promised(runs: Sequence[Run], of: Callable[[Run], Sequence[Bar]]) -> Lines:
    """Headings, and a line a bar."""
    lines = [["figure", "may be", *map(size_of, runs)]]
    columns = zip(*map(of, runs), strict=True)
    return lines + [[line[0].name, line[0].terms, *map(of_bar, line)] for line in columns]


def _exponent(runs: Sequence[Run]) -> float:
    return growth_exponent([run.points for run in runs], [run.seconds[ALL] for run in runs])


def stage_table(runs: Sequence[Run]) -> Lines:
    """Table of what every stage takes: a line a stage, a column a size."""
    lines = [["stage", *[f"{size_of(run)}: s, M points/s, × laspy, B/point" for run in runs]]]
    names = list(dict.fromkeys(name for run in runs for name in run.seconds if name != ALL))
    lines.append(["laspy.read, xyz", *[figures(run, run.reading, run.reading_peak) for run in runs]])
    lines += [[name, *[figures(run, run.seconds.get(name), run.peaks.get(name)) for run in runs]] for name in names]
    lines.append(["whole parcel", *[figures(run, run.seconds[ALL], run.peak) for run in runs]])
    lines.append(["with start-up", *[figures(run, run.wall, run.peak) for run in runs]])
    return lines


def figures(run: Run, seconds: float | None, peak: int | None) -> str:
    """Seconds, million points a second, ratio to reading, and most memory a point (bytes)."""
    if seconds is None:
        return "–"
    speed = f"{run.points / seconds / 1e6:.1f}" if seconds >= 0.0005 else "–"
    held = "–" if peak is None else f"{peak / run.points:.0f}"
    return f"{seconds:.2f}, {speed}, {seconds / run.reading:.2f}, {held}"


def machine() -> str:
    """The machine and the versions in a sentence, without its name."""
    try:
        about = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        about = []
    named = (line.partition(":")[2].strip() for line in about if line.startswith("model name"))
    processor = next(named, platform.processor() or platform.machine())
    libraries = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return (
        f"Measured on {os.cpu_count()} cores ({processor}), with Python {platform.python_version()}, "
        f"vinemap {__version__}, {libraries}."
    )


def write_tables(tables: Mapping[str, Lines], path: Path) -> None:
    """Fill tables, and the machine, into a document between its marks."""
    text = fill(path.read_text(encoding="utf-8"), "machine", machine())
    for name, lines in tables.items():
        text = fill(text, name, as_markdown(lines))
    path.write_text(text, encoding="utf-8")
