"""Parcels on a Dask cluster: a real scheduler and two workers, on loopback."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import here
from products import SURVEYS, map_here, tree
from systems import LINUX

import vinemap
from vinemap.config.surveys import survey_config
from vinemap.errors import ConfigError, WorkerError
from vinemap.jobs import survey
from vinemap.jobs.dask import DaskWorkers
from vinemap.jobs.outcomes import DONE
from vinemap.jobs.survey import map_survey
from vinemap.parcel import follow


def start(*words, cwd):
    log = (cwd / "dask.log").open("ab")
    environment = here(os.environ, Path(__file__).parents[1]) | {"DASK_LOGGING__DISTRIBUTED": "warning"}
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
    mine = map_here(survey_config(survey="three", cloud=three, boundaries=boundaries), tmp_path / "here")
    theirs = job(three, tmp_path / "there", boundaries, **by_dask(cluster))
    assert [outcome.state for outcome in mine + theirs] == [DONE] * 6
    assert tree(tmp_path / "here") == tree(tmp_path / "there")
    assert {path.name for path in (tmp_path / "there").iterdir()} == {"A", "B", "C", *SURVEYS}


def misbehave(recipe, folder, **options):
    """Work a parcel; B first kills the worker of the cluster that has it, and C crashes."""
    if recipe.parcel == "B" and not (mark := folder.parent.parent / "killed").exists():
        mark.touch()
        os.kill(worker_of(os.getpid()), signal.SIGKILL)
        time.sleep(60)
    if recipe.parcel == "C":
        os.abort()
    return follow(recipe, folder, **options)


def worker_of(pid):
    """The cluster's worker that began a process."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


@LINUX
def test_a_worker_that_is_killed_costs_nothing_but_time(cluster, three, tmp_path, monkeypatch):
    """Nor do calls that crash cost the cluster a worker."""
    monkeypatch.setattr(survey, "follow", misbehave)
    outcomes = job(three, tmp_path / "out", three.with_name("parcels.gpkg"), **by_dask(cluster))
    found = {outcome.parcel: outcome for outcome in outcomes}
    assert {name for name, outcome in found.items() if outcome.state == DONE} == {"A", "B"}
    assert found["C"].line() == "C: failed: its process died (SIGABRT)"
    assert (tmp_path / "killed").exists()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"A", "B", *SURVEYS}


def test_calls_that_hang_do_not_keep_a_worker(cluster):
    with DaskWorkers(cluster[0]) as workers:
        for _ in range(2):
            with pytest.raises(WorkerError, match=r"took longer than 0\.5 s"):
                workers.run(time.sleep, 600, limit=0.5)
        assert workers.run(eval, "__import__('vinemap').__file__") == vinemap.__file__


def test_a_scheduler_that_does_not_answer(three, tmp_path, monkeypatch):
    monkeypatch.setattr("vinemap.jobs.dask.PATIENCE", 1.0)
    with pytest.raises(ConfigError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        job(three, tmp_path / "out", three.with_name("parcels.gpkg"), engine="dask", scheduler="tcp://127.0.0.1:9")
    assert list(tmp_path.iterdir()) == []
