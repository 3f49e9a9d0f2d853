"""Surveys that arrive in a folder: found, named and told, and one's fault costing no other."""

import os
import zipfile
from pathlib import Path

import laspy
import pytest
from arriving import NOW, found, polygons, put, reasons
from systems import POSIX

from vinemap.cloud.las import read_cloud
from vinemap.errors import InputError
from vinemap.jobs import estate


def test_surveys_are_files_and_folders(clouds, place):
    put(clouds["laz 1.4"], place / "may.laz", place / "june" / "flight 7.LAZ", place / "july.copc.laz")
    put(clouds["las 1.2"], place / "Àugust.LAS")
    polygons(place / "june" / "anything.gpkg")
    (place / "empty").mkdir()
    (place / "notes.txt").touch()
    surveys = {arrival.name: arrival.config for arrival in found(place)}
    assert list(surveys) == sorted(surveys) == ["july", "june", "may", "Àugust"]
    assert all(config.survey == name for name, config in surveys.items())
    assert surveys["may"].cloud == place / "may.laz"
    assert surveys["june"].cloud == place / "june" / "flight 7.LAZ"
    assert surveys["june"].boundaries == place / "june" / "anything.gpkg"
    assert surveys["may"].boundaries is None


@pytest.mark.parametrize("name", [".may.laz", ".may/a.laz"])
def test_what_is_hidden_is_left_out(clouds, place, name):
    put(clouds["laz 1.4"], place / name)
    assert found(place) == []


@pytest.mark.parametrize("name", ["may.txt", "may.tif", "parcels.gpkg"])
def test_something_else_is_left_out(place, name):
    (place / name).write_bytes(b"something")
    assert found(place) == []


@pytest.mark.parametrize("folder", ["", "may"])
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("may.zip", "unpack it"),
        ("may.tar.gz", "unpack it"),
        ("may.rcp", "save it as LAS or LAZ"),
        ("may.PTX", "save it as LAS or LAZ"),
        ("may.zip.001", "unpack it"),
        ("may.ldr", "save it as LAS or LAZ"),
        ("may.laz.part", "is its upload over?"),
        ("may.las.filepart", "is its upload over?"),
    ],
)
def test_what_cannot_be_used_is_named_with_what_to_do(clouds, place, folder, name, told):
    path = place / folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"something")
    os.utime(path, (NOW - 1000, NOW - 1000))
    (arrival,) = found(place)
    assert str(path) in arrival.reason
    assert told in arrival.reason
    assert arrival.waits is ("upload" in told)
    os.utime(path, (NOW - 2 * estate.LATE, NOW - 2 * estate.LATE))
    assert not found(place)[0].waits
    if folder:
        put(clouds["laz 1.4"], place / "may" / "a.laz")
        (arrival,) = found(place)
        assert arrival.config.cloud == place / "may" / "a.laz"
        (passed,) = arrival.passed
        assert passed.startswith(name)


@pytest.mark.parametrize("name", ["may.laz.bak", "may.laz (1)", "may.copc", "may"])
def test_a_cloud_of_another_name_is_told(clouds, place, name):
    put(clouds["laz 1.4"], place / "june" / name)
    told = f"{place / 'june' / name} is a cloud by its first bytes: let its name end in .las or .laz"
    assert reasons(place) == {"june": told}
    put(clouds["laz 1.4"], place / "june" / "a.laz")
    assert found(place)[0].passed == (told.removeprefix(f"{place / 'june'}{os.sep}"),)
    if name != "may":
        put(clouds["laz 1.4"], place / name)
        assert name in reasons(place)


@POSIX
def test_a_tile_that_is_no_file_is_not_passed_over(clouds, place):
    """Of a disk that isn't there, say."""
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    (place / "may" / "b.laz").symlink_to("/nowhere/b.laz")
    assert reasons(place) == {"may": f"{place / 'may' / 'b.laz'}: can't be read: it is no file"}


@pytest.mark.parametrize("name", ["p.dxf", "p.gdb"])
def test_polygons_in_another_form_are_told_where_there_are_none(clouds, place, name):
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    (place / "may" / name).mkdir()
    assert found(place)[0].passed == (f"{name} can't be read: if it holds the parcels, save them as GeoPackage",)
    polygons(place / "may" / "p.gpkg")
    assert found(place)[0].passed == ()


def test_clouds_in_deeper_folders_are_told(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "lidars" / "terra" / "a.laz", place / "may" / ".trash" / "b.laz")
    assert "its clouds lie in lidars/terra: move them up, or say 'cloud: lidars/terra'" in reasons(place)["may"]
    (place / "may" / "survey.yaml").write_text("cloud: lidars/terra\n")
    assert found(place)[0].config.cloud == place / "may" / "lidars" / "terra"
    put(clouds["laz 1.4"], place / "june" / "a.laz", place / "june" / "old" / "b.laz")
    assert found(place)[0].passed == ("old holds clouds, too: move them up",)


