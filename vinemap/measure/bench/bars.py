"""What is promised of speed and memory, and how a run keeps it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

ALL = "All"
OTHER = "other"
ROWS = ("DTM", "Ends and gaps")
"""First and last of the stages that find rows."""
SMALL, LARGE = 3e6, 16e6
"""Points below which a bar is a matter of seconds, and from which the final bars hold."""
HECTARE = 10_000.0
BASE = 2e6
START = 0.9
"""Seconds before reading begins."""
WRONG = 2.0
"""Rows (%) that may be missed or found beside the true ones."""
A_KILOMETRE = 0.6
"""Seconds a kilometre of row, in vineyards that are planted densely."""
GROWTH = 1.15
"""Of the seconds a point, from ``BASE`` to the largest survey."""
EXPONENT = 1.02
"""Of seconds against points, in vineyards that are planted densely."""

MANY_TIMES, MANY_MEMORY = 1.8, 1200
"""Times the seconds of reading, and MB, of many parcels in one job."""
COLD, GOAL = 12.0, 8.0
"""Seconds that a run with an empty cache may take beyond a warm one, and shall."""


class Found(NamedTuple):
    """What a run, or what stands in for one, found, against the simulated truth."""

    rows: int
    """That there are."""
    right: int
    extra: int
    length: float
    """Of the rows that were found, m."""
    volume: float
    """Error of all canopies' volume, as a share of it."""

    @property
    def wrong(self) -> float:
        """Rows that were missed or found beside the true ones, % of these."""
        return 100 * (self.rows - self.right + self.extra) / self.rows


class Run(NamedTuple):
    """One size, measured."""

    points: int
    """In the file."""
    area: float
    """Of the parcel, m²."""
    reading: float
    """Seconds of plain laspy."""
    reading_peak: int
    """Most memory that takes, bytes."""
    wall: float
    """Seconds of the command, as a user waits."""
    start: float
    """Those of them before reading begins."""
    peak: int
    """Most memory of the command, bytes."""
    seconds: dict[str, float]
    """Of every stage in order, of what lies between them, and of all."""
    peaks: dict[str, int | None]
    """Most memory (bytes) in every stage; None where the system doesn't tell."""
    found: Found

    @property
    def per_kilometre(self) -> float:
        """Seconds a kilometre of row of the command, less twice those of reading; infinite where no row was found."""
        length = self.found.length / 1000
        return (self.wall - 2 * self.reading) / length if length else math.inf


class Bar(NamedTuple):
    """A figure, and what it may be at the most."""

    name: str
    terms: str
    value: float
    most: float
    digits: int = 2


def with_other(seconds: Mapping[str, float]) -> dict[str, float]:
    """Seconds of stages and of all, with what lies between the stages as one more."""
    stages = {name: value for name, value in seconds.items() if name != ALL}
    return stages | {OTHER: max(seconds[ALL] - sum(stages.values()), 0.0), ALL: seconds[ALL]}


def span(seconds: Mapping[str, float], first: str, last: str) -> float:
    """Seconds of the stages from one to another, both included."""
    names = list(seconds)
    return sum(seconds[name] for name in names[names.index(first) : names.index(last) + 1])


def growth_exponent(points: Sequence[float], seconds: Sequence[float]) -> float:
    """Slope of log seconds against log points by least squares; NaN of a single size."""
    x, y = [math.log(value) for value in points], [math.log(value) for value in seconds]
    middle, height = sum(x) / len(x), sum(y) / len(y)
    spread = sum((a - middle) ** 2 for a in x)
    return sum((a - middle) * (b - height) for a, b in zip(x, y, strict=True)) / spread if spread else math.nan


def growth_ratio(runs: Sequence[Run]) -> float:
    """Seconds a point in the largest survey over those in the one nearest to ``BASE``; NaN if that is the same."""
    base, top = min(runs, key=lambda run: abs(run.points - BASE)), max(runs, key=lambda run: run.points)
    if base.points >= top.points:
        return math.nan
    return (top.seconds[ALL] / top.points) / (base.seconds[ALL] / base.points)


def bars(run: Run) -> list[Bar]:
    """What is promised of every size of F's shape."""
    hectares = run.area / HECTARE
    if run.points >= LARGE:
        rows, whole = 0.5 * run.reading + 0.5 * hectares, 1.5 * run.reading + hectares
    else:
        rows, whole = (2.0, 4.0) if run.points < SMALL else (run.reading + hectares, 2 * run.reading + 2 * hectares)
    terms = "{} × reading + {} s a hectare; below 16 M points {} ×, {} s; below 3 M points {} s"
    return [
        Bar(f"rows ({ROWS[0]} … {ROWS[1]}), s", terms.format(0.5, 0.5, 1, 1, 2), span(run.seconds, *ROWS), rows),
        Bar("whole parcel, s", terms.format(1.5, 1, 2, 2, 4), run.seconds[ALL], whole),
        _start(run),
        Bar("most memory, MB", "60 bytes a point + 400 MB", run.peak / 1e6, 60e-6 * run.points + 400, 0),
        _wrong(run),
    ]


def dense_bars(run: Run) -> list[Bar]:
    """What is promised of every size of a vineyard that is planted densely."""
    whole = A_KILOMETRE * run.found.length / 1000 + 2 * run.reading
    memory = 60e-6 * run.points + 15 * run.area / HECTARE + 350
    return [
        Bar("whole run, s", f"{A_KILOMETRE} s a km of row + 2 × reading", run.wall, whole),
        Bar("s a km of row, beyond 2 × reading", f"{A_KILOMETRE}", run.per_kilometre, A_KILOMETRE),
        _start(run),
        Bar("most memory, MB", "60 bytes a point + 15 MB a hectare + 350 MB", run.peak / 1e6, memory, 0),
        _wrong(run),
    ]


def _start(run: Run) -> Bar:
    return Bar("start before reading, s", f"{START} s", run.start, START)


def _wrong(run: Run) -> Bar:
    return Bar("rows missed or extra, %", f"{WRONG:g}% of the true ones", run.found.wrong, WRONG, 1)


def of_bar(bar: Bar) -> str:
    """A figure and its bar, "!" where it misses it; as precise as it is printed."""
    value, most = (round(number, bar.digits) for number in (bar.value, bar.most))
    return f"{value:.{bar.digits}f} of {most:.{bar.digits}f}{'!' if value > most else ''}"
