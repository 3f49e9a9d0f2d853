"""What is flat and compact, and no vine."""

import numpy as np
import pytest
from pyproj import CRS

from vinemap.geo.raster import Grid, Raster
from vinemap.surfaces.things import flat_things

CELL = 0.25
UTM = CRS.from_epsg(32632)


def field(*, rough=0.15, width=4, every=None):
    """Heights of eight rows of leaves so rough and so many cells wide, cut every so many cells, on even ground."""
    rng = np.random.default_rng(0)
    heights = rng.normal(0, 0.01, (140, 200))
    for row in range(10, 90, 10):
        heights[row : row + width, 10:190] = 1.8 + rng.normal(0, rough, (width, 180))
        if every:
            heights[row : row + width, 10:190:every] = heights[row : row + width, 11:190:every] = 0.01
    return heights, rng


def flat(heights):
    return flat_things(Raster(heights, Grid(0.0, 0.0, CELL, *heights.shape), UTM), 3.6)


@pytest.mark.parametrize(("tall", "size"), [(1.5, (7, 17)), (1.0, (5, 4))], ids=["cars", "pallets"])
def test_cars_and_pallets_are_flat(tall, size):
    heights, rng = field()
    things = np.zeros(heights.shape, bool)
    for left in range(20, 180, 40):
        things[110 : 110 + size[0], left : left + size[1]] = True
    heights[things] = tall + rng.normal(0, 0.01, np.count_nonzero(things))
    found = flat(heights)
    assert found[things].all()
    assert not found[:100].any()


@pytest.mark.parametrize("width", [3, 4, 6, 8])
@pytest.mark.parametrize("every", [None, 40])
def test_trimmed_vines_are_long(width, every):
    heights, _ = field(rough=0.005, width=width, every=every)
    assert not flat(heights).any()


def test_trimmed_vines_of_which_little_hangs_together_are_many():
    heights, _ = field(rough=0.005, every=12)
    assert not flat(heights).any()


def test_leaves_are_rougher_than_the_ground():
    heights, _ = field(rough=0.04, width=5, every=12)
    heights[:60] = 0.0  # few of them
    assert not flat(heights).any()


def test_nothing_stands():
    assert not flat(np.zeros((50, 50))).any()
    assert not flat(np.full((50, 50), np.nan)).any()
