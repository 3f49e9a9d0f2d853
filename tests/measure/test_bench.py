"""The benchmark of speed: its figures from records made by hand, and one small run of all of it."""

import json
import math
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from systems import LINUX

from vinemap.errors import ConfigError, VinemapError
from vinemap.measure.bench import instead, runs, watched
from vinemap.measure.bench.__main__ import main, parse_sizes
from vinemap.measure.bench.alternatives import course, memory_since
from vinemap.measure.bench.bars import (
    Bar,
    Found,
    Run,
    bars,
    dense_bars,
    growth_exponent,
    growth_ratio,
    of_bar,
    span,
    with_other,
)
from vinemap.measure.bench.plot import draw
from vinemap.measure.bench.runs import cold, many, prefect
from vinemap.measure.bench.surveys import dense, plot
from vinemap.measure.bench.tables import bar_table, dense_table, figures, stage_table, write_tables
from vinemap.measure.bench.watched import high_water

FOUND = Found(rows=20, right=20, extra=0, length=2000.0, volume=-0.1)
SECONDS = {"Reading": 1.0, "DTM": 2.0, "Curves": 0.5, "Ends and gaps": 0.25, "Mesh": 0.0, "Writing": 1.0, "All": 5.0}


def run(millions, *, seconds=SECONDS, area=8200.0, reading=1.0, peak=500e6, found=FOUND):
    peaks = dict.fromkeys(seconds, 400_000_000) | {"Mesh": None}
    wall, seconds = seconds["All"] + 1.5, with_other(seconds)
    return Run(int(1e6 * millions), area, reading, 300_000_000, wall, 0.8, int(peak), seconds, peaks, found)


def grown(millions, exponent):
    return run(millions, seconds=SECONDS | {"All": 5.0 * millions**exponent})


def test_what_lies_between_stages_is_other():
    seconds = with_other(SECONDS)
    assert seconds["other"] == pytest.approx(0.25)
    assert list(seconds)[-2:] == ["other", "All"]
    assert with_other(SECONDS | {"All": 4.7})["other"] == 0


def test_stages_from_one_to_another():
    assert span(SECONDS, "DTM", "Ends and gaps") == 2.75
    assert span(SECONDS, "DTM", "DTM") == 2.0


@pytest.mark.parametrize("exponent", [0.8, 1.0, 1.3])
def test_growth(exponent):
    runs = [grown(millions, exponent) for millions in (1, 2, 4, 16)]
    assert growth_exponent([r.points for r in runs], [r.seconds["All"] for r in runs]) == pytest.approx(exponent)
    assert growth_ratio(runs) == pytest.approx(8 ** (exponent - 1))


@LINUX
def test_memory_of_processes_is_summed():
    held = "x = bytearray(60_000_000); x[::4096] = b'1' * len(x[::4096]); import time; time.sleep(1.5)"
    with watched.summed_memory() as most:
        children = [subprocess.Popen([sys.executable, "-c", held]) for _ in range(2)]
        for child in children:
            child.wait()
    assert 120e6 < most[0] < 250e6
    assert watched.resident(children[0].pid) == 0


@LINUX
def test_memory_that_processes_share_counts_once():
    forked = "import os, time; x = bytearray(b'1') * 100_000_000; os.fork(), os.fork(); time.sleep(1.5)"
    with watched.summed_memory() as most:
        subprocess.run([sys.executable, "-c", forked], check=True)
    assert 100e6 < most[0] < 250e6  # each by itself: 400e6; they are looked at one after the other, while they fork


def test_a_survey_of_many_parcels(tmp_path):
    (heading, line) = many(0.15, 3, tmp_path)
    assert line[0] == "0.2 M points, 3 parcels"
    assert len(list((tmp_path / "products").glob("estate-*/*/run.json"))) == 3
    assert len(heading) == len(line)


def test_one_size_has_no_growth():
    assert math.isnan(growth_exponent([1e6], [2.0]))
    assert math.isnan(growth_ratio([run(1)]))
    assert math.isnan(growth_ratio([run(1), run(2)]))
    assert bar_table([run(1)])[-1][-1] == "–"


