"""What image matching makes of a survey: pull to the sun, holes on one side, clumps off as a whole, rough shade."""

import numpy as np
import pytest
import shapely

from vinemap.simulate.matching import Matching
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import PLACE, hillside

FLAT = hillside(0.0, undulation=0.0, elevation=0.0)
NORTH = 90.0


def seen(sensor):
    """Along, across (to the north) and height of points about a row from west to east, with another south of it."""
    vines = Vineyard("p", rows_of(2, length=24, spacing=4.0), dead=0.0)
    quiet = {"weeds": 0.0, "floaters": 0.0, "bled": 0.0, "noise": 0.01}
    xyz = simulate([vines], FLAT, sensor=sensor, density=500, density_outside=0, seed=2, **quiet).xyz
    x, y, height = (xyz - [PLACE[0], PLACE[1] + 2, 0]).T
    near = (np.abs(x) < 11) & (np.abs(y) < 2)
    return x[near], y[near], height[near]


@pytest.fixture(scope="module")
def plain():
    return seen(None)


def poorly(sun):
    return seen(Matching(sun, 45, clump=0.3, depth=0.07, pull=0.03, matched=0.6, shade=0.08))


@pytest.fixture(scope="module")
def poor():
    return poorly(NORTH)


@pytest.fixture(scope="module")
def mirrored():
    return poorly(-NORTH)


def test_canopies_are_drawn_to_the_sun(plain, poor, mirrored):
    across = [np.mean(y[(height > 0.4) & (np.abs(y) < 0.7)]) for _, y, height in (plain, poor, mirrored)]
    assert 0.03 < (across[1] - across[2]) / 2 < 0.07
    assert across[2] < across[0] < across[1]


def test_the_shaded_side_has_more_holes(plain, poor, mirrored):
    found, holes = [], []
    for x, y, height in (plain, poor, mirrored):
        north = (height > 0.6) & (height < 1.6) & (y > 0.1) & (y < 0.6)
        count = np.bincount(((x[north] + 11) / 0.5).astype(int), minlength=44)
        found.append(count.sum())
        holes.append(np.mean(count < 0.3 * np.mean(found[0] / 44)))
    assert found[2] < 0.8 * found[1] < 0.6 * found[0]
    assert holes[0] < 0.05 < holes[1] < holes[2]


def test_tops_are_matched_more_often_than_sides(plain, poor):
    shares = [np.mean(height[(height > 0.5) & (np.abs(y) < 0.6)] > 1.5) for _, y, height in (plain, poor)]
    assert shares[1] > shares[0] + 0.05


def test_clumps_are_off_as_a_whole(plain, poor):
    """Tops of neighbouring decimetres are alike, and off from those of true foliage by more than noise would be."""
    steps = []
    for x, y, height in (plain, poor):
        up = (height > 1.2) & (np.abs(y) < 0.1)
        cell = ((x[up] + 11) / 0.1).astype(int)
        tops = np.bincount(cell, height[up], 220) / np.maximum(np.bincount(cell, minlength=220), 1)
        tops[np.bincount(cell, minlength=220) < 3] = np.nan
        steps.append((np.nanstd(tops), np.nanstd(np.diff(tops))))
    assert steps[1][0] > 1.1 * steps[0][0]
    assert steps[1][1] < 1.2 * steps[1][0]


def test_ground_is_rough_in_the_shade_only(poor):
    _, y, height = poor
    low = np.abs(height) < 0.35
    sun, shade = (np.std(height[low & (y > start) & (y < start + 0.8)]) for start in (0.8, -1.4))
    assert sun < 0.015
    assert 0.05 < shade < 0.1


def test_a_bare_patch_lies_across_neighbours():
    hole = shapely.box(PLACE[0] - 2, PLACE[1] - 1, PLACE[0] + 2, PLACE[1] + 9)
    survey = simulate([Vineyard("p", rows_of(4, length=20), dead=0.0, bare=hole)], FLAT, density=20)
    assert list(survey.rows.n_dead > 0) == [False, False, True, True]
    assert survey.gaps.length.between(3, 5).all()
    assert survey.dead_vines.within(hole.buffer(0.01)).all()
