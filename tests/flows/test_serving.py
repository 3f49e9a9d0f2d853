"""The schedule: a real Prefect server on loopback, runs that are started by it, and what stopping leaves."""

import os
import re
import shutil
import signal
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from commands import gone
from place import Place, wait

from vinemap.compute.processes import descendants

JOB = """
import time
from pathlib import Path
from prefect import flow, get_run_logger
from prefect.states import Completed, Failed

@flow(name="job")
def job(seconds: float = 0):
    get_run_logger().info("at work in %s", Path.cwd())
    time.sleep(seconds)
    with Path("runs").open("a") as file:
        file.write("x")
    if Path("runs").stat().st_size == 2:
        return Failed(message="1 survey failed")
    return Completed(message="done")
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    (folder / "job.py").write_text(JOB)
    yield Place(folder)
    shutil.rmtree(folder, ignore_errors=True)


def listening(processes):
    """Addresses at which processes listen, as the kernel writes them."""
    found = set()
    for process in processes:
        try:
            files = [str(file.readlink()) for file in Path(f"/proc/{process}/fd").iterdir()]
        except OSError:
            continue
        lines = [
            line.split() for table in ("tcp", "tcp6") for line in Path(f"/proc/net/{table}").read_text().splitlines()
        ]
        found |= {line[1].split(":")[0] for line in lines if line[3] == "0A" and f"socket:[{line[9]}]" in files}
    return found


def states(place, seconds):
    """Of the runs with a parameter."""
    return {run["state_type"] for run in place.runs() if run["parameters"]["seconds"] == seconds}


@pytest.fixture(scope="module")
def seen(place):
    """A schedule whose machine dies while a run is at work, and in its place another with other parameters.

    What the server told of the second, what that said, and which run was left.
    """
    with place.serving(every=3, parameters={"seconds": 600}) as (process, _):
        left = wait(lambda: place.runs("RUNNING"))[0]["id"]
        orphans = descendants(process.pid)
        process.kill()
        process.wait()
        for one in orphans[1:]:
            if not gone(one):
                os.kill(one, signal.SIGKILL)
        wait(lambda: all(map(gone, orphans)))
    with place.serving(every=2, parameters={"seconds": 2}) as (process, said):
        (crashed,) = place.ask("/flow_runs/filter", {"flow_runs": {"id": {"any_": [left]}}})
        wait(lambda: states(place, 2) >= {"COMPLETED", "FAILED", "CANCELLED"})
        listens = listening([process.pid, *descendants(process.pid)])
        earlier, runs = states(place, 600), [run for run in place.runs() if run["parameters"]["seconds"] == 2]
        logs = {(log["level"], log["message"]) for log in place.ask("/logs/filter", {})}
        deployments = place.ask("/deployments/filter", {})
        lines = wait(lambda: "Failed" in said.read_text() and said.read_text())
    ended = said.read_text()
    return SimpleNamespace(
        crashed=crashed,
        earlier=earlier,
        listens=listens,
        runs=runs,
        logs=logs,
        deployments=deployments,
        lines=lines,
        ended=ended,
    )


def test_a_run_that_died_with_its_machine_stands_in_nobodys_way(seen):
    assert seen.crashed["state_type"] == "CRASHED"
    assert seen.crashed["parameters"]["seconds"] == 600
    (deployment,) = seen.deployments
    assert [one["schedule"]["interval"] for one in deployment["schedules"]] == [2]
    assert seen.earlier <= {"CRASHED", "CANCELLED"}


def test_runs_fire_on_their_own_and_never_two_at_once(place, seen):
    assert (20, f"at work in {place.folder}") in seen.logs
    assert {run["state"]["message"] for run in seen.runs if run["state_type"] == "FAILED"} == {"1 survey failed"}
    worked = sorted(
        (run["start_time"], run["end_time"]) for run in seen.runs if run["state_type"] in {"COMPLETED", "FAILED"}
    )
    assert len(worked) > 1
    assert all(one[1] <= other[0] for one, other in pairwise(worked))


def test_a_schedule_says_where_it_is_seen_and_how_runs_ended(place, seen):
    assert seen.listens == {"0100007F"}
    assert seen.lines.startswith(f"Runs and their logs: http://127.0.0.1:{place.port}\nNext run: ")
    assert re.search(r"^20\d\d-\d\d-\d\d \d\d:\d\d CES?T: Failed in \d+ s: 1 survey failed$", seen.lines, re.MULTILINE)
    assert seen.ended.endswith("\nStopped\n")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"cron": "0 2 * *"}, 'no schedule: Invalid cron string: "0 2 * *"'),
        ({"timezone": "Europe/Roma"}, 'no schedule: Invalid timezone: "Europe/Roma"'),
    ],
)
def test_no_schedule(place, options, said):
    line = place.fails(**options)
    assert said in line
    assert line.count("\n") == 1


def test_port_of_another(place):
    with ThreadingHTTPServer(("127.0.0.1", place.port), BaseHTTPRequestHandler) as other:
        threading.Thread(target=other.serve_forever).start()
        try:
            line = place.fails()
        finally:
            other.shutdown()
    assert f"port {place.port} is in use" in line
    assert line.count("\n") == 1


def test_folder_that_cant_be_written(tmp_path):
    (tmp_path / "data").write_text("")
    (tmp_path / "job.py").write_text(JOB)
    line = Place(tmp_path).fails()
    assert "data/.prefect: can't be written" in line
    assert line.count("\n") == 1
