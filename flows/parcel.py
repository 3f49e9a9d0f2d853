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

from vinemap.errors import ConfigError
from vinemap.example import ready
from vinemap.jobs.configured import map_one
from vinemap.terminal import plain_errors, progress

if TYPE_CHECKING:
    from collections.abc import Callable

    from vinemap.config.surveys import SurveyConfig
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
    del survey  # which names the run
    with progress(parcel) as show:
        return map_one(config, parcel, step=as_tasks(show))


def main() -> None:
    """Map the parcel named on the command line."""
    with plain_errors():
        if len(sys.argv) != 3:
            raise ConfigError(
                "give a survey's configuration and a parcel: python -m flows.parcel configs/barolo.yaml F"
            )
        config, parcel = ready(Path(sys.argv[1]), sys.argv[2])
        click.echo(parcel_flow(config.survey, parcel, config).line())


if __name__ == "__main__":
    main()
