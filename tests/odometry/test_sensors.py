"""Wheel speeds, yaw rates and satellite fixes: what they bridge and pull, and what of them is refused."""

import numpy as np
import pytest
from drives import frames, images, poses
from pyproj import Geod

from vinemap.config.drives import Start
from vinemap.errors import InputError
from vinemap.odometry.frames import Frame
from vinemap.odometry.poses import STILL, Pose, moved, onward, onward_covariance
from vinemap.odometry.sensors.files import check_times
from vinemap.odometry.sensors.fixes import Fixes, read_fixes
from vinemap.odometry.sensors.pulling import pulled
from vinemap.odometry.sensors.wheels import Odometer, Wheels, read_wheels
from vinemap.odometry.step import Motion
from vinemap.odometry.track import UNSURE_MM, UNSURE_SHARE, TrackPoint, follow
from vinemap.simulate.camera import LOW

START = Start(44.61167, 7.92442, 72.5)
STEP = Pose(60.0, 1.0, 1.5)


def wheels(speed=300.0, rate=10.0, n=41):
    return Wheels(np.arange(n) / 10, np.full(n, speed), np.full(n, rate))


def tracked(n=30, *, lost=(), seed=0, period=0.2):
    """A track whose steps err as they say, the true poses, and where it guesses."""
    rng, track, true = np.random.default_rng(seed), [], []
    pose, truth, covariance = STILL, STILL, np.zeros((3, 3))
    for k in range(n):
        bad = k in lost
        of_step = np.diag([30.0**2, 30.0**2, 2.0**2]) if bad else np.diag([0.1**2, 0.1**2, 0.02**2])
        if k:
            step = Pose(*(np.array(STEP) + rng.multivariate_normal(np.zeros(3), of_step)))
            covariance = onward_covariance(pose, covariance, step, of_step)
            pose, truth = onward(pose, step), onward(truth, STEP)
            motion = None if bad else Motion(*step, of_step)
            track.append(
                TrackPoint(
                    str(k), k * period, pose, covariance, of_step, 245.0, "blank" * bad, None if bad else k - 1, motion
                )
            )
        else:
            track.append(TrackPoint("0", 0.0, pose, covariance, of_step, 245.0))
        true.append(truth)
    return track, true


def slopes_of(start, end, by=1e-3):
    """Slopes (3, 6) of the movement from a pose to another by both."""
    ways = [
        moved(
            *(
                pose._replace(**{name: getattr(pose, name) + by}) if turn == k else pose
                for k, pose in enumerate((start, end))
            )
        )
        for turn in range(2)
        for name in Pose._fields
    ]
    return (np.array(ways) - moved(start, end)).T / by


def off(track, true):
    return np.array([np.hypot(f.pose.x_mm - t.x_mm, f.pose.y_mm - t.y_mm) for f, t in zip(track, true, strict=True)])


def test_wheels_drive_an_arc():
    movement, covariance = wheels().between(0.55, 2.55, STILL)
    radius = 300 / np.radians(10)
    assert movement == pytest.approx(
        (radius * np.sin(np.radians(20)), radius * (1 - np.cos(np.radians(20))), 20), rel=1e-4
    )
    assert np.sqrt(covariance[0, 0]) == pytest.approx(np.hypot(12, 1), rel=0.01)
    assert wheels().between(3.5, 4.5, STILL) is None
    assert wheels().between(None, 1.0, STILL) is None
    gap = Wheels(np.array([0.0, 1.0, 3.0]), np.ones(3), np.ones(3))
    assert gap.between(0.5, 1.5, STILL) is None


def test_what_wheels_dont_know_is_as_usual():
    straight = wheels(rate=np.nan).between(0.0, 1.0, Pose(30.0, 0.0, 4.0))[0]
    assert straight.heading_deg == pytest.approx(4.0)
    slow, covariance = wheels(speed=np.nan).between(0.0, 1.0, Pose(30.0, 0.0, 4.0))
    assert slow.x_mm == pytest.approx(30.0, rel=0.01)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(UNSURE_MM + 30 * UNSURE_SHARE)  # a guess, and as sure as one


def test_an_odometer_learns_its_scale_and_drift_of_frames():
    odometer = Odometer(wheels(speed=330.0, rate=12.0))
    for k in range(1, 35):
        odometer.learn((k - 1) / 10, k / 10, Pose(30.0, 0.0, 1.0))
    movement, _ = odometer.between(3.4, 3.9, STILL)
    assert movement.x_mm == pytest.approx(150, rel=0.03)
    assert movement.heading_deg == pytest.approx(5.0, abs=0.5)