def test_bars_of_small_and_large_parcels():
    assert [bar.most for bar in bars(run(2.9))] == [2, 4, 0.9, pytest.approx(574), 2]
    large = bars(run(4, area=20_000, reading=3))
    assert [bar.most for bar in large] == [5, 10, 0.9, pytest.approx(640), 2]
    assert [bar.value for bar in large] == [2.75, 5, 0.8, 500, 0]
    assert [bar.most for bar in bars(run(16, area=40_000, reading=3))][:2] == [3.5, 8.5]


def test_bars_of_dense_vineyards():
    bars = dense_bars(run(8, area=60_000, found=FOUND._replace(length=25_000.0, right=19, extra=1)))
    assert [bar.most for bar in bars] == [17, 0.6, 0.9, pytest.approx(920), 2]
    assert [bar.value for bar in bars] == [6.5, pytest.approx(4.5 / 25), 0.8, 500, 10]
    assert run(8, found=FOUND._replace(length=0.0)).per_kilometre == math.inf


def test_dense_vineyards_may_not_grow_dearer():
    table = {line[0]: line[2:] for line in dense_table([grown(2, 1.1), grown(8, 1.1)])}
    assert table["growth exponent of the whole"] == ["", "1.10 of 1.02!"]
    assert table["km of row found"] == ["2.0", "2.0"]
    assert dense_table([run(2)])[-1][-1] == "–"


def test_a_missed_bar_is_marked():
    assert of_bar(Bar("", "", 2.004, 2.0)) == "2.00 of 2.00"
    assert of_bar(Bar("", "", 2.006, 2.0)) == "2.01 of 2.00!"
    table = bar_table([run(2), run(16, peak=2e9)])
    assert [line[2:] for line in table[:2]] == [
        ["2.0 M points, 0.82 ha", "16.0 M points, 0.82 ha"],
        ["2.75 of 2.00!", "2.75 of 0.91!"],
    ]
    assert table[4][3] == "2000 of 1360!"
    assert table[5][2:] == ["0.0 of 2.0", "0.0 of 2.0"]
    assert table[6][2:] == ["", "0.12 of 1.15"]
    assert {len(line) for line in table} == {4}


def test_figures_of_a_stage():
    one = run(2, reading=0.5)
    assert figures(one, 0.25, 400_000_000) == "0.25, 8.0, 0.50, 200"
    assert figures(one, 0.0, None) == "0.00, –, 0.00, –"
    assert figures(one, None, None) == "–"
    table = {line[0]: line[1:] for line in stage_table([one, run(4)])}
    assert table["laspy.read, xyz"] == ["0.50, 4.0, 1.00, 150", "1.00, 4.0, 1.00, 75"]
    assert table["DTM"] == ["2.00, 1.0, 4.00, 200", "2.00, 2.0, 2.00, 100"]
    assert table["Mesh"][0] == "0.00, –, 0.00, –"
    assert table["whole parcel"][0] == "5.00, 0.4, 10.00, 250"
    assert table["with start-up"][1] == "6.50, 0.6, 6.50, 125"


def test_sizes_are_numbers():
    assert parse_sizes("4 1, 0.5 4") == [0.5, 1, 4]
    for text in ("", "one", "0 1", "-1", "nan", "inf"):
        with pytest.raises(ConfigError, match="million points"):
            parse_sizes(text)


def test_processes_are_measured_and_stopped():
    done = watched.run_process([sys.executable, "-c", "x = bytearray(100_000_000)"])
    assert done.code == 0
    assert done.seconds > 0
    assert done.peak > 100e6
    failed = watched.run_process(
        [sys.executable, "-c", "import sys; print('why', file=sys.stderr); sys.exit('no luck')"]
    )
    assert (failed.code, failed.said) == (1, "no luck")
    hung = watched.run_process([sys.executable, "-c", "import time; time.sleep(60)"], limit=0.3)
    assert hung.code < 0
    assert hung.said == "stopped after 0.3 s"
    with pytest.raises(VinemapError, match="ended with code 1: no luck"):
        watched.must([sys.executable, "-c", "import sys; sys.exit('no luck')"])


