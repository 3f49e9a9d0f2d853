"""A flow on a schedule, on one machine: its runs are started when they are due, one at a time."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import time
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any
from zoneinfo import ZoneInfo

import click
from prefect import get_client
from prefect.client.schemas.filters import (
    DeploymentFilter,
    DeploymentFilterId,
    FlowRunFilter,
    FlowRunFilterState,
    FlowRunFilterStateType,
)
from prefect.client.schemas.objects import ConcurrencyLimitConfig, ConcurrencyLimitStrategy, StateType
from prefect.client.schemas.sorting import FlowRunSort
from prefect.flows import load_flow_from_entrypoint
from prefect.runner import Runner
from prefect.schedules import Cron, Interval
from prefect.settings import PREFECT_API_URL, PREFECT_HOME, PREFECT_LOGGING_LEVEL, temporary_settings
from prefect.states import Crashed
from prefect.types.entrypoint import EntrypointType
from pydantic import ValidationError

from vinemap.compute.processes import STOPPING, descendants
from vinemap.errors import ConfigError, VinemapError

from .server import LOOPBACK, home, server

if TYPE_CHECKING:
    from subprocess import Popen
    from uuid import UUID

    from prefect.client.orchestration import PrefectClient
    from prefect.client.schemas.objects import FlowRun
    from prefect.deployments.runner import RunnerDeployment

ONE_AT_A_TIME = ConcurrencyLimitConfig(limit=1, collision_strategy=ConcurrencyLimitStrategy.CANCEL_NEW)
DUE = [StateType.SCHEDULED]
BEGUN = [StateType.PENDING, StateType.RUNNING, StateType.CANCELLING]
ENDED = [StateType.COMPLETED, StateType.FAILED, StateType.CRASHED, StateType.CANCELLED]


def serve(
    entrypoint: str,
    *,
    parameters: dict[str, Any],
    cron: str,
    timezone: str,
    every: float | None = None,
) -> None:
    """Run a flow on a schedule until a signal comes, on a server of our own unless ``PREFECT_API_URL`` has one.

    Parameters
    ----------
    entrypoint : str
        The flow, as ``package.module.name``.
    parameters : dict
        What each run is given.
    cron, timezone : str
        When runs begin, and in which IANA time zone.
    every : float, optional
        Seconds from run to run, in place of ``cron``.

    Raises
    ------
    VinemapError
        If the schedule is none, the server can't be had, or it ends.
    """
    deployment = _deployment(entrypoint, parameters, cron=cron, timezone=timezone, every=every)
    api = (os.environ.get("PREFECT_API_URL") or f"http://{LOOPBACK}:4200/api").rstrip("/")
    # What runs log goes to the server, and none of it to the terminal; nor do Prefect's own slips when it is stopped.
    os.environ["PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL"] = "CRITICAL"
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    with home() as folder, server(api, folder) as process:
        click.echo(f"Runs and their logs: {api.removesuffix('/api')}")
        with temporary_settings({PREFECT_API_URL: api, PREFECT_HOME: folder, PREFECT_LOGGING_LEVEL: "INFO"}):
            asyncio.run(_serve(deployment, process, ZoneInfo(timezone)))
    click.echo("Stopped")


def _deployment(
    entrypoint: str, parameters: dict[str, Any], *, cron: str, timezone: str, every: float | None
) -> RunnerDeployment:
    flow: Any = load_flow_from_entrypoint(entrypoint)
    try:
        deployment: RunnerDeployment = flow.to_deployment(
            flow.name,
            schedule=Interval(every, timezone=timezone) if every else Cron(cron, timezone=timezone),
            parameters=parameters,
            concurrency_limit=ONE_AT_A_TIME,
            entrypoint_type=EntrypointType.MODULE_PATH,
        )
    except ValueError as error:
        reasons = [one["msg"] for one in error.errors()] if isinstance(error, ValidationError) else [str(error)]
        raise ConfigError(f"no schedule: {'; '.join(reasons).replace('Value error, ', '')}") from error
    return deployment


async def _serve(deployment: RunnerDeployment, process: Popen[bytes] | None, zone: ZoneInfo) -> None:
    stopped = asyncio.Event()
    # A run that is fetched before its time holds the only place until then.
    runner = Runner(pause_on_shutdown=False, prefetch_seconds=0)
    async with get_client() as client:
        runs = _Runs(client, await runner.aadd_deployment(deployment), zone)
        await runs.catch_up()
        tasks = [asyncio.create_task(one) for one in (stopped.wait(), runs.tell(process), runner.start())]
        # The runner begins with a handler of SIGTERM, which ends the process before its runs have.
        await asyncio.sleep(0)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, *STOPPING):
            try:
                loop.add_signal_handler(number, stopped.set)
            except NotImplementedError:  # on Windows
                signal.signal(number, lambda *_: loop.call_soon_threadsafe(stopped.set))
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        asked = stopped.is_set()
        with suppress(Exception):
            if asked:
                await runner.astop()
                await runs.tell_ended()
        await _end_runs(process)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    if not asked:
        raise VinemapError("the Prefect server has ended, or answers no more")


async def _end_runs(process: Popen[bytes] | None, *, patience: float = 10) -> None:
    """End the runs that are left: without a server, the runner would wait for them."""
    deadline = time.monotonic() + patience
    number = signal.SIGTERM
    while ours := set(descendants(os.getpid())) - {process.pid if process else 0}:
        for one in ours:
            with suppress(ProcessLookupError):
                os.kill(one, number)
        await asyncio.sleep(0.5)
        if time.monotonic() > deadline:
            number = getattr(signal, "SIGKILL", number)


class _Runs:
    """Runs of a deployment."""

    def __init__(self, client: PrefectClient, deployment: UUID, zone: ZoneInfo) -> None:
        self.client = client
        self.deployment = deployment
        self.zone = zone
        self.told: set[UUID] = set()

    async def catch_up(self) -> None:
        """Clear away what a stop of this machine left, and begin one run in place of those that it missed.

        A run that was at work would keep all others from beginning, for ever; missed ones have yesterday's parameters.
        """
        for run in await self._read(BEGUN):
            await self.client.set_flow_run_state(run.id, Crashed(message="The machine or the schedule was stopped."))
        now = datetime.now(UTC)
        missed = [run for run in await self._read(DUE) if run.expected_start_time and run.expected_start_time < now]
        for run in missed:
            await self.client.delete_flow_run(run.id)
        if missed:
            await self.client.create_flow_run_from_deployment(self.deployment)

    async def tell(self, process: Popen[bytes] | None, *, patience: float = 15) -> None:
        """Say how runs ended and when the next is due, until the server has ended or is silent for too long."""
        self.told = {run.id for run in await self._read(ENDED)}
        due = None
        heard = time.monotonic()
        while time.monotonic() < heard + patience and (process is None or process.poll() is None):
            with suppress(Exception):
                async with asyncio.timeout(patience / 3):
                    await self.tell_ended()
                    coming = await self._read(DUE, sort=FlowRunSort.EXPECTED_START_TIME_ASC, limit=1)
                if coming and coming[0].expected_start_time != due:
                    due = coming[0].expected_start_time
                    click.echo(f"Next run: {self._when(due)}")
                heard = time.monotonic()
            await asyncio.sleep(1)

    async def tell_ended(self) -> None:
        """Say how runs ended since it was last said."""
        for run in reversed(await self._read(ENDED, limit=50)):
            if run.id not in self.told and run.state:
                self.told.add(run.id)
                seconds = run.total_run_time.total_seconds()
                message = f": {run.state.message}" if run.state.message else ""
                click.echo(f"{self._when(run.expected_start_time)}: {run.state.name} in {seconds:.0f} s{message}")

    async def _read(
        self, states: list[StateType], *, sort: FlowRunSort = FlowRunSort.END_TIME_DESC, limit: int | None = None
    ) -> list[FlowRun]:
        return await self.client.read_flow_runs(
            deployment_filter=DeploymentFilter(id=DeploymentFilterId(any_=[self.deployment])),
            flow_run_filter=FlowRunFilter(state=FlowRunFilterState(type=FlowRunFilterStateType(any_=states))),
            sort=sort,
            limit=limit,
        )

    def _when(self, moment: datetime | None) -> str:
        return f"{moment.astimezone(self.zone):%Y-%m-%d %H:%M %Z}" if moment else "at once"
