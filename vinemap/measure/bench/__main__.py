"""Seconds and memory of the chain on parcels of several sizes: ``python -m vinemap.measure.bench``.

A run of ``vinemap run`` as a user starts it is held against plain reading of the same file, against what is promised,
and against what a user would pick instead of a step. Everything that is measured has a process of its own.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from vinemap.cli.options import FILE
from vinemap.errors import ConfigError
from vinemap.measure.bench.instead import instead, whole
from vinemap.measure.bench.plot import draw
from vinemap.measure.bench.runs import cold, many, measure, prefect
from vinemap.measure.bench.tables import bar_table, dense_table, machine, stage_table, write_tables
from vinemap.measure.tables import as_text
from vinemap.terminal import plain_errors

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vinemap.measure.bench.bars import Run
    from vinemap.measure.bench.tables import Lines

SIZES, DENSE = "1 2 4 8 16", "2 4 8 24"
MANY = 60.0, 20
"""Million points and parcels of the survey that is one job."""
PARTS = ["F", "dense", "many", "cold", "instead", "whole", "prefect"]
"""What may be measured by itself: sizes of F's shape, dense ones, and the other tables."""


def parse_sizes(text: str) -> list[float]:
    """Sizes in million points from a text, ascending.

    Raises
    ------
    ConfigError
        If they aren't numbers above 0.
    """
    try:
        sizes = sorted({float(word) for word in text.replace(",", " ").split()})
    except ValueError:
        sizes = []
    if not sizes or not 0 < sizes[0] <= sizes[-1] < math.inf:
        raise ConfigError(f"sizes {text!r} aren't million points, for example --sizes '{SIZES}'")
    return sizes


@click.command()
@click.option("--sizes", default=SIZES, show_default=True, help="Million points, in quotes.")
@click.option("--dense", default=DENSE, show_default=True, help="Those of vineyards that are planted densely.")
@click.option("--out", type=FILE, default=Path("build/bench"), show_default=True, help="Folder of all that is made.")
@click.option("--docs", type=FILE, help="Markdown file to fill between its marks; the plot goes beside it.")
@click.option("--instead-at", default=4.0, show_default=True, help="Million points for what a user would pick instead.")
@click.option("--whole-at", default=2.0, show_default=True, help="Million points for the whole job by other tools.")
@click.option("--only", multiple=True, type=click.Choice(PARTS), help="What to measure; all of it by default.")
def main(
    sizes: str, dense: str, out: Path, docs: Path | None, instead_at: float, whole_at: float, only: Sequence[str]
) -> None:
    """Measure seconds and memory of the chain on simulated parcels of several sizes."""
    out.mkdir(parents=True, exist_ok=True)
    sized = {"F": parse_sizes(sizes), "dense": parse_sizes(dense)}
    parts = [part for part in PARTS if part in (only or PARTS)]
    runs: dict[tuple[str, float], Run] = {}

    def run(family: str, size: float) -> Run:
        if (family, size) not in runs:
            click.echo(f"{family}, {size:g} million points…", err=True)
            runs[family, size] = measure(size, out, family)
        return runs[family, size]

    def all_of(family: str) -> list[Run]:
        return [run(family, size) for size in sized[family]]

    def near(family: str, wanted: float) -> tuple[float, str, Run]:
        size = min(sized[family], key=lambda size: abs(size - wanted))
        return size, family, run(family, size)

    made: dict[str, Callable[[], dict[str, Lines]]] = {
        "F": lambda: {"bars": bar_table(all_of("F")), "stages": stage_table(all_of("F"))},
        "dense": lambda: {"dense": dense_table(all_of("dense")), "dense-stages": stage_table(all_of("dense"))},
        "many": lambda: {"many": many(*MANY, out)},
        "cold": lambda: {"cold": cold(out)},
        "instead": lambda: {"instead": instead(*near("F", instead_at), out)},
        "whole": lambda: {"whole": whole([near(family, whole_at) for family in sized], out)},
        "prefect": lambda: {"prefect": prefect(out)},
    }
    tables = {name: lines for part in parts for name, lines in made[part]().items()}
    told = [{"family": family} | one._asdict() | {"found": one.found._asdict()} for (family, _), one in runs.items()]
    (out / "runs.json").write_text(json.dumps(told, indent=2), encoding="utf-8")
    click.echo(machine())
    for lines in tables.values():
        click.echo("\n" + as_text(lines))
    if "F" in parts:
        draw(all_of("F"), docs.with_suffix(".png") if docs else out / "speed.png")
    if docs:
        write_tables(tables, docs)


if __name__ == "__main__":
    with plain_errors():
        main(standalone_mode=False)
