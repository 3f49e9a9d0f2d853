"""Every survey that needs work, mapped each night: once now, or on a schedule.

``python -m flows.nightly configs/nightly.yaml --serve``
"""

from __future__ import annotations

import sys

import click
from prefect import State, flow, get_run_logger
from prefect.states import Completed

from flows.serving import serve
from vinemap.cli import plain_errors


@flow(name="nightly", persist_result=False)
def nightly(config: str = "configs/nightly.yaml") -> State[None]:
    """Map the surveys that need it."""
    get_run_logger().info("Nothing to do for %s", config)
    return Completed(message="0 surveys mapped")


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("config", default="configs/nightly.yaml")
@click.option("--serve", "served", is_flag=True, help="Stay, and run it on a schedule.")
@click.option("--cron", default="0 2 * * *", show_default=True, help="When it runs.")
@click.option("--timezone", default="Europe/Rome", show_default=True, help="Time zone of that.")
@click.option("--every", type=click.FloatRange(1), help="Seconds from run to run, instead of --cron.")
def command(config: str, served: bool, cron: str, timezone: str, every: float | None) -> None:
    """Map the surveys in CONFIG that need it; exit code 1 if one of them fails."""
    if served:
        serve("flows.nightly.nightly", parameters={"config": config}, cron=cron, timezone=timezone, every=every)
        return
    state = nightly(config, return_state=True)
    click.echo(state.message, err=not state.is_completed())
    if not state.is_completed():
        sys.exit(1)


def main() -> None:
    """Run the command line."""
    with plain_errors():
        command.main(prog_name="python -m flows.nightly", standalone_mode=False)


if __name__ == "__main__":
    main()
