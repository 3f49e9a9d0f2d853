"""Many parcels in one job: what each would be alone, and what one's fault costs the others."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import geopandas as gpd
import numpy as np
import pytest
import shapely
from commands import assert_refused, vinemap
from products import SURVEYS, content, many, map_here, tree
from systems import POSIX

from vinemap import paths
from vinemap.cloud.las import read_cloud
from vinemap.cloud.pieces import read_piece, split_cloud
from vinemap.cloud.tiles import Collector
from vinemap.config.surveys import survey_config
from vinemap.errors import InputError, OutputError, WorkerError
from vinemap.geo.boundaries import read_boundary
from vinemap.jobs.outcomes import CURRENT, DONE, FAILED, LEFT
from vinemap.jobs.plan import plan_survey
from vinemap.jobs.survey import map_survey
from vinemap.parcel import map_parcel
from vinemap.product.recipe import product_in

KILLS = int(os.environ.get("VINEMAP_KILLS", "2"))
"""Instants at which a job is killed."""
VINEMAP = [sys.executable, "-m", "vinemap"]


@pytest.fixture(scope="module")
def cloud(three):
    return three


@pytest.fixture(scope="module")
def boundaries(cloud):
    return cloud.with_name("more.gpkg")


@pytest.fixture(scope="module")
def mapped(cloud, boundaries, tmp_path_factory):
    """Outcomes of a job with a parcel that isn't there and one without points, and the folder of its products."""
    folder = tmp_path_factory.mktemp("job") / "products"
    parcels = ["nobody's", "A", "B", "C", "inner A", "empty"]
    outcomes = list(job(cloud, folder, parcels=parcels, boundaries=boundaries))
    return {outcome.parcel: outcome for outcome in outcomes}, folder


def configured(cloud, boundaries, **options):
    return survey_config(survey="three", cloud=cloud, boundaries=boundaries, **options)


def job(cloud, folder, *, boundaries, **options):
    return map_survey(configured(cloud, boundaries, **options), folder)


@pytest.mark.parametrize("parcel", ["A", "B", "C", "inner A"])
def test_products_are_those_of_parcels_mapped_alone(mapped, cloud, boundaries, tmp_path, parcel):
    outcomes, folder = mapped
    alone = tmp_path / parcel
    summary = map_parcel(cloud, alone, parcel=parcel, boundary=boundaries)
    found = outcomes[parcel]
    assert (found.state, found.rows, found.length) == (DONE, summary.rows, summary.length)
    assert found.rows > 0
    names = sorted(path.name for path in alone.iterdir())
    assert sorted(path.name for path in (folder / parcel).iterdir()) == names
    for name in names:
        # The survey is named in the others.
        if name not in (paths.RUN, f"{parcel}_stac.json", f"{parcel}_report.html"):
            assert content(folder / parcel / name) == content(alone / name), name
    records = [json.loads(paths.run_record(place).read_text()) for place in (folder / parcel, alone)]
    for record in records:
        assert record.pop("created")
        assert len(record.pop("key")) == 64
        assert record.pop("survey") in ("three", None)
        assert record["files"].pop(f"{parcel}_stac.json") > 500
        assert record["files"].pop(f"{parcel}_report.html") > 500_000
        assert record.pop("seconds")["All"] > 0
    assert records[0] == records[1]


def test_what_is_wrong_with_a_parcel_is_its_own(mapped, boundaries):
    outcomes, folder = mapped
    assert set(outcomes) == {"nobody's", "A", "B", "C", "inner A", "empty"}
    assert outcomes["nobody's"].state == FAILED
    assert f'{boundaries}: none of its 5 polygons has "nobody\'s" in a column' in outcomes["nobody's"].line()
    assert outcomes["empty"].line().startswith("empty: failed: ")
    assert "three.laz: no point lies inside the boundary" in outcomes["empty"].reason
    assert sorted(path.name for path in folder.iterdir()) == ["A", "B", "C", *SURVEYS[:2], "inner A", *SURVEYS[2:]]
    assert [path.name for path in folder.parent.iterdir()] == ["products"]


