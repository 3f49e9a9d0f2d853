"""How well odometry measures on simulated frames, whose movement is known: ``python -m vinemap.measure.odometry``.

Tables 4.3 and 4.4 of the thesis, relief, its Fig. 4.9 to 4.11, what happens when lost, and the error gathered along its
paths. What misses its bar is marked with "!".
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from vinemap.cli.options import FILE
from vinemap.measure.odometry import plots
from vinemap.measure.odometry.bridges import bridges
from vinemap.measure.odometry.tables import (
    MOST_SECONDS,
    bridge_table,
    drift_table,
    loss_table,
    relief_table,
    size_table,
    terrain_tables,
    trouble_table,
)
from vinemap.measure.odometry.trials import (
    SHARES,
    drifts,
    frames_to_time,
    losses,
    measure,
    pool,
    relief_errors,
    seconds_of,
    size_of,
)
from vinemap.measure.odometry.troubles import troubles
from vinemap.measure.tables import as_markdown, as_text, fill
from vinemap.simulate.camera import LOW, PHOTOGRAPHS, lay_ground
from vinemap.simulate.grounds import MADE
from vinemap.simulate.steps import PATCH, walk
from vinemap.terminal import plain_errors

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.measure.odometry.plots import Panel
    from vinemap.measure.odometry.tables import Lines

    Panels = list[list[Panel]]

PAGE = click.Path(exists=True, dir_okay=False, path_type=Path)
PARTS = ("terrains", "relief", "sizes", "lost", "troubles", "paths", "bridges")
ROUGH = 8.0
"""Millimetres of relief on which steps are lost, too."""
TITLES = {
    "places": "Place of the template (Table 4.3)",
    "turns": "Rotation (Table 4.4)",
    "relief": "Grass with relief",
    "sizes": "Size of the template: time of a pair, highest speed, errors (Fig. 4.9 to 4.11)",
    "lost": "Lost: errors above 5 mm",
    "troubles": "In trouble: steps that are believed, and those that are wrong all the same",
    "paths": "Error at the end of sinusoidal paths of 9.6 m, over their length (Fig. 4.8)",
    "bridges": "Paths of 9.6 m of which a fifth is lost",
}


def terrains(grounds: Sequence[str | Path], steps: int) -> tuple[dict[str, Lines], dict[str, Panels]]:
    """Tables and plots of every method on every ground, random step by random step."""
    found = {str(ground): measure(walk(ground, steps, seed=1000 * k)) for k, ground in enumerate(grounds)}
    errors = pool(list(found.values()))
    scattered: list[Panel] = [
        partial(plots.scatter, errors=errors["maximum"], title="standard"),
        partial(plots.scatter, errors=errors["centroid"], title="centroid"),
        partial(plots.scatter, errors=errors["aligned"], title="aligned"),
    ]
    boxes: list[Panel] = [partial(plots.places, errors=errors), partial(plots.turns, errors=errors)]
    return terrain_tables(found), {"errors": [boxes], "scatter": [scattered]}


def relief(steps: int) -> tuple[dict[str, Lines], dict[str, Panels]]:
    """Table of grass with relief."""
    return {"relief": relief_table(relief_errors(steps, seed=200_000))}, {}


def sizes(grounds: Sequence[str | Path], steps: int) -> tuple[dict[str, Lines], dict[str, Panels]]:
    """Table and plot of sizes of the template."""
    frames = frames_to_time()
    found = [size_of(share, frames, grounds, steps, seed=100_000) for share in SHARES]
    exhaustive = seconds_of(frames["320 × 240"], camera=LOW, search="exhaustive")
    times = partial(plots.times, sizes=found, exhaustive=exhaustive, bar=MOST_SECONDS)
    return {"sizes": size_table(found, exhaustive)}, {"sizes": [[times, partial(plots.speeds, sizes=found)]]}


def lost(grounds: Sequence[str | Path], pairs: int) -> tuple[dict[str, Lines], dict[str, Panels]]:
    """Table of what is lost; its name says of how many pairs."""
    found = {str(ground): losses(ground, pairs, seed=1000 * k) for k, ground in enumerate(grounds, 300)}
    found[f"grass, relief {ROUGH:g} mm"] = losses("grass", pairs, relief_mm=ROUGH, seed=400_000)
    return {f"lost {pairs}": loss_table(found)}, {}


def in_trouble(grounds: Sequence[str | Path], steps: int) -> tuple[dict[str, Lines], dict[str, Panels]]:
    """Table of drives that are spoilt."""
    return {"troubles": trouble_table(troubles(grounds, steps, seed=500_000))}, {}


def paths(grounds: Sequence[str | Path], count: int) -> tuple[dict[str, Lines], dict[str, Panels]]:
    """Table and plot of the error gathered along paths."""
    found = drifts(grounds, count, seed=100)
    boxes: list[Panel] = [partial(plots.drifted, drift=found), partial(plots.turned, drift=found)]
    return {"paths": drift_table(found)}, {"paths": [boxes]}


def bridged(grounds: Sequence[str | Path], count: int) -> tuple[dict[str, Lines], dict[str, Panels]]:
    """Table of paths with lost stretches."""
    return {"bridges": bridge_table(bridges(grounds, count, seed=700))}, {}


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("parts", nargs=-1, type=click.Choice(PARTS), metavar="[PART]...")
@click.option("--steps", type=click.IntRange(1), default=300, show_default=True, help="Random steps a ground.")
@click.option("--pairs", type=click.IntRange(5), default=300, show_default=True, help="The same, for what gets lost.")
@click.option("--paths", "count", type=click.IntRange(1), default=20, show_default=True, help="Paths of 9.6 m.")
@click.option("--photograph", "photographs", multiple=True, type=FILE, help="Ground of one's own, 0.4 mm a pixel.")
@click.option("--out", type=FILE, default=Path("build/odometry"), show_default=True, help="Folder of the plots.")
@click.option("--docs", type=PAGE, help="Markdown file to fill; a plot of terrains, sizes and paths goes beside.")
def main(
    parts: Sequence[str],
    steps: int,
    pairs: int,
    count: int,
    photographs: Sequence[Path],
    out: Path,
    docs: Path | None,
) -> None:
    """Measure odometry on simulated frames, on one core: all parts, or those named."""
    import cv2

    cv2.setNumThreads(1)
    began = time.perf_counter()
    for photograph in photographs:  # at once, if it can't be read
        lay_ground(photograph, size_mm=(1.0, 1.0))
    grounds: list[str | Path] = [*PHOTOGRAPHS, *MADE, *photographs]
    work = {
        "terrains": partial(terrains, grounds, steps),
        "relief": partial(relief, steps),
        "sizes": partial(sizes, grounds, min(steps, PATCH)),
        "lost": partial(lost, grounds, pairs),
        "troubles": partial(in_trouble, grounds, steps),
        "paths": partial(paths, grounds, count),
        "bridges": partial(bridged, grounds, count),
    }
    tables: dict[str, Lines] = {}
    panels: dict[str, Panels] = {}
    for part in parts or PARTS:
        lines, drawn = work[part]()
        for name, table in lines.items():
            click.echo(f"{TITLES[name.split()[0]]}\n{as_text(table)}\n")
        for name, rows in drawn.items():
            plots.save(rows, out / f"{name}.png")
        tables |= lines
        panels |= drawn
    if docs:
        text = docs.read_text(encoding="utf-8")
        for name, table in tables.items():
            text = fill(text, name, as_markdown(table))
        docs.write_text(text, encoding="utf-8")
        if {"errors", "paths", "sizes"} <= panels.keys():
            overview = [panels["errors"][0] + panels["paths"][0][:1], panels["sizes"][0] + panels["paths"][0][1:]]
            plots.save(overview, docs.with_name("odometry.png"))
    missed = sum(cell.count("!") for table in tables.values() for line in table[1:] for cell in line)
    click.echo(f"{missed} values miss their bars (!), in {time.perf_counter() - began:.0f} s", err=True)


if __name__ == "__main__":
    with plain_errors():
        main(standalone_mode=False)
