"""Tables of how well odometry measures, like the thesis's 4.3 and 4.4; what misses its bar is marked with "!"."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2

from vinemap.measure.odometry.trials import CAMERAS, METHODS, RELIEFS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from vinemap.measure.odometry.bridges import Bridge
    from vinemap.measure.odometry.trials import ByMethod, Drift, Losses, Size
    from vinemap.measure.odometry.troubles import Outcome
    from vinemap.odometry.refinement import Method

    Lines = list[list[str]]

NAMES = {"maximum": "standard"}
"""What methods are called that have another name in the thesis."""
CEP, WORST_CEP, TURN, WORST_TURN = 0.03, 0.05, 0.08, 0.15
"""Bars in mm and degrees, over all flat grounds and on the worst of them."""
CLOSER, STRAIGHTER = 85.0, 65.0
"""Percent by which errors of place and rotation are smaller than the standard algorithm's."""
RELIEF_BARS = dict(zip(RELIEFS, ((0.08, 0.15), (np.inf, np.inf), (0.03, 0.10)), strict=True))
MOST_SECONDS = 0.009
"""Of a pair of 320 × 240 with a template of 0.2."""
LEAST_CONTRAST, MOST_WRONG = 10.0, 0.001
"""Grey levels from which on a share of the steps may be wrong at most."""
LEAST_BELIEVED, MOST_BELIEVED_WRONG = {"none": 98.0, "spots": 50.0, "mud": 50.0}, 1 / 2000
"""Percent of steps that are believed without trouble and through dirt; share of all that may be wrong and believed."""
MOST_DRIFT, MOST_HEADING = 0.25, 0.15
"""Of paths: share of the standard algorithm's error of the place, and degrees a metre."""
BRIDGED_END = {"wheels": 1.0}
"""Percent of the way by which paths with lost stretches may be off at their end."""
BRIDGED_WORST = {"fixes at both ends": 0.05, "wheels, fixes at both ends": 0.05}
"""Metres by which they may be off anywhere."""


def mark(value: float, bar: float = np.inf, digits: int = 3, *, at_least: bool = False) -> str:
    """A number, with "!" if it misses its bar as precisely as it is printed."""
    shown = round(float(value), digits)
    return f"{shown:.{digits}f}" + "!" * (shown < bar if at_least else shown > bar)


def terrain_tables(found: Mapping[str, ByMethod]) -> dict[str, Lines]:
    """Tables 4.3 and 4.4: a line a ground, then the mean and the worst of the lines."""
    places = {name: [(e.cep, e.place.std()) for e in errors.values()] for name, errors in found.items()}
    turns = {name: [(e.turn.mean(), e.turn.std()) for e in errors.values()] for name, errors in found.items()}
    return {
        "places": _by_ground(places, "CEP, σ mm", CEP, WORST_CEP, CLOSER),
        "turns": _by_ground(turns, "mean, σ °", TURN, WORST_TURN, STRAIGHTER),
    }


def _by_ground(
    found: Mapping[str, Sequence[tuple[float, float]]], what: str, most: float, worst: float, least: float
) -> Lines:
    """A line a ground of each method's error and its spread, and by how much two are better than the first."""
    numbers = np.array(list(found.values()))
    lines = [[*_method_heads("ground", what), "better: centroid, aligned %"]]
    for name, cells in zip(found, numbers, strict=True):
        lines.append([name, *_pairs(cells), _better(cells)])
    overall = numbers.mean(axis=0)
    lines.append(["overall", *_pairs(overall, most), _better(overall, least)])
    lines.append(["the worst", *_pairs(numbers.max(axis=0), worst), "–"])
    return lines


def _method_heads(first: str, what: str) -> list[str]:
    return [first, *(f"{NAMES.get(method, method)}: {what}" for method in METHODS)]


def _pairs(cells: Sequence[Sequence[float]], bar: float = np.inf) -> list[str]:
    """A cell a method; the bar is for the last of them."""
    bars = [*[np.inf] * (len(cells) - 1), bar]
    return [f"{mark(value, most)}, {mark(spread)}" for (value, spread), most in zip(cells, bars, strict=True)]


def _better(cells: Sequence[Sequence[float]], least: float = -np.inf) -> str:
    standard, centroid, aligned = (cells[METHODS.index(m)][0] for m in ("maximum", "centroid", "aligned"))
    by = [100 * (1 - value / standard) for value in (centroid, aligned)]
    return f"{by[0]:.0f}, {mark(by[1], least, 0, at_least=True)}"


def relief_table(found: Mapping[str, ByMethod]) -> Lines:
    """Errors with relief, a line for each relief and reference."""
    lines = [_method_heads("relief, against", "CEP mm, mean °")]
    for name, errors in found.items():
        bars: Mapping[Method, tuple[float, float]] = {"aligned": RELIEF_BARS[name]}
        limits = [(e, bars.get(method, (np.inf, np.inf))) for method, e in errors.items()]
        lines.append([name, *(f"{mark(e.cep, mm)}, {mark(e.turn.mean(), degrees)}" for e, (mm, degrees) in limits)])
    return lines