def test_known_vines_are_their_parcels(three, cloud, tmp_path):
    polygons = gpd.read_file(cloud.with_name("parcels.gpkg"))
    at = polygons.set_index("name").representative_point()
    points = gpd.GeoSeries([at["A"], at["B"], at["B"], shapely.Point(0, 0)], crs=polygons.crs)
    points.to_crs(4326).to_file(tmp_path / "v.geojson")
    how = {"survey": "three", "cloud": cloud, "boundaries": cloud.with_name("parcels.gpkg")}
    plan = plan_survey(survey_config(**how, vines=tmp_path / "v.geojson"), tmp_path / "products")
    assert {recipe.parcel: len(recipe.vines) for recipe in plan.recipes} == {"A": 1, "B": 1, "C": 0}
    (left,) = plan.settled
    assert (left.state, left.reason) == (LEFT, "v.geojson: 1 of 3 known vines stand in no parcel")
    without = plan_survey(survey_config(**how), tmp_path / "products").recipes
    same = [one.parcel for one, other in zip(plan.recipes, without, strict=True) if one.key == other.key]
    assert same == ["C"]


def test_known_rows_are_their_parcels(three, cloud, tmp_path):
    """Where none is known, rows are sought; what lies in no parcel is told."""
    true = gpd.read_file(three.with_name("truth.gpkg"), layer="rows")
    known = true[true["parcel"] != "C"][["row", "geometry"]].to_crs(4326)
    known.to_file(tmp_path / "rows.gpkg", layer="rows")
    how = {"survey": "three", "cloud": cloud, "rows": tmp_path / "rows.gpkg"}
    boundaries = cloud.with_name("parcels.gpkg")
    plan = plan_survey(survey_config(**how, boundaries=boundaries), tmp_path / "products")
    rows = {recipe.parcel: recipe.known and recipe.known.lines["label"].tolist() for recipe in plan.recipes}
    assert rows == {"A": [f"{k} A" for k in range(1, 5)], "B": [f"{k} B" for k in range(1, 5)], "C": None}
    assert plan.settled == []
    assert plan.sources[-1].path == tmp_path / "rows.gpkg"
    some = gpd.read_file(boundaries)
    some[some["name"] != "B"].to_file(tmp_path / "some.gpkg")
    plan = plan_survey(survey_config(**how, boundaries=tmp_path / "some.gpkg"), tmp_path / "products")
    (left,) = plan.settled
    assert (left.state, left.reason) == (LEFT, "rows.gpkg: 4 of 8 known rows lie in no parcel: 1, 2, 3, 4")
    listed = survey_config(**how, boundaries=tmp_path / "some.gpkg", parcels=["A"])
    assert plan_survey(listed, tmp_path / "products").settled == []


def test_too_short_a_limit_leaves_nothing(cloud, boundaries, tmp_path):
    folder = tmp_path / "new" / "products"
    with pytest.raises(WorkerError, match=r"three\.laz: can't be read: took longer than 0\.02 s"):
        list(job(cloud, folder, parcels=["A", "B"], boundaries=boundaries, job={"limit": 0.01}))
    assert list(tmp_path.iterdir()) == []


def test_earlier_products_outlive_a_failure(cloud, boundaries, tmp_path):
    (tmp_path / "A").mkdir()
    (tmp_path / "A" / "kept.txt").write_text("kept")
    (outcome,) = job(cloud, tmp_path, parcels=["A"], boundaries=boundaries, job={"limit": 0.01})
    assert outcome.line() == "A: failed: took longer than 0.01 s"
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")} == {
        "A",
        "A/kept.txt",
        "index.html",
        "survey.json",
    }


def test_a_cloud_that_cannot_be_read_is_the_whole_jobs_fault(cloud, boundaries, tmp_path):
    cut = tmp_path / "cut.laz"
    cut.write_bytes(cloud.read_bytes()[:200_000])
    for path, reason in ((cut, r"cut\.laz: "), (tmp_path / "none.laz", "no such file")):
        with pytest.raises(InputError, match=reason):
            list(job(path, tmp_path / "new" / "out", parcels=["A", "B"], boundaries=boundaries))
        assert not {path.name for path in tmp_path.rglob("*")} - {"cut.laz", "new", "out", "index.html", "survey.json"}


