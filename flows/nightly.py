"""Every survey that needs work, mapped each night: once now, or on a schedule.

``python -m flows.nightly configs/nightly.yaml``
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, NamedTuple

import click
from prefect import State, flow, get_run_logger
from prefect.artifacts import create_table_artifact
from prefect.states import Completed, Failed

from vinemap import paths
from vinemap.config.surveys import load_estate, load_survey
from vinemap.errors import BusyError, VinemapError, own_fault
from vinemap.jobs.estate import Arrival, arrivals
from vinemap.jobs.outcomes import COLUMNS, FAILED, Outcome, in_table
from vinemap.jobs.plan import plan_survey
from vinemap.jobs.survey import map_survey
from vinemap.terminal import plain_errors, show

from .serving import serve
from .survey import outcomes_of

PASSED = "passed over"
"""State of a file that can't be used."""


class Night(NamedTuple):
    """What became of a survey, or why nothing did."""

    survey: str
    outcomes: list[Outcome]
    reason: str = ""
    failed: bool = False
    passed: tuple[str, ...] = ()
    """What lies beside it and can't be used."""

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of a table: one a parcel, or one for all that ended alike without being worked, and what was passed."""
        passed = [(self.survey, "", "", "", PASSED, remark) for remark in self.passed]
        if self.reason:
            return [(self.survey, "", "", "", FAILED if self.failed else "waits", self.reason), *passed]
        return [*((self.survey, *row) for row in in_table(self.outcomes)), *passed]


@flow(name="nightly", persist_result=False)
def nightly(config: str = str(paths.ESTATE)) -> State[list[Night]]:
    """Map the parcels of all surveys that need it; failed if one of them fails.

    Parameters
    ----------
    config : str
        File of the estate's configuration.
    """
    log = get_run_logger()
    estate = load_estate(Path(config))
    nights = []
    for arrival in arrivals(estate):
        night = _survey(arrival, estate.products / arrival.name)._replace(passed=arrival.passed)
        nights.append(night)
        if night.reason:
            (log.error if night.failed else log.info)("%s: %s", night.survey, night.reason)
        for remark in night.passed:
            log.warning("%s: %s", night.survey, remark)
    table = [dict(zip(("survey", *COLUMNS), row, strict=True)) for night in nights for row in night.rows()]
    create_table_artifact(table, key="nightly")
    failed = [night.survey for night in nights if night.failed]
    if failed:
        message = f"{len(failed)} of {len(nights)} surveys failed, or parcels of theirs: {', '.join(failed)[:200]}"
        return Failed(message=message, data=nights)
    return Completed(message=f"{len(nights)} surveys", data=nights)


def _survey(arrival: Arrival, folder: Path) -> Night:
    """Map a survey's parcels if any needs it."""
    if not arrival.config:
        return Night(arrival.name, [], arrival.reason, failed=not arrival.waits)
    try:
        own = paths.configuration(arrival.name)
        config = load_survey(own) if own.is_file() and own != paths.ESTATE else arrival.config
        # What is to be mapped has a flow of its own; where nothing is, pages and records are still made good.
        needed = bool(plan_survey(config, folder).recipes)
        outcomes = outcomes_of(config, folder) if needed else list(map_survey(config, folder))
    except BusyError as error:
        return Night(arrival.name, [], str(error))
    except VinemapError as error:
        return Night(arrival.name, [], str(error), failed=True)
    except Exception as error:  # noqa: BLE001 - a fault of our own costs no other survey
        return Night(arrival.name, [], " ".join(own_fault(error).split()), failed=True)
    return Night(arrival.name, outcomes, failed=any(outcome.state == FAILED for outcome in outcomes))


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("config", default=str(paths.ESTATE))
@click.option("--serve", "served", is_flag=True, help="Stay, and do it when CONFIG says.")
@click.option("--every", type=click.FloatRange(1), help="Seconds from run to run, instead of CONFIG's cron.")
def command(config: str, served: bool, every: float | None) -> None:
    """Map the parcels of all surveys that need it; exit code 1 if one of them fails."""
    work(config, served=served, every=every)


def work(config: str, *, served: bool, every: float | None = None) -> None:
    """Map what needs it: now, which ends with exit code 1 if a survey fails, or staying, when the estate's file says.

    Parameters
    ----------
    config : str
        File of the estate's configuration.
    served : bool
        Whether to stay.
    every : float, optional
        Seconds from run to run, instead of the file's cron.
    """
    estate = load_estate(Path(config))
    if served:
        given = {"config": config}
        serve(
            f"{__package__}.nightly.nightly", parameters=given, cron=estate.cron, timezone=estate.timezone, every=every
        )
        return
    state = nightly(config, return_state=True)
    nights: Any = state.result(raise_on_failure=False)
    if isinstance(nights, Exception):
        raise nights
    show(("survey", *COLUMNS), [row for night in nights for row in night.rows()])
    if not state.is_completed():
        click.echo(f"vinemap: {state.message}", err=True)
        sys.exit(1)


def main() -> None:
    """Run the command line."""
    with plain_errors():
        command.main(prog_name="python -m flows.nightly", standalone_mode=False)


if __name__ == "__main__":
    main()
