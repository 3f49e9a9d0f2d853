"""Jobs of many parcels with made-up work: what is done again, what is remembered, what one's fault costs."""

import contextlib
import io
import json
import os
import shutil
import threading
from datetime import UTC, datetime
from pathlib import Path

import doubles
import geopandas as gpd
import laspy
import numpy as np
import pytest
import shapely
from commands import vinemap
from products import without_workers
from systems import LINUX, POSIX

from vinemap import paths
from vinemap.cloud import las
from vinemap.cloud.las import read_cloud
from vinemap.cloud.pieces import read_piece, split_cloud
from vinemap.cloud.tiles import Collector
from vinemap.compute.processes import descendants
from vinemap.config.surveys import survey_config
from vinemap.errors import BusyError, InputError, OutputError, VinemapError
from vinemap.geo.boundaries import read_parcels
from vinemap.geo.crs import parse_crs
from vinemap.jobs import survey
from vinemap.jobs.plan import CURRENT, DONE, FAILED, OUTSIDE, plan_survey
from vinemap.jobs.survey import map_survey
from vinemap.product import recipe, store

PLACE = np.array([414_700.0, 4_940_700.0])
SIDE = 10.0
"""Metres of a parcel; they stand in a line, the cloud is over all of the first nine."""
CRS = parse_crs("EPSG:32632")


def write_cloud(path, *, seed=0):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = [*PLACE, 0]
    header.creation_date = datetime(2024, 6, 1, tzinfo=UTC)
    header.add_crs(CRS)
    las = laspy.LasData(header)
    las.xyz = np.random.default_rng(seed).uniform([*PLACE, 0], [*(PLACE + [9 * SIDE, SIDE]), 2], (900, 3))
    las.write(path)
    return path


def square(k, *, grow=0.0):
    return shapely.box(*(PLACE + [k * SIDE, 0]), *(PLACE + [(k + 1) * SIDE, SIDE])).buffer(grow)


def write_polygons(path, polygons, *, crs=32632):
    """Polygons by name; a number stands for a square."""
    shapes = [square(shape) if isinstance(shape, int) else shape for shape in polygons.values()]
    path.unlink(missing_ok=True)
    gpd.GeoDataFrame({"name": list(polygons)}, geometry=shapes, crs=crs).to_file(path)
    return path


class Job:
    """A survey with its folder of products, whose parcels are worked by a double."""

    def __init__(self, place):
        self.cloud = write_cloud(place / "may.las")
        self.boundaries = place / "parcels.geojson"
        self.folder = place / "products"
        self.worked = []
        self.draw(A=0, B=1, C=2)

    def draw(self, **polygons):
        self.polygons = polygons
        write_polygons(self.boundaries, polygons)

    def config(self, **options):
        return survey_config(**{"survey": "may", "cloud": self.cloud, "boundaries": self.boundaries} | options)

    def run(self, *, again=False, **options):
        """Outcomes by parcel; what was worked stands in ``worked``."""
        self.worked = []
        found = {outcome.parcel: outcome for outcome in self.outcomes(again=again, **options)}
        assert left(self.folder) == []
        return found

    def outcomes(self, *, again=False, **options):
        return map_survey(self.config(**options), self.folder, again=again, step=self.step)

    def step(self, parcel, function, *args, **kwargs):
        self.worked.append(parcel)
        return function(*args, **kwargs)

    def states(self, **options):
        return {parcel: outcome.state for parcel, outcome in self.run(**options).items()}

    def planned(self, **options):
        return [one.parcel for one in plan_survey(self.config(**options), self.folder).recipes]

    def record(self):
        return json.loads(paths.survey_record(self.folder).read_text(encoding="utf-8"))


