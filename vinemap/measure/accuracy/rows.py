"""How accurate rows and canopies are, on simulated vineyards of every kind: ``python -m vinemap.measure.accuracy``.

Every family of :mod:`vinemap.simulate.scenes` is simulated with a few seeds and mapped in memory, without a boundary
and with the settings as they come. What misses its bar is marked with "!". Of the worst row of each family a picture is
drawn.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import numpy as np
import pandas as pd
import shapely

from vinemap.cloud.points import PointCloud
from vinemap.config.settings import PolygonOptions, Settings
from vinemap.evaluate.rows import evaluate_rows
from vinemap.geo.raster import Raster, RowField, cell_of, sample, sample_across
from vinemap.measure.accuracy.canopies import CanopyErrors, compare_canopies, pool_canopies
from vinemap.measure.tables import as_markdown, as_text, fill
from vinemap.parcel import RowMap, map_rows, model_canopies
from vinemap.simulate.scenes import FAMILIES, family

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import geopandas as gpd
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike, NDArray

    from vinemap.simulate.survey import Survey

    Array = NDArray[np.float64]

NEAR = 0.8
"""Metres within which a gap and a dead vine belong together."""
LONG = 1.5
"""Metres from which a gap is one of two vines or more."""
PROCESSES = 2


class Errors(NamedTuple):
    """What is wrong with one map, or with several."""

    rows: int
    """True rows."""
    found: int
    pairs: pd.DataFrame
    """The pairs of :func:`vinemap.evaluate.rows.evaluate_rows`."""
    terrain: Array
    """|error| of the DTM (m) at random points of the parcels."""
    direction: Array
    """|error| of the row direction (degrees) every metre of the true rows."""
    spacing: Array
    """|error| of the inter-row spacing, as a share of it, every metre of the true rows that have a neighbour."""
    recalled: NDArray[np.bool_]
    """Whether a dead vine with a dead neighbour lies by a gap."""
    right: NDArray[np.bool_]
    """Whether a long gap lies by such a vine."""
    gap_length: Array
    """|error| of the length (m) of gaps of two vines or more."""


class Worst(NamedTuple):
    """The worst row of a map; ``badness`` is 1 where a bar is just met."""

    badness: float
    line: shapely.LineString
    what: str


class Measure(NamedTuple):
    """A number of the table, and the bar that it must meet."""

    value: Callable[[Any], float]
    """Of :class:`Errors` or :class:`CanopyErrors`."""
    bar: float
    digits: int = 3
    at_least: bool = False


def mean(values: ArrayLike) -> float:
    """Mean, NaN of nothing."""
    return float(np.mean(np.asarray(values, dtype=float))) if np.size(values) else np.nan


def quantile(values: ArrayLike, order: float) -> float:
    """Quantile, NaN of nothing."""
    return float(np.quantile(np.asarray(values, dtype=float), order)) if np.size(values) else np.nan


ALONG = ["e1_along_m", "en_along_m"]
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
TRUE_FOLIAGE = "against the true foliage"
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
EASED = {
    ("thin", "DEP m", "mean"): 0.10,
    ("terraces", "DTM m", "median"): 0.03,
    ("terraces", "DTM m", "95%"): 0.20,
    ("sparse", "width m", "worst row"): 0.10,
}
EASED |= {(family, TRUE_FOLIAGE, "G"): 0.85 for family in ("thin", "sparse")}
EASED |= {(family, TRUE_FOLIAGE, "U"): 0.15 for family in ("thin", "sparse")}
EASED |= {(family, TRUE_FOLIAGE, "G − U − O"): 0.55 for family in ("thin", "sparse")}
"""Bars that are lower for a family."""


def compare(survey: Survey, found: RowMap) -> tuple[Errors, Worst | None]:
    """Hold a map against the truth of its survey; the worst row is None if there is no row at all."""
    evaluation = evaluate_rows(found.rows[["geometry"]], survey.rows[["geometry"]])
    truth = shapely.force_2d(survey.rows.geometry.to_numpy())
    lines = shapely.force_2d(found.rows.geometry.to_numpy())
    direction, spacing = _field_errors(truth, found.field)
    errors = Errors(
        len(truth),
        len(lines),
        evaluation.pairs,
        _terrain_errors(survey, found.dtm),
        direction,
        spacing,
        *_gap_errors(survey, found.gaps),
    )
    pairs = evaluation.pairs.to_dict("records")
    worst = [
        Worst(
            max(p["dep_m"] / 0.2, p["dek_m"] / 0.03, p["cof_m"] / 0.03),
            truth[p["reference"] - 1],
            f"DEP {p['dep_m']:.3f}, DEK {p['dek_m']:.3f}, COF {p['cof_m']:.3f} m",
        )
        for p in pairs
    ]
    # A row that is wrong altogether is worse than any that isn't, the longest first.
    for rows, ids, what in ((truth, evaluation.missed_rows, "missed"), (lines, evaluation.extra_rows, "extra")):
        worst += [Worst(1000 + rows[int(str(i)) - 1].length, rows[int(str(i)) - 1], f"{what} row") for i in ids]
    return errors, max(worst, key=lambda row: row.badness, default=None)


def pool(errors: Sequence[Errors]) -> Errors:
    """Errors of several maps as those of one."""
    rows, found, pairs, *arrays = zip(*errors, strict=True)
    return Errors(sum(rows), sum(found), pd.concat(pairs), *(np.concatenate(values) for values in arrays))


def _terrain_errors(survey: Survey, dtm: Raster, *, n: int = 4000) -> Array:
    inside = shapely.union_all(survey.parcels.geometry.to_numpy())
    west, south, east, north = inside.bounds
    x, y = np.random.default_rng(0).uniform([west, south], [east, north], (n, 2)).T
    x, y = np.array([x, y])[:, shapely.contains_xy(inside, x, y)]
    return np.abs(sample(dtm, np.column_stack([x, y])) - survey.terrain(x, y))


def _field_errors(rows: NDArray[np.object_], field: RowField) -> tuple[Array, Array]:
    """Errors of direction (degrees) and spacing (shares) every metre of rows; where the field is unknown, the worst."""
    along = [np.arange(0.5, row.length, 1.0) for row in rows]
    row = np.repeat(np.arange(len(rows)), [len(a) for a in along])
    at = np.concatenate([*along, np.empty(0)])
    xy, back, ahead = (
        shapely.get_coordinates(shapely.line_interpolate_point(rows[row], np.maximum(at + step, 0)))
        for step in (0, -0.3, 0.3)
    )
    if len(xy) == 0:
        return np.empty(0), np.empty(0)
    way = ahead - back
    cells = cell_of(xy, field.direction.grid)
    there = [raster.values.ravel()[cells] for raster in (field.direction, field.spacing)]  # noqa: PD011 - no frames
    turn = there[0] - np.degrees(np.arctan2(way[:, 1], way[:, 0]))
    direction = np.abs((turn + 90) % 180 - 90)
    wanted = _true_spacing(rows, row, xy, way / np.hypot(*way.T)[:, None])
    spacing = np.abs(there[1] / wanted - 1)
    return np.nan_to_num(direction, nan=90.0), np.nan_to_num(spacing, nan=1.0)[np.isfinite(wanted)]


def _true_spacing(rows: NDArray[np.object_], row: NDArray[np.intp], xy: Array, way: Array) -> Array:
    """Distance (m) across the rows to the neighbours, the mean of both sides; NaN where there is none."""
    normal = np.column_stack([-way[:, 1], way[:, 0]])
    others = np.array([shapely.MultiLineString(list(np.delete(rows, i))) for i in range(len(rows))], dtype=object)
    sides = []
    for side in (1, -1):
        rays = shapely.linestrings(np.stack([xy, xy + 6 * side * normal], axis=1))
        sides.append(shapely.distance(shapely.points(xy), shapely.intersection(rays, others[row])))
    distance = np.array(sides)
    # Past the end of its neighbour a row looks at the one beyond.
    usual = quantile(distance[np.isfinite(distance)], 0.5)
    known = distance < 1.5 * usual
    total = np.where(known, distance, 0).sum(axis=0)
    out: Array = np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
    return out


def _gap_errors(survey: Survey, gaps: gpd.GeoDataFrame) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Array]:
    """Recall of dead vines in runs, precision of long gaps, errors of the runs' lengths (m)."""
    dead = survey.dead_vines
    runs = ((dead["vine"].diff() != 1) | (dead["row"].diff() != 0)).cumsum()
    spots = shapely.force_2d(dead.geometry[runs.map(runs.value_counts()) >= 2].to_numpy())
    pieces = shapely.force_2d(gaps.geometry.to_numpy())
    recalled = shapely.distance(spots, shapely.union_all(pieces)) < NEAR
    long = pieces[shapely.length(pieces) >= LONG]
    right = shapely.distance(long, shapely.union_all(spots)) < NEAR
    errors = []
    for true in shapely.force_2d(survey.gaps.geometry[survey.gaps["n_vines"] >= 2].to_numpy()):
        by = pieces[shapely.dwithin(pieces, true, NEAR / 2)]
        if len(by):
            errors.append(abs(shapely.length(by).max() - true.length))
    return recalled, right, np.array(errors)


