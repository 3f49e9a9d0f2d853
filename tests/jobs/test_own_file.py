"""What a survey's own file says, and the estate's for all."""

from pathlib import Path

import pytest
from arriving import NOW, found, polygons, put, reasons

from vinemap.config.surveys import load_estate
from vinemap.jobs.estate import arrivals


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


def test_its_own_file_names_an_address(clouds, place):
    (place / "may").mkdir()
    put(clouds["laz 1.4"], place / "may" / "raw" / "b.laz")
    (place / "may" / "survey.yaml").write_text("cloud: [https://example.org/may.copc.laz, raw/b.laz]\n")
    (arrival,) = found(place)
    assert arrival.config.cloud == [Path("https://example.org/may.copc.laz"), place / "may" / "raw" / "b.laz"]


def test_its_own_file_names_a_pipeline(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz")
    own = "settings: &own {ground: {engine: pdal, pipeline: mine.json}}\noverrides: {A: {settings: *own}}\n"
    (place / "may" / "survey.yaml").write_text(own)
    config = found(place)[0].config
    assert [config.of_parcel(name).settings.ground.pipeline for name in "AB"] == [place / "may" / "mine.json"] * 2


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ("cluod: a.laz", "unknown key cluod: did you mean 'cloud'?"),
        ("settle: 5", "unknown key settle"),
        ("cloud: b.laz", "b.laz: no such file"),
        ("cloud: ../..", "holds no cloud"),
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
