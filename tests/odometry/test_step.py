"""Movement between two frames of known ground, in millimetres and degrees."""

from itertools import pairwise

import numpy as np
import pytest

from vinemap.config.camera import Camera
from vinemap.errors import InputError
from vinemap.measure.odometry.trials import template_error
from vinemap.odometry.correlation import Place, search_of
from vinemap.odometry.poses import Pose, moved
from vinemap.odometry.step import estimate_motion, peaks_near
from vinemap.simulate.camera import HIGH, LOW, Ground, Weather, lay_ground, render, rough, wander

SIZE = (1000, 1000)


@pytest.fixture(scope="module")
def grounds():
    return {name: lay_ground(name, size_mm=SIZE, seed=4) for name in ("gravel", "soil")}


@pytest.fixture(scope="module")
def walk(grounds):
    """Pairs of frames on two grounds, each with the true movement."""
    poses = wander(21, seed=6)
    out = {}
    for name, ground in grounds.items():
        frames = [render(ground, pose, seed=k) for k, pose in enumerate(poses)]
        out[name] = [(*pair, moved(*step)) for pair, step in zip(pairwise(frames), pairwise(poses), strict=True)]
    return out


def errors(pairs, **options):
    """Error (n,) of the template's place in mm, and of the turn in degrees."""
    out = []
    for frame, next_frame, truth in pairs:
        motion = estimate_motion(frame, next_frame, camera=LOW, **options)
        out.append((template_error(motion.movement, truth, LOW), abs(motion.rotation_deg - truth.heading_deg)))
    return np.transpose(out)


@pytest.mark.parametrize("name", ["gravel", "soil"])
def test_a_step_is_measured_to_hundredths_of_a_millimetre(walk, name):
    place, turn = errors(walk[name], method="quadratic")
    assert np.median(place) < 0.03
    assert place.max() < 0.12
    assert turn.mean() < 0.08


@pytest.mark.parametrize("name", ["gravel", "soil"])
def test_alignment_halves_what_is_left(walk, name):
    place, turn = errors(walk[name], method="quadratic")
    closer, straighter = errors(walk[name])
    assert np.median(closer) < 0.6 * np.median(place)
    assert straighter.mean() < 0.5 * turn.mean()


def test_the_enhanced_algorithm_beats_the_standard_one_as_the_thesis_says(walk):
    pairs = [*walk["gravel"], *walk["soil"]]
    standard, centroid, quadratic = (errors(pairs, method=m) for m in ("maximum", "centroid", "quadratic"))
    assert np.median(standard[0]) == pytest.approx(0.33, abs=0.05)  # of pixels of 0.82 mm
    assert np.median(centroid[0]) < 0.46 * np.median(standard[0])  # Table 4.3: 54% better
    assert np.mean(centroid[1]) < 0.6 * np.mean(standard[1])
    assert np.median(quadratic[0]) < 0.15 * np.median(standard[0])
    assert np.mean(quadratic[1]) < 0.35 * np.mean(standard[1])


@pytest.mark.parametrize("method", ["aligned", "quadratic", "centroid", "maximum"])
def test_coarse_to_fine_finds_what_the_exhaustive_search_finds(walk, method):
    for frame, next_frame, _ in [*walk["gravel"][::4], *walk["soil"][::4]]:
        quick, whole = (
            estimate_motion(frame, next_frame, camera=LOW, method=method, search=search)
            for search in ("coarse to fine", "exhaustive")
        )
        assert template_error(quick.movement, whole.movement, LOW) < 0.003
        assert quick.rotation_deg == pytest.approx(whole.rotation_deg, abs=0.008)


@pytest.mark.parametrize("camera", [HIGH, Camera(width=640, height=480, fx=599, fy=599, above_ground_mm=245)])
def test_more_pixels_measure_more_finely(grounds, camera):
    robot = [Pose(-camera.x_mm + x, y, heading) for x, y, heading in ((0, 0, 0), (61, 4, 0), (0, 0, 3))]
    first, *others = [render(grounds["soil"], pose, camera=camera, seed=k) for k, pose in enumerate(robot)]
    for other, pose in zip(others, robot[1:], strict=True):
        motion, truth = estimate_motion(first, other, camera=camera), moved(robot[0], pose)
        assert motion.flag == ""
        assert template_error(motion.movement, truth, camera) < 0.01
        assert motion.rotation_deg == pytest.approx(truth.heading_deg, abs=0.01)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"template_share": 0.0}, "template_share = 0 "),
        ({"template_share": 1.0}, "template_share = 1 "),
        ({"template_share": 0.02}, "0.02 of 240 pixels"),
        ({"template_share": float("nan")}, "template_share = nan"),
        ({"angles": (9.0, -9.0)}, "from 9° to -9° hold nothing"),
        ({"angles": (0.0, 1000.0)}, "hold nothing"),
    ],
)
def test_absurd_options_are_refused(walk, options, says):
    frame, next_frame, _ = walk["soil"][0]
    with pytest.raises(InputError, match=says):
        estimate_motion(frame, next_frame, camera=LOW, **options)


