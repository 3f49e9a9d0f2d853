"""Damage is repeatable, and what comes of it is told apart: right, told, or bad."""

import geopandas as gpd
import numpy as np
import pytest
import shapely
from click.testing import CliRunner
from lasfiles import as_las

from vinemap.cloud.las import read_cloud
from vinemap.errors import BusyError, InputError, OutputError
from vinemap.geo.crs import parse_crs
from vinemap.measure.fuzz import __main__ as fuzz
from vinemap.measure.fuzz import trial
from vinemap.measure.fuzz.damages import DAMAGES
from vinemap.measure.fuzz.trial import LATER, NOISE, RIGHT, SAME, TOLD, UNCLEAR, WARNED, WRONG, Verdict, Whole, examine

CRS = parse_crs("EPSG:32632")
ROWS = (((0.0, 0.0), (10.0, 0.0)), ((0.0, 2.0), (10.0, 2.0)))


@pytest.fixture
def whole(tmp_path):
    las = as_las(2000, "laz 1.4")
    las.header.add_crs(CRS)
    las.write(tmp_path / "a.laz")
    square = shapely.box(414_690, 4_940_690, 414_740, 4_940_740)
    gpd.GeoDataFrame({"name": ["A"]}, geometry=[square], crs=CRS).to_file(tmp_path / "a.gpkg")
    cloud = read_cloud(tmp_path / "a.laz")
    return Whole(tmp_path / "a.laz", tmp_path / "a.gpkg", trial.digest(cloud.xyz, cloud.crs), ROWS)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_number_gives_the_same_damage_again(damage):
    first, second, other = bytearray(range(256)) * 40, bytearray(range(256)) * 40, bytearray(range(256)) * 40
    for data, seed in ((first, 1), (second, 1), (other, 2)):
        damage(data, np.random.default_rng(seed))
    assert first == second != bytearray(range(256)) * 40
    assert first != other


def test_a_whole_file_and_a_cut_one(whole, tmp_path):
    assert examine(whole.path, whole) == Verdict(SAME)
    cut = tmp_path / "b.laz"
    cut.write_bytes(whole.path.read_bytes()[:9000])
    assert examine(cut, whole) == (TOLD, f"{cut}: ends before its table of chunks: copy or download it again")
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == []


@pytest.mark.parametrize(
    ("rows", "warnings", "outcome"),
    [
        (ROWS, (), RIGHT),
        (tuple(tuple((x, y + 0.05) for x, y in row) for row in ROWS), (), RIGHT),
        (ROWS[:1], ("half of it",), WARNED),
        (ROWS[:1], (), WRONG),
        (tuple(tuple((x, y + 0.5) for x, y in row) for row in ROWS), (), WRONG),
    ],
)
def test_other_points_are_right_where_the_rows_are(whole, monkeypatch, rows, warnings, outcome):
    monkeypatch.setattr(trial, "_map", lambda *args: (warnings, rows))
    assert examine(whole.path, whole).outcome == outcome


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (InputError("a.laz: is damaged"), TOLD),
        (InputError("something is damaged"), UNCLEAR),
        (InputError("a.laz: is\ndamaged"), UNCLEAR),
        (OutputError("a.laz: can't be written"), UNCLEAR),
        (BusyError("a.laz: try again"), LATER),
    ],
)
def test_errors_are_judged(whole, monkeypatch, error, outcome):
    def fail(*args):
        raise error

    monkeypatch.setattr(trial, "_map", fail)
    assert examine(whole.path, whole).outcome == outcome


@pytest.mark.parametrize(("outcome", "code"), [(TOLD, 0), (WRONG, 1), (NOISE, 1)])
def test_the_table_counts_and_the_exit_code_tells(monkeypatch, outcome, code):
    found = [(0, "a.laz", "cut", Verdict(TOLD, "said")), (7, "a.las", "header", Verdict(outcome, "what\nwas said"))]
    monkeypatch.setattr(fuzz, "cases", lambda numbers, processes: found)
    run = CliRunner().invoke(fuzz.main, ["--cases", "2"])
    assert run.exit_code == code
    assert ("7 a.las header: " in run.output) == bool(code)
    assert run.output.splitlines()[-1].split()[0] == "all"
