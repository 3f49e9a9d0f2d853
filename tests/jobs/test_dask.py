"""Parcels on a Dask cluster: a real scheduler and two workers, on loopback."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from products import SURVEYS, many, tree

from vinemap.config.surveys import survey_config
from vinemap.errors import ConfigError
from vinemap.jobs import survey
from vinemap.jobs.plan import DONE
from vinemap.jobs.survey import map_survey
from vinemap.parcel import follow

pytest.importorskip("distributed", reason="needs Dask: pip install 'vinemap[dask]'")


def start(*words, cwd):
    log = (cwd / "dask.log").open("ab")
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "DASK_LOGGING__DISTRIBUTED": "warning"}
    with log:
        return subprocess.Popen(
            [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]],
            cwd=cwd,
            stdout=log,
            stderr=log,
            env=environment,
            start_new_session=True,
        )


def until(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Address of a scheduler with two workers of a thread each, and the workers' processes."""
    folder = tmp_path_factory.mktemp("dask")
    scheduler = start(
        "dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
        "--scheduler-file",
        "s.json",
        cwd=folder,
    )
    workers = []
    try:
        until((folder / "s.json").is_file)
        until(lambda: (folder / "s.json").read_text().endswith("}"))
        address = json.loads((folder / "s.json").read_text())["address"]
        few = "--nthreads", "1", "--no-dashboard", "--memory-limit", "0"
        workers += [start("dask_worker", address, "--host", "127.0.0.1", *few, cwd=folder) for _ in range(2)]
        yield address, workers
    finally:
        for process in (*workers, scheduler):
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def job(cloud, folder, boundaries, **options):
    config = survey_config(survey="three", cloud=cloud, boundaries=boundaries, job=options)
    return list(map_survey(config, folder))


def by_dask(cluster):
    return {"engine": "dask", "scheduler": cluster[0]}


def test_products_are_the_same_byte_for_byte(cluster, three, tmp_path):
    boundaries = three.with_name("parcels.gpkg")
    here = job(three, tmp_path / "here", boundaries)
    there = job(three, tmp_path / "there", boundaries, **by_dask(cluster))
    assert [outcome.state for outcome in here + there] == [DONE] * 6
    assert tree(tmp_path / "here") == tree(tmp_path / "there")
    assert {path.name for path in (tmp_path / "there").iterdir()} == {"A", "B", "C", *SURVEYS}


def misbehave(recipe, folder, **options):
    """Work a parcel, or do what its name says; B0 first kills the worker of the cluster that has it."""
    if recipe.parcel == "B0" and not (mark := folder.parent.parent / "killed").exists():
        mark.touch()
        os.kill(worker_of(os.getpid()), signal.SIGKILL)
        time.sleep(60)
    if recipe.parcel == "C0":
        os.abort()
    if recipe.parcel == "C1":
        time.sleep(60)
    return follow(recipe, folder, **options)


def worker_of(pid):
    """The cluster's worker that began a process."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_a_worker_that_is_killed_costs_nothing_but_time(cluster, three, tmp_path, monkeypatch):
    """Nor do calls that crash or hang cost the cluster a worker."""
    many(three, tmp_path / "many.gpkg", 2)
    monkeypatch.setattr(survey, "follow", misbehave)
    outcomes = job(three, tmp_path / "out", tmp_path / "many.gpkg", limit=10, **by_dask(cluster))
    found = {outcome.parcel: outcome for outcome in outcomes}
    assert {name for name, outcome in found.items() if outcome.state == DONE} == {"A0", "A1", "B0", "B1"}
    assert found["C0"].line() == "C0: failed: its process died (SIGABRT)"
    assert found["C1"].line() == "C1: failed: took longer than 10 s"
    assert (tmp_path / "killed").exists()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"A0", "A1", "B0", "B1", *SURVEYS}


def test_a_scheduler_that_does_not_answer(three, tmp_path, monkeypatch):
    monkeypatch.setattr("vinemap.jobs.dask.PATIENCE", 1.0)
    with pytest.raises(ConfigError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        job(three, tmp_path / "out", three.with_name("parcels.gpkg"), engine="dask", scheduler="tcp://127.0.0.1:9")
    assert list(tmp_path.iterdir()) == []