def left(folder):
    """What has a temporary name in a folder."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".")] if folder.is_dir() else []


@pytest.fixture
def job(tmp_path, monkeypatch):
    monkeypatch.setattr(survey, "follow", doubles.follow)
    without_workers(monkeypatch)
    return Job(tmp_path)


@pytest.fixture
def done(job):
    """A job that has been done once."""
    assert job.states() == dict.fromkeys("ABC", DONE)
    return job


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
    assert set(states.values()) <= {DONE, CURRENT}
    assert done.planned(**options) == []
    assert recipe.product_in(done.folder / "B")


def test_a_new_version_does_all_again(done, monkeypatch):
    monkeypatch.setattr(recipe, "__version__", "99.0")
    assert done.planned() == ["A", "B", "C"]


def test_a_cloud_that_moved_is_the_same(done):
    done.cloud = done.cloud.rename(done.cloud.with_name("june.las"))
    assert done.planned() == []


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


def test_parcels_that_are_not_in_the_cloud(job):
    job.draw(A=0, B=1, away=50)
    outcomes = job.run()
    assert outcomes["away"].state == OUTSIDE
    assert outcomes["away"].line() == "away: not in the cloud"
    assert job.states() == {"A": CURRENT, "B": CURRENT, "away": OUTSIDE}
    assert job.worked == []
    assert not (job.folder / "away").exists()


def test_one_parcel_that_is_not_in_the_cloud(job, monkeypatch):
    """All others being up to date."""
    monkeypatch.setattr(survey, "follow", needs_points)
    job.draw(A=0, B=1)
    job.run()
    job.draw(A=0, B=1, away=50)
    assert job.states() == {"A": CURRENT, "B": CURRENT, "away": OUTSIDE}


def test_a_parcel_that_somebody_names_must_be_in_the_cloud(job, monkeypatch):
    job.draw(A=0, B=1, away=50)
    monkeypatch.setattr(survey, "follow", needs_points)
    assert job.states()["away"] == OUTSIDE
    outcomes = job.run(parcels=["A", "away"])
    assert outcomes["away"].state == FAILED
    assert "no point lies inside the boundary" in outcomes["away"].reason


def needs_points(one, folder, *, piece=None, **options):
    if piece:
        read_piece(piece, Collector())
    else:
        read_cloud(one.clouds, boundary=one.boundary)
    return doubles.follow(one, folder, piece=piece, **options)


def test_one_parcel_that_is_not_in_the_cloud_alone(job, monkeypatch):
    monkeypatch.setattr(survey, "follow", needs_points)
    job.draw(away=50)
    assert job.states() == {"away": OUTSIDE}
    assert job.states() == {"away": OUTSIDE}
    assert job.worked == []


def test_a_job_for_some_parcels_forgets_no_other(job):
    job.draw(A=0, refuses=1, C=2)
    job.run()
    assert job.states(parcels=["A"]) == {"A": CURRENT}
    assert [one["parcel"] for one in job.record()["parcels"]] == ["A", "C", "refuses"]
    assert job.planned() == []
    job.draw(A=0, C=2)
    job.run()
    assert [one["parcel"] for one in job.record()["parcels"]] == ["A", "C"]


def test_names_that_cannot_name_folders(job):
    odd = {"a/b": "a-b", "CON": "_CON", "x" * 65: "x" * 64, ".hidden": "hidden", "tab here": "tab here"}
    drawn = ["A", "é" * 64, "🍇" * 40, "..", *odd, "a:b"]
    job.draw(**{name: k for k, name in enumerate(drawn)})
    outcomes = job.run()
    bad = {"..": "can't name a file, nor a parcel", "a:b": "its folder would be that of 'a"}
    assert {parcel for parcel, one in outcomes.items() if one.state == DONE} == set(drawn) - set(bad)
    for name, folder in odd.items():
        assert recipe.product_in(job.folder / folder).parcel == name
    for name, reason in bad.items():
        assert outcomes[name].state == FAILED
        assert reason in outcomes[name].reason
        assert outcomes[name].line().count("\n") == 0
    assert {*odd, *bad} <= {one["parcel"] for one in job.record()["parcels"]}
    assert job.states() == {parcel: CURRENT if one.state == DONE else FAILED for parcel, one in outcomes.items()}
    assert job.worked == []


def test_a_file_in_the_place_of_a_product(job):
    job.folder.mkdir()
    (job.folder / "B").write_text("mine")
    outcomes = job.run()
    assert {parcel: one.state for parcel, one in outcomes.items()} == {"A": DONE, "B": FAILED, "C": DONE}
    assert outcomes["B"].reason == f"{job.folder / 'B'}: can't be written (is a file): choose another folder"
    assert (job.folder / "B").read_text() == "mine"
    (job.folder / "B").unlink()
    assert job.states() == {"A": CURRENT, "B": DONE, "C": CURRENT}


@POSIX
@pytest.mark.parametrize("to", ["A", "../elsewhere", "B", "gone"])
def test_a_link_in_the_place_of_a_product(job, to):
    """Neither another parcel's product nor a folder elsewhere is touched."""
    (job.folder.parent / "elsewhere").mkdir()
    job.folder.mkdir()
    (job.folder / "B").symlink_to(to)
    for expected in (DONE, CURRENT):
        assert job.states() == {"A": expected, "B": FAILED, "C": expected}
    assert json.loads((job.folder / "A" / "run.json").read_text())["parcel"] == "A"
    assert list((job.folder.parent / "elsewhere").iterdir()) == []


def test_two_jobs_at_once(job):
    """The second says so, and takes nothing from the first."""
    with contextlib.closing(job.outcomes()) as first:
        one = next(first)
        for _ in range(2):
            with pytest.raises(BusyError, match="another job is at work here"):
                list(job.outcomes())
        assert recipe.product_in(job.folder / one.parcel)
        assert [outcome.state for outcome in first] == [DONE, DONE]
    assert job.states() == dict.fromkeys("ABC", CURRENT)