def test_the_document_is_filled(tmp_path):
    page = tmp_path / "speed.md"
    page.write_text("<!-- machine -->\n<!-- /machine -->\n<!-- bars -->\n<!-- /bars -->\nend", encoding="utf-8")
    for _ in range(2):
        write_tables({"bars": [["a"], ["1"]]}, page)
    lines = page.read_text(encoding="utf-8").splitlines()
    assert lines[1].startswith("Measured on ")
    assert lines[3:] == ["<!-- bars -->", "| a |", "| --- |", "| 1 |", "<!-- /bars -->", "end"]


def test_the_page_has_a_place_for_every_table():
    page = (Path(__file__).parents[2] / "docs" / "speed.md").read_text(encoding="utf-8")
    tables = "bars", "stages", "dense", "dense-stages", "many", "cold", "instead", "whole", "prefect"
    for name in ("machine", *tables):
        assert page.count(f"<!-- {name} -->") == page.count(f"<!-- /{name} -->") == 1


def test_the_plot_is_small(tmp_path):
    stages = dict.fromkeys(["Reading", "DTM", "Canopy cover", "Curves", "Ends and gaps", "Sections", "Mesh"], 0.5)
    runs = [run(n, seconds={k: n * v for k, v in (stages | {"Writing": 0.5, "All": 4.5}).items()}) for n in (1, 2, 16)]
    draw(runs, tmp_path / "new" / "speed.png")
    assert 0 < (tmp_path / "new" / "speed.png").stat().st_size < 150_000


