"""``vinemap export``: rows, lanes, canopies and tables for other programs; ``vinemap view``: products in Open3D."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from vinemap.cli.options import FILE
from vinemap.export import FORMATS, LINES

if TYPE_CHECKING:
    from pathlib import Path

PICTURES = (".png", ".jpg")
"""Endings of pictures that Open3D writes."""


@click.command(short_help="Write rows, lanes, canopies for other programs.")
@click.argument("products", metavar="PRODUCT...", nargs=-1, required=True, type=FILE)
@click.option(
    "--format",
    "formats",
    multiple=True,
    required=True,
    type=click.Choice([*FORMATS, "all"]),
    help="Any number of times.",
)
@click.option("--out", type=FILE, help="Folder of the parcels' folders; exports by default.")
@click.option("--lines", type=click.Choice(LINES), default="lanes", help="What guidance follows; lanes by default.")
@click.option(
    "--headland", type=click.FloatRange(0, 50), default=3.0, help="Metres of lanes beyond rows; 3 by default."
)
@click.option("--outer", is_flag=True, help="Lanes beside the first row of a block and its last, too.")
@click.option("--frame", default="map", help="Name of the frame of a robot's coordinates; map by default.")
@click.option("--grid", is_flag=True, help="Robots' coordinates and meshes in the product's CRS; in {Main} by default.")
@click.option("--vertices", type=click.IntRange(2, 10_000), help="Vertices of every lane; by default few.")
def export(products: tuple[Path, ...], formats: tuple[str, ...], out: Path | None, **options: Any) -> None:
    """Write rows, lanes, canopies and tables of each PRODUCT (its folder or GeoPackage, or a survey's) for others."""
    from vinemap import paths
    from vinemap.export.write import export_products

    chosen = FORMATS if "all" in formats else tuple(dict.fromkeys(formats))
    for line in export_products(products, out or paths.EXPORTS, formats=chosen, **options):
        click.echo(line)


@click.command(short_help="Show cloud, rows and meshes in 3D.")
@click.argument("products", metavar="PRODUCT...", nargs=-1, required=True, type=FILE)
@click.option("--cloud", type=FILE, help="Points to show; by default the product's classified cloud, if it has one.")
@click.option("--png", type=FILE, help="Picture to write instead of opening a window; needed where there is no screen.")
def view(products: tuple[Path, ...], cloud: Path | None, png: Path | None) -> None:
    """Show cloud, rows and meshes of each PRODUCT (its folder or GeoPackage, or that of a survey)."""
    from vinemap.compute.extras import load
    from vinemap.errors import InputError
    from vinemap.view.scene import scene_of
    from vinemap.view.window import has_screen, show

    load("open3d")
    if png and png.suffix.lower() not in PICTURES:
        raise InputError(f"{png}: a picture ends in {' or '.join(PICTURES)}: give it such a name")
    if png is None and not has_screen():
        raise InputError("There is no screen here: give --png FILE for a picture")
    scene = scene_of(products, cloud)
    if not len(scene.points):
        click.echo("Rows and meshes without points: give --cloud FILE, or map with --classified (classified: true)")
    show(scene, png)
    if png:
        click.echo(f"→ {png}")