def test_a_job_beside_another_by_the_command(done):
    words = ["survey", done.cloud, "--boundaries", done.boundaries, "--out", done.folder]
    before = sorted(done.folder.rglob("*"))
    with store.workshop(done.folder):
        command = vinemap(*words, cwd=done.folder.parent)
    assert command.returncode == 2
    assert command.stdout == ""
    assert command.stderr == f"vinemap: {done.folder}: another job is at work here: wait until it is done\n"
    assert sorted(done.folder.rglob("*")) == before


def test_a_job_beside_one_parcels_run(job, monkeypatch):
    """As of `vinemap run` into the same folder, which may last."""
    monkeypatch.setattr(store, "PATIENCE", 0.1)
    job.folder.mkdir()
    with store.product(job.folder / "B"):
        outcomes = {outcome.parcel: outcome for outcome in job.outcomes()}
    assert {parcel: one.state for parcel, one in outcomes.items()} == {"A": DONE, "B": FAILED, "C": DONE}
    assert outcomes["B"].heals
    assert job.states() == {"A": CURRENT, "B": DONE, "C": CURRENT}


def test_who_stops_early_keeps_what_is_done(job):
    outcomes = job.outcomes()
    first = next(outcomes)
    outcomes.close()
    assert left(job.folder) == []
    assert job.states()[first.parcel] == CURRENT


def test_a_cloud_that_vanishes_once_it_was_read(job):
    """As with a disk that is taken away: what was read is worked, and what was found is told."""
    job.step = lambda parcel, function, *args, **kwargs: (
        job.cloud.unlink(missing_ok=True),
        function(*args, **kwargs),
    )[1]
    assert job.states() == dict.fromkeys("ABC", DONE)
    assert len(job.record()["parcels"]) == 3


def test_a_cloud_that_vanishes_while_it_is_read(job, monkeypatch):
    """It isn't wrong for good."""

    def split(clouds, *args, **kwargs):
        pieces = split_cloud(clouds, *args, **kwargs)
        job.cloud.rename(job.cloud.with_name("away"))
        return pieces

    with monkeypatch.context() as patch:
        patch.setattr(survey, "split_cloud", split)
        with pytest.raises(VinemapError):
            job.run()
    job.cloud.with_name("away").rename(job.cloud)
    assert job.states() == dict.fromkeys("ABC", DONE)


def test_a_cloud_that_cannot_be_read_is_known(job):
    """Its parcels fail, once as the job does, then as is known of that very content."""
    whole = job.cloud.read_bytes()
    job.cloud.write_bytes(whole[:5000])
    with pytest.raises(InputError, match=r"may\.las: "):
        job.run()
    assert {one["state"] for one in job.record()["parcels"]} == {FAILED}
    outcomes = job.run()
    assert {one.state for one in outcomes.values()} == {FAILED}
    assert all("may.las: " in one.reason for one in outcomes.values())
    assert job.worked == []
    job.cloud.write_bytes(whole)
    assert job.states() == dict.fromkeys("ABC", DONE)


def test_a_disk_that_fails_while_a_cloud_is_read(job, monkeypatch):
    """It may do better another night."""

    def fail(*words, **options):
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(laspy.LasReader, "chunk_iterator", fail)
        with pytest.raises(VinemapError, match=r"may\.las: .*Input/output error"):
            job.run()
    assert job.states() == dict.fromkeys("ABC", DONE)


class Failing(io.BytesIO):
    """A file of which a disk gives only the beginning."""

    def readinto(self, buffer):
        if self.tell() > 1000:
            raise OSError(5, "Input/output error")
        return super().readinto(buffer)


@pytest.mark.parametrize("backend", ["Lazrs", "LazrsParallel"])
def test_a_disk_that_fails_while_laz_is_read(job, tmp_path, backend):
    laspy.read(job.cloud).write(tmp_path / "may.laz")
    stream = Failing((tmp_path / "may.laz").read_bytes())
    with laspy.open(stream, laz_backend=getattr(laspy.LazBackend, backend)) as reader:
        chunks = las._usable_chunks(reader, tmp_path / "may.laz", None)
        with pytest.raises(BusyError, match=r"may\.laz: can't be read now"):
            list(chunks)


def test_no_scheduler_is_no_fault_of_the_parcels(job, monkeypatch):
    """When it is back, they are worked."""
    from vinemap.jobs import dask as dask_engine

    monkeypatch.setattr(dask_engine, "PATIENCE", 0.2)

    def unreachable(plan, config):
        return dask_engine.DaskWorkers("tcp://127.0.0.1:9")

    with monkeypatch.context() as patch:
        patch.setattr(survey, "_engine", unreachable)
        with pytest.raises(VinemapError, match=r"127\.0\.0\.1:9"):
            job.run()
    assert job.states() == dict.fromkeys("ABC", DONE)


