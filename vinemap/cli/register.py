"""``vinemap register``: put rows of products into the register of an estate."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from vinemap.cli.options import FILE

if TYPE_CHECKING:
    from pathlib import Path


@click.command(short_help="Put the rows of products into the register.")
@click.argument("products", metavar="PRODUCT...", nargs=-1, required=True, type=FILE)
@click.option("--register", "path", type=FILE, help="The register; data/register.gpkg by default.")
@click.option("--add", "how", flag_value="add", help="Take in rows that the register lacks where it has others, too.")
@click.option("--replace", "how", flag_value="replace", help="The same, and end those that are there no more.")
def register(products: tuple[Path, ...], path: Path | None, how: str | None) -> None:
    """Put the rows of each PRODUCT (its folder or GeoPackage, or that of a survey) into the estate's register."""
    from vinemap import paths
    from vinemap.jobs.register import register_products
    from vinemap.product.seasons.products import products_of

    found = [one for given in products for one in products_of(given)]
    for line in register_products(found, path or paths.REGISTER, how=how):
        click.echo(line)
