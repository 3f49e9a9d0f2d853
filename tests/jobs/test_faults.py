"""Faults of machines, disks and parcels: what each costs, and what it never costs."""

import contextlib
import io
import os
import threading
from pathlib import Path

import doubles
import laspy
import pytest
from commands import vinemap
from squares import Job, left
from systems import LINUX

from vinemap.cloud import las
from vinemap.cloud.pieces import split_cloud
from vinemap.compute.processes import descendants
from vinemap.errors import BusyError, InputError, OutputError, VinemapError
from vinemap.jobs import survey
from vinemap.jobs.outcomes import CURRENT, DONE, FAILED
from vinemap.product import recipe, store


def test_two_jobs_at_once(job):
    """The second says so, and takes nothing from the first."""
    with contextlib.closing(job.outcomes()) as first:
        one = next(first)
        for _ in range(2):
            with pytest.raises(BusyError, match="another job is at work here"):
                list(job.outcomes())
        assert recipe.product_in(job.folder / one.parcel)
        assert [outcome.state for outcome in first] == [DONE, DONE]
    assert job.states() == dict.fromkeys("ABC", CURRENT)


def test_a_job_beside_another_by_the_command(done):
    words = ["survey", done.cloud, "--boundaries", done.boundaries, "--out", done.folder]
    before = sorted(done.folder.rglob("*"))
    with store.workshop(done.folder):
        command = vinemap(*words, cwd=done.folder.parent)
    assert command.returncode == 2
    assert command.stdout == ""
    assert command.stderr == f"vinemap: {done.folder}: another job is at work here: wait until it is done\n"
    assert sorted(done.folder.rglob("*")) == before


def test_a_job_beside_one_parcels_run(job, monkeypatch):
    """As of `vinemap run` into the same folder, which may last."""
    monkeypatch.setattr(store, "PATIENCE", 0.1)
    job.folder.mkdir()
    with store.product(job.folder / "B"):
        outcomes = {outcome.parcel: outcome for outcome in job.outcomes()}
    assert {parcel: one.state for parcel, one in outcomes.items()} == {"A": DONE, "B": FAILED, "C": DONE}
    assert outcomes["B"].heals
    assert job.states() == {"A": CURRENT, "B": DONE, "C": CURRENT}


def test_who_stops_early_keeps_what_is_done(job):
    outcomes = job.outcomes()
    first = next(outcomes)
    outcomes.close()
    assert left(job.folder) == []
    assert job.states()[first.parcel] == CURRENT


def test_a_cloud_that_vanishes_once_it_was_read(job):
    """As with a disk that is taken away: what was read is worked, and what was found is told."""
    job.step = lambda parcel, function, *args, **kwargs: (
        job.cloud.unlink(missing_ok=True),
        function(*args, **kwargs),
    )[1]
    assert job.states() == dict.fromkeys("ABC", DONE)
    assert len(job.record()["parcels"]) == 3


def test_a_cloud_that_vanishes_while_it_is_read(job, monkeypatch):
    """It isn't wrong for good."""

    def split(clouds, *args, **kwargs):
        pieces = split_cloud(clouds, *args, **kwargs)
        job.cloud.rename(job.cloud.with_name("away"))
        return pieces

    with monkeypatch.context() as patch:
        patch.setattr(survey, "split_cloud", split)
        with pytest.raises(VinemapError):
            job.run()
    job.cloud.with_name("away").rename(job.cloud)
    assert job.states() == dict.fromkeys("ABC", DONE)


def test_a_cloud_that_cannot_be_read_is_known(job):
    """Its parcels fail, once as the job does, then as is known of that very content."""
    whole = job.cloud.read_bytes()
    job.cloud.write_bytes(whole[:5000])
    with pytest.raises(InputError, match=r"may\.las: "):
        job.run()
    assert {one["state"] for one in job.record()["parcels"]} == {FAILED}
    outcomes = job.run()
    assert {one.state for one in outcomes.values()} == {FAILED}
    assert all("may.las: " in one.reason for one in outcomes.values())
    assert job.worked == []
    job.cloud.write_bytes(whole)
    assert job.states() == dict.fromkeys("ABC", DONE)


