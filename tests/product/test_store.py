"""Products are put in place whole, or not at all, and leave alone what others put there."""

import errno
import json
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from drafts import fill, names, publish
from systems import LINUX

from vinemap.errors import OutputError
from vinemap.product import store


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


@pytest.mark.parametrize("recorded", [True, False])
def test_what_others_put_into_a_product_s_folders_stays(tmp_path, recorded):
    """Though the record that tells whose a file is may be lost."""
    target, files = tmp_path / "F", ("a/b/old", "a/b/both", "a/both", "c/old")
    for text, written in (("old", files), ("new", ("a/b/both", "a/both", "d/new"))):
        with store.product(target, within=tmp_path) as draft:
            for name in written:
                (draft / name).parent.mkdir(parents=True, exist_ok=True)
            fill(draft, text, files=written)
        if text == "old":
            for name in ("a/mine", "a/b/mine", "a/b/old-wal", "a/e/mine", "d/mine"):
                (target / name).parent.mkdir(exist_ok=True)
                (target / name).write_text("mine")
            (target / "a" / "empty").mkdir()
            if not recorded:
                (target / "run.json").unlink()
    found = {path.relative_to(target).as_posix(): path.read_text() for path in target.rglob("*") if path.is_file()}
    mine, ours = ["a/mine", "a/b/mine", "a/e/mine", "d/mine"], ["a/b/both", "a/both", "d/new"]
    lost = [] if recorded else ["a/b/old", "a/b/old-wal", "c/old"]
    assert sorted(found) == sorted([*mine, *ours, *lost, "run.json"])
    assert [found[name] for name in mine + ours] == ["mine"] * 4 + ["new"] * 3
    assert (target / "a" / "empty").is_dir()
    assert (target / "c").exists() == (not recorded)


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
