"""The camera: what it sees where, and what is no camera."""

import numpy as np
import pytest

from vinemap.config.camera import Camera
from vinemap.config.drives import load_camera
from vinemap.config.template import template
from vinemap.errors import ConfigError
from vinemap.simulate.camera import LOW


def test_a_pixel_is_as_large_as_the_thesis_says():
    assert LOW.ground(161, 120) - LOW.ground(160, 120) == pytest.approx([0.8182, 0], abs=1e-4)
    assert LOW.ground(160, 119) - LOW.ground(160, 120) == pytest.approx([0, 0.8183], abs=1e-4)
    assert LOW.ground(159.5, 119.5) == pytest.approx([950, 0])


@pytest.mark.parametrize(("turned", "right"), [(0, (1, 0)), (-90, (0, -1)), (90, (0, 1)), (180, (-1, 0))])
def test_the_right_edge_lies_where_it_is_turned_to(turned, right):
    camera = LOW.model_copy(update={"turned_deg": float(turned)})
    step = camera.ground(camera.axis[0] + 1, camera.axis[1]) - camera.ground(*camera.axis)
    assert step / np.hypot(*step) == pytest.approx(right, abs=1e-9)


def test_ground_and_pixel_are_each_others_inverse():
    camera = Camera(**LOW.model_dump() | {"turned_deg": 33.0, "cx": 140.0, "y_mm": -80.0})
    assert camera.pixel(*camera.ground(12.5, 200.0)) == pytest.approx([12.5, 200.0])


GOOD = {"width": 320, "height": 240, "fx": 299.4, "fy": 299.4, "above_ground_mm": 245}


def write(path, keys):
    path.write_text("".join(f"{key}: {value}\n" for key, value in keys.items()))
    return path


def test_a_file_of_a_camera(tmp_path):
    camera = load_camera(write(tmp_path / "camera.yaml", GOOD | {"distortion": [-0.1, 0.01, 0, 0, 0]}))
    assert camera.distortion == (-0.1, 0.01, 0, 0, 0)
    wide = [12.3, -31.5, 0.001, -0.002, 8.9, 12.6, -30.8, 4.1]  # as OpenCV's rational model has them
    assert load_camera(write(tmp_path / "wide.yaml", GOOD | {"distortion": wide})).distortion == tuple(wide)
    assert camera.axis == (159.5, 119.5)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"fx": None}, "fx is missing"),
        ({"above_ground_mm": None}, "above_ground_mm is missing"),
        ({"above_ground_mm": -245}, "above_ground_mm = -245: input should be greater than or equal to 10"),
        ({"above_ground_mm": 0.245}, "above_ground_mm = 0.245"),
        ({"fx": 0}, "fx = 0: input should be greater than 0"),
        ({"fx": 0.003, "fy": 0.003}, "makes 18.*°: is it in pixels"),
        ({"fx": 1e6, "fy": 1e6}, "is it in pixels"),
        ({"fy": 350}, "pixels must be square"),
        ({"fx": ".nan"}, "finite number"),
        ({"fx": "much"}, "fx = 'much': input should be a valid number"),
        ({"width": 0}, "width = 0"),
        ({"width": 32.5}, "width = 32.5"),
        ({"cx": 500}, "lie outside of the image"),
        ({"mask": [[[0, 0], [10, 0]]]}, "mask"),
        ({"mask": [[[0, 0], [400, 0], [0, 90]]]}, "mask reaches beyond the image's 320 × 240 pixels"),
        ({"distortion": [0.1]}, "must be 4, 5 or 8 numbers"),
        ({"distortion": [500, 0, 0, 0]}, "distortion.0 = 500: input should be less than or equal to 200"),
        ({"hight": 245}, "unknown key hight: did you mean 'height'"),
    ],
)
def test_what_is_no_camera_is_refused_in_one_line(tmp_path, wrong, says):
    keys = {key: value for key, value in (GOOD | wrong).items() if value is not None}
    path = write(tmp_path / "camera.yaml", keys)
    with pytest.raises(ConfigError, match=says) as error:
        load_camera(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_the_template_is_a_camera(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(template("camera"))
    assert load_camera(path).width == 320
