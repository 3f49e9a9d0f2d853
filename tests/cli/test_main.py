"""Commands as a person types them: results, and one line for everything that can be wrong."""

import json
import os
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pytest
import shapely
from click.testing import CliRunner
from commands import assert_refused, vinemap
from squares import write_cloud

from vinemap.cli import doctor
from vinemap.cli.track import track
from vinemap.config.settings import OdometryOptions
from vinemap.stages import STAGES
from vinemap.terminal import progress


def test_run_and_evaluate(tmp_path, survey):
    truth = survey.parent / "truth.gpkg"
    done = vinemap("run", survey, "--boundary", survey.parent / "parcels.gpkg", "--parcel", "A", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.startswith("A: 6 rows, ")
    folder = tmp_path / "data" / "products" / "small" / "A"
    assert (folder / "run.json").is_file()
    done = vinemap("evaluate", folder / "A.gpkg", truth, "--pairs", "new/pairs.gpkg", cwd=tmp_path)
    assert len(gpd.read_file(tmp_path / "new" / "pairs.gpkg", layer="pairs")) == 6
    assert done.returncode == 0
    assert "good 100.0%, extra 0.0%, missed 0.0%" in done.stdout


def test_classified_clouds_and_plain_meshes_on_demand(tmp_path, survey):
    done = vinemap("run", survey, "--out", "usual", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not list((tmp_path / "usual").glob("*.laz"))
    done = vinemap("run", survey, "--out", "asked", "--classified", "--plain", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    las = laspy.read(tmp_path / "asked" / "small_classified.laz")
    assert len(las.points) == len(laspy.read(survey).points)
    assert {1, 2, 5} <= set(np.asarray(las.classification)) <= {1, 2, 5, 7}
    light, plain = ((tmp_path / name / "small_canopy.glb").read_bytes() for name in ("usual", "asked"))
    assert b"KHR_mesh_quantization" in light
    assert b"KHR_mesh_quantization" not in plain
    assert len(light) < 0.7 * len(plain)
    # Sections far apart leave no point out.
    (tmp_path / "far.yaml").write_text("sections: {step: 1.5}\n")
    done = vinemap("run", survey, "--out", "far", "--classified", "--settings", "far.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    far = laspy.read(tmp_path / "far" / "small_classified.laz")
    leaves, others = ((np.asarray(cloud.classification) == 5).sum() for cloud in (las, far))
    assert others > 0.97 * leaves
    record = json.loads((tmp_path / "asked" / "run.json").read_text())
    assert record["settings"]["product"] == {"classified": True, "plain": True, "audit": False, "geoid": None}
    assert "small_classified.laz" in record["files"]
    assert 0 < record["modelling"]["over"] < 0.09


def test_a_cloud_does_not_take_the_place_of_another_unseen(tmp_path):
    """Whose long name begins alike; of one with the same name it is said, as the same survey may come again."""
    long = "Neive, the long hill by the river, flown at sixty metres, processed, "
    for k, cloud in enumerate(("may/cloud.las", "june/cloud.las", f"{long}1.las", f"{long}2.las")):
        (tmp_path / cloud).parent.mkdir(exist_ok=True)
        write_cloud(tmp_path / cloud, seed=k)
    may, june, one = (
        vinemap("run", cloud, cwd=tmp_path) for cloud in ("may/cloud.las", "june/cloud.las", f"{long}1.las")
    )
    assert "replaces" not in may.stdout
    assert june.stdout.endswith("; it replaces that of another cloud.las\n")
    assert one.returncode == 0
    assert_refused(
        vinemap("run", f"{long}2.las", cwd=tmp_path),
        f"holds the product of {long}1.las: give another folder with --out",
    )


def test_a_parcel_does_not_take_the_place_of_another(tmp_path):
    """Whose folder would have the same name, or that was named for both."""
    write_cloud(tmp_path / "a.las")
    for other, options in (("1-2", ()), ("2", ("--out", "out"))):
        first = vinemap("run", "a.las", "--parcel", "1/2", *options, cwd=tmp_path)
        assert first.returncode == 0, first.stderr
        second = vinemap("run", "a.las", "--parcel", other, *options, cwd=tmp_path)
        assert_refused(second, "holds the product of parcel 1/2: give another folder with --out")


def test_settings_and_names_from_the_command_line(tmp_path, survey):
    (tmp_path / "s.yaml").write_text("sections: {step: 1.0}\ncurves: {min_length: 100}\n")
    out = tmp_path / "x" / "y"
    done = vinemap("run", survey, "--settings", "s.yaml", "--out", out, "--origin", "44.6,7.9,250", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "small: no vine row found" in done.stdout
    assert (out / "small.gpkg").is_file()


def test_bad_clouds(tmp_path, survey):
    whole = survey.read_bytes()
    (tmp_path / "cut.laz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.laz").write_text("no cloud")
    for path, word in (("none.laz", "no such file"), ("cut.laz", "cut.laz"), ("text.laz", "text.laz")):
        assert_refused(vinemap("run", path, "--out", "out", cwd=tmp_path), path, word)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.laz", "text.laz"]


def test_no_crs(tmp_path):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    las = laspy.LasData(header)
    las.xyz = np.random.default_rng(0).uniform([1000, 1000, 0], [1020, 1020, 2], (100, 3))
    las.write(tmp_path / "bare.las")
    assert_refused(vinemap("run", "bare.las", cwd=tmp_path), "bare.las", "--crs")
    assert_refused(vinemap("run", "bare.las", "--crs", "EPSG:99", cwd=tmp_path), "EPSG:99")


def test_bad_boundaries(tmp_path, survey):
    away = gpd.GeoDataFrame(geometry=[shapely.box(0, 0, 1, 1)], crs=32632)
    away.to_file(tmp_path / "away.gpkg")
    assert_refused(vinemap("run", survey, "--boundary", "away.gpkg", cwd=tmp_path), "boundary", survey.name)
    assert_refused(vinemap("run", survey, "--boundary", "none.gpkg", cwd=tmp_path), "none.gpkg: no such file")
    assert [p.name for p in tmp_path.iterdir()] == ["away.gpkg"]


@pytest.mark.parametrize("name", ["../F", "a/../b", ""])
def test_parcel_names_with_characters_of_paths(tmp_path, survey, name):
    assert_refused(vinemap("run", survey, "--parcel", name, cwd=tmp_path), "can't name a file")


def test_bad_settings(tmp_path, survey):
    (tmp_path / "s.yaml").write_text("ground: {resolution: 50}\n")
    done = vinemap("run", survey, "--settings", "s.yaml", cwd=tmp_path)
    assert_refused(done, "s.yaml", "ground.resolution = 50", "less than or equal to 2")


def test_folder_that_cannot_be_written(tmp_path, survey):
    (tmp_path / "file").write_text("x")
    assert_refused(vinemap("run", survey, "--out", "file/out", cwd=tmp_path), "file/out", "can't be written")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_wrong_words(tmp_path):
    assert_refused(vinemap("run", "a.laz", "--out", "", cwd=tmp_path), "'--out': its name is empty")
    assert_refused(vinemap("run", cwd=tmp_path), "Missing argument 'CLOUD...'")
    assert_refused(vinemap("run", "a.laz", "--origin", "north", cwd=tmp_path), "latitude, longitude and altitude")
    assert_refused(vinemap("fly", cwd=tmp_path), "fly")


def test_faults_are_one_line_too(tmp_path):
    code = "from vinemap import terminal\nwith terminal.plain_errors():\n    raise ZeroDivisionError('oops')\n"
    environment = {k: v for k, v in os.environ.items() if k != "VINEMAP_TRACEBACK"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "ZeroDivisionError: oops" in done.stderr
    environment["VINEMAP_TRACEBACK"] = "1"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert "Traceback" in done.stderr


def test_programs_are_told_the_stages_in_lines(monkeypatch, capsys):
    monkeypatch.setenv("VINEMAP_PROGRESS", "1")
    with progress("A") as step:
        assert step("DTM", max, 1, 2) == 2
    assert capsys.readouterr().err == f"1/{len(STAGES)} DTM\n"


def test_what_a_template_is_a_share_of_is_told_as_in_the_settings():
    option = next(one for one in track.params if one.name == "template_share")
    known = OdometryOptions.model_fields["template_share"]
    assert known.description in option.help.lower()
    assert option.default == known.default


@pytest.mark.parametrize(
    ("home", "shown"), [("a", "~/b (1.0"), ("a/b", "/a/b (1.0"), ("", "/a/b (1.0"), ("b", "/a/b (1.0")]
)
def test_the_doctor_calls_the_home_by_its_sign_and_nothing_else(monkeypatch, home, shown):
    monkeypatch.setattr(Path, "home", lambda: Path("/", home))
    monkeypatch.setattr(doctor, "_folders", lambda: [("working folder", "/a/b (1.0 GiB free)")])
    monkeypatch.setattr(doctor, "_extras", list)
    assert f" {shown} GiB free)" in CliRunner().invoke(doctor.doctor).output
