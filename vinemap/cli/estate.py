"""What make's verbs do: ``vinemap example``, ``vinemap parcel`` and ``vinemap nightly``.

Where Prefect is installed the work is a flow of it, else the same without.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import click

from vinemap import paths
from vinemap.cli.options import FILE
from vinemap.errors import ConfigError
from vinemap.terminal import progress

if TYPE_CHECKING:
    from pathlib import Path


def flows(name: str) -> Any:
    """A module of flows: within the package where that is installed, beside it in a clone.

    Raises
    ------
    DependencyError
        If Prefect can't be loaded.
    """
    from vinemap.compute.extras import load

    package = "vinemap.flows" if find_spec("vinemap.flows") else "flows"
    import_module(package)  # it has Prefect's settings, which are read when that is first imported
    load("prefect")
    return import_module(f"{package}.{name}")


@click.command(short_help="Make the example survey in this folder.")
def example() -> None:
    """Make the example in this folder: configs/barolo.yaml, and a simulated survey whose true rows are known."""
    from vinemap.example import write_example

    for path in write_example():
        click.echo(path)
    click.echo("vinemap parcel F maps its parcel F, vinemap survey barolo all of them")


@click.command(short_help="Map one parcel of a configured survey.")
@click.argument("parcel")
@click.option("--config", type=FILE, default=paths.EXAMPLE, help="Configuration; configs/barolo.yaml by default.")
def parcel(parcel: str, config: Path) -> None:
    """Map one PARCEL of a configured survey, anew."""
    from vinemap.example import ready
    from vinemap.jobs.configured import map_one

    if config == paths.EXAMPLE and not config.is_file():
        raise ConfigError(f"{config}: no such file: vinemap example makes it, --config names another")
    survey, name = ready(config, parcel)
    if find_spec("prefect"):
        summary = flows("parcel").parcel_flow(survey.survey, name, survey)
    else:
        with progress(name) as step:
            summary = map_one(survey, name, step=step)
    click.echo(summary.line())


@click.command(short_help="Map the surveys that arrive, on a schedule.")
@click.option("--config", type=FILE, default=paths.ESTATE, help="The estate's; configs/nightly.yaml by default.")
@click.option("--once", is_flag=True, help="Map what needs it now, and end; exit code 1 if a survey fails.")
@click.option("--every", type=click.FloatRange(1), help="Seconds from run to run, instead of the configuration's cron.")
def nightly(config: Path, once: bool, every: float | None) -> None:
    """Stay, and map the parcels of all surveys that need it when the estate's configuration says."""
    if config == paths.ESTATE and not config.is_file():
        raise ConfigError(f"{config}: no such file: vinemap config estate prints one, --config names another")
    flows("nightly").work(str(config), served=not once, every=every)


def map_configured(name: str, *, again: bool) -> None:
    """Map the parcels of a configured survey that need it, and tell what became of them."""
    from vinemap.example import ensure_cloud
    from vinemap.jobs.configured import chosen
    from vinemap.jobs.survey import map_survey
    from vinemap.terminal import tell

    config, folder = chosen(name)
    ensure_cloud(config)
    if find_spec("prefect"):
        tell(flows("survey").outcomes_of(config, folder, again=again))
        return
    outcomes = []
    for outcome in map_survey(config, folder, again=again):
        outcomes.append(outcome)
        if sys.stderr.isatty():
            click.echo(outcome.line(), err=True)
    tell(sorted(outcomes, key=lambda outcome: outcome.parcel))
