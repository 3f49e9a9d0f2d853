"""``vinemap evaluate``: compare a map with reference lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from vinemap.cli.options import FILE

if TYPE_CHECKING:
    from pathlib import Path


@click.command(short_help="Compare rows with reference lines.")
@click.argument("result", type=FILE)
@click.argument("reference", type=FILE)
@click.option("--layer", help="Layer of REFERENCE; rows, or its only layer of lines, by default.")
@click.option("--parcel", help="Only the lines of REFERENCE in which a column holds this name.")
@click.option("--pairs", type=FILE, help="GeoPackage to write: matched, extra and missed rows with their indices.")
def evaluate(result: Path, reference: Path, layer: str | None, parcel: str | None, pairs: Path | None) -> None:
    """Compare the rows of RESULT with lines drawn in REFERENCE: the six indices of Table 2.2."""
    from vinemap.evaluate.reference import read_lines
    from vinemap.evaluate.rows import as_layer, evaluate_rows, format_table
    from vinemap.product.geopackage import write_layer

    found, drawn = read_lines(result), read_lines(reference, layer, parcel=parcel)
    evaluation = evaluate_rows(found, drawn)
    if pairs:
        write_layer(as_layer(evaluation, found, drawn), pairs, layer="pairs")
    click.echo(format_table(evaluation))
