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
SMALL = 3e6
"""Points below which a bar is a matter of seconds."""
HECTARE = 10_000.0
START_UP = 2.0
"""Seconds."""
BASE = 2e6


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
    peak: int
    """Most memory of the command, bytes."""
    seconds: dict[str, float]
    """Of every stage in order, of what lies between them, and of all."""
    peaks: dict[str, int | None]
    """Most memory (bytes) in every stage; None where the system doesn't tell."""


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
    """What is promised of every size."""
    small, hectares = run.points < SMALL, run.area / HECTARE
    rows = 2.0 if small else run.reading + hectares
    whole = 4.0 if small else 2 * run.reading + 2 * hectares
    terms = "{} × reading + {} s a hectare; below 3 M points {} s"
    return [
        Bar(f"rows ({ROWS[0]} … {ROWS[1]}), s", terms.format(1, 1, 2), span(run.seconds, *ROWS), rows),
        Bar("whole parcel, s", terms.format(2, 2, 4), run.seconds[ALL], whole),
        Bar("start-up, s", "2 s", run.wall - run.seconds[ALL], START_UP),
        Bar("most memory, MB", "60 bytes a point + 400 MB", run.peak / 1e6, 60e-6 * run.points + 400, 0),
    ]


def of_bar(bar: Bar) -> str:
    """A figure and its bar, "!" where it misses it; as precise as it is printed."""
    value, most = (round(number, bar.digits) for number in (bar.value, bar.most))
    return f"{value:.{bar.digits}f} of {most:.{bar.digits}f}{'!' if value > most else ''}"
