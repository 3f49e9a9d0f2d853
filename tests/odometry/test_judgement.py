"""Patches that must agree: what they correct, how sure they are, and what they flag."""

import numpy as np
import pytest

from vinemap.measure.odometry.trials import template_error
from vinemap.measure.odometry.troubles import TROUBLES, drive
from vinemap.odometry.correlation import Place
from vinemap.odometry.judgement import ALIKE, Patches, fit_of, patches_at
from vinemap.odometry.poses import Pose, moved, onward, onward_covariance
from vinemap.odometry.step import estimate_motion
from vinemap.odometry.views import view_of
from vinemap.simulate.camera import LOW, above, lay_ground, render
from vinemap.simulate.grounds import RESOLUTION

FOCAL = 300.0
PLACE, CENTRE = Place(3.0, 100.0, 140.0), (120, 160)


def patches(shift, turn, *, scale=0.0, slope=(0.0, 0.0), noise=0.0, seed=0):
    """Patches that a movement, a scale and a slope put aside."""
    places = np.stack(np.meshgrid(np.linspace(40, 280, 5), np.linspace(30, 210, 5)), axis=-1).reshape(-1, 2)
    x, y = (places - [PLACE.column, PLACE.row]).T
    far = np.array([PLACE.column - CENTRE[1], PLACE.row - CENTRE[0]]) / FOCAL
    raised = slope[0] * x + slope[1] * y
    shifts = np.column_stack([shift[0] - turn * y + scale * x, shift[1] + turn * x + scale * y])
    shifts += raised[:, None] * far + np.random.default_rng(seed).normal(0, noise, places.shape)
    return Patches(places, shifts, np.full(25, 0.9))


def test_patches_tell_movement_scale_and_slope():
    fit = fit_of(patches((0.4, -0.2), 0.002, scale=0.01, slope=(0.05, -0.08)), PLACE, CENTRE, FOCAL)
    assert fit.scale == pytest.approx(0.01, abs=1e-9)
    assert fit.slope == pytest.approx([0.05, -0.08], abs=1e-9)
    assert max(fit.rest, fit.apart) < 1e-9 < fit.spread
    fit = fit_of(patches((0.4, -0.2), 0.002), PLACE, CENTRE, FOCAL)
    assert fit.corrected(PLACE) == pytest.approx((3 + np.degrees(0.002), 99.8, 140.4))
    assert fit_of(patches((0, 0), 0), Place(0.0, 120.0, 160.0), CENTRE, FOCAL).slope is None


def test_patches_in_a_line_tell_no_more_than_they_can():
    along = np.linspace(0, 400, 13).round()
    for seed in range(20):
        shifts = np.random.default_rng(seed).normal(0, 0.1, (13, 2))
        fit = fit_of(Patches(np.column_stack([along, np.full(13, 200.0)]), shifts, np.ones(13)), PLACE, CENTRE, FOCAL)
        assert abs(fit.scale) < 0.01
        assert fit.rest < 0.2
        assert (np.linalg.eigvalsh(fit.covariance) > 0).all()


def test_how_sure_a_fit_is_follows_from_how_far_patches_disagree():
    fits = [fit_of(patches((0, 0), 0, noise=0.3, seed=k), PLACE, CENTRE, FOCAL) for k in range(300)]
    errors = np.array([[*fit.shift, fit.turn] for fit in fits])
    told = np.sqrt(np.diag(np.mean([fit.covariance for fit in fits], axis=0)) / ALIKE)
    assert errors.std(axis=0) == pytest.approx(told, rel=0.1)


def test_a_place_that_patches_put_elsewhere_is_as_unsure_as_that():
    fit = fit_of(patches((0.4, -0.2), 0.002, noise=0.01), PLACE, CENTRE, FOCAL)
    place, unsure = fit.turned(PLACE)
    assert (place.row, place.column) == (PLACE.row, PLACE.column)
    assert place.angle == fit.corrected(PLACE).angle
    assert np.sqrt(np.diag(unsure.covariance)[:2]) == pytest.approx([0.4, 0.2], abs=0.02)
    assert unsure.covariance[2, 2] == fit.covariance[2, 2]
    assert np.linalg.eigvalsh(unsure.covariance)[0] > 0


