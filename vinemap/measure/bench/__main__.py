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
from vinemap.cli.terminal import plain_errors
from vinemap.errors import ConfigError
from vinemap.measure.bench.plot import draw
from vinemap.measure.bench.runs import instead, many, measure, prefect
from vinemap.measure.bench.tables import bar_table, machine, stage_table, write_tables
from vinemap.measure.tables import as_text

if TYPE_CHECKING:
    from collections.abc import Iterable

SIZES = "1 2 4 8 16"
MANY = 60.0, 20
"""Million points and parcels of the survey that is one job."""


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
@click.option("--out", type=FILE, default=Path("build/bench"), show_default=True, help="Folder of all that is made.")
@click.option("--docs", type=FILE, help="Markdown file to fill between its marks; the plot goes beside it.")
@click.option("--instead-at", default=4.0, show_default=True, help="Million points for what a user would pick instead.")
@click.option("--without", multiple=True, type=click.Choice(["many", "instead", "prefect"]), help="What to leave out.")
def main(sizes: str, out: Path, docs: Path | None, instead_at: float, without: Iterable[str]) -> None:
    """Measure seconds and memory of the chain on simulated parcels of several sizes."""
    millions = parse_sizes(sizes)
    runs = []
    for size in millions:
        click.echo(f"{size:g} million points…", err=True)
        runs.append(measure(size, out))
    (out / "runs.json").write_text(json.dumps([run._asdict() for run in runs], indent=2), encoding="utf-8")
    tables = {"bars": bar_table(runs), "stages": stage_table(runs)}
    if "many" not in without:
        tables["many"] = many(*MANY, out)
    if "instead" not in without:
        k = min(range(len(runs)), key=lambda i: abs(millions[i] - instead_at))
        tables["instead"] = instead(millions[k], runs[k], out)
    if "prefect" not in without:
        tables["prefect"] = prefect(out)
    click.echo(machine())
    for lines in tables.values():
        click.echo("\n" + as_text(lines))
    draw(runs, docs.with_suffix(".png") if docs else out / "speed.png")
    if docs:
        write_tables(tables, docs)


if __name__ == "__main__":
    with plain_errors():
        main(standalone_mode=False)