def size_table(sizes: Sequence[Size], exhaustive: float) -> Lines:
    """Fig. 4.9 to 4.11: time of a pair, highest speed and errors against the size of the template."""
    heads = [f"{name}: ms, m/s" for name in CAMERAS]
    lines = [["template", *heads, "may move: mm", "CEP: standard, aligned mm", "turn, median: standard, aligned °"]]
    for size in sizes:
        times = []
        for name, seconds in size.seconds.items():
            bar = 1000 * MOST_SECONDS if (size.share, name) == (0.2, "320 × 240") else np.inf
            times.append(f"{mark(1000 * seconds, bar, 1)}, {size.speed(seconds):.1f}")
        ceps = ", ".join(f"{errors.cep:.3f}" for errors in size.errors.values())
        turns = ", ".join(f"{np.median(errors.turn):.3f}" for errors in size.errors.values())
        lines.append([f"{size.share:g}", *times, f"{size.most_mm:.0f}", ceps or "–", turns or "–"])
        if size.share == 0.2:
            whole = f"{1000 * exhaustive:.1f}, {size.speed(exhaustive):.1f}"
            lines.append(["0.2, exhaustive", whole, *["–"] * 4])
    return lines


def loss_table(found: Mapping[str, Losses]) -> Lines:
    """Steps that are lost, and whether odometry says so, a line a ground."""
    lines = [["ground", "contrast: levels", "steps: all, wrong", "wrong: not flagged", "right: flagged %"]]
    lines[0] += ["unrelated: all, flagged %", "beyond: all, wrong", "wrong: not flagged "]
    for name, (contrast, steps, unrelated, beyond) in found.items():
        bar = MOST_WRONG * len(steps.wrong) if contrast >= LEAST_CONTRAST else np.inf
        right = steps.flagged[~steps.wrong]
        cells = [
            f"{contrast:.0f}",
            f"{len(steps.wrong)}, {mark(steps.wrong.sum(), bar, 0)}",
            mark((steps.wrong & ~steps.flagged).sum(), 0, 0),
            f"{100 * right.mean():.2f}" if len(right) else "–",
            f"{len(unrelated)}, {mark(100 * unrelated.mean(), 100, 1, at_least=True)}",
            f"{len(beyond.wrong)}, {beyond.wrong.sum()}",
            mark((beyond.wrong & ~beyond.flagged).sum(), 0, 0),
        ]
        lines.append([name, *cells])
    return lines


def trouble_table(found: Mapping[str, Outcome]) -> Lines:
    """Steps in trouble: how many are believed, and how many of these are wrong."""
    lines = [["trouble", "steps", "believed %", "wrong and believed"]]
    for name, (steps, believed, wrong) in found.items():
        least = max((percent for word, percent in LEAST_BELIEVED.items() if word in name), default=0.0)
        lines.append([name, str(steps), mark(100 * believed / steps, least, 1, at_least=True), str(wrong)])
    steps, believed, wrong = map(sum, zip(*found.values(), strict=True))
    most = MOST_BELIEVED_WRONG * steps
    lines.append(["all", str(steps), f"{100 * believed / steps:.1f}", mark(wrong, most, 0)])
    return lines


def drift_table(found: Mapping[str, Drift]) -> Lines:
    """Fig. 4.8: error at the end of paths over their length, and squared in what the covariance tells of it.

    The mean of n squares lies within a band in 95 of 100 trials, where covariances are right: that of χ² with three
    degrees of freedom a path.
    """
    n = len(found["maximum"].place)
    low, high = chi2.ppf((0.025, 0.975), 3 * n) / n
    heads = ["method", "place: mean, worst mm/m", "of the standard's: %", "heading: mean, worst °/m"]
    lines = [[*heads, f"normalised and squared: mean ({low:.1f}–{high:.1f})"]]
    standard = found["maximum"].place.mean()
    for name, (place, turn, squared) in found.items():
        share, heading = (100 * MOST_DRIFT, MOST_HEADING) if name in ("aligned", "keyframes") else (np.inf, np.inf)
        cells = [
            f"{mark(place.mean())}, {mark(place.max())}",
            mark(100 * place.mean() / standard, share, 0),
            f"{mark(turn.mean(), heading)}, {mark(turn.max())}",
            "" if np.isnan(squared).any() else f"{squared.mean():.2f}" + "!" * (not low < squared.mean() < high),
        ]
        lines.append([NAMES.get(name, name), *cells])
    return lines


def bridge_table(found: Mapping[str, Bridge]) -> Lines:
    """Errors of paths with lost stretches, a line for each way to bridge them."""
    lines = [["bridged by", "at the end: mean, worst % of the way", "anywhere: mean, worst m"]]
    for name, (worst, end, length) in found.items():
        share, metres = 0.1 * end / length, worst / 1000
        most, far = BRIDGED_END.get(name, np.inf), BRIDGED_WORST.get(name, np.inf)
        lines.append(
            [
                name,
                f"{mark(share.mean(), most, 2)}, {mark(share.max(), most, 2)}",
                f"{mark(metres.mean(), far)}, {mark(metres.max(), far)}",
            ]
        )
    return lines
