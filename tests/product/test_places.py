"""Where products can be put: folders that can't be written, links, disks of their own, long names."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from drafts import fill, names, publish
from pyproj import CRS
from systems import LINUX, POSIX

from vinemap import paths
from vinemap.config.names import check_name
from vinemap.errors import InputError, OutputError
from vinemap.evaluate.reference import read_lines
from vinemap.geo.boundaries import read_boundary
from vinemap.geo.lines import read_rows
from vinemap.naming import LONGEST_NAME, MOST_BYTES
from vinemap.plugin.install import write_zip
from vinemap.product import store
from vinemap.product.geopackage import write_layer
from vinemap.product.register import file
from vinemap.product.register.file import make_register
from vinemap.product.seasons.products import read_record
from vinemap.view.window import show


@pytest.mark.parametrize(
    "write",
    [
        lambda path: write_layer(None, path, layer="rows"),
        lambda path: make_register(path, CRS.from_epsg(32632)),
        write_zip,
        lambda path: show(None, path),
    ],
    ids=["layer", "register", "plugin", "picture"],
)
def test_a_file_that_cannot_be_written_is_said_in_a_line(tmp_path, write):
    (tmp_path / "a").write_text("a file")
    with pytest.raises(OutputError, match=r"a/b: can't be written \((File exists|Not a directory)\): choose another"):
        write(tmp_path / "a" / "b")
    assert names(tmp_path) == ["a"]


def test_a_register_for_which_there_is_no_room_leaves_nothing(tmp_path, monkeypatch):
    def full(tables, path, **how):
        path.with_name(f"{path.name}-journal").touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(file, "write_geopackage", full)
    with pytest.raises(OutputError, match=r"r\.gpkg: can't be written \(No space left on device\): make room there"):
        make_register(tmp_path / "r.gpkg", CRS.from_epsg(32632))
    assert names(tmp_path) == []


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


@pytest.mark.parametrize("name", ["Go!/a.gpkg", "a!b.gpkg", "a;b.gpkg"])
def test_a_file_whose_path_would_be_cut(tmp_path, monkeypatch, name):
    """Neither is something else read, or written, nor is a file that is there said to be missing."""
    monkeypatch.chdir(tmp_path)
    place = Path(name)
    place.parent.mkdir(exist_ok=True)
    for write in (lambda: write_layer(None, place, layer="rows"), lambda: make_register(place, CRS.from_epsg(32632))):
        with pytest.raises(InputError, match=r"has a '[!;]' in its path, at which it would be cut: rename that"):
            write()
    place.touch()
    for read in (read_boundary, read_rows, read_lines):
        with pytest.raises(InputError, match=r"has a '[!;]' in its path, at which it would be cut: rename that"):
            read(place)
    assert names(place.parent) == [place.name]


def test_a_product_whose_path_would_be_cut(tmp_path):
    publish(tmp_path / "F")
    (tmp_path / "F").rename(tmp_path / "F!")
    (tmp_path / "F!" / "run.json").write_text('{"parcel": "F", "origin": {"lat": 44, "lon": 8, "alt": 300}}')
    with pytest.raises(InputError, match="has a '!' in its path"):
        read_record(tmp_path / "F!")


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


@pytest.fixture
def mounted(tmp_path, monkeypatch):
    """A folder that can't be moved, and into which and out of which nothing can be."""
    target, rename = tmp_path / "out", Path.rename
    target.mkdir()

    def renamed(path, to):
        if (target in path.parents) != (target in Path(to).parents):
            raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))
        rename(path, to)

    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == target)
    monkeypatch.setattr(Path, "rename", renamed)
    monkeypatch.setattr(Path, "replace", renamed)
    return target


