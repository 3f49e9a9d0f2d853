"""Confidence beside truth: rows of a confidence should be right as often as it says, and canopies as far off."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.canopy.numbers import judge_canopies, summarise_rows
from vinemap.evaluate.confidence import DOUBTFUL
from vinemap.measure.accuracy.rows import quantile

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import pandas as pd
    from matplotlib.axes import Axes

    from vinemap.canopy.model import CanopyModel
    from vinemap.chain import RowMap
    from vinemap.compute.arrays import Flags, Floats

SURE = 0.9
"""Confidence from which rows are sure."""
MOSTLY, HALF = 0.99, 0.5
"""Share of the sure ones that must be right, and of the doubtful ones that may be."""
BINS = np.linspace(0, 1, 11)


class Trust(NamedTuple):
    """Confidence in rows and canopies of a map, or of several, and what they are."""

    confidence: Floats
    right: Flags
    """Whether rows (n,) pair with true ones."""
    canopy: Floats
    """Confidence in the canopies (m,) of rows that do, NaN where none was modelled."""
    volume: Floats
    """Error of their volume (m,), as a share of it."""


def trust(found: RowMap, model: CanopyModel, pairs: pd.DataFrame, volume: Floats, *, step: float) -> Trust:
    """Confidence in a map's rows and canopies beside what is right.

    Parameters
    ----------
    found : RowMap
        The map.
    model : CanopyModel
        Its canopies.
    pairs : DataFrame
        Matched rows of :func:`vinemap.evaluate.rows.evaluate_rows`.
    volume : (m,) array
        Error of the volume of the pairs, in their order, as a share of it; or none at all.
    step : float
        Metres between sections.
    """
    rows = judge_canopies(summarise_rows(found.rows, model.table, step=step), model.table, step=step)
    mine = pairs["row_id"].to_numpy(dtype=int) - 1
    right = np.isin(np.arange(len(rows)), mine)
    canopy = rows["canopy_confidence"].to_numpy()[mine[: len(volume)]]
    return Trust(rows["confidence"].to_numpy(dtype=float), right, canopy, volume)


def pool_trust(maps: Sequence[Trust]) -> Trust:
    """Confidence of several maps as that of one."""
    return Trust(*(np.concatenate(values) for values in zip(*maps, strict=True)))


def trust_table(all_: Trust) -> list[list[str]]:
    """Lines of a table: how many rows of a confidence are right, and how far off the volume of such canopies is."""
    lines = [["confidence", "rows: all, right %", "canopies: all, volume off % (median, 90%)"]]
    for name, low, high, least, most in (
        (f"below {DOUBTFUL:g}", 0.0, DOUBTFUL, 0.0, HALF),
        (f"{DOUBTFUL:g} to {SURE:g}", DOUBTFUL, SURE, 0.0, 1.0),
        (f"{SURE:g} and more", SURE, np.inf, MOSTLY, 1.0),
    ):
        right = all_.right[(all_.confidence >= low) & (all_.confidence < high)]
        off = np.abs(all_.volume[(all_.canopy >= low) & (all_.canopy < high)])
        share = f"{100 * right.mean():.1f}{'' if least <= right.mean() <= most else '!'}" if len(right) else "–"
        errors = ", ".join(f"{100 * quantile(off, order):.1f}" for order in (0.5, 0.9)) if len(off) else "–"
        lines.append([name, f"{len(right)}, {share}", f"{len(off)}, {errors}"])
    return lines


def draw_trust(all_: Trust, path: Path) -> None:
    """Draw, over the confidence, the share of rows that are right, and the errors of canopies' volumes."""
    from matplotlib.figure import Figure  # a tool of development

    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_rows(left, all_)
    _draw_canopies(right, all_)
    for axes in (left, right):
        axes.set(xlim=(0, 1))
        axes.grid(visible=True, alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def _draw_rows(axes: Axes, all_: Trust) -> None:
    n, right = (np.histogram(values, BINS)[0] for values in (all_.confidence, all_.confidence[all_.right]))
    middle, known = (BINS[1:] + BINS[:-1]) / 2, n > 0
    axes.bar(middle[known], right[known] / n[known], width=0.08, color="tab:green", alpha=0.7)
    axes.plot([0, 1], [0, 1], color="black", linewidth=1, linestyle="--", label="as it says")
    for x, share, count in zip(middle[known], right[known] / n[known], n[known], strict=True):
        axes.annotate(f"{count}", (x, share), ha="center", va="bottom", fontsize=8)
    axes.set(xlabel="confidence of a row", ylabel="share of such rows that are right (their number)", ylim=(0, 1.08))
    axes.legend(loc="upper left")


def _draw_canopies(axes: Axes, all_: Trust) -> None:
    off = 100 * np.abs(all_.volume)
    axes.plot(all_.canopy, np.maximum(off, 0.1), ".", color="tab:green", alpha=0.5)
    bins = np.digitize(all_.canopy, BINS[1:-1])
    known = np.isfinite(all_.canopy)
    for k in np.unique(bins[known]):
        median = np.median(off[known & (bins == k)])
        axes.plot(BINS[k : k + 2], [median, median], color="black", linewidth=2)
    axes.set(xlabel="canopy_confidence of a row", ylabel="error of its volume (%; bars: medians)", yscale="log")
    axes.yaxis.set_major_formatter("{x:g}")
