"""The nightly job: what needs it is mapped once, by whichever night comes first, and on a real schedule."""

import json
import shutil
import subprocess
import sys
import time

import doubles
import laspy
import pytest
from commands import free_of_prefect, here
from place import Place, wait
from products import without_workers
from squares import Job, left

from vinemap import paths
from vinemap.jobs import survey as jobs
from vinemap.jobs.estate import Arrival
from vinemap.jobs.outcomes import CURRENT
from vinemap.product import recipe
from vinemap.simulate.survey import write_survey

NIGHTLY = [sys.executable, "-m", "flows.nightly"]


@pytest.fixture(scope="module")
def survey(vineyard, tmp_path_factory):
    """Folder of a survey of parcel A, as it arrives."""
    folder = tmp_path_factory.mktemp("survey") / "small"
    write_survey(vineyard, folder)
    (folder / "truth.gpkg").unlink()
    return folder


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("home")
    yield folder / "prefect"
    shutil.rmtree(folder, ignore_errors=True)


def estate(folder, **options):
    """Configure an estate in a folder, with files that need not settle."""
    (folder / "in").mkdir()
    (folder / "nightly.yaml").write_text(json.dumps({"surveys": "in", "products": "out", "settle": 0} | options))


def arrive(survey, folder, name):
    """Put a survey in its place under a name, at one stroke."""
    shutil.copytree(survey, folder / f".{name}")
    (folder / f".{name}").rename(folder / name)


def start(folder, home):
    environment = here(free_of_prefect()) | {"PREFECT_HOME": str(home)}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [*NIGHTLY, "nightly.yaml"], cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True
    )


def ended(process):
    said, errors = process.communicate(timeout=300)
    rows = [line.split(maxsplit=5) for line in said.splitlines()[1:]]
    return process.returncode, rows, errors


def test_two_nights_at_once_do_everything_once(survey, home, tmp_path):
    estate(tmp_path)
    names = ["one", "two"]
    for name in names:
        arrive(survey, tmp_path / "in", name)
    nights = [start(tmp_path, home) for _ in range(2)]
    found = [ended(night) for night in nights]
    assert [code for code, _, _ in found] == [0, 0], [errors for _, _, errors in found]
    done = [row[0] for _, rows, _ in found for row in rows if row[4:5] == ["done"]]
    assert sorted(done) == sorted(names)
    others = [row for _, rows, _ in found for row in rows if row[4:5] != ["done"]]
    assert len(others) == 2
    assert all(row[1] == "waits" or row[4:] == ["up", "to date"] for row in others)
    left = {path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob(".*")}
    assert left == set()


def test_a_night_makes_good_what_a_killed_job_has_left(tmp_path, monkeypatch):
    """All parcels were mapped, but the record is that of the job before, there is no page, and raw points lie about."""
    from flows.nightly import _survey

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(jobs, "follow", doubles.follow)
    monkeypatch.setattr(recipe, "SETTLED", -1.0)  # so that nothing has to be read again
    without_workers(monkeypatch)
    job = Job(tmp_path)
    job.run()
    record = paths.survey_record(job.folder)
    record.write_text(record.read_text().replace('"rows": 3', '"rows": 99'))
    paths.index(job.folder).unlink()
    (job.folder / ".pieces-killed").mkdir()
    night = _survey(Arrival("may", job.config()), job.folder)
    assert {one.state for one in night.outcomes} == {CURRENT}
    assert {one["parcel"]: one["rows"] for one in job.record()["parcels"]} == {"A": 3, "B": 3, "C": 3}
    assert paths.index(job.folder).is_file()
    assert left(job.folder) == []


def test_a_night_does_what_can_be_done_and_says_why_the_rest_cannot(survey, home, tmp_path):
    estate(tmp_path, overrides={"A": {"settings": {"polygon": {"c": 9}}}})
    for name in ("good", "cut", "two"):
        arrive(survey, tmp_path / "in", name)
    cut = tmp_path / "in" / "cut" / "small.laz"
    cut.write_bytes(cut.read_bytes()[:-5000])
    las = laspy.read(tmp_path / "in" / "two" / "small.laz")
    (tmp_path / "in" / "two" / "small.laz").unlink()
    for k in range(2):
        las[list(range(k, len(las), 2))].write(tmp_path / "in" / "two" / f"tile {k}.laz")
    (tmp_path / "in" / "two" / "flight.rcp").write_bytes(b"RCP")
    (tmp_path / "in" / "noise.laz").write_bytes(b"no cloud" * 100)
    code, rows, errors = ended(start(tmp_path, home))
    assert code == 1
    assert errors == "vinemap: 1 of 4 surveys failed, or parcels of theirs: noise\n"
    states = {row[0]: " ".join(row[1:]) for row in rows}
    assert "ends before its table of chunks" in states["cut"]
    assert "noise.laz: can't be read as LAS or LAZ" in states["noise"]
    assert states["two"] == "passed over flight.rcp can't be read: save it as LAS or LAZ"
    assert json.loads((tmp_path / "out" / "two" / "A" / "run.json").read_text())["counts"]["rows"] == 6
    record = json.loads((tmp_path / "out" / "good" / "A" / "run.json").read_text())
    assert record["settings"]["polygon"]["c"] == 9
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"good", "noise", "two"}


def test_surveys_that_are_dropped_in_are_mapped_on_schedule(survey, tmp_path):
    """On a real server, seen through its interface."""
    estate(tmp_path)
    place = Place(tmp_path)
    with place.serving("-m", "flows.nightly", "nightly.yaml", "--serve", "--every", "3") as (_, said):
        began = time.time()
        arrive(survey, tmp_path / "in", "new")
        product = tmp_path / "out" / "new" / "A" / "run.json"
        wait(product.is_file)
        assert product.stat().st_mtime > began
        artifacts = wait(lambda: _tables(place, "new"))
        assert {"survey": "new", "parcel": "A", "rows": "6", "state": "done"}.items() <= artifacts[0].items()
        wait(lambda: [run for run in place.runs("COMPLETED") if _worked(place, run, "new")])
        assert place.runs("FAILED") == []
    assert "Completed" in said.read_text()
    shutil.rmtree(tmp_path / "data", ignore_errors=True)


def _tables(place, survey):
    """Rows of a survey that was mapped, in the tables of the nights."""
    tables = place.ask("/artifacts/filter", {"artifacts": {"key": {"any_": ["nightly"]}}})
    rows = [row for table in tables for row in json.loads(table["data"])]
    return [row for row in rows if (row["survey"], row["state"]) == (survey, "done")]


def _worked(place, run, survey):
    """Whether a run has a run of a survey beneath it."""
    below = place.ask("/flow_runs/filter", {"flow_runs": {"name": {"any_": [survey]}}})
    parents = place.ask("/task_runs/filter", {"task_runs": {"flow_run_id": {"any_": [run["id"]]}}})
    return {one["parent_task_run_id"] for one in below} & {task["id"] for task in parents}