def measure(name: str, seeds: int, out: Path | None = None) -> tuple[Errors, CanopyErrors]:
    """Errors over all seeds of a family; draws its worst row into a folder."""
    cases, canopies = [], []
    ours, thesis = Settings(), Settings(polygon=PolygonOptions(foot="soil"))
    for seed in range(seeds):
        survey = family(name, seed)
        points = PointCloud(survey.xyz, survey.rows.crs)
        found = map_rows(points, ours)
        errors, worst = compare(survey, found)
        model, on_soil = (model_canopies(found, settings) for settings in (ours, thesis))
        canopies.append(compare_canopies(survey, found, model, on_soil, errors.pairs, step=ours.sections.step))
        cases.append((errors, worst, survey, found, f"{name}, seed {seed}"))
    if out:
        _, worst, survey, found, title = max(cases, key=lambda case: case[1].badness if case[1] else 0.0)
        draw(worst, survey, found, title, out / f"{name}.png")
    return pool([errors for errors, *_ in cases]), pool_canopies(canopies)


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


def _draw_along(axes: Axes, line: shapely.LineString, survey: Survey, found: RowMap, reach: float = 3.0) -> None:
    """Draw what lies along a line, across it exaggerated."""
    xy = shapely.get_coordinates(line.segmentize(0.25))
    for k, other in ((0, 1), (-1, -2)):
        out = (xy[k] - xy[other]) / np.hypot(*(xy[k] - xy[other]))
        xy = np.insert(xy, 0 if k == 0 else len(xy), xy[k] + reach * out, axis=0)
    axis = shapely.LineString(xy)
    s, left = np.arange(0, axis.length, 0.1), np.arange(-reach, reach, 0.05)
    here, ahead = (shapely.get_coordinates(shapely.line_interpolate_point(axis, s + step)) for step in (0, 0.05))
    way = np.where(np.arange(len(s))[:, None] < len(s) - 1, ahead - here, (ahead - here)[-2])
    normal = np.column_stack([-way[:, 1], way[:, 0]]) / np.hypot(*way.T)[:, None]
    image = sample_across(found.cover, here, normal, left)
    extent = (-reach, axis.length - reach, -reach, reach)
    axes.imshow(image.T[::-1], extent=extent, aspect="auto", cmap="Greys", vmin=0, vmax=1)
    for rows, colour in ((survey.rows, "tab:green"), (found.rows, "red")):
        for row in shapely.force_2d(rows.geometry.to_numpy()):
            points = shapely.get_coordinates(row.segmentize(0.25))
            at = shapely.line_locate_point(axis, shapely.points(points))
            k = np.minimum((at / 0.1).astype(int), len(s) - 1)
            across = np.einsum("ij,ij->i", points - here[k], normal[k])
            near = (np.abs(across) < reach) & (at > 0) & (at < axis.length)
            axes.plot(np.where(near, at - reach, np.nan), np.where(near, across, np.nan), color=colour, linewidth=1)
            ends = np.column_stack([at - reach, across])[[0, -1]][near[[0, -1]]]
            axes.plot(*ends.T, "|", color=colour, markersize=25)
    axes.set(xlabel="along the row (m)", ylabel="to its left (m)")


