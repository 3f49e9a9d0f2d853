"""Pieces of two frames beside each other: what they tell, and how sure they are."""

import numpy as np
import pytest

from vinemap.odometry.correlation import Place
from vinemap.odometry.patches import ALIKE, Patches, fit_of, patches_at
from vinemap.odometry.views import view_of
from vinemap.simulate.camera import LOW

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
