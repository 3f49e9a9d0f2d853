"""Flights whose positions don't agree, and files that only look like it."""

import re

import numpy as np
import pytest
from formats import write_las
from pyproj import CRS

from vinemap.cloud.las import read_cloud

UTM, SIDE, DENSITY = CRS.from_epsg(32632), 50.0, 40.0
CORNER = np.array([414_700.0, 4_940_700.0, 460.0])


def flown(path, seed, *, across=0.0, up=0.0, part=(0.0, 1.0), tall=1.8):
    """Rows 2.5 m apart at 30° from east on a slope, in a part of the square from west to east."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((part[0] * SIDE, 0), (part[1] * SIDE, SIDE), (int(DENSITY * SIDE**2 * np.ptp(part)), 2))
    off = (xy @ [-0.5, np.sqrt(0.75)] - across) % 2.5
    high = (off < 0.6) & (rng.random(len(xy)) < 0.9)
    z = 0.2 * xy[:, 0] + np.where(high, rng.uniform(0.6 * tall, tall, len(xy)), 0.0) + rng.normal(up, 0.03, len(xy))
    return write_las(path, CORNER + np.column_stack([xy, z]), UTM)


@pytest.mark.parametrize(("across", "up"), [(0.5, 0.0), (0.7, 2.0), (-1.0, 0.3)])
def test_flights_that_lie_aside_are_told(tmp_path, across, up):
    files = [flown(tmp_path / "may.laz", 1), flown(tmp_path / "june.laz", 2, across=across, up=up, tall=1.4)]
    (remark,) = read_cloud(files).remarks
    metres = re.fullmatch(r"two flights lie about (.*) m aside of each other, and canopies come out .*", remark)[1]
    assert float(metres) == pytest.approx(abs(across), abs=0.15)


OTHERS = {
    "the same place": [{}, {"up": 0.5}],
    "hardly aside": [{}, {"across": 0.15}],
    "tiles": [{"part": (0.0, 0.5)}, {"part": (0.5, 1.0), "across": 1.0}],
    "ground alone": [{"tall": 0.0}, {"across": 1.0}],
}


@pytest.mark.parametrize("name", OTHERS)
def test_files_that_do_not_are_not(tmp_path, name):
    files = [flown(tmp_path / f"{k}.laz", k, **how) for k, how in enumerate(OTHERS[name])]
    assert read_cloud(files).remarks == ()
