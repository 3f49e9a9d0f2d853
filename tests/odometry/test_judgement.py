"""What is believed of steps over relief, slopes, patterns and shadows."""

import numpy as np
import pytest

from vinemap.measure.odometry.trials import template_error
from vinemap.measure.odometry.troubles import TROUBLES, drive
from vinemap.odometry.poses import Pose, moved
from vinemap.odometry.step import estimate_motion
from vinemap.simulate.camera import LOW, above, lay_ground, render
from vinemap.simulate.grounds import RESOLUTION


@pytest.fixture(scope="module")
def soil():
    return lay_ground("soil", size_mm=(700, 600), seed=3)


def pair(ground, *, far=60.0, camera=LOW, sunk=None):
    robot = [above(np.array([x, 0.0]), 0.0) for x in (0.0, far)]
    shots = [
        render(ground, pose, camera=c, seed=k)
        for k, (pose, c) in enumerate(zip(robot, (camera, sunk or camera), strict=True))
    ]
    return shots, moved(*robot)


def test_a_camera_that_sinks_sees_ground_grow(soil):
    shots, _ = pair(soil, sunk=LOW.model_copy(update={"above_ground_mm": 240.0}))
    assert estimate_motion(*shots, camera=LOW).scale == pytest.approx(245 / 240, abs=0.001)
    shots, _ = pair(soil)
    assert estimate_motion(*shots, camera=LOW).scale == pytest.approx(1, abs=0.001)


@pytest.mark.parametrize("degrees", [0.0, 4.0])
def test_the_tilt_of_ground_is_told(soil, degrees):
    ny, nx = soil.image.shape
    along = (np.arange(nx) - nx / 2) * RESOLUTION * np.tan(np.radians(degrees))
    tilted = soil._replace(relief=np.tile(along.astype(np.float32), (ny, 1)))
    shots, _ = pair(tilted)
    motion = estimate_motion(*shots, camera=LOW)
    assert motion.tilt_deg == pytest.approx(degrees, abs=0.4)
    assert motion.flag == ""


def test_relief_is_halved_by_patches():
    shots, robot, _ = drive(TROUBLES["relief of 20 mm"], "soil", 8, seed=2)
    for k in range(7):
        motion = estimate_motion(shots[k], shots[k + 1], camera=LOW)
        assert template_error(motion.movement, moved(robot[k], robot[k + 1]), LOW) < 0.25
        assert abs(motion.rotation_deg - moved(robot[k], robot[k + 1]).heading_deg) < 0.25


def test_the_bars_of_a_grate_are_told_apart_by_what_lies_between():
    shots, robot, _ = drive(TROUBLES["grate"], "gravel", 4, seed=2)
    for k in range(3):
        motion = estimate_motion(shots[k], shots[k + 1], camera=LOW)
        assert motion.flag == ""
        assert template_error(motion.movement, moved(robot[k], robot[k + 1]), LOW) < 0.1


def test_a_pattern_of_nothing_else_goes_with_the_movement_before(soil):
    shots, truth = pair(soil._replace(image=np.tile(soil.image[:100, :100], (15, 18))), far=55.0)  # every 40 mm
    for guess in (truth, Pose(truth.x_mm - 40, 0.0, 0.0)):
        motion = estimate_motion(*shots, camera=LOW, expected=guess)
        assert motion.flag == "ambiguous"
        assert template_error(motion.movement, guess, LOW) < 1


@pytest.mark.parametrize(("ground", "seed"), [("concrete", 2), ("snow", 5)])
def test_shadows_that_move_are_never_believed(ground, seed):
    shots, robot, _ = drive(TROUBLES["shadows that move"], ground, 6, seed=seed)
    for k in range(5):
        motion = estimate_motion(shots[k], shots[k + 1], camera=LOW)
        assert motion.flag or template_error(motion.movement, moved(robot[k], robot[k + 1]), LOW) < 5
