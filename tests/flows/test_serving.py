"""The schedule: a real Prefect server on loopback, runs that are started by it, and what stopping leaves."""

import os
import re
import shutil
import signal
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from place import ROOT, Place, gone, wait

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
NIGHTLY = """
from pathlib import Path
from prefect import flow, get_run_logger
from prefect.states import Completed

@flow(name="nightly")
def nightly(config: str):
    get_run_logger().info("mapped")
    return Completed(message=f"{config} in {Path.cwd()}")
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


def test_runs_fire_on_their_own_and_never_two_at_once(place):
    with place.serving(every=2, parameters={"seconds": 2}) as (process, said):
        wait(lambda: all(map(place.runs, ("COMPLETED", "FAILED", "CANCELLED"))))
        assert listening([process.pid, *descendants(process.pid)]) == {"0100007F"}
        runs = place.runs()
        logs = {(log["level"], log["message"]) for log in place.ask("/logs/filter", {})}
        lines = wait(lambda: "Failed" in said.read_text() and said.read_text())
    assert (20, f"at work in {place.folder}") in logs
    assert {run["state"]["message"] for run in runs if run["state_type"] == "FAILED"} == {"1 survey failed"}
    assert {run["parameters"]["seconds"] for run in runs} == {2}
    worked = sorted(
        (run["start_time"], run["end_time"]) for run in runs if run["state_type"] in {"COMPLETED", "FAILED"}
    )
    assert len(worked) > 1
    assert all(one[1] <= other[0] for one, other in pairwise(worked))
    assert lines.startswith(f"Runs and their logs: http://127.0.0.1:{place.port}\nNext run: ")
    assert re.search(r"^20\d\d-\d\d-\d\d \d\d:\d\d CES?T: Failed in \d+ s: 1 survey failed$", lines, re.MULTILINE)
    assert said.read_text().endswith("\nStopped\n")


def test_a_run_that_died_with_its_machine_stands_in_nobodys_way(place):
    """After the first schedule: the same server's folder, another schedule and other parameters."""
    with place.serving(every=3, parameters={"seconds": 600}) as (process, _):
        earlier = {run["id"] for run in place.runs("COMPLETED")}
        running = wait(lambda: place.runs("RUNNING"))[0]["id"]
        orphans = descendants(process.pid)
        process.kill()
        process.wait()
        for one in orphans[1:]:
            if not gone(one):
                os.kill(one, signal.SIGKILL)
        wait(lambda: all(map(gone, orphans)))
    with place.serving(every=3):
        assert place.ask("/flow_runs/filter", {"flow_runs": {"id": {"any_": [running]}}})[0]["state_type"] == "CRASHED"
        wait(lambda: {run["id"] for run in place.runs("COMPLETED")} > earlier)
        (deployment,) = place.ask("/deployments/filter", {})
        assert [one["schedule"]["interval"] for one in deployment["schedules"]] == [3]


def test_prefect_yaml_deploys_and_a_worker_runs_it(place, tmp_path):
    shutil.copy(ROOT / "prefect.yaml", tmp_path)
    shutil.copytree(ROOT / "flows", tmp_path / "flows")
    with place.serving(every=3600):
        pool = place.prefect("work-pool", "create", "vinemap", "--type", "process", cwd=tmp_path)
        assert pool.returncode == 0, pool.stderr
        deployed = place.prefect("deploy", "--all", "--no-prompt", cwd=tmp_path)
        assert deployed.returncode == 0, deployed.stdout + deployed.stderr
        (deployment,) = place.ask("/deployments/filter", {"deployments": {"name": {"any_": ["nightly"]}}})
        assert deployment["schedules"][0]["schedule"] == {
            "cron": "0 2 * * *",
            "timezone": "Europe/Rome",
            "day_or": True,
        }
        assert deployment["global_concurrency_limit"]["limit"] == 1
        assert deployment["concurrency_options"]["collision_strategy"] == "CANCEL_NEW"
        (tmp_path / "flows" / "nightly.py").write_text(NIGHTLY)
        run = place.ask(f"/deployments/{deployment['id']}/create_flow_run", {"state": {"type": "SCHEDULED"}})["id"]
        worked = place.prefect("worker", "start", "--pool", "vinemap", "--run-once", cwd=tmp_path.parent)
        assert worked.returncode == 0, worked.stdout + worked.stderr
        (run,) = place.ask("/flow_runs/filter", {"flow_runs": {"id": {"any_": [run]}}})
        assert run["state"]["message"] == f"configs/nightly.yaml in {tmp_path}"


def test_prefect_yaml_names_no_machine():
    text = (ROOT / "prefect.yaml").read_text(encoding="utf-8")
    assert "http" not in text
    assert "/home" not in text
    (deployment,) = yaml.safe_load(text)["deployments"]
    assert (ROOT / deployment["entrypoint"].split(":")[0]).is_file()


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
