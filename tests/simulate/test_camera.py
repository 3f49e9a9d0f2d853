"""The virtual camera, by points whose place in an image follows from geometry."""

import numpy as np
import pytest

from vinemap.odometry.poses import Pose, moved
from vinemap.simulate.camera import (
    HIGH,
    LOW,
    Ground,
    Weather,
    lay_ground,
    render,
    rough,
    sinusoid,
    wander,
)
from vinemap.simulate.grounds import RESOLUTION

CLEAR = Weather(0, 0)
AHEAD = LOW.model_copy(update={"x_mm": 0.0})


def dot(x_mm, y_mm, size=1201):
    """Ground with a bright spot of 4 mm."""
    at = (np.arange(size) - size // 2) * RESOLUTION
    image = 250 * np.exp(-(((at - x_mm) ** 2)[None] + ((-at - y_mm) ** 2)[:, None]) / (2 * 2.0**2))
    return Ground(np.rint(image).astype(np.uint8))


def seen_at(image):
    """Column and row of the brightness's centre."""
    weights = image / image.sum(dtype=float)
    rows, columns = np.indices(image.shape)
    return (columns * weights).sum(), (rows * weights).sum()


@pytest.mark.parametrize("camera", [LOW, HIGH])
@pytest.mark.parametrize("heading", [0, 20, -65])
def test_a_point_of_the_ground_is_seen_where_it_is(camera, heading):
    a, camera = np.radians(heading), camera.model_copy(update={"x_mm": 40.0})
    robot = Pose(-30.0, 12.0, heading)
    place = np.array([20.0, 15.0])  # in the robot's frame
    on_ground = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ place + robot[:2]
    column, row = seen_at(render(dot(*on_ground), robot, camera=camera, weather=CLEAR))
    assert camera.ground(column, row) == pytest.approx(place, abs=0.02)


@pytest.mark.parametrize("height", [-8.0, 0.0, 10.0])
def test_what_is_higher_is_seen_further_out(height):
    ground = dot(60, 0)
    ground = ground._replace(relief=np.full(ground.image.shape, height, np.float32))
    column, row = seen_at(render(ground, Pose(0, 0, 0), camera=AHEAD, weather=CLEAR))
    assert AHEAD.ground(column, row) == pytest.approx([60 * 245 / (245 - height), 0], abs=0.05)


def test_movement_is_seen_from_where_the_robot_was():
    assert moved(Pose(10, 20, 90), Pose(10, 50, 100)) == pytest.approx((30, 0, 10))
    assert moved(Pose(0, 0, 179), Pose(0, 5, -179)) == pytest.approx((5 * np.sin(np.radians(179)), -5, 2), abs=1e-3)


def test_the_path_of_the_thesis():
    poses = np.array(sinusoid())
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert 156 <= len(poses) <= 166  # Section 4.4
    assert steps == pytest.approx(61, abs=0.3)
    assert np.abs(poses[:, 1]).max() == pytest.approx(150, abs=1)
    along = np.degrees(np.arctan2(np.diff(poses[:, 1]), np.diff(poses[:, 0])))
    assert along == pytest.approx((poses[1:, 2] + poses[:-1, 2]) / 2, abs=0.1)
    assert np.abs(np.diff(poses[:, 2])).max() < 9


def test_a_robot_that_wanders_stays_about_the_origin():
    walk = wander(50, seed=1)
    cameras = [(p.x_mm + 950 * np.cos(np.radians(p.heading_deg)), p.heading_deg) for p in walk]
    assert np.abs([x for x, _ in cameras]).max() <= 250
    assert np.abs(np.diff([heading for _, heading in cameras])).max() <= 9


def test_relief_is_as_told():
    ground = rough(lay_ground("soil", size_mm=(800, 800)), amplitude_mm=8, correlation_mm=30, seed=2)
    relief = ground.relief - ground.relief.mean()
    assert np.ptp(relief) == pytest.approx(8, abs=0.5)
    lag = round(30 / RESOLUTION)
    assert np.mean(relief[:, lag:] * relief[:, :-lag]) / relief.var() == pytest.approx(np.exp(-1), abs=0.12)


def test_weather_is_as_told():
    ground = Ground(np.full((1001, 1001), 120, np.uint8))
    camera = AHEAD
    noisy = render(ground, Pose(0, 0, 0), camera=camera, weather=Weather(3, 0)).astype(float)
    uneven = render(ground, Pose(0, 0, 0), camera=camera, weather=Weather(0, 0.05)).astype(float)
    assert noisy.std() == pytest.approx(3, abs=0.1)
    assert np.ptp(uneven) / 120 == pytest.approx(0.095, abs=0.01)


def test_the_edge_of_the_ground_is_no_ground():
    with pytest.raises(ValueError, match="beyond the ground"):
        render(dot(0, 0), Pose(0, 0, 0))


def test_a_recording_to_try_things_on(tmp_path):
    from vinemap.config.drives import load_camera
    from vinemap.odometry.frames import read_recording
    from vinemap.simulate.drive import BEGUN, record

    robot = [Pose(k * 30.0 - 950, 0, 0) for k in range(3)]
    laid = lay_ground("soil", size_mm=(600, 500))
    record(tmp_path, laid, robot)
    camera = load_camera(tmp_path / "camera.yaml")
    assert camera == LOW
    frames = list(read_recording([tmp_path / "frames"], camera=camera).frames)
    assert [frame.time for frame in frames] == pytest.approx([BEGUN, BEGUN + 0.2, BEGUN + 0.4])
    assert np.array_equal(frames[2].image, render(laid, robot[2], seed=2))
