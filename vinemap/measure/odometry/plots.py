"""Plots of how well odometry measures, like the thesis's Fig. 4.6, 4.7, 4.8 and 4.11."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.measure.odometry.tables import NAMES
from vinemap.measure.odometry.trials import CAMERAS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from vinemap.compute.arrays import Values
    from vinemap.measure.odometry.trials import ByMethod, Drift, Errors, Size

    Panel = Callable[[Axes], None]

THESIS_CEP = {"standard": 0.37, "enhanced": 0.16}
"""Millimetres, overall (Table 4.3)."""
THESIS_SHARES, THESIS_MS, THESIS_SPEEDS = (0.05, 0.35), (20, 190), (4.1, 0.3)
"""Sizes of its template, with milliseconds of a pair of 320 × 240 and highest speeds in m/s (Section 4.4)."""
FINEST = 1e-4
"""Errors that are less are drawn as large."""


def save(panels: Sequence[Sequence[Panel]], path: Path, *, width: float = 5.0, height: float = 4.4) -> None:
    """Draw panels, row by row, into a PNG."""
    from matplotlib.figure import Figure  # a tool of development

    rows, columns = len(panels), len(panels[0])
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    for axes, panel in zip(
        figure.subplots(rows, columns, squeeze=False).flat, (p for row in panels for p in row), strict=True
    ):
        panel(axes)
        axes.grid(visible=True, alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def boxes(axes: Axes, values: Mapping[str, Values], what: str) -> None:
    """Boxes from quarter to quarter, whiskers from 5% to 95%, on a logarithmic scale."""
    names = [NAMES.get(name, name) for name in values]
    shown = [np.maximum(errors, FINEST) for errors in values.values()]
    axes.boxplot(shown, tick_labels=names, whis=(5, 95), widths=0.6, showfliers=False)
    axes.set(yscale="log", ylabel=what)
    axes.yaxis.set_major_formatter("{x:g}")


def places(axes: Axes, errors: ByMethod) -> None:
    """Errors of the template's place (Fig. 4.6 a, b)."""
    boxes(axes, {method: e.place for method, e in errors.items()}, "error of the place (mm)")
    for (name, cep), style in zip(THESIS_CEP.items(), ("--", ":"), strict=True):
        axes.axhline(cep, color="tab:blue", linestyle=style, linewidth=1, label=f"the thesis's CEP, {name}")
    axes.legend(fontsize=8)


def turns(axes: Axes, errors: ByMethod) -> None:
    """Errors of the rotation (Fig. 4.6 c, d)."""
    boxes(axes, {method: e.turn for method, e in errors.items()}, "error of the rotation (°)")


def scatter(axes: Axes, errors: Errors, title: str) -> None:
    """Errors of the place along both axes, its CEP as a circle, that of the rotation as colour (Fig. 4.7)."""
    x, y = errors.offset.T
    points = axes.scatter(x, y, c=errors.turn, s=6, cmap="hot", vmin=0, vmax=0.8)
    around = np.linspace(0, 2 * np.pi, 181)
    axes.plot(errors.cep * np.cos(around), errors.cep * np.sin(around), "b")
    reach = 0.8
    ticks = np.linspace(-reach, reach, 5)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xticks=ticks, yticks=ticks, aspect="equal", facecolor="0.85")
    axes.set(xlabel="forward (mm)", ylabel="to the left (mm)", title=f"{title}: CEP {errors.cep:.3f} mm")
    axes.figure.colorbar(points, ax=axes, label="error of the rotation (°)", shrink=0.8)


def times(axes: Axes, sizes: Sequence[Size], exhaustive: float, bar: float) -> None:
    """Time of a pair against the size of the template (Fig. 4.11 a)."""
    _against(axes, sizes, {name: [1000 * size.seconds[name] for size in sizes] for name in CAMERAS})
    axes.plot(0.2, 1000 * exhaustive, "b*", markersize=11, label="320 × 240, exhaustive")
    axes.plot(0.2, 1000 * bar, "b_", markersize=16, markeredgewidth=2, label=f"{1000 * bar:g} ms, our bar")
    axes.plot(THESIS_SHARES, THESIS_MS, "k.", label="the thesis, 320 × 240")
    axes.set(ylabel="time of a pair (ms)", ylim=(1, None))
    axes.legend(fontsize=8)


def speeds(axes: Axes, sizes: Sequence[Size]) -> None:
    """Highest speed against the size of the template (Fig. 4.11 b)."""
    _against(axes, sizes, {name: [size.speed(size.seconds[name]) for size in sizes] for name in CAMERAS})
    axes.plot(THESIS_SHARES, THESIS_SPEEDS, "k.", label="the thesis, 320 × 240")
    axes.set(ylabel="highest speed (m/s)")
    axes.legend(fontsize=8)


def drifted(axes: Axes, drift: Mapping[str, Drift]) -> None:
    """Error of the place gathered along paths (Fig. 4.8 a)."""
    boxes(axes, {name: d.place for name, d in drift.items()}, "place at a path's end (mm/m)")


def turned(axes: Axes, drift: Mapping[str, Drift]) -> None:
    """Error of the heading gathered along paths (Fig. 4.8 b)."""
    boxes(axes, {name: d.turn for name, d in drift.items()}, "heading at a path's end (°/m)")


def _against(axes: Axes, sizes: Sequence[Size], lines: Mapping[str, Sequence[float]]) -> None:
    for (name, values), style in zip(lines.items(), ("bo-", "rs-"), strict=True):
        axes.plot([size.share for size in sizes], values, style, label=name)
    axes.set(yscale="log", xlabel="template size $p_T$")
    axes.yaxis.set_major_formatter("{x:g}")