def test_a_disk_that_fails_while_a_cloud_is_read(job, monkeypatch):
    """It may do better another night."""

    def fail(*words, **options):
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(laspy.LasReader, "chunk_iterator", fail)
        with pytest.raises(VinemapError, match=r"may\.las: .*Input/output error"):
            job.run()
    assert job.states() == dict.fromkeys("ABC", DONE)


class Failing(io.BytesIO):
    """A file of which a disk gives only the beginning."""

    def readinto(self, buffer):
        if self.tell() > 1000:
            raise OSError(5, "Input/output error")
        return super().readinto(buffer)


@pytest.mark.parametrize("backend", ["Lazrs", "LazrsParallel"])
def test_a_disk_that_fails_while_laz_is_read(job, tmp_path, backend):
    laspy.read(job.cloud).write(tmp_path / "may.laz")
    stream = Failing((tmp_path / "may.laz").read_bytes())
    with laspy.open(stream, laz_backend=getattr(laspy.LazBackend, backend)) as reader:
        chunks = las._usable_chunks(reader, tmp_path / "may.laz", None)
        with pytest.raises(BusyError, match=r"may\.laz: can't be read now"):
            list(chunks)


def test_no_scheduler_is_no_fault_of_the_parcels(job, monkeypatch):
    """When it is back, they are worked."""
    from vinemap.jobs import dask as dask_engine

    monkeypatch.setattr(dask_engine, "PATIENCE", 0.2)

    def unreachable(plan, config):
        return dask_engine.DaskWorkers("tcp://127.0.0.1:9")

    with monkeypatch.context() as patch:
        patch.setattr(survey, "_engine", unreachable)
        with pytest.raises(VinemapError, match=r"127\.0\.0\.1:9"):
            job.run()
    assert job.states() == dict.fromkeys("ABC", DONE)


def test_no_room_for_the_points(job, monkeypatch):
    def full(path, *words, **options):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "touch", full)
        with pytest.raises(OutputError, match="No space left on device"):
            job.run()
    assert left(job.folder) == []
    assert job.states() == dict.fromkeys("ABC", DONE)


FAULTS = {
    "aborts": "its process died (SIGABRT)",
    "crashes": "its process died (SIGSEGV, a segmentation fault)",
    "divides": "a fault of vinemap's own (ZeroDivisionError: division by zero, doubles.py line ",
    "gorges": "not enough memory",
    "hangs": "took longer than 12 s",
    "kills": "its process died (SIGKILL, killed by the system, perhaps for want of memory)",
    "leaves": "a fault of vinemap's own (SystemExit: 7, ",
    "refuses": "no vines here",
}


@LINUX
def test_each_fault_is_one_parcels_own(tmp_path, monkeypatch):
    """In processes of their own, two at a time, among parcels that go well."""
    monkeypatch.setattr(survey, "follow", doubles.follow)
    job = Job(tmp_path)
    good = [f"good {k}" for k in range(4)]
    job.draw(**{name: k for k, name in enumerate([*FAULTS])} | dict.fromkeys(good, 8))
    before = len(descendants(os.getpid())), threading.active_count()
    outcomes = job.run(job={"limit": 12, "memory": 1, "workers": 2})
    assert {parcel for parcel, one in outcomes.items() if one.state == DONE} == set(good)
    for name, reason in FAULTS.items():
        assert outcomes[name].reason.startswith(reason), name
        assert outcomes[name].heals == (name != "refuses")
        assert not (job.folder / name).exists()
    assert outcomes["hangs"].seconds == pytest.approx(12, abs=2)
    assert (len(descendants(os.getpid())), threading.active_count()) == before
    assert sorted(path.name for path in job.folder.iterdir() if path.is_dir()) == good
    assert job.planned() == [name for name in FAULTS if name != "refuses"]
