"""Surveys that arrive in a folder: found, told from uploads, and one's fault costing no other."""

import os
import shutil
import time
import zipfile
from pathlib import Path

import geopandas as gpd
import laspy
import pytest
import shapely
from systems import POSIX

from vinemap.cloud.las import read_cloud
from vinemap.config.surveys import EstateConfig, load_estate
from vinemap.errors import InputError
from vinemap.jobs import estate
from vinemap.jobs.estate import arrivals

NOW = time.time() + 3600
"""When files that were just written are long settled."""


@pytest.fixture
def place(tmp_path):
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


def found(place, *, now=NOW, **options):
    return list(arrivals(EstateConfig(surveys=place, **options), now=now))


def reasons(place, **options):
    """What is said of surveys that can't be worked."""
    return {arrival.name: arrival.reason for arrival in found(place, **options)}


def put(cloud, *places):
    for place in places:
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(cloud, place)


def polygons(path):
    gpd.GeoDataFrame({"name": ["A"]}, geometry=[shapely.box(7, 44, 7.1, 44.1)], crs=4326).to_file(path)
    return path


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
        ("may.e57", "save it as LAS or LAZ"),
        ("may.PLY", "save it as LAS or LAZ"),
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


def test_a_survey_waits_for_the_last_of_its_files(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz", place / "may" / "b.laz.part")
    assert found(place)[0].waits


def test_polygons_wait_for_their_cloud(place):
    (place / "may").mkdir()
    polygons(place / "may" / "parcels.gpkg")
    (arrival,) = found(place)
    assert arrival.waits
    assert arrival.reason == f"{place / 'may'}: holds polygons, but no cloud: put LAS or LAZ there"


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


def test_an_upload_waits_until_it_stays_as_it_is(clouds, place):
    path = place / "may.laz"
    put(clouds["laz 1.4"], path)
    changed = path.stat().st_mtime
    for age, waits in ((0, True), (1, True), (299, True), (301, False), (1e6, False)):
        (arrival,) = found(place, now=changed + age)
        assert arrival.waits is waits, age
        assert bool(arrival.config) is not waits
    (arrival,) = found(place, now=changed + 20)
    assert arrival.reason == "changed 20 s ago, waits until 300 s"
    (arrival,) = found(place, now=changed + 20, settle=10)
    assert arrival.config
    (arrival,) = found(place, now=changed, settle=0)
    assert arrival.config


@pytest.mark.parametrize("young", ["a.laz", "parcels.gpkg", "survey.yaml"])
def test_every_file_of_a_survey_must_stay_as_it_is(clouds, place, young):
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    polygons(place / "may" / "parcels.gpkg")
    (place / "may" / "survey.yaml").write_text("crs: EPSG:32632\n")
    for path in (place / "may").iterdir():
        os.utime(path, (NOW - 1000, NOW - 1000))
    assert found(place)[0].config
    os.utime(place / "may" / young, (NOW - 10, NOW - 10))
    (arrival,) = found(place)
    assert arrival.waits
    assert arrival.reason == "changed 10 s ago, waits until 300 s"


def test_an_upload_that_pauses_waits_for_a_day(clouds, place):
    path = place / "may.laz"
    put(clouds["laz 1.4"], path)
    os.truncate(path, 5000)
    os.utime(path, (NOW - 1000, NOW - 1000))
    (arrival,) = found(place)
    assert (arrival.config, arrival.waits) == (None, True)
    assert arrival.reason == f"{path}: ends before its table of chunks: is its upload over?"
    os.utime(path, (NOW - estate.LATE - 1, NOW - estate.LATE - 1))
    assert not found(place)[0].waits


def test_a_clock_that_is_ahead_holds_nothing_up(clouds, place):
    """A file of the future can't be waited for, but may still be unfinished."""
    path = place / "may.laz"
    put(clouds["laz 1.4"], path)
    os.utime(path, (NOW + 1e6, NOW + 1e6))
    assert found(place)[0].config
    os.truncate(path, 5000)
    os.utime(path, (NOW + 1e6, NOW + 1e6))
    assert found(place)[0].waits


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


def test_its_own_file(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz", place / "may" / "raw" / "b.laz")
    polygons(place / "drawn.gpkg")
    own = "survey: other\ncloud: raw/b.laz\nboundaries: ../drawn.gpkg\nsettings: {polygon: {c: 9}}\njob: {limit: 60}\n"
    (place / "may" / "survey.yaml").write_text(own)
    (arrival,) = found(place)
    assert arrival.config.survey == arrival.name == "may"
    assert arrival.config.cloud.samefile(place / "may" / "raw" / "b.laz")
    assert arrival.config.boundaries.samefile(place / "drawn.gpkg")
    assert (arrival.config.settings.polygon.c, arrival.config.job.limit) == (9, 60)
    (place / "may" / "survey.yaml").write_text(f"cloud: {place / 'may' / 'raw' / 'b.laz'}\n")
    assert found(place)[0].config.cloud == place / "may" / "raw" / "b.laz"


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ("cluod: a.laz", "unknown key cluod: did you mean 'cloud'?"),
        ("settle: 5", "unknown key settle"),
        ("cloud: b.laz", "b.laz: no such file"),
        ("cloud: ../..", "holds no LAS, LAZ or COPC file"),
        ("cloud: [a.laz, b.laz]", "b.laz: no such file"),
        ("cloud: []", "holds no cloud"),
        ('cloud: "a\\0b.laz"', "no such file"),
        ("cloud: " + "x" * 300, ""),
        ("boundaries: b.gpkg", "b.gpkg: no such file"),
        ("- cloud", "holds no keys"),
        ("just words", "holds no keys"),
        ("a: [", "no valid YAML"),
        (b"\xff\xfe\x00", "no valid YAML"),
        (bytes(100), "no valid YAML"),
        ("[" * 800, "no valid YAML"),
        ("settle: " + "9" * 5000, ""),
        ("&a {settings: *a, overrides: {A: *a}}", ""),
        ("parcels: 5", "parcels = 5"),
        ("parcels: [5]", "put it in quotes"),
        ("overrides: 5", "overrides = 5"),
        ("settings: {polygon: 5}", "settings.polygon = 5"),
    ],
)
def test_its_own_file_is_wrong(clouds, place, own, said):
    """Named, and no other survey's concern."""
    put(clouds["laz 1.4"], place / "may" / "a.laz", place / "june.laz")
    (place / "may" / "survey.yaml").write_bytes(own if isinstance(own, bytes) else own.encode())
    options = {"overrides": {"A": {"origin": [44, 7, 100]}}}
    path = place.parent / "estate.yaml"
    path.write_text(f"surveys: {place}\noverrides: {{A: {{origin: [44, 7, 100]}}}}\n")
    june, may = arrivals(load_estate(path), now=NOW)
    assert june.config.overrides.keys() == options["overrides"].keys()
    assert may.config is None
    assert not may.waits
    assert str(place / "may") in may.reason
    assert said in may.reason
    assert "\n" not in may.reason
    assert len(may.reason) < 1000