def test_parcels_grow_in_both_directions():
    small, large = (plot(millions).rows for millions in (1, 16))
    assert (len(small), len(large)) == (7, 30)
    lengths = [np.linalg.norm(np.diff(rows[len(rows) // 2], axis=0), axis=1).sum() for rows in (small, large)]
    assert 4.5 < lengths[1] / lengths[0] < 5.5


def test_dense_vineyards_are_as_real_ones():
    for millions in (2, 24):
        made = dense(millions)
        hectares = made.vineyard.outline.area / 1e4
        length = sum(np.linalg.norm(np.diff(row, axis=0), axis=1).sum() for row in made.rows)
        assert hectares * 1.3 == pytest.approx(millions, rel=0.05)
        assert 4.0 < length / 1000 / hectares < 4.7
    starts = np.array([row[0] for row in made.rows[:26]])
    across = np.array([-np.sin(np.radians(18)), np.cos(np.radians(18))])
    assert np.diff(starts @ across) == pytest.approx(1.7)


def test_a_line_through_a_cluster():
    along = np.linspace(0, 20, 400)
    xy = np.column_stack([along, 0.005 * (along - 10) ** 2]) + [[400_000, 5_000_000]]
    line = course(xy)
    assert line.length == pytest.approx(20, abs=0.1)
    assert max(abs(y - 5_000_000 - 0.005 * (x - 400_010) ** 2) for x, y in line.coords[1:-1]) < 0.03
    assert course(xy[:10]) is None


def test_memory_that_the_system_does_not_tell(monkeypatch):
    monkeypatch.setattr(watched, "Path", lambda path: Path(path.replace("/proc", "/no/proc")))
    assert high_water() is None
    assert memory_since(None) == ""


def test_an_alternative_that_is_missing_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setattr(instead, "ensure_survey", lambda *_: {})
    monkeypatch.setattr(instead, "find_spec", lambda _: None)
    stages = with_other(dict.fromkeys(["DTM", "Canopy cover", "Curves"], 0.5) | {"All": 2.0})
    lines = instead.instead(1, "F", run(1)._replace(seconds=stages), tmp_path)
    assert [line[0] for line in lines[1:]] == ["ground", "rows", "rows, thinned", "c-gons"]
    assert all("pip install 'vinemap[bench]'" in line[1] for line in lines[1:])
    assert {len(line) for line in lines} == {6}
    lines = instead.whole([(1, "F", run(1))], tmp_path)
    assert lines[1][1] == "CSF and sklearn not installed: pip install 'vinemap[bench]'"
    assert lines[2][1:] == ["vinemap run", "6.5 s", "500", "20 of 20 right, 0 extra", "-10%"]
    assert {len(line) for line in lines} == {6}


def test_an_alternative_that_fails_costs_nothing(tmp_path, monkeypatch):
    files = {"cloud": "none.laz", "boundary": "none.gpkg", "truth": "none.gpkg"}
    monkeypatch.setattr(instead, "ensure_survey", lambda *_: files)
    monkeypatch.setattr(instead, "find_spec", lambda module: module in ("cv2", "pdal"))
    monkeypatch.setattr(instead, "run_process", lambda *_, **__: watched.Outcome(-9, 600.0, 1, "stopped after 600 s"))
    stages = with_other(dict.fromkeys(["DTM", "Canopy cover", "Curves"], 0.5) | {"All": 2.0})
    lines = instead.instead(1, "F", run(1)._replace(seconds=stages), tmp_path)
    assert lines[-1] == ["c-gons", "cv2", "–", "stopped after 600 s", "–", "–"]
    monkeypatch.setattr(instead, "find_spec", bool)
    lines = instead.whole([(1, "F", run(1))], tmp_path)
    assert [line[1:3] for line in lines[1:3]] == [[how, "stopped after 600 s"] for how in ("HDBSCAN", "DBSCAN")]


def test_a_cold_start_has_an_empty_cache(tmp_path, monkeypatch):
    asked = []

    def took(command, *, env=None):
        if env is None:
            (tmp_path / "jobs" / "example.json").write_text('{"cloud": "a", "boundary": "b"}', encoding="utf-8")
            return watched.Outcome(0, 1.0, 0, "")
        cache = Path(env["NUMBA_CACHE_DIR"])
        asked.append(cache)
        is_empty = not any(cache.iterdir())
        (cache / "compiled").touch()
        return watched.Outcome(0, 20.0 + len(asked) if is_empty else 4.0, 0, "")

    monkeypatch.setattr(runs, "must", took)
    assert cold(tmp_path)[1][1:] == ["21.0 s", "4.0 s", "17.0 of 12.0! s; 8 s are the goal"]
    assert [asked.count(cache) for cache in set(asked)] == [2, 2, 2]


def test_no_flow_without_its_configuration(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "start from the repository's folder" in prefect(tmp_path)[1][0]


def test_a_small_benchmark(tmp_path):
    arguments = ["--sizes", "0.1", "--out", str(tmp_path), "--instead-at", "0.1", "--only", "F", "--only", "instead"]
    done = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert done.exit_code == 0
    (cloud,) = (tmp_path / "surveys").glob("F-0.1M-*/F-0.1M-*.laz")
    (found,) = json.loads((tmp_path / "runs.json").read_text(encoding="utf-8"))
    assert found["points"] == pytest.approx(1e5, rel=0.2)
    assert found["seconds"]["All"] + found["start"] <= found["wall"]
    assert found["start"] > 0
    assert found["found"]["right"] == found["found"]["rows"] == 3
    assert abs(found["found"]["volume"]) < 0.2
    assert (tmp_path / "speed.png").read_bytes().startswith(b"\x89PNG")
    for word in ("laspy.read, xyz", "whole parcel", "growth exponent", "other"):
        assert word in done.output
    for module, tool in (("CSF", "cloth-simulation-filter "), ("sklearn", "DBSCAN of"), ("cv2", "approxPolyN of")):
        assert (tool if find_spec(module) else f"{module} isn't installed") in done.output
    # What stands in for steps asked for the same survey again, after it had been mapped.
    assert cloud.stat().st_mtime_ns < (tmp_path / "products" / "F-0.1M" / "run.json").stat().st_mtime_ns
