"""The trials of odometry measure what is true, and say what misses its bar."""

from itertools import accumulate

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from vinemap.errors import InputError
from vinemap.measure.odometry.__main__ import main
from vinemap.measure.odometry.bridges import LOST, Bridge, bridges, lost_frames, wheels_of
from vinemap.measure.odometry.tables import (
    bridge_table,
    drift_table,
    loss_table,
    mark,
    size_table,
    terrain_tables,
    trouble_table,
)
from vinemap.measure.odometry.trials import (
    FAILURE,
    METHODS,
    Drift,
    Errors,
    Losses,
    Size,
    drifts,
    measure,
    pool,
    referred,
    template_error,
    template_offset,
)
from vinemap.measure.odometry.troubles import Outcome
from vinemap.odometry.poses import STILL, Pose, onward
from vinemap.simulate.camera import HIGH, LOW, PIECE, lay_ground
from vinemap.simulate.steps import beyond, unrelated, walk


def errors(place, turn, flagged=None):
    """Errors forward in mm, in degrees, and which of them are flagged."""
    offset = np.column_stack([place, np.zeros(len(place))]).astype(float)
    return Errors(offset, np.array(turn, float), np.array(flagged or [False] * len(place)))


def by_method(*scales):
    """Errors of all methods: a scale each."""
    place, turn = np.array([1, 2, 9]), np.array([1, 2, 3])
    return {m: errors(scale * place, scale * turn) for m, scale in zip(METHODS, scales, strict=True)}


def test_a_template_is_off_by_the_movement_and_by_the_lever_of_the_camera():
    assert template_error(Pose(3, 4, 0), STILL, LOW) == pytest.approx(5)
    # Turned by 1° too much about a point 950 mm behind; the middle pixel is half a pixel from the axis.
    assert template_error(Pose(0, 0, 1), STILL, LOW) == pytest.approx(950 * np.radians(1), rel=1e-3)
    assert template_offset(Pose(0, 0, 1), STILL, LOW) == pytest.approx([0, -950 * np.radians(1)], abs=0.2)


def test_steps_are_as_long_as_told_and_found():
    steps = list(walk("gravel", 4, seed=2))
    found = measure(steps, ["aligned"])["aligned"]
    assert found.place.max() < 0.03
    assert found.turn.max() < 0.03
    assert not found.flagged.any()
    # A truth that is moved is missed by as much.
    wrong = [(a, b, truth._replace(x_mm=truth.x_mm + 7, heading_deg=truth.heading_deg)) for a, b, truth in steps]
    off = measure(wrong, ["aligned"])["aligned"]
    assert off.place == pytest.approx(7, abs=0.03)
    assert off.wrong.all()


def test_both_resolutions_see_the_same_steps():
    low, high = (list(walk("grass", 2, camera=camera, seed=5)) for camera in (LOW, HIGH))
    assert [truth for *_, truth in low] == [truth for *_, truth in high]
    for (*_, truth), (*_, by_high) in zip(low, referred(low, high), strict=True):
        assert template_error(by_high, truth, LOW) < 0.02
        assert by_high != truth


def test_unrelated_frames_and_those_beyond_show_little_of_the_same():
    for frame, other in unrelated("grass", 3):
        assert abs(np.corrcoef(frame.ravel(), other.ravel())[0, 1]) < 0.15
    width = 320 * 245 / 299.43
    far = [template_error(truth, STILL, LOW) for *_, truth in beyond("grass", 12)]
    assert 0.28 * width < min(far) < max(far) < 2.02 * width


def test_a_follower_without_error_arrives_and_one_that_stands_still_does_not():
    straight, sd = Pose(0, 0, 0), np.diag([10.0, 10.0, 1.0])
    followers = {
        "still": lambda _: (STILL, None),
        "straight": lambda frames: (straight._replace(x_mm=61.0 * (len(frames) - 1)), sd**2),
        "unsure": lambda frames: (straight._replace(x_mm=61.0 * (len(frames) - 1)), 4 * sd**2),
    }
    found = drifts(["grass"], 1, followers=followers, length_mm=400.0)
    assert found["still"].place == pytest.approx([1000 * 0.98], rel=0.03)  # all of the way, with its turn
    assert found["straight"].place[0] < 0.2 * found["still"].place[0]
    assert found["still"].turn == pytest.approx(found["straight"].turn)
    assert np.isnan(found["still"].squared).all()
    assert found["straight"].squared == pytest.approx(4 * found["unsure"].squared)
    assert found["straight"].squared[0] > (0.35 * found["straight"].turn[0]) ** 2