def test_a_folder_that_cannot_be_written(cloud, boundaries, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=r"file/out: can't be written \(Not a directory\): choose another folder"):
        list(job(cloud, tmp_path / "file" / "out", parcels=["A", "B"], boundaries=boundaries))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_whoever_asks_for_no_more_outcomes_stops_the_job(cloud, boundaries, tmp_path):
    folder = tmp_path / "out"
    outcomes = job(cloud, folder, parcels=["A", "B", "C", "inner A"], boundaries=boundaries, job={"workers": 1})
    first = next(outcomes)
    assert first.state == DONE
    outcomes.close()
    done = sorted(path.name for path in folder.iterdir() if path.is_dir())
    assert first.parcel in done
    assert len(done) < 4
    assert all((folder / name / "run.json").is_file() for name in done)


def test_the_longest_names(cloud, tmp_path):
    """Of two, three and four bytes a letter."""
    parcels = gpd.read_file(cloud.with_name("parcels.gpkg"))
    names = ["é" * 64, "葡" * 53, "🍇" * 40]
    gpd.GeoDataFrame({"name": names}, geometry=parcels.geometry, crs=parcels.crs).to_file(tmp_path / "long.gpkg")
    config = configured(cloud, tmp_path / "long.gpkg", settings={"product": {"classified": True}})
    outcomes = map_here(config, tmp_path / "out")
    assert {outcome.parcel: outcome.state for outcome in outcomes} == dict.fromkeys(names, DONE)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted([*names, *SURVEYS])
    for name in names:
        assert len(gpd.read_file(paths.geopackage(tmp_path / "out" / name, name), layer="rows")) > 0
        assert product_in(tmp_path / "out" / name)
    assert {outcome.state for outcome in map_here(config, tmp_path / "out")} == {CURRENT}


@pytest.mark.parametrize("most", [np.inf, 1000])
def test_pieces_are_what_reading_alone_gives(cloud, boundaries, tmp_path, most):
    names = ["A", "inner A", "B"]
    polygons = [read_boundary(boundaries, parcel=name) for name in names]
    for name, boundary, piece in zip(names, polygons, split_cloud(cloud, polygons, tmp_path), strict=True):
        (tmp_path / name).mkdir()
        found = read_piece(piece, Collector(tmp_path / name, most=most))
        alone = read_cloud(cloud, boundary=boundary)
        parts = np.concatenate([part.xyz for part in found.parts()])
        order = slice(None) if most == np.inf else np.lexsort(parts.T)
        assert np.array_equal(parts[order], alone.xyz if most == np.inf else alone.xyz[np.lexsort(alone.xyz.T)])
        assert (found.crs, found.vertical) == (alone.crs, alone.vertical)


def test_the_command(cloud, boundaries, tmp_path):
    done = vinemap("survey", cloud, "--boundaries", cloud.with_name("parcels.gpkg"), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    folder = tmp_path / "data" / "products" / "three"
    lines = sorted(done.stdout.splitlines())
    assert [line.split(": ")[0] for line in lines] == ["A", "B", "C"]
    assert lines[0].startswith("A: 4 rows, ")
    assert sorted(path.name for path in folder.iterdir()) == ["A", "B", "C", *SURVEYS]
    other = tmp_path / "other" / cloud.name
    other.parent.mkdir()
    other.write_bytes(cloud.read_bytes() + b"more")
    done = vinemap("survey", other, "--boundaries", boundaries, cwd=tmp_path)
    assert_refused(done, f"holds the products of {cloud}: give another folder with --out")
    words = "--boundaries", boundaries, "--parcel", "B", "--parcel", "empty", "--out", "out"
    done = vinemap("survey", cloud, *words, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stdout.startswith("B: 4 rows, ")
    assert done.stdout.count("\n") == done.stderr.count("\n") == 1
    assert done.stderr.startswith("empty: failed: ")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["B", *SURVEYS]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["none.laz", "--boundaries", "{b}"], "none.laz: no such file"),
        (["{c}", "--boundaries", "none.gpkg"], "none.gpkg: no such file"),
        (["{c}", "--boundaries", "{b}", "--parcel", "../A"], "can't name a file"),
        (["{c}", "--boundaries", "{b}", "--limit", "0"], "job.limit = 0.0: input should be greater than 0"),
        (["{c}", "--boundaries", "{b}", "--crs", "EPSG:99"], "EPSG:99"),
        (["{c}"], "--boundaries"),
    ],
)
def test_what_a_user_can_mend(cloud, boundaries, tmp_path, words, reason):
    done = vinemap("survey", *(word.format(b=boundaries, c=cloud) for word in words), cwd=tmp_path)
    assert_refused(done, reason)
    assert list(tmp_path.iterdir()) == []


