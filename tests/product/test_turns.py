"""One at a time: who comes second, who dies at work, and what is swept after them."""

import errno
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest
from drafts import fill, names, publish
from pyproj import CRS
from systems import POSIX

from vinemap.compute import locks
from vinemap.errors import BusyError, OutputError
from vinemap.odometry import drive
from vinemap.product import geopackage, store
from vinemap.product.register import file


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(store, "PATIENCE", 0.1)


def test_who_comes_second_says_so(tmp_path, impatient):
    with store.product(tmp_path / "F") as draft:
        with ThreadPoolExecutor(1) as threads:
            error = threads.submit(publish, tmp_path / "F", "second's").exception()
        assert isinstance(error, BusyError)
        assert error.heals
        assert str(error) == f"{tmp_path / 'F'}: another run is at work here"
        assert draft.is_dir()
        fill(draft)
    assert (tmp_path / "F" / "F.gpkg").read_text() == "new"
    publish(tmp_path / "F", "third's")
    assert names(tmp_path) == ["F"]


def test_who_comes_second_waits_for_a_while(tmp_path):
    with ThreadPoolExecutor(1) as threads:
        with store.product(tmp_path / "F") as draft:
            second = threads.submit(publish, tmp_path / "F", "second's")
            fill(draft)
            with pytest.raises(TimeoutError):
                second.result(0.1)
        second.result(5)
    assert (tmp_path / "F" / "F.gpkg").read_text() == "second's"
    assert names(tmp_path) == ["F"]


def test_never_two_at_once(tmp_path):
    """Locks are removed when they are let go of, while others wait for them."""
    inside, most = [], []

    def work(k):
        for n in range(5):
            with store.product(tmp_path / "F") as draft:
                inside.append(k)
                most.append(len(inside))
                fill(draft, f"{k}.{n}")
                inside.remove(k)

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(work, range(4)))
    assert len(most) == 20
    assert max(most) == 1
    assert names(tmp_path) == ["F"]


def test_a_register_that_two_make_at_once_is_one(tmp_path, monkeypatch):
    path, begun, write = tmp_path / "register.gpkg", threading.Event(), file.write_geopackage

    def slow(*given, **options):
        begun.set()
        write(*given, **options)
        time.sleep(0.2)

    monkeypatch.setattr(file, "write_geopackage", slow)
    with ThreadPoolExecutor(1) as threads:
        first = threads.submit(file.make_register, path, CRS(32632))
        assert begun.wait(5)
        file.make_register(path, CRS(32633))
        first.result()
    assert file.read_register(path).crs.to_epsg() == 32632
    assert names(tmp_path) == ["register.gpkg"]


@pytest.mark.parametrize(
    ("module", "name", "write"),
    [
        (geopackage.pyogrio, "write_dataframe", lambda path: geopackage.write_layer(None, path, layer="rows")),
        (drive, "write_geopackage", lambda path: drive._write({}, path)),
    ],
)
def test_who_comes_second_leaves_the_first_its_geopackage(tmp_path, monkeypatch, module, name, write):
    """The second comes and goes while the first is at work."""
    path, left = tmp_path / "a.gpkg", ["second", "first"]

    def work(layers, draft, **options):
        who = left.pop()
        draft.write_text(who)
        if left:
            write(path)
            assert path.read_text() == "second, whole"
        with draft.open("a") as stream:
            stream.write(", whole")

    monkeypatch.setattr(module, name, work)
    write(path)
    assert path.read_text() == "first, whole"
    assert names(tmp_path) == ["a.gpkg"]


def test_a_lock_is_removed_while_it_is_held(tmp_path, monkeypatch):
    """Later it could be another's."""
    held = []

    class Watched(locks.FileLock):
        def release(self, *words, **options):
            held.append(Path(self.lock_file).exists())
            super().release(*words, **options)

    monkeypatch.setattr(locks, "FileLock", Watched)
    publish(tmp_path / "F")
    assert set(held) == {False}


HOLD = """
import sys
from pathlib import Path
from vinemap.product import store
folder = Path(sys.argv[1])
with store.workshop(folder) as aside, store.product(folder / "F", drafts=aside, within=folder) as draft:
    (draft / "F.gpkg").write_text("half")
    with store.product(folder / "alone") as other:
        print("held", flush=True)
        sys.stdin.read()
"""