def test_overall_is_the_mean_of_the_grounds_and_the_worst_the_worst():
    tables = terrain_tables({"a": by_method(1, 0.5, 0.25, 0.01), "b": by_method(3, 1, 0.5, 0.02)})
    place = {line[0]: line[1:] for line in tables["places"]}
    assert place["a"][0].split(", ")[0] == "2.000"
    assert place["a"][-1] == "50, 99"
    assert [cell.split(", ")[0] for cell in place["overall"][:4]] == ["4.000", "1.500", "0.750", "0.030"]
    assert place["overall"][-1] == "62, 99"
    assert place["the worst"][3].split(", ")[0] == "0.040"
    turn = {line[0]: line[1:] for line in tables["turns"]}
    assert turn["overall"][3].startswith("0.030, ")
    assert pool([by_method(1, 1, 1, 1), by_method(3, 1, 1, 1)])["maximum"].cep == np.median([1, 2, 9, 3, 6, 27])


def misses(lines):
    return [cell for line in lines[1:] for cell in line if "!" in cell]


def test_what_misses_its_bar_is_marked():
    assert [mark(0.0304, 0.03), mark(0.0306, 0.03), mark(84.6, 85, 0, at_least=True)] == ["0.030", "0.031!", "85"]
    good, bad = by_method(3, 1, 0.5, 0.01), by_method(0.3, 0.2, 0.2, 0.08)
    assert misses(terrain_tables({"a": good})["places"]) == []
    tables = terrain_tables({"a": bad})
    assert [cell.split(", ")[0] for cell in misses(tables["places"])] == ["0.160!", "33", "0.160!"]
    assert [cell.split(", ")[0] for cell in misses(tables["turns"])] == ["0.160!", "0.160!"]


def test_what_is_lost_and_not_flagged_is_marked():
    ok, off = 0.1, 2 * FAILURE
    steps = errors([ok] * 998 + [off, off], np.zeros(1000), [True] * 9 + [False] * 990 + [True])
    far = errors([off, ok, off], np.zeros(3), [True, False, True])
    lost = Losses(20.0, steps, np.array([True, True]), far)
    assert loss_table({"soil": lost})[1] == ["soil", "20", "1000, 2!", "1!", "0.90", "2, 100.0", "3, 2", "0"]
    pale = lost._replace(contrast=8.0, unrelated=np.array([True, False]), beyond=errors([off], [0]))
    assert loss_table({"pale": pale})[1][2:] == ["1000, 2", "1!", "0.90", "2, 50.0!", "1, 1", "1!"]


def test_troubles_are_held_against_their_bars():
    found = {
        "none": Outcome(1000, 979, 0),
        "mud on half of the lens": Outcome(1000, 500, 0),
        "grate": Outcome(1000, 0, 2),
    }
    lines = trouble_table(found)
    assert misses(lines) == ["97.9!", "2!"]
    assert lines[-1] == ["all", "3000", "49.3", "2!"]


def test_paths_and_times_are_held_against_their_bars():
    ends = zip(METHODS, (8, 4, 2, 2.4), (1, 1, 1, 0.2), strict=True)
    squared = np.array([2.0, 4.0])
    drift = {method: Drift(np.full(2, place), np.full(2, turn), squared) for method, place, turn in ends}
    assert misses(drift_table(drift)) == ["30!", "0.200!, 0.200"]
    assert drift_table(drift)[0][-1].endswith("(0.6–7.2)")
    for squared in (np.array([7.0, 9.0]), np.array([0.1, 0.9])):
        drift["aligned"] = drift["aligned"]._replace(squared=squared)
        assert misses(drift_table(drift))[-1] == f"{squared.mean():.2f}!"
    slow = Size(0.2, {"320 × 240": 0.01, "1280 × 720": 0.05}, 90.0, {})
    assert misses(size_table([slow], 0.02)) == ["10.0!, 9.0"]
    assert misses(size_table([slow._replace(share=0.1)], 0.02)) == []


def test_a_fifth_of_a_path_is_lost_but_not_its_ends():
    lost = lost_frames(160, np.random.default_rng(3))
    assert lost.mean() == pytest.approx(LOST)
    assert not lost[:5].any()
    assert not lost[-5:].any()


