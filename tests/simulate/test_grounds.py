"""Grounds that are made look like what they are called, as far as numbers tell."""

import numpy as np
import pytest

from vinemap.simulate.camera import lay_ground
from vinemap.simulate.grounds import MADE, RESOLUTION

SIZE = (300.0, 240.0)


def likeness(image, other):
    return float(np.corrcoef(image.ravel(), other.ravel())[0, 1])


@pytest.mark.parametrize("name", MADE)
def test_every_seed_makes_ground_of_its_own_and_the_same_again(name):
    first, again, other = (lay_ground(name, size_mm=SIZE, seed=seed).image for seed in (1, 1, 2))
    assert first.shape == (600, 750)
    assert np.array_equal(first, again)
    assert abs(likeness(first, other)) < (0.9 if name == "tyre tracks" else 0.4)  # its lugs are the same
    assert first.std() > 3
    assert 40 < np.median(first) < 230


def test_grounds_of_different_names_differ():
    images = [lay_ground(name, size_mm=SIZE, seed=k).image for k, name in enumerate(MADE)]
    like = np.corrcoef([image.ravel() for image in images]) - np.eye(len(images))
    assert np.abs(like).max() < 0.5


def test_lugs_come_again_every_90_mm_and_nothing_else_does():
    lugs, clay = (
        lay_ground(name, size_mm=(600, 200), seed=1).image.astype(float) for name in ("tyre tracks", "cracked clay")
    )
    lag = round(90 / RESOLUTION)
    assert likeness(lugs[:, lag:], lugs[:, :-lag]) > 0.5
    assert abs(likeness(clay[:, lag:], clay[:, :-lag])) < 0.2


def test_grass_lies_in_swaths_and_straw_any_way():
    def spread(name):
        """How differently 100 mm squares are aligned, from 0 to 1 on the mean."""
        image = lay_ground(name, size_mm=(500, 500), seed=3).image.astype(float)
        dy, dx = np.gradient(image)
        twice = (dx + 1j * dy) ** 2
        return np.mean(
            [abs(part.mean()) / np.abs(part).mean() for row in np.split(twice, 5) for part in np.split(row, 5, 1)]
        )

    assert spread("mown grass") > 2 * spread("straw")
