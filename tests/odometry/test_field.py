"""What stays in frames: it isn't taken for ground that stands still, nor is a frame that a recorder wrote again."""

from itertools import pairwise

import numpy as np
import pytest
from drives import frames, images, poses

from vinemap.config.camera import Camera
from vinemap.measure.odometry.troubles import LENSES, TROUBLES, drive, outcome
from vinemap.odometry.field import FEWEST, cleaner_of, field_of, mask_of
from vinemap.odometry.frames import Frame, repeats
from vinemap.odometry.poses import moved
from vinemap.odometry.step import estimate_motion
from vinemap.odometry.track import follow
from vinemap.odometry.views import cleaned
from vinemap.simulate.camera import LOW, Weather, lay_ground, render

N = 14


@pytest.fixture(scope="module")
def faint():
    return lay_ground("concrete", size_mm=(1160, 500), seed=4)


@pytest.fixture(scope="module")
def shots(faint):
    return [render(faint, pose, seed=k) for k, pose in enumerate(poses(N))]


def spoilt(shots, lens, seed=1):
    spoil = LENSES[lens](np.random.default_rng(seed))
    return [
        np.clip(np.rint(spoil(shot.astype(np.float32), k)), 0, 255).astype(np.uint8) for k, shot in enumerate(shots)
    ]


def off(track, robot):
    steps = [
        (moved(track[0].pose, point.pose), moved(robot[0], true)) for point, true in zip(track, robot, strict=True)
    ]
    return max(np.hypot(found.x_mm - true.x_mm, found.y_mm - true.y_mm) for found, true in steps)


def test_clean_frames_are_left_as_they_are(faint):
    even = [render(faint, pose, weather=Weather(light=0), seed=k) for k, pose in enumerate(poses(N))]
    light = cleaner_of(field_of(even), LOW).light
    assert np.mean(np.abs(light - 1) > 0.002) < 0.005
    assert cleaner_of(None, LOW) is None


@pytest.mark.parametrize("lens", ["60 spots of dirt", "mud on half of the lens", "text"])
def test_a_drive_is_followed_through_what_is_on_the_lens(shots, lens):
    dirty = spoilt(shots, lens)
    track = list(follow(frames(dirty), camera=LOW, foresight=N))
    assert sum(point.flag != "" for point in track) <= 2
    assert off(track, poses(N)) < 5


def test_a_field_is_what_the_light_is_dimmed_by(shots):
    dirty = spoilt(shots, "60 spots of dirt")
    light = cleaner_of(field_of(dirty), LOW).light
    true = spoilt([np.full((240, 320), 200, np.uint8)], "60 spots of dirt")[0] / 200
    assert np.abs(light - true).mean() < 0.03
    assert cleaned(dirty[0], cleaner_of(field_of(dirty), LOW)).std() < 0.6 * dirty[0].std()


def test_dirt_on_faint_ground_is_never_standing_still(shots):
    """Of two frames alone, and before a field is known."""
    dirty = spoilt(shots, "20 spots of dirt")
    for k, point in enumerate(follow(frames(dirty), camera=LOW)):
        assert point.flag or k == 0 or off([point], [poses(N)[k]]) == 0
        if point.measured_from is not None:
            step = moved(poses(N)[point.measured_from], poses(N)[k])
            assert np.hypot(*step[:2]) > 30
            break
    motions = [estimate_motion(*pair, camera=LOW) for pair in pairwise(dirty)]
    assert all(motion.flag or motion.dx_mm > 35 for motion in motions)


def test_standing_still_is_shown_by_ground(faint):
    robot = [poses(N)[k // 3] for k in range(N)]
    dirty = spoilt([render(faint, pose, seed=k) for k, pose in enumerate(robot)], "20 spots of dirt")
    track = list(follow(frames(dirty), camera=LOW, foresight=N))
    still = [k for k in range(1, N) if robot[k] == robot[k - 1]]
    assert sum(track[k].flag == "" for k in still) == len(still)
    assert off(track, robot) < 2
    alone = list(follow(frames(dirty[:3]), camera=LOW))
    assert [point.flag for point in alone] == ["", "", ""]


def test_nothing_is_learned_of_one_place(faint):
    assert field_of(render(faint, poses(1)[0], seed=k) for k in range(FEWEST + 2)).n == 1


def test_what_a_mask_hides_is_no_ground():
    corners = ((0, 140), (320, 140), (320, 240), (0, 240))
    camera = Camera(**LOW.model_dump() | {"mask": (corners,)})
    assert mask_of(camera)[:139].sum() == 0
    assert mask_of(camera)[142:].all()
    shots = images(poses(5))
    shots = [np.vstack([shot[:140], shots[0][140:]]) for shot in shots]
    motions = [estimate_motion(*pair, camera=camera) for pair in pairwise(shots)]
    assert [motion.flag for motion in motions] == [""] * 4
    assert [motion.dx_mm for motion in motions] == pytest.approx([40] * 4, abs=0.5)
    bare = [estimate_motion(*pair, camera=LOW) for pair in pairwise(shots)]
    assert any(motion.flag for motion in bare)


def test_repeated_frames_are_told_from_a_standstill_by_noise(shots):
    again = [*shots[:5], shots[4], shots[4], *shots[5:8]]
    track = list(follow(frames(again), camera=LOW))
    assert [point.flag for point in track] == [""] * 5 + ["repeated"] * 2 + [""] * 3
    assert off(track[:5] + track[7:], poses(8)) < 1
    assert not repeats(*frames(images(poses(1) * 2)))


def test_frames_decoded_a_little_differently_are_repeated(shots):
    rng = np.random.default_rng(0)
    worse = [np.clip(shots[0] + np.rint(rng.normal(0, s, shots[0].shape)), 0, 255).astype(np.uint8) for s in (0.4, 1.4)]
    assert repeats(Frame("a", 1.0, shots[0]), Frame("b", 2.0, worse[0]))
    assert not repeats(Frame("a", 1.0, shots[0]), Frame("b", 2.0, worse[1]))
    assert repeats(Frame("a", 1.0, shots[0]), Frame("b", 1.0, worse[1]))
    assert not repeats(Frame("a", 1.0, shots[0]), Frame("b", 1.0, shots[1]))


def test_a_trial_counts_what_is_wrong():
    spoilt_drive = drive(TROUBLES["repeated frames"], "soil", 8, seed=3)
    shots, robot, again = spoilt_drive
    found = outcome(shots, robot, again)
    assert found == (7 - sum(again), 7 - sum(again), 0)
    moved_on = [pose._replace(x_mm=pose.x_mm + 9 * k) for k, pose in enumerate(robot)]
    assert outcome(shots, moved_on, again).wrong >= 5
