"""Where products can be put: folders that can't be written, links, long names."""

import errno
import os
from pathlib import Path

import pytest
from drafts import fill, names, publish
from systems import POSIX

from vinemap import paths
from vinemap.config.names import check_name
from vinemap.errors import OutputError
from vinemap.naming import LONGEST_NAME, MOST_BYTES
from vinemap.product import store


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
