"""The quality score tells better models from worse, and its search stays in the thesis's ranges."""

import numpy as np
import pytest
from click.testing import CliRunner

from vinemap.chain import map_rows
from vinemap.config.settings import Settings
from vinemap.measure.tune import BOUNDS, main, reference_model, score, search, some_rows
from vinemap.simulate.survey import write_survey


@pytest.fixture(scope="module")
def found(cloud):
    return some_rows(map_rows(cloud, Settings()), 40)


def test_the_longest_rows_are_enough(cloud, found):
    everything = map_rows(cloud, Settings())
    assert len(found.rows) == 2
    assert found.rows.length.min() >= everything.rows.length.sort_values().iloc[-2] - 1e-9
    assert set(found.gaps["row_id"]) <= set(found.rows["row_id"])


def test_better_models_score_higher(cloud, found):
    reference = reference_model(found)
    fine = score(found, reference, 0.4, 0.25, 7, "foliage")
    assert fine.good.mean() > 0.93
    assert fine.over.mean() < 0.09
    assert 0.8 < fine.quality.mean() < 1
    # Feet on the soil take in the void; sections far apart cut across bends and gaps.
    assert score(found, reference, 0.4, 0.25, 7, "soil").over.mean() > fine.over.mean() + 0.2
    coarse = score(found, reference, 0.4, 2.0, 7, "foliage")
    assert coarse.good.mean() - coarse.over.mean() < fine.good.mean() - fine.over.mean() - 0.02
    # More vertices fit more closely and weigh more.
    rich = score(found, reference, 0.4, 0.25, 11, "foliage")
    assert rich.over.mean() < fine.over.mean()
    assert rich.reduction.mean() < fine.reduction.mean()


def test_search_keeps_to_its_ranges_and_finds_no_worse_than_it_began(cloud, found):
    reference = reference_model(found)
    best = search(found, reference, generations=1)
    for value, (low, high) in zip(best, BOUNDS, strict=True):
        assert low <= value <= high
    assert isinstance(best[2], int)
    ours, thesis = (score(found, reference, *model, "foliage") for model in (best, (0.4, 0.25, 7)))
    assert ours.quality.mean() >= thesis.quality.mean() - 0.01


def test_the_command_says_what_it_found_and_draws(vineyard, tmp_path):
    cloud = write_survey(vineyard, tmp_path)
    run = CliRunner().invoke(
        main, [str(cloud), "--length", "20", "--generations", "0", "--out", str(tmp_path / "made" / "tune.png")]
    )
    assert run.exit_code == 0, run.output
    lines = run.output.splitlines()
    assert lines[1].startswith("the thesis's [0.4, 0.25, 7]: G 0.9")
    assert [line.split(" [")[0] for line in lines[:3]] == ["best", "the thesis's", "on the soil"]
    assert (tmp_path / "made" / "tune.png").read_bytes().startswith(b"\x89PNG")


def test_without_rows_there_is_nothing_to_tune(vineyard, tmp_path):
    bare = vineyard._replace(
        xyz=vineyard.xyz[np.abs(vineyard.xyz[:, 2] - vineyard.terrain(*vineyard.xyz[:, :2].T)) < 0.1]
    )
    run = CliRunner().invoke(main, [str(write_survey(bare, tmp_path))])
    assert run.exit_code != 0
    assert "no vine row found" in str(run.exception)
