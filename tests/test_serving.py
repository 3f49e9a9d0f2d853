"""The schedule: a real Prefect server on loopback, runs that are started by it, and what stopping leaves."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from urllib.request import Request, urlopen

import pytest
import yaml

from vinemap.processes import descendants

ROOT = Path(__file__).parents[1]
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
SERVE = """
import json, sys
from flows.serving import serve
from vinemap.cli import plain_errors
with plain_errors():
    serve("job.job", **json.loads(sys.argv[1]))
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


def wait(condition, *, patience=120):
    """Return what a condition gives as soon as that is true."""
    deadline = time.monotonic() + patience
    while not (found := condition()):
        assert time.monotonic() < deadline, "it never came true"
        time.sleep(0.1)
    return found


def gone(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


class Place:
    """A folder with a flow, from which schedules are run on a port of their own."""

    def __init__(self, folder):
        self.folder = folder
        (folder / "job.py").write_text(JOB)
        with socket.create_server(("127.0.0.1", 0)) as one:
            self.port = one.getsockname()[1]
        self.api = f"http://127.0.0.1:{self.port}/api"
        kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_")}
        self.environment = kept | {
            "PYTHONPATH": f"{ROOT}:{folder}",
            "PREFECT_API_URL": self.api,
            "PREFECT_RUNNER_POLL_FREQUENCY": "1",
            "PREFECT_SERVER_SERVICES_SCHEDULER_RECENT_DEPLOYMENTS_LOOP_SECONDS": "1",
            "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
            "DO_NOT_TRACK": "1",
        }

    def start(self, said, **options):
        options = {"parameters": {}} | options
        command = [sys.executable, "-c", SERVE, json.dumps(options)]
        return subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=said, stderr=subprocess.STDOUT)

    def fails(self, **options):
        with (self.folder / "failed.txt").open("w+b") as said:
            process = self.start(said, **options)
            assert process.wait(60) == 2
            said.seek(0)
            return said.read().decode()

    @contextmanager
    def serving(self, **options):
        """Give a process that serves, and what it says; nothing of it is left."""
        path = self.folder / "said.txt"
        with path.open("wb") as said, self.start(said, **options) as process:
            try:
                while "Next run" not in path.read_text():
                    assert process.poll() is None, path.read_text()
                    time.sleep(0.1)
                yield process, path
            finally:
                processes = [process.pid, *descendants(process.pid)]
                process.terminate()
                try:
                    process.wait(60)
                finally:
                    process.kill()
                wait(lambda: all(map(gone, processes)))

    def ask(self, path, body):
        request = Request(self.api + path, json.dumps(body).encode(), {"Content-Type": "application/json"})
        with urlopen(request, timeout=30) as answer:
            return json.load(answer)

    def runs(self, state=None):
        chosen = {"flow_runs": {"state": {"type": {"any_": [state]}}}} if state else {}
        return self.ask("/flow_runs/filter", chosen | {"sort": "EXPECTED_START_TIME_ASC"})

    def prefect(self, *args, cwd):
        command = [sys.executable, "-m", "prefect", *args]
        environment = self.environment | {"PREFECT_HOME": str(self.folder / "client")}
        options = {"cwd": cwd, "env": environment, "stdin": subprocess.DEVNULL, "timeout": 120}
        return subprocess.run(command, capture_output=True, text=True, check=False, **options)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
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
    with socket.create_server(("127.0.0.1", place.port)):
        line = place.fails()
    assert f"port {place.port} is in use" in line
    assert line.count("\n") == 1


def test_folder_that_cant_be_written(tmp_path):
    (tmp_path / "data").write_text("")
    line = Place(tmp_path).fails()
    assert "data/.prefect: can't be written" in line
    assert line.count("\n") == 1