@pytest.mark.parametrize("within", [True, False])
def test_a_disk_of_its_own(mounted, within):
    options = {"within": mounted.parent, "drafts": mounted.parent} if within else {}
    (mounted / "note.txt").write_text("mine")
    (mounted / ".product.01234567.part").mkdir()
    with store.product(mounted, **options) as draft:
        assert names(mounted.parent) == ["out"]
        (draft / "a").mkdir()
        fill(draft, "old", files=("F_old.tif", "F.gpkg", "a/old", "a/both"))
    for name in ("F.gpkg-wal", "a/mine"):
        (mounted / name).write_text("mine")
    with store.product(mounted, **options) as draft:
        (draft / "a").mkdir()
        fill(draft, files=("F.gpkg", "a/both"))
    assert names(mounted) == ["F.gpkg", "a", "note.txt", "run.json"]
    assert names(mounted / "a") == ["both", "mine"]
    assert [(mounted / name).read_text() for name in ("F.gpkg", "a/both", "note.txt")] == ["new", "new", "mine"]
    assert names(mounted.parent) == ["out"]


@pytest.mark.parametrize("parcel", ["F", "G"])
def test_all_is_as_before_on_a_disk_of_its_own_if_one_file_cannot_be_put(mounted, parcel, monkeypatch):
    with store.product(mounted) as draft:
        fill(draft, "old", parcel=parcel)
    before = {path: path.read_text() for path in mounted.iterdir()}
    rename = Path.rename

    def stubborn(path, to):
        if path.name == "F_dtm.tif" and path.read_text() == "new":
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))
        rename(path, to)

    monkeypatch.setattr(Path, "rename", stubborn)
    with pytest.raises(OutputError, match="Permission denied"):
        publish(mounted)
    assert {path: path.read_text() for path in mounted.iterdir()} == before


@pytest.mark.parametrize("parcel", ["F", "G"])
def test_a_disk_of_its_own_that_the_system_does_not_tell_loses_nothing(mounted, parcel, monkeypatch):
    with store.product(mounted) as draft:
        fill(draft, "old", parcel=parcel)
    monkeypatch.setattr(os.path, "ismount", lambda path: False)
    monkeypatch.setattr(store, "_exchange", lambda draft, target: draft.rename(target / "a"))
    with pytest.raises(OutputError, match=r"out: can't be written"):
        publish(mounted)
    assert json.loads((mounted / "run.json").read_text())["parcel"] == parcel
    assert names(mounted) == ["F.gpkg", "F_dtm.tif", "run.json"]


def test_a_folder_that_cannot_be_moved_though_its_files_can(tmp_path, monkeypatch):
    def fixed(draft, target):
        raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))

    monkeypatch.setattr(store, "_exchange", fixed)
    publish(tmp_path / "F", "old")
    (tmp_path / "F" / "note.txt").write_text("mine")
    publish(tmp_path / "F")
    assert names(tmp_path / "F") == ["F.gpkg", "F_dtm.tif", "note.txt", "run.json"]
    assert [(tmp_path / "F" / name).read_text() for name in ("F.gpkg", "note.txt")] == ["new", "mine"]
    assert names(tmp_path) == ["F"]


WORK = """
import json
from pathlib import Path
from drafts import fill, names
from vinemap.product import store
out = Path("my out")
for parcel in "FFG":
    with store.product(out) as draft:
        fill(draft, "new", parcel=parcel, files=(f"{parcel}.gpkg",))
print(json.dumps([names(Path(".")), names(out), json.loads((out / "run.json").read_text())["parcel"]]))
"""
MOUNTS = {"another disk": "mount -t tmpfs none 'my out'", "the same": "mount --bind other 'my out'"}


@LINUX
@pytest.mark.parametrize("disk", MOUNTS)
def test_what_is_mounted_in_truth(tmp_path, disk):
    """As a container's volumes are."""
    alone = ["unshare", "--user", "--map-root-user", "--mount"]
    try:
        subprocess.run([*alone, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs leave to mount")
    command = [*alone, "sh", "-ec", f'mkdir "my out" other; {MOUNTS[disk]}; exec "$0" -c "$1"', sys.executable, WORK]
    here = Path(__file__)
    settings = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (here.parents[1], here.parents[2])))}
    done = subprocess.run(command, cwd=tmp_path, env=settings, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert json.loads(done.stdout) == [["my out", "other"], ["F.gpkg", "G.gpkg", "run.json"], "G"]


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