def test_wheels_tell_the_way_nearly():
    poses = list(accumulate([Pose(60.0, 0.0, 2.0)] * 40, onward, initial=STILL))
    told = wheels_of(poses, np.random.default_rng(1))
    assert told.speeds.mean() == pytest.approx(300, rel=0.2)
    assert told.speeds.std() > 1
    assert told.rates.mean() == pytest.approx(10, abs=2)


def test_lost_stretches_are_bridged(monkeypatch):
    monkeypatch.setattr("vinemap.measure.odometry.bridges.STRETCHES", 1)
    found = bridges(["gravel"], 1, length_mm=2000.0, seed=4)
    assert found["wheels"].end[0] < 0.5 * found["the last movement"].end[0]
    assert found["fixes at both ends"].end[0] < 60  # three standard deviations of a fix
    assert found["the last movement"].length == pytest.approx(2.0, rel=0.05)


def test_bridges_are_held_against_their_bars():
    worst, end = np.array([40.0, 60.0]), np.array([50.0, 100.0])
    names = "the last movement", "wheels", "wheels, fixes at both ends"
    lines = bridge_table({name: Bridge(worst, end, 8.0) for name in names})
    assert [line[1:] for line in lines[1:]] == [
        ["0.94, 1.25", "0.050, 0.060"],
        ["0.94, 1.25!", "0.050, 0.060"],
        ["0.94, 1.25", "0.050, 0.060!"],
    ]


@pytest.fixture
def photograph(tmp_path):
    path = tmp_path / "ours.png"
    rng = np.random.default_rng(1)
    grey = cv2.GaussianBlur(rng.uniform(0, 255, (300, 280)).astype(np.float32), (0, 0), 1.5)
    colour = np.dstack([3 * (grey - 127) + 127] * 3).clip(0, 255).astype(np.uint8)
    path.write_bytes(cv2.imencode(".png", colour)[1].tobytes())
    return path


def test_tables_plots_and_the_document_are_filled(tmp_path, photograph, monkeypatch):
    monkeypatch.setattr("vinemap.measure.odometry.__main__.MADE", ())
    monkeypatch.setattr("vinemap.measure.odometry.__main__.PHOTOGRAPHS", ("brick",))
    docs = tmp_path / "page.md"
    docs.write_text("<!-- places -->\n<!-- /places -->\n<!-- lost 5000 -->\nkept\n<!-- /lost 5000 -->\n", "utf-8")
    options = ["--steps", "2", "--pairs", "5", "--out", str(tmp_path / "plots"), "--docs", str(docs)]
    run = CliRunner().invoke(main, ["terrains", "lost", *options, "--photograph", str(photograph)])
    assert run.exit_code == 0, run.output
    assert "values miss their bars (!)" in run.stderr
    lines = [line for line in docs.read_text("utf-8").splitlines() if line.startswith("| ")]
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| brick", f"| {photograph}", "| overall", "| the worst"]
    assert "kept" in docs.read_text("utf-8")
    for name in ("errors", "scatter"):
        image = cv2.imread(str(tmp_path / "plots" / f"{name}.png"))
        assert image.std() > 10


def test_a_photograph_is_laid_like_the_others(photograph):
    ground = lay_ground(photograph, size_mm=(200, 160))
    assert ground.image.shape == (400, 500)
    grey = cv2.imread(str(photograph), cv2.IMREAD_GRAYSCALE)
    assert ground.image.mean() == pytest.approx(grey.mean(), abs=3)
    assert ground.image.std() == pytest.approx(grey.std(), rel=0.15)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"no image", "give an image"),
        (b"", "it is empty"),
        (None, "No such file"),
        (cv2.imencode(".png", np.zeros((PIECE - 1, 400), np.uint8))[1].tobytes(), "400 × 255 pixels: give one of 256"),
    ],
)
def test_a_photograph_that_cannot_be_laid_is_named(tmp_path, content, says):
    path = tmp_path / "ground.png"
    if content is not None:
        path.write_bytes(content)
    run = CliRunner().invoke(main, ["terrains", "--photograph", str(path)])
    assert isinstance(run.exception, InputError)
    assert str(path) in str(run.exception)
    assert says in str(run.exception)
    assert "\n" not in str(run.exception)