def children(group):
    """Processes of a group that still run."""
    listed = subprocess.run(["ps", "-eo", "pgid=,stat="], capture_output=True, text=True, check=True).stdout
    return [line for line in listed.splitlines() if line.split()[0] == str(group) and "Z" not in line]


@POSIX
@pytest.mark.parametrize(("number", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_job_that_is_stopped_leaves_nothing(cloud, tmp_path, number, code):
    """Stopped as by Ctrl-C, to all its processes, or by a scheduler, to the first alone, while parcels are worked."""
    many(cloud, tmp_path / "many.gpkg", 20)
    words = [*VINEMAP, "survey", cloud, "--boundaries", "many.gpkg", "--out", "out"]
    with subprocess.Popen(
        words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as job:
        first = job.stdout.readline()
        (os.killpg if number == "SIGINT" else os.kill)(job.pid, getattr(signal, number))
        rest, errors = job.communicate(timeout=60)
    assert job.returncode == code
    assert errors.strip() == ("vinemap: stopped" if number == "SIGINT" else "")
    deadline = time.monotonic() + 10
    while children(job.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert children(job.pid) == []
    done = {path.name for path in (tmp_path / "out").iterdir() if path.is_dir()}
    assert not [path.name for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]
    assert {line.split(":")[0] for line in (first + rest).splitlines()} <= done
    assert len(done) < 30
    assert all((tmp_path / "out" / name / "run.json").is_file() for name in done)


@POSIX
def test_a_job_that_is_killed_loses_nothing(mapped, cloud, boundaries, tmp_path):
    """Killed at any instant while it replaces products: each parcel's is whole, and the next job makes the rest."""
    outcomes, folder = mapped
    map_here(configured(cloud, boundaries, parcels=[*outcomes], settings={"polygon": {"c": 9}}), tmp_path / "old")
    old, new = tree(tmp_path / "old"), tree(folder)
    assert old.keys() == new.keys()
    products = {name.split("/")[0] for name in new if "/" in name}
    assert len(products) == 4
    assert not any(part(old, product) == part(new, product) for product in products)
    out, lasts = tmp_path / "out", sum(outcome.seconds for outcome in outcomes.values()) / 2
    words = [*VINEMAP, "survey", cloud, "--boundaries", boundaries, "--out", out]
    words += [word for parcel in outcomes for word in ("--parcel", parcel)]
    instants = random.Random(1)
    for _ in range(KILLS):
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(tmp_path / "old", out)
        with subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        ) as killed:
            while killed.poll() is None and not any(out.glob(".*/.*.part")):  # until one is in the making
                time.sleep(0.01)
            time.sleep(instants.uniform(0, lasts))
            killed.kill()
        deadline = time.monotonic() + 20
        while children(killed.pid) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert children(killed.pid) == []
        left = tree(out)
        for product in products:
            assert part(left, product) in (part(old, product), part(new, product))
        map_here(configured(cloud, boundaries, parcels=[*outcomes]), out)
        assert tree(out) == new


def part(files, folder):
    return {name: content for name, content in files.items() if name.startswith(f"{folder}/")}


def test_a_fault_in_the_page_hides_no_outcome_nor_error(cloud, boundaries, tmp_path, monkeypatch):
    def faulty(*args):
        raise ZeroDivisionError("of the page")

    monkeypatch.setattr("vinemap.jobs.survey.write_index", faulty)
    said = pytest.warns(RuntimeWarning, match=r"index\.html can't be written: a fault .*of the page")
    with said:
        (outcome,) = job(cloud, tmp_path, boundaries=boundaries, parcels=["nobody's"])
    assert outcome.state == FAILED

    def broken(*args, **options):
        raise InputError("the cloud is broken")
        yield

    monkeypatch.setattr("vinemap.jobs.survey._work", broken)
    with said, pytest.raises(InputError, match="the cloud is broken"):
        list(job(cloud, tmp_path, boundaries=boundaries, parcels=["A"]))
    assert json.loads(paths.survey_record(tmp_path).read_text())["parcels"][0]["state"] == FAILED
