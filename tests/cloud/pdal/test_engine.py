"""PDAL as an engine of whole jobs: products, surveys, recipes, and what is said where it can't be used."""

import json
import sys

import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
from commands import free_of_prefect, python
from products import without_workers

from vinemap import paths
from vinemap.cloud.pdal.engine import check_engines, load_pdal, made_by, pdal_versions, stages_of
from vinemap.config.settings import GroundOptions, Settings
from vinemap.config.surveys import survey_config
from vinemap.errors import ConfigError, DependencyError
from vinemap.evaluate.rows import evaluate_rows
from vinemap.jobs import survey as job
from vinemap.jobs.plan import plan_survey
from vinemap.parcel import map_parcel
from vinemap.product.recipe import recipe_of

PDAL = GroundOptions(engine="pdal")
WITH_PDAL = Settings(ground=PDAL)


@pytest.mark.parametrize("most", [None, 40_000])
def test_a_parcel(pdal, tmp_path, vineyard, survey, most):
    """Rows, terrain and record, of points in memory and in tiles."""
    boundary = survey.parent / "parcels.gpkg"
    settings = Settings.model_validate({"ground": {"engine": "pdal"}, "reading": {"max_points": most}})
    summary = map_parcel(survey, tmp_path / "out", parcel="A", boundary=boundary, settings=settings)
    assert summary.rows == 6
    found = evaluate_rows(gpd.read_file(paths.geopackage(summary.folder, "A"), layer="rows"), vineyard.rows)
    assert (found.good, found.extra, found.missed) == (100, 0, 0)
    assert found.dep.mean < 0.08
    assert found.dek.mean < 0.02
    west, south, east, north = vineyard.parcels.total_bounds
    with rasterio.open(paths.raster(summary.folder, "A", "dtm")) as dtm:
        x, y = np.random.default_rng(0).uniform([west + 2, south + 2], [east - 2, north - 2], (3000, 2)).T
        error = np.abs([z[0] for z in dtm.sample(zip(x, y, strict=True))] - vineyard.terrain(x, y))
    assert np.median(error) < 0.025
    assert np.quantile(error, 0.95) < 0.12
    record = json.loads(paths.run_record(summary.folder).read_text())
    assert record["settings"]["ground"]["engine"] == "pdal"
    assert record["versions"].items() >= pdal_versions().items()
    assert not paths.tiles(summary.folder).exists()


def test_a_survey_is_read_once(stand_in, pdal, tmp_path, survey, vineyard, monkeypatch):
    """By PDAL too, and once by our own engine, where a parcel has it."""
    monkeypatch.setenv(stand_in.READ, str(tmp_path / "read"))
    west, south, east, north = vineyard.parcels.total_bounds
    strips = [
        shapely.box(west + k * (east - west) / 4, south, west + (k + 1) * (east - west) / 4, north) for k in range(4)
    ]
    boundaries = tmp_path / "strips.gpkg"
    gpd.GeoDataFrame({"name": list("abcd")}, geometry=strips, crs=vineyard.parcels.crs).to_file(boundaries)
    given = {"settings": {"ground": {"engine": "pdal"}}}
    given["overrides"] = {name: {"settings": {"ground": {"engine": "vinemap"}}} for name in "cd"}
    config = survey_config(survey="strips", cloud=survey, boundaries=boundaries, **given)
    without_workers(monkeypatch)
    dealt = job._jobs(plan_survey(config, tmp_path), config, tmp_path, tmp_path)
    pieces = {recipe.parcel: piece for recipe, piece in dealt}
    assert (tmp_path / "read").read_text() == f"{survey.name}\n"
    assert sorted(pieces) == list("abcd")
    assert len({piece.path for piece in pieces.values()}) == 4
    x, y = vineyard.xyz[:, :2].T
    within = (west < x) & (x < east) & (south < y) & (y < north)
    assert sum(piece.path.stat().st_size for piece in pieces.values()) == pytest.approx(24 * within.sum(), abs=240)


