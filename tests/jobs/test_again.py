"""Jobs of many parcels with made-up work: what is done again, and what is remembered."""

import json
import os
import shutil

import doubles
import pytest
import shapely
from squares import left, square, write_cloud

from vinemap import paths
from vinemap.cloud.las import read_cloud
from vinemap.errors import OutputError
from vinemap.jobs import survey
from vinemap.jobs.outcomes import CURRENT, DONE, FAILED, check_same
from vinemap.product import recipe
from vinemap.product.seasons.products import GONE, places_of


def test_what_is_done_is_not_done_again(done):
    assert sorted(done.worked) == ["A", "B", "C"]
    outcomes = done.run()
    assert done.worked == []
    assert outcomes["A"] == survey.Outcome("A", CURRENT, 3, 12.5, 0.0, "made up", key=outcomes["A"].key)
    assert outcomes["A"].line() == "A: up to date: made up"
    assert {one["parcel"]: one["state"] for one in done.record()["parcels"]} == dict.fromkeys("ABC", DONE)
    assert done.states(again=True) == dict.fromkeys("ABC", DONE)
    assert sorted(done.worked) == ["A", "B", "C"]


def test_points_go_to_their_parcels(done):
    points = read_cloud(done.cloud).xyz
    for k, parcel in enumerate("ABC"):
        inside = shapely.contains_xy(square(k), *points[:, :2].T).sum()
        assert int((done.folder / parcel / "points.txt").read_text()) == inside > 0


CHANGES = {
    "its polygon": (lambda job: job.draw(A=0, B=square(1, grow=0.1), C=2), {}, ["B"]),
    "its settings": (lambda job: None, {"overrides": {"B": {"settings": {"polygon": {"c": 9}}}}}, ["B"]),
    "its origin": (lambda job: None, {"overrides": {"B": {"origin": (44.6, 7.9, 0)}}}, ["B"]),
    "its folder": (lambda job: shutil.rmtree(job.folder / "B"), {}, ["B"]),
    "a file": (lambda job: (job.folder / "B" / "points.txt").unlink(), {}, ["B"]),
    "bytes of a file": (lambda job: os.truncate(job.folder / "B" / "B.gpkg", 0), {}, ["B"]),
    "its record": (lambda job: (job.folder / "B" / "run.json").unlink(), {}, ["B"]),
    "bytes of its record": (lambda job: os.truncate(job.folder / "B" / "run.json", 40), {}, ["B"]),
    "its record for another's": (
        lambda job: shutil.copytree(job.folder / "A", job.folder / "B", dirs_exist_ok=True),
        {},
        ["B"],
    ),
    "its record for rubbish": (lambda job: (job.folder / "B" / "run.json").write_bytes(b"\xff[null"), {}, ["B"]),
    "the cloud": (lambda job: write_cloud(job.cloud, seed=1), {}, ["A", "B", "C"]),
    "all settings": (lambda job: None, {"settings": {"polygon": {"c": 9}}}, ["A", "B", "C"]),
    "the crs": (lambda job: None, {"crs": "EPSG:32632"}, ["A", "B", "C"]),
    "the survey's name": (lambda job: None, {"survey": "june"}, ["A", "B", "C"]),
    "a polygon more": (lambda job: job.draw(A=0, B=1, C=2, D=3), {}, ["D"]),
    "a polygon less": (lambda job: job.draw(A=0, C=2), {}, []),
    "nothing": (lambda job: None, {}, []),
    "the cloud's time": (lambda job: os.utime(job.cloud, (1, 1)), {}, []),
    "the boundaries' time": (lambda job: os.utime(job.boundaries, (1, 1)), {}, []),
    "a note beside": (lambda job: (job.folder / "B" / "note.txt").touch(), {}, []),
    "survey.json": (lambda job: paths.survey_record(job.folder).unlink(), {}, []),
    "the job": (lambda job: None, {"job": {"limit": 99, "workers": 2}}, []),
    "an override that changes nothing": (lambda job: None, {"overrides": {"B": {}}}, []),
}


