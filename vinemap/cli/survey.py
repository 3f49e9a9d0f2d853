"""``vinemap survey``: map many parcels of a cloud, or of a configured survey."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from vinemap.cli.estate import map_configured
from vinemap.cli.options import CRS, FILE, ROWS_CRS, SETTINGS, VINES, OriginParam
from vinemap.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

GIVEN = {ParameterSource.COMMANDLINE, ParameterSource.ENVIRONMENT}


@click.command(short_help="Map many parcels of a survey in one job.")
@click.argument("clouds", metavar="CLOUD... | NAME", nargs=-1, required=True, type=FILE)
@click.option("--boundaries", type=FILE, help="Polygons of the parcels of CLOUD, named in one of their columns.")
@click.option("--rows", type=FILE, help="Known rows, as lines or posts: where there are some, they are measured alone.")
@ROWS_CRS
@VINES
@click.option(
    "--register", "row_register", type=FILE, help="Register of known rows; data/register.gpkg, where that is there."
)
@click.option("--parcel", "parcels", multiple=True, help="Name of a parcel, any number of times; all by default.")
@CRS
@click.option("--out", type=FILE, help="Folder of the products' folders; data/products/<cloud> by default.")
@click.option("--origin", type=OriginParam(), help="Origin of the local frame {Main}; each parcel's corner by default.")
@SETTINGS
@click.option("--again", is_flag=True, help="Map parcels that are up to date, too.")
@click.option("--workers", type=int, help="Parcels worked at once; as many as there are cores.")
@click.option("--limit", type=float, help="Seconds that a parcel may take; an hour by default.")
@click.option("--memory", type=float, help="Memory that a parcel may take, in GB; its share of what there is.")
@click.option("--engine", type=click.Choice(["processes", "dask"]), help="What works the parcels; processes here.")
@click.option("--scheduler", help="Address of the Dask scheduler, as tcp://host:8786.")
def survey(
    clouds: tuple[Path, ...],
    boundaries: Path | None,
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
    """Map many parcels of CLOUD in one job, or those of a configured survey; exit code 1 if one of them fails.

    CLOUD is files or folders, as of vinemap run, and wants --boundaries. NAME is a survey that
    configs/NAME.yaml describes, that has arrived under that name, or a .yaml file; with it goes --again alone.
    """
    if boundaries is None:
        map_configured(_name(clouds), again=again)
        return
    from vinemap import paths
    from vinemap.cloud.files import cloud_files
    from vinemap.config.surveys import load_settings, survey_config
    from vinemap.jobs.outcomes import FAILED, check_same
    from vinemap.jobs.survey import map_survey

    files = cloud_files(clouds)
    name = paths.named_by(files)
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
    if out is None:
        check_same(paths.survey_products(name), files)
    failed = False
    for outcome in map_survey(config, out or paths.survey_products(name), again=again):
        failed |= outcome.state == FAILED
        click.echo(outcome.line(), err=outcome.state == FAILED)
    if failed:
        sys.exit(1)


def _name(given: tuple[Path, ...]) -> str:
    """Name of a configured survey, which no option describes."""
    from vinemap.cloud.files import CLOUDS

    name, context = str(given[0]), click.get_current_context()
    if len(given) > 1 or given[0].suffix.lower() in CLOUDS:
        raise ConfigError(f"{name}: clouds need the polygons of their parcels: give --boundaries")
    for option in context.command.params:
        if option.name not in {"clouds", "again"} and context.get_parameter_source(option.name or "") in GIVEN:
            raise ConfigError(
                f"{option.opts[0]} goes with clouds and --boundaries: of {name} its configuration says that"
            )
    return name