def test_the_template_lies_where_both_frames_should_show_it(grounds):
    """Steps too long for a template of the middle are measured where they are expected."""
    robot = [Pose(x - 950, 0, heading) for x, heading in ((0, 0), (150, 2))]
    frames = [render(grounds["gravel"], pose, seed=k) for k, pose in enumerate(robot)]
    truth = moved(*robot)
    assert estimate_motion(*frames, camera=LOW).flag
    guess = Pose(truth.x_mm - 9, truth.y_mm + 6, 0.5)
    motion = estimate_motion(*frames, camera=LOW, expected=guess)
    assert motion.flag == ""
    assert motion.rotation_deg == pytest.approx(2, abs=0.03)
    assert template_error(motion.movement, truth, LOW) < 0.05


def test_steps_on_good_ground_are_believed(walk):
    motions = [estimate_motion(a, b, camera=LOW) for pairs in walk.values() for a, b, _ in pairs]
    assert sum(motion.flag != "" for motion in motions) <= 1
    assert min(motion.agreement for motion in motions) > 0.7
    assert max(motion.rival for motion in motions) < 0.35


@pytest.mark.parametrize(
    ("right", "down", "movement"), [(10, 0, (-10, 0)), (0, 10, (0, 10)), (-7, 4, (7, 4)), (0, 0, (0, 0))]
)
def test_ground_that_moves_back_in_the_image_means_forward(grounds, right, down, movement):
    frame = render(grounds["gravel"], Pose(-950, 0, 0), weather=Weather(0, 0))
    shifted = np.roll(frame, (down, right), axis=(0, 1))
    motion = estimate_motion(frame, shifted, camera=LOW)
    assert np.array([motion.dx_mm, motion.dy_mm]) == pytest.approx(np.array(movement) * 0.8183, abs=0.05)
    assert motion.rotation_deg == pytest.approx(0, abs=0.003)


