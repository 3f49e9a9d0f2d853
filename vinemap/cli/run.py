"""``vinemap run``: map one cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from vinemap.cli.options import CRS, FILE, ROWS_CRS, SETTINGS, VINES, OriginParam
from vinemap.terminal import progress

if TYPE_CHECKING:
    from pathlib import Path


@click.command(short_help="Map the rows and canopies of one parcel.")
@click.argument("clouds", metavar="CLOUD...", nargs=-1, required=True, type=FILE)
@click.option(
    "--boundary",
    type=FILE,
    help="Polygon to clip to, in any CRS: GeoPackage, GeoJSON, KML, KMZ or Shapefile, or a .zip of one.",
)
@click.option(
    "--rows", type=FILE, help="Known rows, as lines or posts: measured, none sought. The same formats, and DXF."
)
@ROWS_CRS
@VINES
@CRS
@click.option("--parcel", help="Name of the parcel; the cloud's by default.")
@click.option("--out", type=FILE, help="Folder of the product; data/products/<cloud>/<parcel> by default.")
@click.option("--origin", type=OriginParam(), help="Origin of the local frame {Main}; the parcel's corner by default.")
@SETTINGS
@click.option("--classified", is_flag=True, help="Write the points with a class and a row each, too.")
@click.option("--plain", is_flag=True, help="Write meshes for readers of glTF that know no extension: larger files.")
def run(
    clouds: tuple[Path, ...],
    boundary: Path | None,
    rows: Path | None,
    rows_crs: str | None,
    vines: Path | None,
    crs: str | None,
    parcel: str | None,
    out: Path | None,
    origin: Any,
    settings: Path | None,
    classified: bool,
    plain: bool,
) -> None:
    """Map the rows and canopies in CLOUD: files or folders, worked as one.

    They are LAS, LAZ, COPC (also as https://…), EPT, E57, PLY, PCD, XYZ or CSV, or a surface model as GeoTIFF.
    """
    from vinemap import paths
    from vinemap.cloud.files import cloud_files
    from vinemap.config.names import check_parcel
    from vinemap.config.settings import Settings
    from vinemap.config.surveys import load_settings
    from vinemap.errors import OutputError
    from vinemap.geo.crs import parse_crs
    from vinemap.product.json_values import read_object
    from vinemap.product.recipe import made_of
    from vinemap.warm import warming

    files = cloud_files(clouds)
    survey = paths.named_by(files)
    name = check_parcel(parcel) if parcel is not None else survey
    folder = out or paths.product_folder(survey, name)
    earlier, known = made_of(folder), read_object(paths.run_record(folder)).get("parcel")
    if earlier and (known != name or (out is None and not any(file.name in earlier for file in files))):
        whose = ", ".join(earlier) if known == name else f"parcel {known}"
        raise OutputError(f"{folder}: holds the product of {whose}: give another folder with --out")
    chosen = load_settings(settings) if settings else Settings()
    extra = {key: True for key, wanted in {"classified": classified, "plain": plain}.items() if wanted}
    options = {
        "crs": parse_crs(crs) if crs else None,
        "settings": chosen.model_copy(update={"product": chosen.product.model_copy(update=extra)}),
        "boundary": boundary,
        "rows": rows,
        "rows_crs": parse_crs(rows_crs) if rows_crs else None,
        "vines": vines,
        "origin": origin,
        "named": parcel is not None,
    }
    with progress(name) as bar, warming(bar) as step:
        from vinemap.parcel import map_parcel

        summary = map_parcel(clouds, folder, parcel=name, step=step, **options)
    now = made_of(folder)
    others = [file.name for file in files if earlier.get(file.name, now.get(file.name)) != now.get(file.name)]
    click.echo(summary.line() + (f"; it replaces that of another {others[0]}" if others else ""))
