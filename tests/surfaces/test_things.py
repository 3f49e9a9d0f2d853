"""What is compact and no vine: flat, or a tree."""

import numpy as np
import pytest
from pyproj import CRS

from vinemap.geo.raster import Grid, Raster
from vinemap.surfaces.things import flat_things, trees

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


def test_rows_that_touch_a_house_go_on_beyond_it():
    heights, rng = field(every=40)
    heights[20:60, 150:190] = 2.8 + rng.normal(0, 0.01, (40, 40))
    found = flat(heights)
    assert found[20:60, 150:190].all()
    assert not found[:, :140].any()


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


def disc(heights, row, column, radius, tall):
    """Raise a dome of leaves, in cells and metres; its cells that reach above the vines by half."""
    i, j = np.indices(heights.shape)
    up = tall * np.sqrt(np.maximum(1 - ((i - row) ** 2 + (j - column) ** 2) / (radius + 0.5) ** 2, 0))
    np.maximum(heights, up, out=heights)
    return up > 1.5 * 1.8


def found_trees(heights):
    return trees(Raster(heights, Grid(0.0, 0.0, CELL, *heights.shape), UTM), 3.6)


@pytest.mark.parametrize("tall", [3.5, 5.0])
def test_trees_among_rows_are_none_of_them(tall):
    heights, _ = field()
    tops = disc(heights, 31, 60, 6, tall) | disc(heights, 55, 150, 6, tall)
    found = found_trees(heights)
    assert found[tops].all()
    assert not found[:, 75:130].any()


def test_what_is_tall_and_long_is_no_tree():
    """Older vines in three rows that touch here and there, and a piece of a hedge."""
    heights, rng = field()
    heights[30:54, 60:90] *= 1.8
    heights[30:54, 62:90:9] = 3.2
    heights[75:79, 120:150] = 3.3 + rng.normal(0, 0.1, (4, 30))
    assert not found_trees(heights).any()


def test_old_vines_among_young_ones_are_no_trees():
    heights, _ = field()
    heights *= 0.4
    for column in range(30, 180, 25):
        disc(heights, 32, column, 4, 1.9)
    assert not found_trees(heights).any()


def test_a_tree_by_itself_is_told_by_none():
    heights = np.zeros((140, 200))
    disc(heights, 70, 100, 8, 4.0)
    assert not found_trees(heights).any()
