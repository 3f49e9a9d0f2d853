"""Surveys are told from uploads: they wait until they stay as they are."""

import os

import pytest
from arriving import NOW, found, polygons, put

from vinemap.jobs import estate


def test_a_survey_waits_for_the_last_of_its_files(clouds, place):
    put(clouds["laz 1.4"], place / "may" / "a.laz", place / "may" / "b.laz.part")
    assert found(place)[0].waits


def test_polygons_wait_for_their_cloud(place):
    (place / "may").mkdir()
    polygons(place / "may" / "parcels.gpkg")
    (arrival,) = found(place)
    assert arrival.waits
    assert arrival.reason == f"{place / 'may'}: holds polygons, but no cloud: put LAS or LAZ there"


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


@pytest.mark.parametrize(("ahead", "waits"), [(1, True), (60, True), (3600, True), (2 * estate.LATE, False)])
def test_an_upload_to_a_disk_whose_clock_is_ahead(clouds, place, ahead, waits):
    """All times of its files are ahead, so that they wait until these are past, but for what never would be."""
    path = place / "may.laz"
    put(clouds["laz 1.4"], path)
    (arrival,) = found(place, now=path.stat().st_mtime - ahead)
    assert arrival.waits is waits
    assert bool(arrival.config) is not waits


def test_a_time_that_is_hardly_ahead_may_be_of_an_upload(clouds, place):
    path = place / "may.laz"
    put(clouds["laz 1.4"], path)
    os.utime(path, (NOW + 60, NOW + 60))
    assert found(place)[0].reason == "changed 0 s ago, waits until 300 s"
    assert found(place, settle=0)[0].config


@pytest.mark.parametrize("ahead", [3600, 1e9])
def test_a_camera_whose_clock_was_ahead_holds_nothing_up(clouds, place, ahead):
    """A file of the future can't be waited for, but may still be unfinished."""
    path, part = place / "may.laz", place / "june.laz.part"
    put(clouds["laz 1.4"], path, part)
    for file in (path, part):
        os.utime(file, (NOW + ahead, NOW + ahead))
    assert found(place)[1].config
    os.truncate(path, 5000)
    os.utime(path, (NOW + ahead, NOW + ahead))
    assert [arrival.waits for arrival in found(place)] == [True, True]
    assert [arrival.waits for arrival in found(place, now=NOW + 2 * estate.LATE)] == [False, False]