def test_an_odometer_learns_nothing_of_what_wheels_dont_tell():
    half = wheels(speed=330.0, rate=12.0)
    half.speeds[20:], half.rates[20:] = np.nan, np.nan
    odometer, other = Odometer(half), Odometer(wheels(speed=330.0, rate=12.0))
    for k in range(1, 20):
        other.learn((k - 1) / 10, k / 10, Pose(30.0, 0.0, 1.0))
    for k in range(1, 40):
        odometer.learn((k - 1) / 10, k / 10, Pose(30.0, 0.0, 1.0))
    assert odometer.between(0.5, 1.5, STILL)[0] == pytest.approx(other.between(0.5, 1.5, STILL)[0], abs=1e-9)


def test_wheels_bridge_a_lost_stretch():
    robot = poses(14)
    shots = [None if 4 <= k < 11 else image for k, image in enumerate(images(robot))]
    shots = [frame._replace(time=k / 10) for k, frame in enumerate(frames(shots))]
    speeds = np.full(20, 400.0)
    sensor = Odometer(Wheels(np.arange(-1, 19) / 10, speeds, np.full(20, 10.0)))
    alone, bridged = (list(follow(iter(shots), camera=LOW, sensor=s)) for s in (None, sensor))
    true = [moved(robot[0], pose) for pose in robot]
    assert off(bridged, true).max() < 6
    assert bridged[12].flag == ""
    assert bridged[12].covariance[0, 0] < alone[12].covariance[0, 0]
    assert isinstance(shots[0], Frame)


def test_fixes_pull_the_track_to_where_they_are():
    track, true = tracked(lost={10, 11, 12, 13})
    ends = np.array([true[0][:2], true[-1][:2]])
    found, left_out, _ = pulled(track, Fixes(np.array([0.0, 29 * 0.2]), ends, np.array([20.0, 20.0])))
    assert left_out == 0
    assert off(found, true)[-1] < 10 < off(track, true)[-1]
    assert off(found, true).max() < off(track, true).max()
    steps = [moved(found[k - 1].pose, found[k].pose) for k in range(20, 30)]
    assert np.array(steps)[:, 0] == pytest.approx([60] * 10, abs=0.5)  # what was measured stays


def test_the_covariance_of_a_pulled_track_is_that_of_its_errors():
    z = []
    for seed in range(40):
        track, true = tracked(20, lost={8, 9}, seed=seed)
        rng = np.random.default_rng(seed)
        ends = np.array([true[0][:2], true[-1][:2]]) + rng.normal(0, 20, (2, 2))
        found = pulled(track, Fixes(np.array([0.0, 19 * 0.2]), ends, np.array([20.0, 20.0]))).track
        e = np.array(found[9].pose[:2]) - true[9][:2]
        z.append(e @ np.linalg.solve(found[9].covariance[:2, :2], e))
    assert 1.4 < np.mean(z) < 2.7  # 2 expected, 95% of 80 degrees of freedom


def test_covariances_of_a_pulled_track_are_those_of_its_whole_normal_matrix():
    """Keyframes make a tree of it; places are at both ends and in its midst."""
    track, true = tracked(40, lost={8, 9, 25})
    for k, point in enumerate(track):
        if point.motion:
            key = (k - 1) // 4 * 4
            motion = Motion(*moved(track[key].pose, point.pose), point.of_step)
            track[k] = point._replace(measured_from=key, motion=motion)
    at = np.array([0, 22, 39])
    found = pulled(track, Fixes(at * 0.2, np.array([true[k][:2] for k in at]), np.full(3, 20.0))).track
    normal = np.zeros((40, 3, 40, 3))
    normal[0, :, 0] = np.diag([1e-6, 1e-6, 1e-2])
    normal[at, :2, at, :2] += np.eye(2) / 20**2
    for k, point in enumerate(found[1:], start=1):
        parent = k - 1 if point.measured_from is None else point.measured_from
        slopes = slopes_of(found[parent].pose, point.pose)
        known = (slopes.T @ np.linalg.inv(point.of_step) @ slopes).reshape(2, 3, 2, 3)
        for a, row in enumerate((parent, k)):
            for b, column in enumerate((parent, k)):
                normal[row, :, column] += known[a, :, b]
    whole = np.linalg.inv(normal.reshape(120, 120)).reshape(40, 3, 40, 3)
    for k, point in enumerate(found):
        assert point.covariance == pytest.approx(whole[k, :, k], rel=1e-3, abs=1e-4)