@pytest.mark.parametrize("what", CHANGES)
def test_what_is_changed_is_done_again(done, what):
    """And only then; after that it is up to date."""
    change, options, expected = CHANGES[what]
    change(done)
    assert done.planned(**options) == expected
    states = done.states(**options)
    assert sorted(done.worked) == expected
    assert {parcel for parcel, state in states.items() if state == DONE} == set(expected)
    assert set(states.values()) <= {DONE, CURRENT} | ({GONE} if what == "a polygon less" else set())
    assert done.planned(**options) == []
    assert recipe.product_in(done.folder / "B")


def test_a_parcel_by_another_name_is_counted_once(done):
    """Its product by the old name stays; somebody who names parcels says nothing of the others."""
    done.draw(A=0, C=2, **{"B Barbera": 1})
    for _ in range(2):
        outcomes = done.run()
        assert {name for name, one in outcomes.items() if one.state == GONE} == {"B"}
        assert outcomes["B"].reason.endswith(f"{done.folder / 'B'} stays, and counts nowhere")
        assert [place.name for place in places_of(done.folder)] == ["A", "B Barbera", "C"]
    assert (done.folder / "B" / "points.txt").is_file()
    assert done.states(parcels=["A"]) == {"A": CURRENT}
    assert [place.name for place in places_of(done.folder)] == ["A", "B Barbera", "C"]
    done.draw(A=0, B=1, C=2)
    assert done.states() == {"A": CURRENT, "B": CURRENT, "C": CURRENT, "B Barbera": GONE}


def test_a_new_version_does_all_again(done, monkeypatch):
    monkeypatch.setattr(recipe, "__version__", "99.0")
    assert done.planned() == ["A", "B", "C"]


def test_a_cloud_that_moved_is_the_same(done):
    done.cloud = done.cloud.rename(done.cloud.with_name("june.las"))
    assert done.planned() == []


def test_a_cloud_does_not_take_the_place_of_another(done, tmp_path):
    """Of the same name, in another folder; one that has changed, was moved, or stands in its folder is the same."""
    moved = tmp_path / "june" / "may.las"
    moved.parent.mkdir()
    shutil.copy(done.cloud, moved)
    check_same(done.folder, [moved])
    os.truncate(moved, 999)
    os.truncate(done.cloud, 999)
    tiles = [tmp_path / "1.las", tmp_path / "2.las"]
    for clouds in ([done.cloud], [done.cloud.with_suffix(".laz")], tiles):
        check_same(done.folder, clouds)
    for clouds in ([moved], tiles[:1], [moved, moved.with_name("more.las")]):
        with pytest.raises(OutputError, match=f"holds the products of {done.cloud}: give another folder with --out"):
            check_same(done.folder, clouds)
    check_same(tmp_path / "new", [moved])


def test_a_parcel_for_which_a_grid_was_lacking_is_tried_again(job):
    job.draw(A=0, lacks=1)
    for _ in range(2):
        assert job.states()["lacks"] == FAILED
        assert "lacks" in job.worked


def test_settings_of_one_parcel_reach_its_work(job):
    overrides = {"B": {"settings": {"polygon": {"c": 9}}}}
    assert job.states(overrides=overrides) == dict.fromkeys("ABC", DONE)
    records = [json.loads((job.folder / parcel / "run.json").read_text()) for parcel in "ABC"]
    assert [record["settings"]["polygon"]["c"] for record in records] == [7, 9, 7]


def test_a_known_failure_is_said_again_but_not_tried(job):
    job.draw(A=0, refuses=1)
    for _ in range(3):
        outcomes = job.run()
        assert outcomes["refuses"].line() == "refuses: failed: no vines here"
        assert not outcomes["refuses"].heals
    assert job.worked == []
    assert job.states(again=True) == {"A": DONE, "refuses": FAILED}
    assert sorted(job.worked) == ["A", "refuses"]
    job.draw(A=0, refuses=square(1, grow=0.1))
    assert job.states() == {"A": CURRENT, "refuses": FAILED}
    assert job.worked == ["refuses"]
    assert (job.folder / "A").is_dir()
    assert not (job.folder / "refuses").exists()