def test_no_room_for_the_points(job, monkeypatch):
    def full(path, *words, **options):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "touch", full)
        with pytest.raises(OutputError, match="No space left on device"):
            job.run()
    assert left(job.folder) == []
    assert job.states() == dict.fromkeys("ABC", DONE)


def test_polygons_that_cannot_be_brought_to_the_cloud(job, tmp_path):
    """One that lies nowhere on earth costs no other, nor are they mistaken for each other."""
    shapes = gpd.GeoSeries([square(k) for k in range(3)], crs=32632).to_crs(4326)
    nowhere = shapely.box(7.9, 95, 7.91, 95.01)
    polygons = dict(zip("AxBC", [shapes[0], nowhere, shapes[1], shapes[2]], strict=True))
    write_polygons(job.boundaries, polygons, crs=4326)
    outcomes = job.run()
    assert {parcel: one.state for parcel, one in outcomes.items()} == {"A": DONE, "x": FAILED, "B": DONE, "C": DONE}
    assert "save it with its CRS" in outcomes["x"].reason
    points = read_cloud(job.cloud).xyz
    for k, parcel in enumerate("ABC"):
        inside = shapely.contains_xy(square(k), *points[:, :2].T).sum()
        assert int((job.folder / parcel / "points.txt").read_text()) == pytest.approx(inside, abs=1)
    boundaries = [read_parcels(job.boundaries)["x"].boundary] * 2
    assert [type(piece) for piece in split_cloud(job.cloud, boundaries, tmp_path)] == [InputError, InputError]


def test_polygons_without_a_place_on_earth(job):
    """As QGIS saves them where nobody chose a CRS."""
    local = 'LOCAL_CS["Undefined Cartesian SRS",UNIT["metre",1],AXIS["X",EAST],AXIS["Y",NORTH]]'
    job.boundaries = job.boundaries.with_suffix(".gpkg")
    write_polygons(job.boundaries, {"A": 0, "B": 1}, crs=local)
    outcomes = job.run()
    assert {one.state for one in outcomes.values()} == {FAILED}
    assert all("Undefined Cartesian SRS can't be brought to" in one.reason for one in outcomes.values())
    with pytest.raises(InputError, match="check their CRS"):
        read_cloud(job.cloud, boundary=read_parcels(job.boundaries)["A"].boundary)


def test_a_single_polygon_and_none(job):
    """A survey that nobody drew is one parcel of its own name."""
    job.draw(A=0)
    assert job.states() == {"A": DONE}
    job.boundaries.unlink()
    assert job.states(boundaries=None) == {"may": DONE}
    assert job.states(boundaries=None) == {"may": CURRENT}
    with pytest.raises(InputError, match=r"parcels\.geojson: no such file"):
        job.run()


FAULTS = {
    "aborts": "its process died (SIGABRT)",
    "crashes": "its process died (SIGSEGV, a segmentation fault)",
    "divides": "a fault of vinemap's own (ZeroDivisionError: division by zero, doubles.py line ",
    "gorges": "not enough memory",
    "hangs": "took longer than 12 s",
    "kills": "its process died (SIGKILL, killed by the system, perhaps for want of memory)",
    "leaves": "a fault of vinemap's own (SystemExit: 7, ",
    "refuses": "no vines here",
}


@LINUX
def test_each_fault_is_one_parcels_own(tmp_path, monkeypatch):
    """In processes of their own, two at a time, among parcels that go well."""
    monkeypatch.setattr(survey, "follow", doubles.follow)
    job = Job(tmp_path)
    good = [f"good {k}" for k in range(4)]
    job.draw(**{name: k for k, name in enumerate([*FAULTS])} | dict.fromkeys(good, 8))
    before = len(descendants(os.getpid())), threading.active_count()
    outcomes = job.run(job={"limit": 12, "memory": 1, "workers": 2})
    assert {parcel for parcel, one in outcomes.items() if one.state == DONE} == set(good)
    for name, reason in FAULTS.items():
        assert outcomes[name].reason.startswith(reason), name
        assert outcomes[name].heals == (name != "refuses")
        assert not (job.folder / name).exists()
    assert outcomes["hangs"].seconds == pytest.approx(12, abs=2)
    assert (len(descendants(os.getpid())), threading.active_count()) == before
    assert sorted(path.name for path in job.folder.iterdir() if path.is_dir()) == good
    assert job.planned() == [name for name in FAULTS if name != "refuses"]
