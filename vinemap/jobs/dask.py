"""Parcels on the workers of a Dask cluster, which share the disk of clouds and products."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Self

from vinemap.compute import machine
from vinemap.compute.extras import load
from vinemap.errors import ConfigError, WorkerError
from vinemap.jobs.workers import Worker

if TYPE_CHECKING:
    from collections.abc import Callable

PATIENCE = 30.0
"""Seconds for which a scheduler and its first worker are waited for."""
MOST_SLOTS = 256
"""Parcels that are handed to a cluster at once, at the most."""
_here = threading.local()


class DaskWorkers:
    """Workers of a Dask cluster: each hands what it is given to a process of its own, as a job on one machine does.

    A call that hangs or crashes costs that process, not the cluster's worker. One whose worker dies goes to another,
    as the cluster's ``distributed.scheduler.allowed-failures`` says how often.

    Parameters
    ----------
    scheduler : str
        Address of the scheduler.
    memory : float, optional
        Memory that a call may take (GB).

    Raises
    ------
    DependencyError
        If Dask isn't installed.
    ConfigError
        If no scheduler or no worker answers there.
    """

    def __init__(self, scheduler: str, *, memory: float | None = None) -> None:
        distributed = load("distributed")
        try:
            self._client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ConfigError(f"no Dask scheduler answers at {scheduler}: is that its address?") from error
        try:
            self._client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError as error:
            self._client.close()
            raise ConfigError(f"the Dask scheduler at {scheduler} has no workers: start some there") from error
        self._memory = int(memory * 1e9) if memory else None
        self.slots = min(MOST_SLOTS, sum(self._client.nthreads().values()))

    def run(self, function: Callable[..., Any], *args: Any, limit: float | None = None, **kwargs: Any) -> Any:
        """Run a function on the cluster as :meth:`vinemap.jobs.workers.Worker.run` does here."""
        from distributed import CancelledError, KilledWorker

        job = self._client.submit(_run, function, args, kwargs, limit, self._memory, pure=False)
        try:
            return job.result()
        except KilledWorker as error:
            raise WorkerError("every Dask worker that took it died") from error
        except (CancelledError, OSError) as error:
            raise WorkerError(f"the Dask scheduler is gone ({error})") from error
        finally:
            job.release()

    def stop(self) -> None:
        """Let go of the cluster; what still waits there is cancelled."""
        self._client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()


def _run(
    function: Callable[..., Any],
    args: tuple[Any, ...],
    kwargs: dict[str, Any],
    limit: float | None,
    memory: int | None,
) -> Any:
    """Run a function in a process of this thread's own, on a worker of the cluster."""
    from distributed import get_worker

    if not hasattr(_here, "worker"):
        n = get_worker().state.nthreads
        _here.worker = Worker(cores=max(1, machine.cores() // n), memory=memory or machine.share(n))
    return _here.worker.run(function, *args, limit=limit, **kwargs)