@pytest.mark.parametrize("fault", ["dies", "divides"])
def test_a_failure_that_may_heal_is_tried_again(job, monkeypatch, fault):
    job.draw(**{"A": 0, fault: 1})
    for _ in range(2):
        outcomes = job.run()
        assert outcomes[fault].state == FAILED
        assert outcomes[fault].heals
        assert fault in job.worked
    monkeypatch.setitem(doubles.DEEDS, fault, None)
    assert job.states() == {"A": CURRENT, fault: DONE}
    assert job.states() == {"A": CURRENT, fault: CURRENT}


def test_a_product_outlives_a_failure(done, monkeypatch):
    """The old one stays, but isn't called up to date."""
    monkeypatch.setitem(doubles.DEEDS, "B", doubles.refuse)
    options = {"settings": {"polygon": {"c": 9}}}
    for _ in range(2):
        assert done.states(**options)["B"] == FAILED
        assert (done.folder / "B" / "B.gpkg").read_text() == "B"
    assert done.states() == {"A": DONE, "B": CURRENT, "C": DONE}


def test_a_torn_record_of_the_survey(job):
    """It costs what was known of failures, but neither a product nor a night."""
    job.draw(A=0, refuses=1)
    job.run()
    record = paths.survey_record(job.folder)
    text = record.read_text(encoding="utf-8")
    assert job.planned() == []
    for n in [*range(0, len(text) - 1, 37), len(text) - 1]:
        record.write_text(text[:n], encoding="utf-8")
        assert job.planned() == ["refuses"]
    assert job.states() == {"A": CURRENT, "refuses": FAILED}
    assert job.planned() == []


KNOWN = {"parcel": "A", "state": "failed", "rows": 0, "length": 0, "seconds": 0, "reason": "", "heals": False}
SEEN = {"path": "may.las", "sha256": "0", "stamp": [1, 2, 3, 4], "read": 5.0}
FOREIGN = [
    "",
    "null",
    "[]",
    "5",
    '"parcels"',
    "{}",
    '{"parcels": 5, "sources": 5}',
    '{"parcels": [5], "sources": []}',
    '{"parcels": [{}], "sources": []}',
    '{"parcels": {}, "sources": {"a": 1}}',
    *(json.dumps({"parcels": [KNOWN | change], "sources": []}) for change in ({"parcel": 5}, {"parcel": [1]})),
    *(json.dumps({"parcels": [KNOWN | change], "sources": []}) for change in ({"color": "red"}, {"key": None})),
    *(
        json.dumps({"parcels": [], "sources": [SEEN | change]})
        for change in ({"path": 5}, {"path": "a\0b"}, {"stamp": 5}, {"stamp": ["x"]}, {"read": "now"}, {"sha256": 5})
    ),
    "\udcff\udcfe",
]


@pytest.mark.parametrize("content", FOREIGN)
def test_something_else_in_the_place_of_the_record(done, content):
    paths.survey_record(done.folder).write_text(content, encoding="utf-8", errors="surrogateescape")
    assert done.states(parcels=["A", "B"]) == {"A": CURRENT, "B": CURRENT}
    assert {one["parcel"] for one in done.record()["parcels"]} >= {"A", "B"}


@pytest.mark.parametrize("change", [{"path": 5}, {"stamp": ["x"]}, {"read": "now"}])
def test_a_foreign_word_about_the_very_file(done, change):
    record = done.record()
    record["sources"][0] |= change
    paths.survey_record(done.folder).write_text(json.dumps(record))
    assert done.states() == dict.fromkeys("ABC", CURRENT)


def test_a_folder_in_the_place_of_the_record(job):
    """The products are made; that no record can be is said."""
    paths.survey_record(job.folder).mkdir(parents=True)
    with pytest.raises(OutputError, match="can't be written"):
        job.run()
    assert sorted(path.name for path in job.folder.iterdir() if path.is_dir()) == ["A", "B", "C", "survey.json"]
    assert left(job.folder) == []


def test_a_job_for_some_parcels_forgets_no_other(job):
    job.draw(A=0, refuses=1, C=2)
    job.run()
    assert job.states(parcels=["A"]) == {"A": CURRENT}
    assert [one["parcel"] for one in job.record()["parcels"]] == ["A", "C", "refuses"]
    assert job.planned() == []
    job.draw(A=0, C=2)
    job.run()
    assert [one["parcel"] for one in job.record()["parcels"]] == ["A", "C"]