@pytest.mark.parametrize("name", ["p.kml", "p.kmz", "p.zip", "p.geojson", "p.json", "p.SHP", "p.fgb", "p.gml"])
def test_polygons_of_any_kind_are_a_surveys(clouds, place, name):
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    path = place / "may" / name
    if name == "p.zip":
        with zipfile.ZipFile(path, "w") as packed:
            packed.writestr("fields/p.shp", "")
    else:
        path.write_text('{"type": "FeatureCollection"}')
    (place / "may" / "report.json").write_text('{"points": 5}')
    (arrival,) = found(place)
    assert (arrival.config.boundaries, arrival.passed) == (path, ())


def test_hidden_files_of_a_survey_are_left_out(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz", place / "may" / "._a.laz", place / "may" / ".b.laz.x7Yz")
    polygons(place / "may" / "parcels.gpkg")
    polygons(place / "may" / "x.gpkg").rename(place / "may" / ".parcels.gpkg")
    assert [arrival.reason for arrival in found(place)] == [""]


def test_several_clouds_are_one(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz", place / "may" / "a_copy.las")
    laspy.read(clouds["las 1.4"])[:1000].write(place / "may" / "b.las")
    assert found(place)[0].config.cloud == [place / "may" / "a.laz", place / "may" / "b.las"]
    (place / "may" / "survey.yaml").write_text("cloud: a.laz\n")
    assert found(place)[0].config.cloud == place / "may" / "a.laz"
    (place / "may" / "survey.yaml").write_text("cloud: [b.las, a.laz]\n")
    assert found(place)[0].config.cloud == [place / "may" / "b.las", place / "may" / "a.laz"]
    os.truncate(place / "may" / "a.laz", 5000)
    assert "ends before its table of chunks" in found(place)[0].reason


@pytest.mark.parametrize("folder", ["", "june"])
def test_a_cloud_in_two_formats_is_one(clouds, place, folder):
    put(clouds["laz 1.4"], place / folder / "june.laz", place / folder / "june.copc.laz")
    put(clouds["las 1.4"], place / folder / "june.las")
    assert found(place)[0].config.cloud == place / folder / "june.copc.laz"
    laspy.read(clouds["las 1.4"])[:1000].write(place / folder / "june.las")
    (arrival,) = found(place)
    assert "hold another number of points: keep the one that is right" in arrival.reason


def test_several_files_of_polygons(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    polygons(place / "may" / "north.gpkg")
    polygons(place / "may" / "south.geojson")
    said = f"{place / 'may'}: holds 2 files of polygons: name one in its survey.yaml, as 'boundaries: FILE'"
    assert reasons(place) == {"may": said}
    polygons(place / "may" / "Parcels.gpkg")
    assert found(place)[0].config.boundaries == place / "may" / "Parcels.gpkg"
    polygons(place / "may" / "boundary.shp")
    assert "holds 2 files" in reasons(place)["may"]
    (place / "may" / "survey.yaml").write_text("boundaries: south.geojson\n")
    assert found(place)[0].config.boundaries == place / "may" / "south.geojson"


def test_known_rows_are_no_polygons(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    polygons(place / "may" / "north.gpkg")
    polygons(place / "may" / "Rows.gpkg")
    config = found(place)[0].config
    assert (config.boundaries, config.rows) == (place / "may" / "north.gpkg", place / "may" / "Rows.gpkg")
    (place / "may" / "Rows.gpkg").rename(place / "may" / "plan.gpkg")
    assert "holds 2 files of polygons" in reasons(place)["may"]
    (place / "may" / "survey.yaml").write_text("rows: plan.gpkg\nrows_crs: EPSG:3003\nsettings: {rows: {ends: keep}}\n")
    config = found(place)[0].config
    assert (config.boundaries, config.rows) == (place / "may" / "north.gpkg", place / "may" / "plan.gpkg")
    assert (config.rows_crs, config.settings.rows.ends) == ("EPSG:3003", "keep")
    (place / "may" / "survey.yaml").write_text("rows: none.gpkg\nboundaries: north.gpkg\n")
    assert "none.gpkg: no such file" in reasons(place)["may"]


def test_two_of_one_name(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz", place / "may.laz", place / "june.laz")
    first = {arrival.name: arrival for arrival in found(place)}
    assert first["may"].config.cloud == place / "may" / "a.laz"
    assert first["may.laz"].reason == f"{place / 'may.laz'} has the name of {place / 'may'}: give it another"
    assert first["june"].config.cloud == place / "june.laz"
    assert len(first) == 3


def test_an_empty_folder_takes_no_name(clouds, place):
    (place / "may").mkdir()
    put(clouds["laz 1.4"], place / "may.laz")
    (arrival,) = found(place)
    assert arrival.config.cloud == place / "may.laz"


@POSIX
def test_names_composed_and_not_are_the_same(clouds, place):
    put(clouds["laz 1.4"], place / "Àlba.laz", place / "A\u0300lba.laz")
    if len(list(place.iterdir())) == 1:
        pytest.skip("the disk takes them for the same")
    assert sorted(bool(arrival.config) for arrival in found(place)) == [False, True]


@POSIX
@pytest.mark.parametrize("name", ["-may", "may ", "con", "a:b", "a\nb", "x" * 65, "葡" * 60, b"Nebbiolo \xe0"])
def test_names_that_files_of_products_cannot_have(clouds, place, name):
    put(clouds["laz 1.4"], place / (os.fsdecode(name) + ".laz"), place / os.fsdecode(name) / "a.laz", place / "may.laz")
    bad, worse, good = sorted(found(place), key=lambda arrival: bool(arrival.config))
    assert good.name == "may"
    for arrival in (bad, worse):
        assert "can't name a file" in arrival.reason
        assert not arrival.waits
        assert f"{arrival.name} {arrival.reason}".encode()


@POSIX
@pytest.mark.parametrize("kind", ["cloud", "polygons"])
def test_names_that_are_no_unicode_within_a_survey(clouds, place, kind):
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    polygons(place / "may" / "parcels.gpkg")
    path = place / "may" / ("a.laz" if kind == "cloud" else "parcels.gpkg")
    path.rename(path.with_name(os.fsdecode(b"Nebbiolo \xe0") + path.suffix))
    (arrival,) = found(place)
    assert not arrival.config
    assert "rename it" in arrival.reason
    assert arrival.reason.encode()


@POSIX
def test_links(clouds, place):
    put(clouds["laz 1.4"], place.parent / "disk" / "a.laz")
    (place / "may.laz").symlink_to(place.parent / "disk" / "a.laz")
    (place / "june").symlink_to(place.parent / "disk")
    (place / "gone.laz").symlink_to("nowhere")
    (place / "loop.laz").symlink_to("loop.laz")
    os.mkfifo(place / "pipe.laz")
    surveys = {arrival.name: arrival for arrival in found(place)}
    assert surveys["may"].config.cloud == place / "may.laz"
    assert surveys["june"].config.cloud == place / "june" / "a.laz"
    for name in ("gone.laz", "loop.laz", "pipe.laz"):
        assert surveys[name].config is None
        assert "can't be read" in surveys[name].reason


@pytest.mark.parametrize("what", ["folder", "cloud"])
def test_no_permission(clouds, place, monkeypatch, what):
    """That of one survey costs no other."""
    put(clouds["laz 1.4"], place / "may" / "a.laz", place / "june.laz")
    (method, denied) = ("iterdir", place / "may") if what == "folder" else ("open", place / "may" / "a.laz")
    original = getattr(Path, method)

    def guarded(path, *words, **options):
        if path == denied:
            raise PermissionError(13, "Permission denied")
        return original(path, *words, **options)

    monkeypatch.setattr(Path, method, guarded)
    june, may = found(place)
    assert june.config
    assert may.config is None
    assert may.reason == f"{place / 'may'}: can't be read (Permission denied)"


def test_a_cloud_that_vanishes_meanwhile(clouds, place, monkeypatch):
    put(clouds["laz 1.4"], place / "may.laz", place / "june.laz")
    monkeypatch.setattr(estate, "unfinished", lambda cloud: (_ for _ in ()).throw(FileNotFoundError(2, "gone")))
    assert [arrival.config for arrival in found(place)] == [None, None]


def test_an_empty_estate_and_none(place):
    assert found(place) == []
    with pytest.raises(InputError, match=r"none: can't be read \(No such file or directory\)"):
        found(place / "none")
    (place / "file").touch()
    with pytest.raises(InputError, match=r"file: can't be read \(Not a directory\)"):
        found(place / "file")


def test_what_is_found_can_be_read(clouds, place):
    put(clouds["laz 1.4"], place / "may.laz")
    (arrival,) = found(place, crs="EPSG:32632")
    assert read_cloud(arrival.config.cloud, crs=laspy_crs()).size == 2000


def laspy_crs():
    from vinemap.geo.crs import parse_crs

    return parse_crs("EPSG:32632")
