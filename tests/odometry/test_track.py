"""Poses along a drive, against where the robot was."""

import numpy as np
import pytest
from drives import frames, ground, images, poses

from vinemap.config.camera import Camera
from vinemap.odometry.poses import Pose, moved
from vinemap.odometry.track import follow, stretches
from vinemap.simulate.camera import LOW, Weather, render

N = 14


@pytest.fixture(scope="module")
def robot():
    return poses(N)


@pytest.fixture(scope="module")
def shots(robot):
    return images(robot)


def off(track, robot, start=0):
    """Millimetres and degrees (n, 2) of poses from the truth, both as seen from one of them."""
    out = []
    for point, true in zip(track, robot, strict=True):
        found, known = moved(track[start].pose, point.pose), moved(robot[start], true)
        out.append((np.hypot(found.x_mm - known.x_mm, found.y_mm - known.y_mm), abs(moved(found, known).heading_deg)))
    return np.array(out)


def test_a_drive_is_followed_to_fractions_of_a_millimetre(robot, shots):
    track = list(follow(frames(shots), camera=LOW))
    assert [point.flag for point in track] == [""] * N
    assert off(track, robot).max(axis=0) == pytest.approx([0, 0], abs=0.35)
    assert set(stretches(track)) == {1}


def test_keyframes_make_fewer_steps_and_less_error():
    robot = poses(60, step=8, turn=0.3, x=-1200)
    shots = images(robot)
    errors = {}
    for keyframes in (True, False):
        track = list(follow(frames(shots), camera=LOW, keyframes=keyframes))
        assert not any(point.flag for point in track)
        errors[keyframes] = off(track, robot)[-1]
        links = {point.measured_from for point in track}
        assert (len(links) < 12) if keyframes else (len(links) == 60)
    assert errors[True][0] < 0.6 * errors[False][0]
    assert errors[True][0] < 1.0


@pytest.mark.parametrize("bad", [None, np.zeros((240, 320), np.uint8)], ids=["unreadable", "black"])
def test_one_bad_frame_costs_its_own_pose_alone(robot, shots, bad):
    track = list(follow(frames([*shots[:6], bad, *shots[7:]]), camera=LOW))
    flags = [point.flag for point in track]
    assert flags[6] in ("unreadable", "blank")
    assert flags[:6] + flags[7:] == [""] * (N - 1)
    assert off(track, robot)[[*range(6), *range(7, N)]].max() < 0.4
    assert track[7].measured_from < 6
    assert off(track, robot)[6, 0] < 3  # carried on
    assert stretches(track) == [1] * 6 + [0] + [1] * (N - 7)


def test_a_blurred_frame_is_flagged_and_bridged(robot, shots):
    blurred = render(ground(), robot[6], weather=Weather(blur=5))
    track = list(follow(frames([*shots[:6], blurred, *shots[7:]]), camera=LOW))
    assert [k for k, point in enumerate(track) if point.flag] == [6]
    assert off(track, robot)[7:].max() < 0.4


def test_a_robot_that_is_carried_away_is_flagged_once_and_followed_from_there(robot, shots):
    elsewhere = [Pose(pose.x_mm - 60, pose.y_mm + 330, pose.heading_deg) for pose in robot]
    there = images(elsewhere)
    track = list(follow(frames([*shots[:7], *there[7:]]), camera=LOW))
    assert [k for k, point in enumerate(track) if point.flag] == [7]
    assert stretches(track) == [1] * 7 + [2] * (N - 7)
    assert off(track[7:], elsewhere[7:]).max() < 0.4
    assert all(point.measured_from >= 7 for point in track[8:])


def test_frames_before_the_first_good_one_are_flagged(shots):
    track = list(follow(frames([None, None, *shots[:4]]), camera=LOW))
    assert [point.flag for point in track] == ["unreadable", "unreadable", "", "", "", ""]
    assert track[2].pose == (0, 0, 0)
    assert stretches(track) == [0, 0, 1, 1, 1, 1]


def test_nothing_is_believed_of_frames_of_different_places():
    laid = ground()
    shots = [render(laid, Pose(x - 950, y, 0)) for x in (-350, 0, 350) for y in (-300, 0, 300)]
    track = list(follow(frames(shots), camera=LOW))
    assert all(point.flag for point in track[1:])
    assert set(stretches(track)) == {0}


def test_a_robot_that_stands_still_stays(robot):
    laid = ground()
    shots = [render(laid, robot[5], seed=k) for k in range(6)]
    track = list(follow(frames(shots), camera=LOW))
    assert max(np.hypot(*point.pose[:2]) for point in track) < 0.3


@pytest.mark.parametrize("options", [{"turned_deg": -90.0}, {"y_mm": 300.0, "x_mm": -200.0}, {"cx": 171.0, "cy": 99.5}])
def test_how_the_camera_is_mounted_counts(options):
    camera = Camera(**LOW.model_dump() | options)
    robot = [Pose(p.x_mm + 950 - camera.x_mm, p.y_mm - camera.y_mm, p.heading_deg) for p in poses(6, turn=4)]
    track = list(follow(frames(images(robot, camera=camera)), camera=camera))
    assert not any(point.flag for point in track)
    assert off(track, robot)[:, 0].max() < 0.8
    assert off(track, robot)[:, 1].max() < 0.06


def test_poses_come_as_frames_do(shots):
    seen = []

    def camera():
        for frame in frames(shots):
            seen.append(frame.name)
            yield frame

    track = follow(camera(), camera=LOW)
    for k in range(3):
        assert next(track).frame == str(k)
        assert len(seen) == k + 1