def test_a_folder_in_the_place_of_its_own_file(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    (place / "may" / "survey.yaml").mkdir()
    assert found(place)[0].config


def test_its_own_file_alone(place):
    (place / "may").mkdir()
    (place / "may" / "survey.yaml").touch()
    assert reasons(place) == {"may": f"{place / 'may'}: holds no cloud, and its survey.yaml names none"}


def test_what_holds_for_all_surveys(clouds, place):
    put(clouds["laz 1.4"], place / "may.laz", place / "june" / "a.laz", place / "july" / "a.laz")
    polygons(place / "july" / "own.gpkg")
    shared = polygons(place.parent / "shared.gpkg")
    (place / "june" / "survey.yaml").write_text("parcels: [A]\ncrs: EPSG:32633\n")
    path = place.parent / "estate.yaml"
    path.write_text(
        f"surveys: {place}\nboundaries: {shared}\ncrs: EPSG:32632\nsettings: {{polygon: {{c: 9}}}}\n"
        "overrides: {A: {settings: {fit: {smoothing: 5}}}, B: {origin: [44, 7, 100]}}\n"
    )
    july, june, may = (arrival.config for arrival in arrivals(load_estate(path), now=NOW))
    assert july.boundaries == place / "july" / "own.gpkg"
    assert may.boundaries == june.boundaries == shared
    assert (may.crs, june.crs) == ("EPSG:32632", "EPSG:32633")
    assert list(june.overrides) == ["A"]
    assert list(may.overrides) == ["A", "B"]
    own = june.of_parcel("A").settings
    assert (own.polygon.c, own.fit.smoothing) == (9, 5)


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
