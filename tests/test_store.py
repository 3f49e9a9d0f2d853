"""Products are put in place whole, or not at all."""

import json

import pytest

from vinemap import paths
from vinemap.errors import OutputError


def fill(folder, text="new", parcel="F", files=("F.gpkg", "F_dtm.tif")):
    for name in files:
        (folder / name).write_text(text)
    (folder / "run.json").write_text(json.dumps({"parcel": parcel, "files": list(files)}))


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_new_folder(tmp_path):
    with paths.product(tmp_path / "a" / "F") as draft:
        fill(draft)
        assert not (tmp_path / "a" / "F").exists()
    assert names(tmp_path / "a" / "F") == ["F.gpkg", "F_dtm.tif", "run.json"]
    assert names(tmp_path / "a") == ["F"]


def test_failure_leaves_nothing_and_keeps_what_was_there(tmp_path):
    def broken(target):
        with paths.product(target) as draft:
            (draft / "F.gpkg").write_text("half")
            raise RuntimeError("broken")

    with pytest.raises(RuntimeError):
        broken(tmp_path / "F")
    assert names(tmp_path) == []
    with paths.product(tmp_path / "F") as draft:
        fill(draft, "old")
    with pytest.raises(RuntimeError):
        broken(tmp_path / "F")
    assert (tmp_path / "F" / "F.gpkg").read_text() == "old"


def test_earlier_product_is_replaced_whole(tmp_path):
    with paths.product(tmp_path / "F") as draft:
        fill(draft, "old", files=("F.gpkg", "F_old.tif"))
    with paths.product(tmp_path / "F") as draft:
        fill(draft)
    assert names(tmp_path / "F") == ["F.gpkg", "F_dtm.tif", "run.json"]
    assert names(tmp_path) == ["F"]


@pytest.mark.parametrize("other", [{"F.txt": "mine"}, None])
def test_files_of_others_stay(tmp_path, other):
    target = tmp_path / "out"
    target.mkdir()
    if other:
        (target / "F.txt").write_text("mine")
    else:
        fill(target, "G's", parcel="G", files=("G.gpkg",))
    with paths.product(target) as draft:
        fill(draft)
    kept = "F.txt" if other else "G.gpkg"
    assert names(target) == sorted(["F.gpkg", "F_dtm.tif", kept, "run.json"])
    assert json.loads((target / "run.json").read_text())["parcel"] == "F"


def test_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("x")
    for target in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="--out"), paths.product(target):
            pass
    assert names(tmp_path) == ["file"]