@POSIX
def test_a_killed_job_holds_nothing(tmp_path):
    folder = tmp_path / "products"
    publish(folder / "F", "old")
    command = [sys.executable, "-c", HOLD, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as job:
        assert job.stdout.readline() == "held\n"
        with pytest.raises(BusyError, match="another job is at work here"), store.workshop(folder):
            pass
        left = names(folder)
        assert len(left) == 6
        job.kill()
    assert names(folder) == left
    with store.workshop(folder) as aside:
        assert names(folder) == sorted([aside.name, ".lock", "F"])
        assert (folder / "F" / "F.gpkg").read_text() == "old"
        publish(folder / "F", drafts=aside, within=folder)
        assert names(aside) == []
    assert names(folder) == ["F"]
    assert (folder / "F" / "F.gpkg").read_text() == "new"


def test_a_killed_run_holds_nothing(tmp_path):
    """What a run alone has left goes when the same is run again, not when another is."""
    for name in (".F.01234567.part", ".G.01234567.part"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "F.gpkg").write_text("half")
    (tmp_path / ".F.lock").touch()
    publish(tmp_path / "F")
    assert names(tmp_path) == [".G.01234567.part", "F"]


def test_a_workshop_is_swept(tmp_path):
    publish(tmp_path / "F", "old")
    users = [".keep", ".F.part", "F.01234567.part", ".F.lock.txt", "notes"]
    for name in users:
        (tmp_path / name).touch()
    for name in (".pieces-1", ".F.89abcdef.part", ".vigna bella.01234567.part"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "0.xyz").touch()
    for name in (".survey.json.01234567.part", ".F.lock", ".vigna bella.lock"):
        (tmp_path / name).touch()
    with store.workshop(tmp_path) as aside:
        assert names(tmp_path) == sorted([*users, ".lock", "F", aside.name])
        (aside / "0.xyz").touch()
        (tmp_path / ".G.01234567.part").mkdir()
    assert names(tmp_path) == sorted([*users, "F"])


@POSIX
def test_what_is_swept_may_be_odd(tmp_path):
    """Links aren't followed, and what can't be a lock doesn't stop a night's work."""
    (tmp_path / "out").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "note.txt").touch()
    (tmp_path / "out" / ".F.01234567.part").symlink_to(tmp_path / "mine")
    (tmp_path / "out" / ".G.lock").mkdir()
    with store.workshop(tmp_path / "out"):
        pass
    assert names(tmp_path / "out") == [".G.lock"]
    assert names(tmp_path / "mine") == ["note.txt"]


def test_who_is_at_work_is_not_swept_away(tmp_path):
    with ExitStack() as stack:
        draft = stack.enter_context(store.product(tmp_path / "F"))
        fill(draft)
        with ThreadPoolExecutor(1) as threads:
            threads.submit(lambda: stack.enter_context(store.workshop(tmp_path))).result()
        assert {draft.name, ".F.lock"} <= set(names(tmp_path))
        assert names(draft) == ["F.gpkg", "F_dtm.tif", "run.json"]
    assert names(tmp_path) == ["F"]


def test_a_workshop_leaves_no_folder_that_it_made_and_nobody_used(tmp_path):
    folder = tmp_path / "new" / "products"
    with store.workshop(folder):
        pass
    assert names(tmp_path) == []
    with store.workshop(folder):
        (folder / "survey.json").touch()
    assert names(folder) == ["survey.json"]
    (tmp_path / "old").mkdir()
    with store.workshop(tmp_path / "old"):
        pass
    assert names(tmp_path) == ["new", "old"]


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_disk_without_locks_is_one_line(tmp_path, monkeypatch, code):
    fcntl = pytest.importorskip("fcntl", reason="needs locks as POSIX has them")

    def fail(*args):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", fail)
    for opened in (store.product(tmp_path / "F"), store.workshop(tmp_path / "survey")):
        with pytest.raises(OutputError, match=r"its disk has no locks \(.*\): choose a folder on another disk"), opened:
            pass
    assert names(tmp_path) == []
