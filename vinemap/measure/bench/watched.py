"""Processes watched: how long they take, and what memory they and theirs hold."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vinemap.compute.processes import descendants, last_line
from vinemap.errors import VinemapError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence


class Outcome(NamedTuple):
    """What came of a process."""

    code: int
    seconds: float
    peak: int
    """Most resident memory in bytes; 0 where the system doesn't tell."""
    said: str
    """The last line of its stderr."""


def run_process(command: Sequence[str], *, limit: float | None = None, env: Mapping[str, str] | None = None) -> Outcome:
    """Run a command, kill it after ``limit`` seconds, and measure it; ``env`` is its environment, by default ours."""
    with tempfile.TemporaryFile() as stderr:
        began = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr, env=env)  # noqa: S603 - our own
        timer = threading.Timer(limit or threading.TIMEOUT_MAX, process.kill)
        timer.daemon = True
        timer.start()
        try:
            peak = _wait(process)
        except BaseException:
            process.kill()
            raise
        finally:
            timer.cancel()
        seconds = time.perf_counter() - began
        said = last_line(stderr)
    if limit and seconds >= limit:
        said = f"stopped after {limit:g} s"
    return Outcome(process.returncode, seconds, peak, said)


def _wait(process: subprocess.Popen[bytes]) -> int:
    """Wait until a process has ended; gives the most memory (bytes) that it held."""
    if hasattr(os, "wait4"):
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        return usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    process.wait()  # on Windows
    return 0


def must(command: Sequence[str], *, env: Mapping[str, str] | None = None) -> Outcome:
    """Run a command that has to go well, in an environment, by default ours.

    Raises
    ------
    VinemapError
        If it doesn't.
    """
    outcome = run_process(command, env=env)
    if outcome.code:
        raise VinemapError(f"{' '.join(command[1:4])} ended with code {outcome.code}: {outcome.said}")
    return outcome


@contextmanager
def summed_memory() -> Iterator[list[int]]:
    """Give what all processes begun meanwhile hold together (bytes), at the most; 0 where the system doesn't tell.

    What several share, as they do libraries, counts once.
    """
    most, done, earlier = [0], threading.Event(), set(descendants(os.getpid()))

    def watch() -> None:
        while not done.wait(0.2):
            most[0] = max(most[0], sum(map(resident, set(descendants(os.getpid())) - earlier)))

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield most
    finally:
        done.set()
        watcher.join()


def resident(process: int) -> int:
    """Memory (bytes) that a process holds, with its part of what it shares with others; 0 if it has gone."""
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    except OSError:  # on Windows there is none
        return 0
    return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def high_water() -> int | None:
    """Most memory (bytes) that this process has held since the last call; None where the system doesn't tell."""
    own = Path("/proc/self")
    try:
        lines = (own / "status").read_text().splitlines()
        kilobytes = next(line.split()[1] for line in lines if line.startswith("VmHWM"))
        (own / "clear_refs").write_text("5")
    except (OSError, StopIteration):
        return None
    return int(kilobytes) * 1024
