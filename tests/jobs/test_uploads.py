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


def test_a_clock_that_is_ahead_holds_nothing_up(clouds, place):
    """A file of the future can't be waited for, but may still be unfinished."""
    path = place / "may.laz"
    put(clouds["laz 1.4"], path)
    os.utime(path, (NOW + 1e6, NOW + 1e6))
    assert found(place)[0].config
    os.truncate(path, 5000)
    os.utime(path, (NOW + 1e6, NOW + 1e6))
    assert found(place)[0].waits
