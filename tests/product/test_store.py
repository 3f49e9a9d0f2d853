"""Products are put in place whole, or not at all, whoever else reads, writes or dies there."""

import errno
import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from systems import LINUX, POSIX

from vinemap import paths
from vinemap.config.names import check_name
from vinemap.errors import BusyError, OutputError
from vinemap.paths import LONGEST_NAME, MOST_BYTES
from vinemap.product import store


def fill(folder, text="new", parcel="F", files=("F.gpkg", "F_dtm.tif")):
    for name in files:
        (folder / name).write_text(text)
    (folder / "run.json").write_text(
        json.dumps({"parcel": parcel, "files": {name: len(text) for name in files}, "text": text})
    )


def publish(target, text="new", **options):
    with store.product(target, **options) as draft:
        fill(draft, text)


def names(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(store, "PATIENCE", 0.1)


@pytest.fixture
def without_exchange(monkeypatch):
    """A system that can't put two folders in each other's places at one stroke."""
    monkeypatch.setattr(store.ctypes, "CDLL", lambda name: SimpleNamespace())


def test_new_folder(tmp_path):
    with store.product(tmp_path / "a" / "F") as draft:
        fill(draft)
        assert not (tmp_path / "a" / "F").exists()
    assert names(tmp_path / "a" / "F") == ["F.gpkg", "F_dtm.tif", "run.json"]
    assert names(tmp_path / "a") == ["F"]


@pytest.mark.parametrize("within", [True, False])
def test_failure_leaves_nothing_and_keeps_what_was_there(tmp_path, within):
    options = {"within": tmp_path} if within else {}

    def broken(target):
        with store.product(target, **options) as draft:
            (draft / "F.gpkg").write_text("half")
            raise RuntimeError("broken")

    with pytest.raises(RuntimeError):
        broken(tmp_path / "new" / "F" if not within else tmp_path / "F")
    assert names(tmp_path) == []
    publish(tmp_path / "F", "old", **options)
    with pytest.raises(RuntimeError):
        broken(tmp_path / "F")
    assert (tmp_path / "F" / "F.gpkg").read_text() == "old"
    assert names(tmp_path) == ["F"]


def test_a_full_disk_keeps_what_was_there(tmp_path):
    def full(target):
        with store.product(target) as draft:
            (draft / "F.gpkg").write_text("half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    publish(tmp_path / "F", "old")
    with pytest.raises(OutputError, match=r"F: can't be written \(No space left on device\)"):
        full(tmp_path / "F")
    assert (tmp_path / "F" / "F.gpkg").read_text() == "old"
    assert names(tmp_path) == ["F"]


def test_earlier_product_is_replaced_whole(tmp_path):
    with store.product(tmp_path / "F") as draft:
        fill(draft, "old", files=("F.gpkg", "F_old.tif"))
    publish(tmp_path / "F")
    assert names(tmp_path / "F") == ["F.gpkg", "F_dtm.tif", "run.json"]
    assert names(tmp_path) == ["F"]


@pytest.mark.parametrize("other", [{"F.txt": "mine"}, None])
def test_files_of_others_stay_where_no_product_was(tmp_path, other):
    target = tmp_path / "out"
    target.mkdir()
    if other:
        (target / "F.txt").write_text("mine")
    else:
        fill(target, "G's", parcel="G", files=("G.gpkg",))
    publish(target)
    kept = "F.txt" if other else "G.gpkg"
    assert names(target) == sorted(["F.gpkg", "F_dtm.tif", kept, "run.json"])
    assert json.loads((target / "run.json").read_text())["parcel"] == "F"


@pytest.mark.parametrize("within", [True, False])
def test_what_others_put_beside_a_product_stays(tmp_path, within):
    """A note, a project with its folder, links to things that are there or not; not what belongs to old files."""
    target = tmp_path / "F"
    options = {"within": tmp_path} if within else {}
    with store.product(target, **options) as draft:
        fill(draft, "old", files=("F.gpkg", "F_old.tif"))
    (target / "note.txt").write_text("mine")
    (target / "photos" / "may").mkdir(parents=True)
    (target / "photos" / "may" / "1.jpg").write_text("a vine")
    links = {"to file": "note.txt", "to folder": "photos", "to nowhere": "gone"}
    if os.name == "posix":
        for name, to in links.items():
            (target / name).symlink_to(to)
        (target / "photos" / "up").symlink_to("..")
    sides = ("F.gpkg-wal", "F.gpkg-shm", "F_old.tif.aux.xml", "F_old.tif.ovr", "F.gpkg-journal")
    for name in (*sides, "my.tif.aux.xml"):
        (target / name).write_text("side")
    inode = (target / "note.txt").stat().st_ino
    publish(target, **options)
    kept = ["note.txt", "photos", "my.tif.aux.xml", *(links if os.name == "posix" else ())]
    assert names(target) == sorted(["F.gpkg", "F_dtm.tif", "run.json", *kept])
    assert (target / "F.gpkg").read_text() == "new"
    assert (target / "note.txt").read_text() == "mine"
    assert (target / "note.txt").stat().st_ino == inode
    assert (target / "photos" / "may" / "1.jpg").read_text() == "a vine"
    if os.name == "posix":
        assert {name: str((target / name).readlink()) for name in links} == links
        assert (target / "photos" / "up").readlink() == Path("..")
    assert names(tmp_path) == ["F"]


def test_what_others_keep_is_copied_where_it_cannot_be_linked(tmp_path, monkeypatch):
    publish(tmp_path / "F", "old")
    (tmp_path / "F" / "note.txt").write_text("mine")

    def link(*names, **options):
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", link)
    publish(tmp_path / "F")
    assert (tmp_path / "F" / "note.txt").read_text() == "mine"
    assert (tmp_path / "F" / "F.gpkg").read_text() == "new"


@pytest.mark.parametrize("record", ["", "[1]", '{"files": 5}', '{"parcel": "F"}', "\xff\xfe", None])
def test_a_broken_record_costs_nothing_of_others(tmp_path, record):
    publish(tmp_path / "F", "old")
    if record is None:
        (tmp_path / "F" / "run.json").unlink()
    else:
        (tmp_path / "F" / "run.json").write_text(record, encoding="latin-1")
    (tmp_path / "F" / "note.txt").write_text("mine")
    publish(tmp_path / "F", within=tmp_path)
    assert names(tmp_path / "F") == ["F.gpkg", "F_dtm.tif", "note.txt", "run.json"]
    assert (tmp_path / "F" / "F.gpkg").read_text() == "new"


def watch(target, done):
    """Texts of a product's file and record, read again and again as programs do that know nothing of each other."""
    seen = set()
    while not done.is_set():
        seen.add((target / "F.gpkg").read_text())
        seen.add(json.loads((target / "run.json").read_text())["text"])
    return seen


@LINUX
def test_readers_never_miss_a_product_that_is_replaced(tmp_path):
    texts = [letter * 100_000 for letter in "abcdefghijklmnop"]
    publish(tmp_path / "F", texts[0])
    done = threading.Event()
    with ThreadPoolExecutor(2) as threads:
        readers = [threads.submit(watch, tmp_path / "F", done) for _ in range(2)]
        try:
            for text in texts * 4:
                publish(tmp_path / "F", text)
        finally:
            done.set()
        seen = set.union(*(reader.result() for reader in readers))
    assert seen <= set(texts)
    assert len(seen) > 1


def test_without_an_exchange(tmp_path, without_exchange):
    publish(tmp_path / "F", "old")
    (tmp_path / "F" / "note.txt").write_text("mine")
    publish(tmp_path / "F")
    assert (tmp_path / "F" / "F.gpkg").read_text() == "new"
    assert names(tmp_path / "F") == ["F.gpkg", "F_dtm.tif", "note.txt", "run.json"]
    assert names(tmp_path) == ["F"]


@LINUX
def test_a_disk_that_cannot_exchange(tmp_path, monkeypatch):
    asked = []

    def renameat2(*words):
        asked.append(words)
        return -1

    monkeypatch.setattr(store.ctypes, "CDLL", lambda name: SimpleNamespace(renameat2=renameat2))
    publish(tmp_path / "F", "old")
    publish(tmp_path / "F")
    assert len(asked) == 1
    assert (tmp_path / "F" / "F.gpkg").read_text() == "new"
    assert names(tmp_path) == ["F"]


def test_the_old_product_comes_back_if_the_new_cannot_take_its_place(tmp_path, monkeypatch, without_exchange):
    publish(tmp_path / "F", "old")
    rename = Path.rename

    def stubborn(path, to):
        if (path / "F.gpkg").read_text() == "new":
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", stubborn)
    with pytest.raises(OutputError, match="Permission denied"):
        publish(tmp_path / "F")
    assert (tmp_path / "F" / "F.gpkg").read_text() == "old"
    assert names(tmp_path) == ["F"]


def test_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("x")
    for target in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="choose another folder"), store.product(target):
            pass
    with pytest.raises(OutputError, match="choose another folder"), store.workshop(tmp_path / "file"):
        pass
    assert names(tmp_path) == ["file"]


def test_a_folder_whose_path_would_be_cut(tmp_path):
    """A GeoPackage would be written to what follows the "!", or nowhere."""
    folder = tmp_path / "Go!" / "products"
    with pytest.raises(OutputError, match=r"Go!.*choose another folder"):
        publish(folder / "F")
    with pytest.raises(OutputError, match=r"Go!.*choose another folder"), store.workshop(folder):
        pass
    assert names(tmp_path) == []


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_that_may_only_be_read(tmp_path):
    (tmp_path / "mine").mkdir(mode=0o555)
    for opened in (store.product(tmp_path / "mine" / "F"), store.workshop(tmp_path / "mine")):
        with pytest.raises(OutputError, match="Permission denied"), opened:
            pass
    assert names(tmp_path / "mine") == []


@pytest.mark.parametrize("within", [True, False])
def test_folder_in_which_nothing_can_be_made(tmp_path, monkeypatch, within):
    publish(tmp_path / "F", "old")
    mkdir = Path.mkdir

    def denied(path, *words, **options):
        if path.name.endswith(".part"):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        mkdir(path, *words, **options)

    monkeypatch.setattr(Path, "mkdir", denied)
    with pytest.raises(OutputError, match=r"F: can't be written \(Permission denied\)"):
        publish(tmp_path / "F", **({"within": tmp_path} if within else {}))
    assert names(tmp_path) == ["F"]
    assert (tmp_path / "F" / "F.gpkg").read_text() == "old"


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


def test_a_lock_is_removed_while_it_is_held(tmp_path, monkeypatch):
    """Later it could be another's."""
    held = []

    class Watched(store.FileLock):
        def release(self, *words, **options):
            held.append(Path(self.lock_file).exists())
            super().release(*words, **options)

    monkeypatch.setattr(store, "FileLock", Watched)
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


@POSIX
@pytest.mark.parametrize("there", [True, False])
@pytest.mark.parametrize("to", ["elsewhere", "products/G"])
def test_links_are_no_place_for_a_survey(tmp_path, to, there):
    """Neither out of its folder nor to another parcel's."""
    folder = tmp_path / "products"
    folder.mkdir()
    if there:
        publish(tmp_path / to, "other's")
    (folder / "F").symlink_to(tmp_path / to)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(OutputError, match=r"F: is a link.*: put a folder in its place"):
        publish(folder / "F", within=folder)
    assert sorted(tmp_path.rglob("*")) == before
    assert not there or (tmp_path / to / "F.gpkg").read_text() == "other's"


@POSIX
def test_a_loop_of_links_is_no_place(tmp_path):
    (tmp_path / "F").symlink_to("F")
    for within in (tmp_path, None):
        with pytest.raises(OutputError, match=r"F: "):
            publish(tmp_path / "F", within=within)
    assert names(tmp_path) == ["F"]


@POSIX
@pytest.mark.parametrize("there", [True, False])
def test_a_link_that_a_user_names_is_followed(tmp_path, there):
    if there:
        publish(tmp_path / "elsewhere" / "G", "old")
    (tmp_path / "F").symlink_to(Path("elsewhere", "G"))
    publish(tmp_path / "F")
    assert (tmp_path / "F").is_symlink()
    assert (tmp_path / "elsewhere" / "G" / "F.gpkg").read_text() == "new"
    assert names(tmp_path / "elsewhere") == ["G"]
    assert names(tmp_path) == ["F", "elsewhere"]


@POSIX
def test_a_survey_s_own_folder_may_be_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "products").symlink_to("real")
    with store.workshop(tmp_path / "products") as aside:
        publish(tmp_path / "products" / "F", drafts=aside, within=tmp_path / "products")
    assert names(tmp_path / "real") == ["F"]


@pytest.mark.parametrize("letter", ["F", "é", "葡", "🍇"])
def test_long_names(tmp_path, letter):
    """Whatever is added to the longest name that a parcel can have, files can have it."""
    name = check_name(letter * min(LONGEST_NAME, MOST_BYTES // len(letter.encode())))
    with store.workshop(tmp_path) as aside:
        for text in ("old", "new"):
            with store.product(tmp_path / name, drafts=aside, within=tmp_path) as draft:
                longest = paths.raster(draft, name, "vineyard_likelihood")
                longest.with_name(f"{longest.name}.aux.xml").touch()
                store.write_whole(paths.stac_item(draft, name), text)
                fill(draft, text)
        publish(tmp_path / name, text="alone")
        assert (tmp_path / name / "F.gpkg").read_text() == "alone"
    assert names(tmp_path) == [name]


def test_a_text_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "survey.json"
    store.write_whole(path, "é")
    assert path.read_bytes() == "é".encode()
    with pytest.raises(UnicodeEncodeError):
        store.write_whole(path, "half \udcff")

    def replace(path, to):
        raise OSError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(PermissionError):
        store.write_whole(path, "new")
    assert path.read_text(encoding="utf-8") == "é"
    assert names(tmp_path) == ["survey.json"]


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