@pytest.mark.parametrize("turn", [90, 180])
def test_a_turned_camera_means_a_turned_robot(grounds, turn):
    camera = Camera(width=240, height=240, fx=299.4, fy=299.4, above_ground_mm=245)
    frame = render(grounds["gravel"], Pose(0, 0, 0), camera=camera, weather=Weather(0, 0))
    # A robot that turns to the left sees the ground turn to the right.
    turned = np.rot90(frame, -turn // 90).copy()
    motion = estimate_motion(frame, turned, camera=camera, angles=(turn - 9, turn + 9))
    assert motion.rotation_deg == pytest.approx(turn, abs=0.05)
    assert (motion.dx_mm, motion.dy_mm) == pytest.approx((0, 0), abs=0.05)


def test_the_lever_of_the_camera_counts(grounds):
    """A robot that turns on the spot moves its camera, not itself."""
    poses = Pose(-950, 0, 0), Pose(-950, 0, 3)
    frames = [render(grounds["gravel"], pose, seed=k) for k, pose in enumerate(poses)]
    motion = estimate_motion(*frames, camera=LOW)
    assert motion.rotation_deg == pytest.approx(3, abs=0.02)
    assert np.hypot(motion.dx_mm, motion.dy_mm) < 0.4


def test_relief_of_grass_costs_less_than_a_tenth_of_a_millimetre():
    ground = rough(lay_ground("grass", size_mm=SIZE, seed=2), amplitude_mm=8, correlation_mm=30, seed=2)
    poses = wander(25, seed=2)
    frames = [render(ground, pose, seed=k) for k, pose in enumerate(poses)]
    pairs = [(*pair, moved(*step)) for pair, step in zip(pairwise(frames), pairwise(poses), strict=True)]
    place, turn = errors(pairs)
    assert np.median(place) < 0.08
    assert turn.mean() < 0.15


def flags(frames):
    return [estimate_motion(*pair, camera=LOW).flag for pair in frames]


def test_frames_of_other_places_are_never_believed(grounds):
    far = [Pose(x - 950, y, 0) for x in (-300, 0, 300) for y in (-330, -110, 110, 330)]
    for ground in grounds.values():
        frames = [render(ground, pose, seed=k) for k, pose in enumerate(far)]
        assert all(flags((a, b) for a in frames[:5] for b in frames[6:]))


@pytest.mark.parametrize("far", [125, 140, 160, 180])
def test_a_step_beyond_the_overlap_is_flagged(grounds, far):
    frames = [render(grounds["gravel"], Pose(x - 950, 0, 0)) for x in (0, far)]
    assert flags([frames]) != [""]


def test_a_turn_beyond_the_angles_is_flagged(grounds):
    frames = [render(grounds["soil"], Pose(-950, 0, heading)) for heading in (0, 12)]
    assert flags([frames]) != [""]


def test_some_dirt_on_the_lens_is_never_taken_for_standing_still(walk):
    """Twenty dark spots at the same places of all frames, on a twentieth of them."""
    import cv2

    rng, clear = np.random.default_rng(1), np.ones((240, 320), np.float32)
    for _ in range(20):
        spot = np.zeros_like(clear)
        cv2.circle(spot, (int(rng.integers(320)), int(rng.integers(240))), int(rng.integers(3, 15)), 1, -1)
        clear *= 1 - rng.uniform(0.4, 0.8) * cv2.GaussianBlur(spot, (0, 0), 2)
    for frame, next_frame, truth in [*walk["gravel"], *walk["soil"]]:
        motion = estimate_motion(*((image * clear).astype(np.uint8) for image in (frame, next_frame)), camera=LOW)
        assert motion.flag or template_error(motion.movement, truth, LOW) < 5


def test_blur_is_flagged(grounds):
    pose = Pose(-950, 0, 0)
    frames = [render(grounds["gravel"], pose, weather=Weather(blur=blur)) for blur in (0, 4)]
    assert flags([frames, frames[::-1]]) == ["blur", "blur"]


def test_ground_that_repeats_is_flagged(grounds):
    tile = np.tile(grounds["gravel"].image[:100, :100], (25, 25))  # every 40 mm
    frames = [render(Ground(tile), Pose(x - 950, 0, 0), seed=k) for k, x in enumerate((0, 12))]
    assert flags([frames]) == ["ambiguous"]


@pytest.mark.parametrize("level", [0, 255])
def test_a_black_or_white_frame_is_flagged(grounds, level):
    frame, blank = render(grounds["gravel"], Pose(-950, 0, 0)), np.full((240, 320), level, np.uint8)
    motion = estimate_motion(frame, blank, camera=LOW)
    assert (motion.flag, motion.dx_mm, motion.dy_mm, motion.score) == ("blank", 0, 0, 0)
    assert flags([(blank, frame), (blank, blank)]) == ["blank", "blank"]


@pytest.mark.parametrize(
    ("shape", "kind", "says"),
    [
        ((240, 320, 3), np.uint8, "give grey images"),
        ((240, 320), np.uint16, "uint16"),
        ((720, 1280), np.uint8, "1280 × 720 pixels, the camera 320 × 240"),
    ],
)
def test_other_frames_are_refused(shape, kind, says):
    good = np.zeros((240, 320), np.uint8)
    with pytest.raises(InputError, match=says):
        estimate_motion(good, np.zeros(shape, kind), camera=LOW)


@pytest.mark.parametrize(("agreed", "n"), [(0.9, 1), (0.5, 3)])
def test_only_beside_a_sure_place_are_others_left_out(agreed, n):
    """However little agrees at a place that is known roughly, it may be the right one."""
    image = np.random.default_rng(3).normal(size=(40, 60)).astype(np.float32)
    fine = search_of(image, image, centre=(20, 30), half=6, step=1.15, angles=(-2, 2), cubic=True)
    places = [Place(0.0, 20.0, column) for column in (14.0, 30.0, 46.0)]

    def agree(place, *, most_change):
        likely = place.column == 30.0
        return (0.4 if likely else 0.05) if most_change == np.inf else (agreed if likely else 0.0), 1.0

    peaks = peaks_near(fine, places, agree, 2)
    assert len(peaks) == n
    assert peaks[0, 20, 30] == (pytest.approx(1.0), agreed)
