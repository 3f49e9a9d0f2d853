"""Gaps between stretches of a track: what crosses them, how sure that is, and what contradicts it."""

import numpy as np
import pytest

from vinemap.odometry.poses import STILL, Pose, moved, onward, onward_covariance
from vinemap.odometry.sensors.bridging import bridged, joined
from vinemap.odometry.sensors.fixes import Fixes
from vinemap.odometry.sensors.pulling import pulled
from vinemap.odometry.sensors.wheels import Odometer, Wheels
from vinemap.odometry.step import Motion
from vinemap.odometry.track import TrackPoint, stretches

PERIOD = 0.2
MEASURED, GUESSED = np.diag([0.1**2, 0.1**2, 0.02**2]), np.diag([35.0**2, 35.0**2, 3.0**2])
GAP = range(60, 70)


def bends(n=140, *, seed=0):
    """Steps of a robot whose turns rise and fall, and whose speed wavers a bit."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi)
    turns = 3 * np.sin(2 * np.pi * np.arange(n) / 50 + phase)
    return [Pose(60 + rng.normal(0, 0.5), 0.0, turn) for turn in turns]


def tracked(steps, lost=GAP, *, flag="blank", seed=0):
    """A track whose measured steps err as they say, carried on by the last one where frames are lost; and the truth."""
    rng = np.random.default_rng(seed)
    track, true = [TrackPoint("0", 0.0, STILL, np.zeros((3, 3)), MEASURED, 245.0)], [STILL]
    last = steps[0]
    for k, step in enumerate(steps[1:], start=1):
        alone = k in lost or k - 1 in lost
        of_step = GUESSED if alone else MEASURED
        last = last if alone else Pose(*map(float, rng.multivariate_normal(step, of_step)))
        before = track[-1]
        why = flag if k in lost else "score" if alone else ""
        covariance = onward_covariance(before.pose, before.covariance, last, of_step)
        point = TrackPoint(str(k), PERIOD * k, onward(before.pose, last), covariance, of_step, 245.0, why)
        track.append(point if alone else point._replace(measured_from=k - 1, motion=Motion(*last, of_step)))
        true.append(onward(true[-1], step))
    return track, true


def wheels_of(steps, *, speed=1.0, rate=1.0):
    """An odometer of such a robot, which has learned of its frames."""
    values = np.array([*steps, steps[-1]])
    speeds, rates = (np.repeat(values[1:, c] / PERIOD, 2) for c in (0, 2))
    edges = np.repeat(PERIOD * np.arange(len(values)), 2)[1:-1] + np.tile([1e-6, -1e-6], len(values) - 1)
    return Odometer(Wheels(edges, speed * speeds, rate * rates))


def off(track, true):
    return np.array([np.hypot(*np.subtract(f.pose[:2], t[:2])) for f, t in zip(track, true, strict=True)])


def crossed(track):
    """The movement across the gap."""
    return moved(track[GAP[0] - 1].pose, track[GAP[-1] + 1].pose)


def test_a_gap_is_crossed_by_the_steps_beside_it():
    track, true = tracked(bends())
    found = bridged(track)
    assert off(track, true).max() > 300
    assert off(found, true).max() < 60
    assert [point.flag for point in found] == [point.flag for point in track]
    assert stretches(found) == stretches(track)
    measured = [k for k in range(1, 140) if track[k].motion]
    for k in measured:
        assert moved(found[k - 1].pose, found[k].pose) == pytest.approx(track[k].motion.movement, abs=1e-6)


def test_steps_that_err_are_smoothed():
    """Where each turn is wrong by a third of a degree, no curve through all of them may be taken."""
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        steps = bends(seed=seed)
        unsure, _ = tracked([step._replace(heading_deg=step.heading_deg + rng.normal(0, 0.3)) for step in steps])
        true = np.sum([steps[k].heading_deg for k in range(GAP[0], GAP[-1] + 2)])
        errors.append(crossed(bridged(unsure)).heading_deg - true)
    assert np.sqrt(np.mean(np.square(errors))) < 3.3


def test_it_is_as_sure_as_it_errs():
    z = []
    for seed in range(40):
        track, true = tracked(bends(seed=seed), seed=seed)
        found = bridged(track)
        k = GAP[-1] + 1
        z.append((found[k].pose.heading_deg - true[k].heading_deg) ** 2 / found[k].covariance[2, 2])
    assert 0.4 < np.mean(z) < 1.8


def test_wheels_cross_what_steps_beside_a_gap_dont_show():
    steps = [
        Pose(0.0, 0.0, 0.0) if k in range(62, 69) or k in range(20, 27) else step for k, step in enumerate(bends())
    ]
    track, true = tracked(steps)
    alone, driven = bridged(track), bridged(track, wheels_of(steps))
    assert off(alone, true).max() > 200
    assert off(driven, true).max() < 20
    assert driven[70].covariance[0, 0] < alone[70].covariance[0, 0]


def test_wheels_without_yaw_rates_leave_the_turn_to_the_steps_beside():
    steps = bends()
    track, true = tracked(steps)
    found = bridged(track, wheels_of(steps, rate=np.nan))
    way, truth = crossed(found), moved(true[59], true[70])
    assert way.heading_deg == pytest.approx(truth.heading_deg, abs=3)
    assert way.heading_deg == pytest.approx(crossed(bridged(track)).heading_deg, abs=1e-9)
    assert way.x_mm == pytest.approx(truth.x_mm, abs=5)


def test_wheels_that_fall_silent_tell_nothing_of_a_gap():
    """Their yaw rates go on."""
    track, _ = tracked(bends())
    wheels = wheels_of(bends(), speed=1.1).wheels
    silent = wheels.speeds.copy()
    silent[::2] = np.nan  # a file with speeds and yaw rates in turn
    found, alone = bridged(track, Odometer(wheels._replace(speeds=silent))), bridged(track)
    assert crossed(found).x_mm == pytest.approx(crossed(alone).x_mm, abs=5)
    assert [found[k].of_step[0, 0] for k in GAP] == [alone[k].of_step[0, 0] for k in GAP]


def test_a_gap_of_the_robots_own_making_is_no_surer_than_a_guess():
    track, _ = tracked(bends(), flag="score")
    found = bridged(track)
    assert crossed(found) != pytest.approx(crossed(track), abs=1)
    assert all(np.diag(found[k].of_step) == pytest.approx(np.diag(GUESSED)) for k in GAP)


def test_what_compares_with_nothing_stays():
    track, _ = tracked(bends(), lost=range(6, 134))
    assert [point.pose for point in bridged(track)] == [point.pose for point in track]


def test_a_track_without_gaps_stays():
    track, _ = tracked(bends(), lost=())
    assert [point.pose for point in bridged(track)] == [point.pose for point in track]


def test_images_without_times_are_bridged_frame_by_frame():
    track, _ = tracked(bends())
    timeless = [point._replace(time=None) for point in track]
    assert crossed(bridged(timeless)) == pytest.approx(crossed(bridged(track)), abs=1e-6)


def test_frames_that_a_recorder_dropped_count_by_their_time():
    straight = [Pose(60.0, 0.0, 0.0)] * 140
    track, true = tracked(straight)
    late = [point._replace(time=point.time + 1.0 * (k > 65)) for k, point in enumerate(track)]  # five more steps
    assert crossed(bridged(late)).x_mm == pytest.approx(16 * 60, abs=3)
    assert crossed(bridged(track)).x_mm == pytest.approx(moved(true[59], true[70]).x_mm, abs=3)


def test_a_pause_longer_than_any_stretch_that_frames_tell_is_no_way():
    track, _ = tracked(bends())
    on_hold = [point._replace(time=point.time + 3600.0 * (k > 65)) for k, point in enumerate(track)]
    assert [point.pose for point in bridged(on_hold)] == [point.pose for point in track]


def test_a_pause_is_as_sure_as_stretches_that_last_as_long():
    track, _ = tracked(bends())
    late = [point._replace(time=point.time + 3.0 * (k > 65)) for k, point in enumerate(track)]
    longer, usual = (bridged(some)[GAP[-1] + 1].covariance[2, 2] for some in (late, track))
    assert longer > 4 * usual


def test_a_pause_of_the_recorder_is_as_unsure_as_it_is_long():
    track, _ = tracked(bends(), lost=range(60, 61), flag="score")
    late = [point._replace(time=point.time + 0.8 * (k > 60)) for k, point in enumerate(track)]  # five steps
    assert np.diag(bridged(late)[61].of_step) == pytest.approx(25 * np.diag(GUESSED))
    driven = bridged(late, wheels_of([*bends(), *bends()]))
    assert np.diag(driven[61].of_step) == pytest.approx(np.diag(GUESSED))


def test_wheels_that_compare_with_few_stretches_are_trusted_less():
    track, _ = tracked(bends())
    wheels = wheels_of(bends(), speed=1.005).wheels
    there = slice(2 * 43, 2 * 72)  # the gap, and hardly more than one stretch as long before it
    parts = Odometer(wheels), Odometer(Wheels(*(values[there] for values in wheels[:3]))), None
    often, once, alone = (bridged(track, wheels)[GAP[-1]].of_step[0, 0] for wheels in parts)
    assert often < once == pytest.approx(alone)


def test_a_time_that_is_written_twice_costs_no_other_its_own():
    track, _ = tracked([Pose(60.0, 0.0, 0.0)] * 140)
    late = [point._replace(time=point.time + 1.0 * (k > 65)) for k, point in enumerate(track)]
    late[100] = late[100]._replace(time=late[99].time)
    assert crossed(bridged(late)).x_mm == pytest.approx(16 * 60, abs=3)


def test_places_that_contradict_what_bridges_a_gap_have_it_their_way():
    steps = [Pose(0.0, 0.0, 0.0) if k in range(62, 69) else step for k, step in enumerate(bends())]
    track, true = tracked(steps)
    at = np.linspace(0, 139, 8).astype(int)
    fixes = Fixes(PERIOD * at, np.array([true[k][:2] for k in at]), np.full(8, 20.0))
    assert not pulled(bridged(track), fixes).fits or pulled(bridged(track), fixes).left_out
    found = joined(track, fixes)
    assert (found.left_out, found.fits) == (0, True)
    assert off(found.track, true)[at].max() < 30


def test_places_at_both_ends_hold_a_bridged_track():
    track, true = tracked(bends())
    fixes = Fixes(np.array([0.0, 139 * PERIOD]), np.array([true[0][:2], true[-1][:2]]), np.full(2, 20.0))
    found = joined(track, fixes)
    assert off(found.track, true).max() < 30 < off(pulled(track, fixes).track, true).max()
    assert found.fits
