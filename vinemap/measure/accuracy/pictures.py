"""Pictures of the worst row of a family."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from vinemap.geo.raster import sample_across

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from vinemap.chain import RowMap
    from vinemap.measure.accuracy.rows import Worst
    from vinemap.simulate.survey import Survey

REACH = 3.0
"""Metres beyond a row's ends, and to both sides, that are drawn."""


def draw(worst: Worst | None, survey: Survey, found: RowMap, title: str, path: Path) -> None:
    """Draw a map, and its worst row straightened and at both ends, over the canopy cover."""
    from matplotlib.figure import Figure  # a tool of development

    figure = Figure(figsize=(16, 10 if worst else 8), layout="constrained")
    if worst is None:
        figure.suptitle(f"{title}: no row, true or found")
        _draw_plan(figure.add_subplot(), survey, found, 0.8)
    else:
        figure.suptitle(f"{title}: {worst.what} (green: true, red: found)")
        axes = figure.subplot_mosaic([["plan", "start", "end"], ["row", "row", "row"]], height_ratios=[3, 2])
        _draw_plan(axes["plan"], survey, found, 0.8)
        axes["plan"].plot(*worst.line.xy, color="gold", linewidth=6, alpha=0.4, zorder=0.5)
        for k, key in ((0, "start"), (-1, "end")):
            x, y = worst.line.coords[k][:2]
            _draw_plan(axes[key], survey, found, 1.5)
            axes[key].set(xlim=(x - 2.5, x + 2.5), ylim=(y - 2.5, y + 2.5), title=f"its {key}")
        _draw_along(axes["row"], worst.line, survey, found)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def _draw_plan(axes: Axes, survey: Survey, found: RowMap, width: float) -> None:
    grid = found.cover.grid
    east, south = grid.west + grid.nx * grid.resolution, grid.north - grid.ny * grid.resolution
    axes.imshow(found.cover.values, extent=(grid.west, east, south, grid.north), cmap="Greys", vmin=0, vmax=1, zorder=0)
    for rows, colour in ((survey.rows, "tab:green"), (found.rows, "red")):
        for line in rows.geometry:
            axes.plot(*shapely.force_2d(line).xy, color=colour, linewidth=width)
            axes.plot(*np.array(line.coords)[[0, -1], :2].T, "+", color=colour, markersize=8 * width)
    axes.set(xticks=[], yticks=[])


def _draw_along(axes: Axes, line: shapely.LineString, survey: Survey, found: RowMap) -> None:
    """Draw what lies along a line, across it exaggerated."""
    xy = shapely.get_coordinates(line.segmentize(0.25))
    for k, other in ((0, 1), (-1, -2)):
        out = (xy[k] - xy[other]) / np.hypot(*(xy[k] - xy[other]))
        xy = np.insert(xy, 0 if k == 0 else len(xy), xy[k] + REACH * out, axis=0)
    axis = shapely.LineString(xy)
    s, left = np.arange(0, axis.length, 0.1), np.arange(-REACH, REACH, 0.05)
    here, ahead = (shapely.get_coordinates(shapely.line_interpolate_point(axis, s + step)) for step in (0, 0.05))
    way = np.where(np.arange(len(s))[:, None] < len(s) - 1, ahead - here, (ahead - here)[-2])
    normal = np.column_stack([-way[:, 1], way[:, 0]]) / np.hypot(*way.T)[:, None]
    image = sample_across(found.cover, here, normal, left)
    extent = (-REACH, axis.length - REACH, -REACH, REACH)
    axes.imshow(image.T[::-1], extent=extent, aspect="auto", cmap="Greys", vmin=0, vmax=1)
    for rows, colour in ((survey.rows, "tab:green"), (found.rows, "red")):
        for row in shapely.force_2d(rows.geometry.to_numpy()):
            points = shapely.get_coordinates(row.segmentize(0.25))
            at = shapely.line_locate_point(axis, shapely.points(points))
            k = np.minimum((at / 0.1).astype(int), len(s) - 1)
            across = np.einsum("ij,ij->i", points - here[k], normal[k])
            near = (np.abs(across) < REACH) & (at > 0) & (at < axis.length)
            axes.plot(np.where(near, at - REACH, np.nan), np.where(near, across, np.nan), color=colour, linewidth=1)
            ends = np.column_stack([at - REACH, across])[[0, -1]][near[[0, -1]]]
            axes.plot(*ends.T, "|", color=colour, markersize=25)
    axes.set(xlabel="along the row (m)", ylabel="to its left (m)")
