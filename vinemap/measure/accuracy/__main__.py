"""Errors of rows and canopies on simulated vineyards of every kind: ``python -m vinemap.measure.accuracy [FAMILY …]``.

Every family of :mod:`vinemap.simulate.families` is simulated with a few seeds and mapped in memory, without a boundary
and with the settings as they come. What misses its bar is marked with "!". Of the worst row of each family a picture is
drawn, and one of confidence beside truth.
"""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import click

from vinemap.measure.accuracy.family import measure
from vinemap.measure.accuracy.figures import CANOPY_COLUMNS, MESH_COLUMNS, table
from vinemap.measure.accuracy.trust import draw_trust, pool_trust, trust_table
from vinemap.measure.tables import as_markdown, as_text, fill
from vinemap.simulate.families import FAMILIES

PROCESSES = 2


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
    trusted = pool_trust([trust for *_, trust in results.values()])
    tables = {
        "rows": table({name: rows for name, (rows, *_) in results.items()}),
        "canopies": table({n: c for n, (_, c, *_) in results.items() if len(c.good)}, CANOPY_COLUMNS),
        "meshes": table({n: m for n, (_, _, m, _) in results.items() if len(m.told)}, MESH_COLUMNS),
        "confidence": trust_table(trusted),
    }
    for lines in tables.values():
        click.echo((as_markdown if markdown else as_text)(lines) + "\n")
    if out:
        draw_trust(trusted, out / "confidence.png")
    if docs:
        draw_trust(trusted, docs.with_name("confidence.png"))
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
