"""``vinemap survey``: map many parcels of a cloud."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from vinemap.cli.options import FILE, OriginParam

if TYPE_CHECKING:
    from pathlib import Path


@click.command()
@click.argument("clouds", metavar="CLOUD...", nargs=-1, required=True, type=FILE)
@click.option("--boundaries", type=FILE, required=True, help="Polygons of the parcels, named in one of their columns.")
@click.option("--rows", type=FILE, help="Known rows, as lines or posts: where there are some, they are measured alone.")
@click.option("--rows-crs", help="CRS of the known rows and vines, as EPSG:n, where their file states none.")
@click.option("--vines", type=FILE, help="Known vines, as points: where they stand isn't estimated. The same formats.")
@click.option(
    "--register", "row_register", type=FILE, help="Register of known rows; data/register.gpkg, where that is there."
)
@click.option("--parcel", "parcels", multiple=True, help="Name of a parcel, any number of times; all by default.")
@click.option("--crs", help="CRS of the cloud, as EPSG:n, where it states none or a wrong one; local for local metres.")
@click.option("--out", type=FILE, help="Folder of the products' folders; data/products/<cloud> by default.")
@click.option("--origin", type=OriginParam(), help="Origin of the local frame {Main}; each parcel's corner by default.")
@click.option("--settings", type=FILE, help="YAML file with settings of the stages.")
@click.option("--again", is_flag=True, help="Map parcels that are up to date, too.")
@click.option("--workers", type=int, help="Parcels worked at once; as many as there are cores.")
@click.option("--limit", type=float, help="Seconds that a parcel may take; an hour by default.")
@click.option("--memory", type=float, help="Memory that a parcel may take, in GB; its share of what there is.")
@click.option("--engine", type=click.Choice(["processes", "dask"]), help="What works the parcels; processes here.")
@click.option("--scheduler", help="Address of the Dask scheduler, as tcp://host:8786.")
def survey(
    clouds: tuple[Path, ...],
    boundaries: Path,
    rows: Path | None,
    rows_crs: str | None,
    vines: Path | None,
    row_register: Path | None,
    parcels: tuple[str, ...],
    crs: str | None,
    out: Path | None,
    origin: Any,
    settings: Path | None,
    again: bool,
    **job: Any,
) -> None:
    """Map many parcels of CLOUD (LAS, LAZ or COPC files, or folders) in one job; exit code 1 if one of them fails."""
    from vinemap import paths
    from vinemap.cloud.files import cloud_files
    from vinemap.config.surveys import load_settings, survey_config
    from vinemap.jobs.plan import FAILED
    from vinemap.jobs.survey import map_survey

    name = paths.named_by(cloud_files(clouds))
    config = survey_config(
        survey=name,
        cloud=list(clouds),
        boundaries=boundaries,
        rows=rows,
        rows_crs=rows_crs,
        vines=vines,
        row_register=row_register,
        parcels=list(parcels) or None,
        crs=crs,
        origin=origin,
        settings=load_settings(settings) if settings else None,
        job={key: value for key, value in job.items() if value is not None},
    )
    failed = False
    for outcome in map_survey(config, out or paths.survey_products(name), again=again):
        failed |= outcome.state == FAILED
        click.echo(outcome.line(), err=outcome.state == FAILED)
    if failed:
        sys.exit(1)