def test_a_track_that_begins_with_bad_frames_is_pulled_too():
    shots = [frame._replace(time=k / 10) for k, frame in enumerate(frames([None, None, *images(poses(14))[:4]]))]
    track = list(follow(iter(shots), camera=LOW))
    assert [point.covariance.any() for point in track[2:]] == [False, True, True, True]
    found = pulled(track, Fixes(np.array([0.5]), np.array([[300.0, 0.0]]), np.array([10.0]))).track
    assert found[-1].pose.x_mm == pytest.approx(300, abs=5)
    assert all(np.linalg.eigvalsh(point.covariance)[0] > 0 for point in found)


def test_a_fix_far_off_is_left_out():
    track, true = tracked()
    at = np.array([0, 10, 20, 29])
    xy = np.array([true[k][:2] for k in at])
    xy[2] += 5000
    found, left_out, _ = pulled(track, Fixes(at * 0.2, xy, np.full(4, 20.0)))
    assert left_out == 1
    assert off(found, true).max() < 10
    assert pulled(track, Fixes(np.array([0.0, 900.0]), xy[:2], np.full(2, 20.0))).left_out == 1


def test_places_are_in_the_frame_of_the_start_and_accuracies_are_horizontal(tmp_path):
    lon, lat, _ = Geod(ellps="WGS84").fwd(START.lon, START.lat, START.heading_deg, 10.0)
    path = tmp_path / "fixes.csv"
    path.write_text(f"time;lat;lon;accuracy_m\n2026-05-14T08:00:00Z;{lat!r};{lon!r};0.02\nbad;1;2;3\n")
    fixes = read_fixes(path, START)
    assert fixes.left_out == 1
    assert fixes.xy == pytest.approx(np.array([[10_000.0, 0.0]]), abs=1)
    assert fixes.times == pytest.approx([1778745600])
    assert np.hypot(fixes.sd, fixes.sd) == pytest.approx([20.0])


def test_lines_that_jump_are_left_out(tmp_path):
    path = tmp_path / "wheels.csv"
    path.write_text("time,speed_km_h\n1,3.6\n2,3.6\n1.5,3.6\n3,999\n4,3.6\n,3.6\n")
    found = read_wheels(path)
    assert found.left_out == 3
    assert found.times.tolist() == [1, 2, 4]
    assert found.speeds == pytest.approx([1000] * 3)
    assert np.isnan(found.rates).all()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("t,speed_m_s\n1,1\n", "has no column time"),
        ("time,speed\n1,1\n2,1\n", "neither speeds nor yaw rates: name a column speed_m_s or"),
        ("time,speed_m_s\n1,1200\n2,1300\n", "no robot has: is the unit"),
        ("time,yaw_rate_rad_s\n1,30\n2,31\n", "no robot has: is the unit"),
        ("time,speed_m_s\nnoon,1\nlater,2\n", "its times can't be read"),
        ("time,speed_m_s\n1,1\n", "fewer than two lines"),
        ("", "can't be read"),
    ],
)
def test_wheels_that_cant_be_used_are_told(tmp_path, text, says):
    path = tmp_path / "wheels.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=says) as raised:
        read_wheels(path)
    assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match="can't be read"):
        read_wheels(tmp_path / "none.csv")


def test_fixes_that_cant_be_used_are_told(tmp_path):
    path = tmp_path / "fixes.csv"
    path.write_text("time,lat,lon\n1,2,3\n")
    with pytest.raises(InputError, match="has no column accuracy_m"):
        read_fixes(path, START)
    path.write_text("time,lat,lon,accuracy_m\n1,200,3,-1\n")
    with pytest.raises(InputError, match="holds no line with a time, a place and an accuracy"):
        read_fixes(path, START)
    with pytest.raises(InputError, match="of another day"):
        check_times(path, np.array([9e8]), tracked()[0])
    with pytest.raises(InputError, match="the frames have no times"):
        check_times(path, np.array([1.0]), [point._replace(time=None) for point in tracked()[0]])