def table(results: Mapping[str, Errors | CanopyErrors], columns: Columns = COLUMNS) -> list[list[str]]:
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
    return f"{shown:.{measure.digits}f}" + "!" * (shown < bar if measure.at_least else abs(shown) > bar)


@click.command()
@click.argument("families", nargs=-1, type=click.Choice(list(FAMILIES)), metavar="[FAMILY]...")
@click.option("--seeds", default=3, show_default=True, type=click.IntRange(1), help="Surveys of each family.")
@click.option("--out", type=click.Path(path_type=Path), help="Folder for a picture of each family's worst row.")
@click.option("--markdown", is_flag=True, help="Print the tables as Markdown.")
@click.option("--docs", type=click.Path(path_type=Path), help="Markdown file whose tables between marks are filled.")
def main(families: tuple[str, ...], seeds: int, out: Path | None, markdown: bool, docs: Path | None) -> None:
    """Measure rows and canopies on simulated vineyards, of all families unless some are named."""
    names = families or tuple(FAMILIES)
    began = time.perf_counter()
    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool_:
        jobs = {name: pool_.submit(measure, name, seeds, out) for name in names}
        results = {name: job.result() for name, job in jobs.items()}
    tables = {
        "rows": table({name: rows for name, (rows, _) in results.items()}),
        "canopies": table({n: c for n, (_, c) in results.items() if len(c.good)}, CANOPY_COLUMNS),
    }
    for lines in tables.values():
        click.echo((as_markdown if markdown else as_text)(lines) + "\n")
    if docs:
        text = docs.read_text(encoding="utf-8")
        for name, lines in tables.items():
            text = fill(text, name, as_markdown(lines))
        docs.write_text(text, encoding="utf-8")
    missed = sum(cell.count("!") for lines in tables.values() for line in lines[1:] for cell in line)
    click.echo(
        f"{missed} values miss their bars (!); surveys: {len(names) * seeds}, in {time.perf_counter() - began:.0f} s",
        err=True,
    )


if __name__ == "__main__":
    main()