def test_a_patch_that_goes_its_own_way_does_not_agree():
    some = patches((0.5, 0.5), 0)
    some.shifts[3] = (5.0, -4.0)
    some.scores[7] = 0.3
    assert np.flatnonzero(~some.agree).tolist() == [3, 7]
    assert some.fit
    some.scores[8:] = 0.3
    assert not some.fit


@pytest.mark.parametrize("part", [0.25, 0.5, 0.75])
def test_parts_of_a_pixel_are_not_drawn_to_whole_ones(part):
    """To 0.02 pixels, as waves of six pixels are by linear interpolation at a quarter of one."""
    x, y = np.meshgrid(np.arange(LOW.width), np.arange(LOW.height))
    rng = np.random.default_rng(0)
    waves = [(np.cos(a), np.sin(a), b) for a, b in rng.uniform(0, 2 * np.pi, (40, 2))]

    def seen(off):
        image = sum(np.cos((x - off) * c + y * s + b) for c, s, b in waves)
        return view_of(np.rint(128 + 6 * image).clip(0, 255).astype(np.uint8), camera=LOW)

    middle = (LOW.height / 2, LOW.width / 2)
    found = patches_at(seen(0), seen(part), middle, Place(0.0, middle[0], middle[1] + part))
    assert len(found.scores) > 20
    assert np.abs(np.mean(found.shifts, axis=0)).max() < 0.005


def over_relief(seed):
    """Patches that rolling ground puts aside, along the movement, neighbours alike."""
    some = patches((0.4, -0.2), 0.002, noise=0.02, seed=seed)
    hills = np.random.default_rng(seed).normal(0, 1.5, (6, 6))
    heights = (hills[1:, 1:] + hills[1:, :-1] + hills[:-1, 1:] + hills[:-1, :-1]).ravel() / 2
    way = np.array([PLACE.column - CENTRE[1], PLACE.row - CENTRE[0]])
    return some._replace(shifts=some.shifts + heights[:, None] * way / np.hypot(*way))


def test_relief_says_nothing_across_the_movement_and_spoils_no_turn():
    fits = [fit_of(over_relief(seed), PLACE, CENTRE, FOCAL) for seed in range(100)]
    turns = np.array([fit.turn for fit in fits]) - 0.002
    assert np.percentile(np.abs(turns), 90) < 3e-4
    errors = np.array([fit.shift for fit in fits]) - [0.4, -0.2]
    way = np.array([PLACE.column - CENTRE[1], PLACE.row - CENTRE[0]]) / np.hypot(20, 20)
    along, across = errors @ way, errors @ [-way[1], way[0]]
    assert across.std() < 0.05 < along.std()
    told = np.sqrt([way @ fit.covariance[:2, :2] @ way for fit in fits])
    assert 0.6 < np.sqrt(np.mean((along / told) ** 2)) < 1.8  # few patches tell little of how alike they are


def test_large_frames_judge_relief_as_small_ones_do():
    small = over_relief(3)
    large = Patches(3 * small.places, 3 * small.shifts, small.scores, 3)
    assert np.array_equal(large.agree, small.agree)
    place = PLACE._replace(row=3 * PLACE.row, column=3 * PLACE.column)
    by_small, by_large = (
        fit_of(small, PLACE, CENTRE, FOCAL),
        fit_of(large, place, tuple(3 * np.array(CENTRE)), 3 * FOCAL),
    )
    assert by_large.turn == pytest.approx(by_small.turn, abs=1e-9)
    assert by_large.shift == pytest.approx(3 * by_small.shift)


def test_covariance_goes_along_with_the_movement():
    rng = np.random.default_rng(2)
    pose, step = Pose(10.0, -20.0, 30.0), Pose(60.0, 5.0, 4.0)
    of_pose, of_step = np.diag([4.0, 1.0, 0.25]), np.diag([1.0, 2.0, 0.04])
    tried = [
        onward(Pose(*rng.multivariate_normal(pose, of_pose)), Pose(*rng.multivariate_normal(step, of_step)))
        for _ in range(4000)
    ]
    found = np.cov(np.array(tried).T)
    assert found == pytest.approx(onward_covariance(pose, of_pose, step, of_step), abs=0.35)


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
