"""Plot of seconds and memory against points."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vinemap.measure.bench.bars import Run, bars, span

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

GROUPS = {
    "Reading": ("Reading", "Reading"),
    "DTM": ("DTM", "DTM"),
    "Canopy cover … Curves": ("Canopy cover", "Curves"),
    "Sections … Mesh": ("Sections", "Mesh"),
    "Writing": ("Writing", "Writing"),
}
"""First and last stage of what is drawn beside rows and the whole."""
COLOURS = ("tab:blue", "tab:brown", "tab:olive", "tab:purple", "tab:cyan")


def draw(runs: Sequence[Run], path: Path) -> None:
    """Draw seconds and memory against points, with what they may be dotted."""
    from matplotlib.figure import Figure  # a tool of development
    from matplotlib.ticker import LogLocator

    points = [run.points / 1e6 for run in runs]
    rows, whole, _, memory, _ = zip(*map(bars, runs), strict=True)
    figure = Figure(figsize=(11, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    lines = {"laspy.read, xyz": ("k--", [run.reading for run in runs], [run.reading_peak / 1e6 for run in runs])}
    lines["whole parcel"] = ("ro-", [bar.value for bar in whole], [bar.value for bar in memory])
    lines["may take"] = ("r:", [bar.most for bar in whole], [bar.most for bar in memory])
    for name, (style, seconds, held) in lines.items():
        left.plot(points, seconds, style, label=name, linewidth=2)
        right.plot(points, held, style, linewidth=2)
    left.plot(points, [bar.value for bar in rows], "s-", color="tab:green", label=rows[0].name.removesuffix(", s"))
    left.plot(points, [bar.most for bar in rows], ":", color="tab:green", linewidth=2, label="may take")
    for (name, stages), colour in zip(GROUPS.items(), COLOURS, strict=True):
        seconds = [max(span(run.seconds, *stages), 1e-3) for run in runs]
        left.plot(points, seconds, ".-", color=colour, linewidth=1, label=name)
    for axes, what in ((left, "seconds"), (right, "most memory (MB)")):
        axes.set(xscale="log", yscale="log", xlabel="million points", ylabel=what)
        axes.set_xticks(points, [f"{x:.1f}" for x in points])
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.grid(visible=True, alpha=0.3)
    figure.legend(loc="outside lower center", ncols=5, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
