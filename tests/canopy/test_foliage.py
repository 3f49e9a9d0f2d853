"""What of a section's points is canopy: not soil, flyers or posts."""

import numpy as np
import pytest
from sections import many_sections, one_section, separate

from vinemap.canopy.points import canopy_size


def test_soil_noise_on_flat_ground_is_no_canopy():
    """Where h ≈ 0 the printed plane cuts through the soil, and half of its noise would be canopy."""
    rng = np.random.default_rng(0)
    soil = np.column_stack([rng.uniform(-1.2, 1.2, 200), rng.normal(0, 0.03, 200)])
    leaves = np.column_stack([rng.normal(0, 0.2, 100), rng.uniform(0.6, 1.9, 100)])
    ((canopy, _, _),) = separate(one_section(np.concatenate([soil, leaves])))
    assert len(canopy.points) > 90
    assert canopy.points[:, 1].min() > 0.5


def test_flyers_are_no_canopy():
    rng = np.random.default_rng(0)
    leaves = np.column_stack([rng.normal(0, 0.15, 150), rng.uniform(0.6, 1.9, 150)])
    flyers = np.array([[0.85, 1.5], [-0.8, 2.6], [0.7, 2.2]])
    ((canopy, _, _),) = separate(one_section(np.concatenate([leaves, flyers])))
    assert np.abs(canopy.points[:, 0]).max() < 0.6
    assert canopy.points[:, 1].max() < 2.0


@pytest.mark.parametrize(
    ("height", "half", "spacing"), [(0.6, 0.1, 2.0), (1.9, 0.25, 2.5), (3.1, 1.1, 4.5), (1.7, 0.8, 1.8)]
)
def test_the_size_of_a_row_is_what_holds_its_canopy(height, half, spacing):
    """Over weeds, and beside a cover crop half as high as tall rows."""
    rng = np.random.default_rng(0)
    canopy = np.column_stack([rng.uniform(-half, half, 4000), rng.uniform(0.15 * height, height, 4000)])
    weeds = np.column_stack([rng.uniform(-spacing / 2, spacing / 2, 4000), rng.uniform(0, 0.15, 4000)])
    strip = np.column_stack([rng.uniform(0.8, 1.2, 2000), rng.uniform(0, 0.4 * height, 2000)])
    left, up = np.concatenate([canopy, weeds, strip]).T
    top, side = canopy_size(left, up, spacing, 3.6)
    assert top == pytest.approx(height, rel=0.15)
    assert half <= side <= min(1.5 * half + 0.3, spacing / 2)
    assert canopy_size(left[:0], up[:0], spacing, 3.6) == (3.6, spacing / 2)


def test_low_and_wide_canopies_keep_their_points():
    rng = np.random.default_rng(0)
    for height, half, spacing in ((0.55, 0.1, 2.0), (3.1, 1.1, 4.5)):
        box = np.column_stack([rng.uniform(-half, half, 3000), rng.uniform(0.1 * height, height, 3000)])
        (canopy,) = separate(many_sections([box] * 3, spacing=spacing))
        points = canopy.sections.points
        assert np.abs(points[:, 0]).max() == pytest.approx(half, abs=0.02)
        assert points[:, 1].max() == pytest.approx(height, abs=0.02)
        assert len(points) > 0.65 * 9000


def test_posts_that_stick_out_of_low_vines_are_cut_off():
    """Few points of one do, strays beside it; but no old vine among young ones, nor a post no taller than vines."""
    rng = np.random.default_rng(0)
    young = [np.column_stack([rng.uniform(-0.15, 0.15, 300), rng.uniform(0.15, 0.7, 300)]) for _ in range(40)]
    post = np.column_stack([rng.normal(0.05, 0.03, 200), rng.uniform(0.2, 2.0, 200)])
    old = np.column_stack([rng.uniform(-0.3, 0.3, 300), rng.uniform(0.2, 1.8, 300)])
    strays = np.array([[-0.2, 1.2], [0.2, 1.5], [0.2, 1.6]])
    posts = [np.concatenate([young[0], post]), np.concatenate([young[1], post[:12], strays])]
    (canopy,) = separate(many_sections([*young, *posts, old]))
    top = np.maximum.reduceat(canopy.sections.points[:, 1], canopy.sections.start[:-1])
    np.testing.assert_allclose(top, [*[0.7] * 42, 1.8], atol=0.05)
    tall = young[0] * [1, 2.6]
    (canopy,) = separate(many_sections([tall] * 20 + [np.concatenate([tall, post])]))
    assert canopy.sections.points[:, 1].max() == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize(("across", "top"), [(0.03, 0.7), (0.3, 1.35)])
def test_posts_make_no_row_taller(across, top):
    """Where 8% of a young row's points are theirs; so many of old vines are the row's."""
    rng = np.random.default_rng(0)
    young = np.column_stack([rng.uniform(-0.15, 0.15, 1150), rng.uniform(0.2, 0.7, 1150)])
    tall = np.column_stack([rng.uniform(-across, across, 100), rng.uniform(0.9, 2.0, 100)])
    left, up = np.concatenate([young, tall]).T
    assert canopy_size(left, up, 2.0, 3.6)[0] == pytest.approx(top, abs=0.06)
