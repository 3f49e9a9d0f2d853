"""All parcels of a survey as a Prefect flow: every parcel is a task run, worked by a process of its own.

``python -m flows.survey configs/barolo.yaml``
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click
from prefect import flow, get_run_logger, task
from prefect.artifacts import create_table_artifact
from prefect.cache_policies import NO_CACHE
from prefect.states import Completed, Failed

from vinemap.errors import VinemapError
from vinemap.example import ensure_cloud
from vinemap.jobs.configured import chosen
from vinemap.jobs.outcomes import COLUMNS, FAILED, Outcome, in_table
from vinemap.jobs.survey import map_survey
from vinemap.terminal import plain_errors, tell

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from prefect import State
    from prefect.client.schemas.objects import TaskRun

    from vinemap.config.surveys import SurveyConfig

RETRIES = (20, 60, 180)
"""Seconds after which what may heal is tried again."""


def as_task(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Run the work on a parcel as a Prefect task, again after a while where that may help."""
    results = []

    # It gives nothing, as Prefect would keep it.
    @task(
        name="parcel",
        task_run_name=name.replace("{", "(").replace("}", ")"),
        retries=len(RETRIES),
        retry_delay_seconds=list(RETRIES),
        retry_condition_fn=_may_heal,
        cache_policy=NO_CACHE,
        persist_result=False,
    )
    def parcel() -> None:
        results.append(function(*args, **kwargs))

    parcel()
    return results[-1]


def _may_heal(task: Any, run: TaskRun, state: State[Any]) -> bool:
    del task, run
    error = state.result(raise_on_failure=False)
    return isinstance(error, VinemapError) and error.heals


@flow(name="survey", flow_run_name="{config.survey}", persist_result=False, validate_parameters=False)
def survey_flow(config: SurveyConfig, folder: Path, *, again: bool = False) -> State[list[Outcome]]:
    """Map the parcels of a survey that need it; failed if one of them fails."""
    log = get_run_logger()
    outcomes = []
    for outcome in map_survey(config, folder, again=again, step=as_task):
        outcomes.append(outcome)
        (log.error if outcome.state == FAILED else log.info)(outcome.line())
        if sys.stderr.isatty():
            click.echo(outcome.line(), err=True)
    outcomes.sort(key=lambda outcome: outcome.parcel)
    create_table_artifact([dict(zip(COLUMNS, row, strict=True)) for row in in_table(outcomes)], key="survey")
    failed = [outcome.parcel for outcome in outcomes if outcome.state == FAILED]
    message = f"{len(outcomes)} parcels"
    if failed:
        return Failed(message=f"{len(failed)} of {message} failed: {', '.join(failed)[:200]}", data=outcomes)
    return Completed(message=message, data=outcomes)


def outcomes_of(config: SurveyConfig, folder: Path, *, again: bool = False) -> list[Outcome]:
    """Run the flow and tell what became of each parcel.

    Raises
    ------
    VinemapError
        If no parcel could be worked at all.
    """
    state = survey_flow(config, folder, again=again, return_state=True)
    outcomes: Any = state.result(raise_on_failure=False)
    if isinstance(outcomes, Exception):
        raise outcomes
    return list(outcomes)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("survey")
@click.option("--again", is_flag=True, help="Map parcels that are up to date, too.")
def command(survey: str, again: bool) -> None:
    """Map the parcels of SURVEY that need it: a configuration, or what has arrived under that name.

    The exit code is 1 if one of them fails.
    """
    config, folder = chosen(survey)
    ensure_cloud(config)
    tell(outcomes_of(config, folder, again=again))


def main() -> None:
    """Run the command line."""
    with plain_errors():
        command.main(prog_name="python -m flows.survey", standalone_mode=False)


if __name__ == "__main__":
    main()