def test_recipes_know_pdals_version_and_the_pipelines_stages(stand_in, tmp_path, survey, monkeypatch):
    (tmp_path / "mine.json").write_text('[{"type": "filters.smrf"}]')
    mine = Settings(ground=GroundOptions(engine="pdal", pipeline=tmp_path / "mine.json"))
    keys = [recipe_of(survey, parcel="A", settings=settings).key for settings in (WITH_PDAL, mine)]
    monkeypatch.setattr(stand_in.info, "version", "2.11.0")
    keys.append(recipe_of(survey, parcel="A", settings=WITH_PDAL).key)
    (tmp_path / "mine.json").write_text('[{"type": "filters.pmf"}]')
    keys.append(recipe_of(survey, parcel="A", settings=mine).key)
    assert len(set(keys)) == 4
    assert made_by(GroundOptions()) == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no such file: ground.pipeline names a pipeline of PDAL's in JSON"),
        ("{", "no valid JSON"),
        ("{}", "holds no pipeline"),
        ("[]", "holds no pipeline"),
        ('["a.laz", {"type": "filters.smrf"}]', "holds a.laz: leave readers and writers out"),
        ('[{"type": "readers.las", "filename": "a.laz"}]', "holds readers.las: leave readers and writers out"),
        ('{"pipeline": [{"type": "writers.las"}]}', "holds writers.las: leave readers and writers out"),
        (
            '[{"type": "filters.smurf"}]',
            "holds filters.smurf, which this PDAL doesn't have: did you mean filters.smrf?",
        ),
        ('[{"type": "odd"}]', "holds odd, which this PDAL doesn't have: pdal --drivers lists what it has"),
        ('[{"cell": 1}]', "one of its stages has no type"),
        ('[{"type": "filters.reprojection", "out_srs": "EPSG:4326"}]', "leave it out, as points are in metres already"),
    ],
)
def test_pipelines_that_are_wrong(pdal, tmp_path, text, said):
    path = tmp_path / "mine.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        check_engines([Settings(ground=GroundOptions(engine="pdal", pipeline=path))])
    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_pipeline_wants_the_engine():
    with pytest.raises(ValueError, match="wants engine: pdal"):
        GroundOptions(pipeline="a.json")


def test_without_pdal(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pdal", None)
    with pytest.raises(DependencyError, match="conda install -c conda-forge python-pdal"):
        map_parcel(tmp_path / "none.laz", tmp_path / "out", parcel="A", settings=WITH_PDAL)
    assert list(tmp_path.iterdir()) == []
    assert stages_of(PDAL)
    check_engines([Settings()])


def test_with_a_pdal_that_is_too_old(stand_in, monkeypatch):
    monkeypatch.setattr(stand_in.info, "version", "2.4.3")
    with pytest.raises(DependencyError, match=r"2\.4\.3 is older than 2\.7"):
        load_pdal()


@pytest.mark.parametrize(
    ("command", "settings"),
    [
        (["vinemap", "run", "none.laz", "--settings", "s.yaml"], "ground: {engine: pdal}"),
        (
            ["vinemap", "survey", "a.laz", "b.laz", "--boundaries", "b.gpkg", "--settings", "s.yaml", "--out", "out"],
            "ground: {engine: pdal}",
        ),
        (
            ["flows.parcel", "s.yaml", "F"],
            "{survey: barolo, simulate: barolo, parcels: [F], settings: {ground: {engine: pdal}}}",
        ),
    ],
)
def test_commands_without_pdal_end_at_once(tmp_path, command, settings):
    """One line and exit code 2 before anything is read, simulated or written, even if somebody has PDAL."""
    (tmp_path / "pdal.py").write_text("raise ImportError('libpdalcpp.so: cannot open shared object file')\n")
    (tmp_path / "s.yaml").write_text(settings)
    environment = free_of_prefect() | {"PREFECT_HOME": str(tmp_path / "prefect")}
    done = python("-m", *command, cwd=tmp_path, environment=environment)
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("vinemap: ground.engine: pdal")
    assert done.stderr.count("\n") == 1
    for word in ("libpdalcpp.so", "conda install -c conda-forge python-pdal", "leave ground.engine out"):
        assert word in done.stderr
    assert {path.name for path in tmp_path.iterdir()} - {"prefect", "__pycache__"} == {"pdal.py", "s.yaml"}
