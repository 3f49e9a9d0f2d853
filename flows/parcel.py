"""One parcel of a configured survey as a Prefect flow: every stage of the chain is a task run.

``python -m flows.parcel configs/barolo.yaml F``
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from vinemap import paths
from vinemap.cli.terminal import plain_errors, progress
from vinemap.cloud.pdal import check_engine
from vinemap.config.surveys import SurveyConfig, choose_parcel, load_survey
from vinemap.errors import ConfigError, InputError
from vinemap.geo.crs import parse_crs
from vinemap.jobs.register import known_of
from vinemap.parcel import follow
from vinemap.product.recipe import recipe_of
from vinemap.simulate.scenes import barolo
from vinemap.simulate.survey import write_survey

if TYPE_CHECKING:
    from collections.abc import Callable

    from vinemap.product.record import Summary


def as_tasks(show: Callable[..., Any]) -> Callable[..., Any]:
    """Give a ``step`` that runs each stage as a Prefect task; arrays are neither cached nor stored."""

    def step(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        # Without parameters, as Prefect would walk through every array that it is given.
        stage = task(name=name, cache_policy=NO_CACHE, persist_result=False)(lambda: function(*args, **kwargs))
        return show(name, stage)

    return step


@flow(name="parcel", flow_run_name="{survey}-{parcel}", persist_result=False, validate_parameters=False)
def parcel_flow(survey: str, parcel: str, config: SurveyConfig) -> Summary:
    """Map one parcel of a survey."""
    recipe = recipe_of(
        config.cloud or paths.survey_cloud(survey),
        parcel=parcel,
        boundary=config.boundaries or paths.survey_boundaries(survey),
        crs=parse_crs(config.crs) if config.crs else None,
        survey=survey,
        rows=config.rows,
        rows_crs=parse_crs(config.rows_crs) if config.rows_crs else None,
        vines=config.vines,
        **dict(config.of_parcel(parcel)),
    )
    known = None if config.rows else known_of(config, recipe.flown, {parcel: recipe.boundary})
    if known:
        recipe = recipe._replace(known=known.rows.get(parcel))
    products = paths.survey_products(survey)
    with progress(parcel) as show:
        return follow(recipe, paths.parcel_folder(products, parcel), within=products, step=as_tasks(show))


def ensure_cloud(config: SurveyConfig) -> None:
    """Simulate the survey if it is an example that has not been made yet.

    Raises
    ------
    InputError
        If the cloud of a real survey is missing.
    """
    cloud = paths.survey_cloud(config.survey)
    if config.cloud or cloud.is_file():
        return
    if config.simulate is None:
        raise InputError(f"{cloud}: no such file: put the cloud of survey {config.survey} there, or name it as 'cloud'")
    click.echo(f"Simulating the survey {config.survey} in {cloud.parent} (once)…", err=True)
    write_survey(barolo(), cloud.parent)


def main() -> None:
    """Map the parcel named on the command line."""
    with plain_errors():
        if len(sys.argv) != 3:
            raise ConfigError(
                "give a survey's configuration and a parcel: python -m flows.parcel configs/barolo.yaml F"
            )
        config = load_survey(Path(sys.argv[1]))
        parcel = choose_parcel(config, sys.argv[2])
        check_engine(config.settings.ground.engine)
        ensure_cloud(config)
        click.echo(parcel_flow(config.survey, parcel, config).line())


if __name__ == "__main__":
    main()
