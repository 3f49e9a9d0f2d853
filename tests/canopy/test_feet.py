"""Where foliage begins above the soil, told by the sections around."""

import numpy as np
import pytest
from sections import many_sections

from vinemap.canopy.feet import find_feet


def test_feet_stand_where_foliage_begins():
    """Few points a section, fewer still at the foot: the sections around tell."""
    rng = np.random.default_rng(0)
    points = []
    for _ in range(80):
        z = 0.55 + 1.4 * rng.random(40) ** 0.7  # the lower, the deeper in the shade
        points.append(np.column_stack([rng.uniform(-0.3, 0.3, 40), z]))
    canopy, feet = find_feet(many_sections(points))
    assert np.abs(feet[:, 0, 1] - 0.55).max() < 0.1
    assert np.abs(np.diff(feet[:, 0, 1])).max() < 0.02  # neighbours share what they see
    # Half of the points near the foot lie between its sides.
    assert np.abs(feet[:, 1:, 0] - [0.15, -0.15]).max() < 0.07
    assert len(canopy.points) > 0.97 * 80 * 40


def test_feet_stand_where_a_broad_canopy_begins_that_hides_it():
    """Points get rarer downward, to a hundredth of those on top; trunks stand below, and a stray here and there."""
    rng = np.random.default_rng(1)
    points = []
    for _ in range(60):
        z = 3 + 0.45 * np.log(rng.uniform(np.exp(-2.4 / 0.45), 1, 150))
        sides = np.sqrt(np.clip((3 - z) / 1.2, 0.05, 1)) * rng.choice([-1, 1], 150)
        trunk = np.column_stack([rng.normal(0, 0.05, 2), rng.uniform(0.2, 0.6, 2)])
        points.append(np.concatenate([np.column_stack([sides, z]), trunk]))
    points[30] = np.concatenate([points[30], [[0.9, 0.3], [-0.8, 0.4]]])
    _, feet = find_feet(many_sections(points))
    assert np.abs(feet[:, 0, 1] - 0.6).max() < 0.15


def test_a_side_that_hides_its_foot_is_like_the_other():
    rng = np.random.default_rng(2)
    points = []
    for _ in range(60):
        z = rng.uniform(0.5, 2, 60)
        y = np.where(z < 1, rng.uniform(0.1, 0.5, 60), rng.uniform(-0.5, 0.5, 60))  # its right was seen above 1 m
        points.append(np.column_stack([y, z]))
    _, feet = find_feet(many_sections(points))
    assert feet[:, 1, 0] == pytest.approx(-feet[:, 2, 0], abs=0.01)
    assert feet[:, 1, 0].mean() == pytest.approx(0.3, abs=0.03)


def test_a_side_under_which_a_canopy_leans_is_as_far_from_the_other_as_the_canopy_is_wide():
    rng = np.random.default_rng(2)
    points = []
    for _ in range(60):
        z = rng.uniform(0.6, 1.9, 60)
        lean = 0.4 * (z - 1.25)
        y = lean + np.where(z < 1, rng.uniform(-0.25, -0.2, 60), rng.uniform(-0.25, 0.25, 60))
        points.append(np.column_stack([y, z]))
    _, feet = find_feet(many_sections(points))
    assert feet[:, 1, 0].mean() == pytest.approx(-0.26 + 0.25, abs=0.07)


@pytest.mark.parametrize("across", [np.zeros(50), np.linspace(-0.6, 0.6, 50)], ids=["on a line", "above 3 m"])
def test_a_foot_of_which_sides_tell_nothing_is_where_points_thin_out(across):
    low = 0.5 if not across.any() else 3.2
    points = [np.column_stack([across, np.random.default_rng(k).uniform(low, low + 1.5, 50)]) for k in range(60)]
    _, feet = find_feet(many_sections(points))
    assert feet[:, 0, 1] == pytest.approx(min(low, 3.0), abs=0.05)


def test_a_foot_at_which_nothing_was_seen_is_a_point():
    heights = np.concatenate([np.full(3, 0.6), np.linspace(1.5, 2, 97)])  # it thins out at 0.4 m
    _, feet = find_feet(many_sections([np.column_stack([np.linspace(-0.9, 0.9, 100), heights])] * 60))
    assert np.abs(feet[:, :, 0]).max() == 0


def test_no_foot_lies_in_the_ground():
    heights = np.concatenate([np.linspace(0.2, 0.25, 5), np.linspace(1.5, 2, 95)])
    _, feet = find_feet(many_sections([np.column_stack([np.linspace(-0.3, 0.3, 100), heights])] * 60))
    assert feet[:, 0, 1].min() >= 0
