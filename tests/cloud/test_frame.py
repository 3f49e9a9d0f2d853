"""The frame of a row: coordinates in it, and smoothing along it."""

import numpy as np
import pytest
from pyproj import CRS

from vinemap.cloud.frame import points_of_rows
from vinemap.cloud.points import PointCloud


def row_coordinates(xyz, curves, reach):
    """Coordinates of a small cloud's points, which are one group."""
    cloud = PointCloud(xyz, CRS.from_epsg(32632))
    ((rows, near, taken),) = points_of_rows(cloud, curves, reach, lambda part, member: (part.xyz[member, 2],))
    assert rows.tolist() == list(range(len(curves)))
    assert np.array_equal(taken[0], xyz[near.member, 2])
    return near


def test_coordinates_on_an_arc():
    t = np.linspace(0, 1.2, 400)
    arc = np.column_stack([30 * np.sin(t), 30 - 30 * np.cos(t)])
    xyz = np.random.default_rng(0).uniform([-2, -2, 0], [30, 22, 1], (20000, 3))
    near = row_coordinates(xyz, [arc], np.array([1.5]))
    radius = np.hypot(xyz[:, 0], xyz[:, 1] - 30)
    along = 30 * np.arctan2(xyz[:, 0], 30 - xyz[:, 1])
    inside = (np.abs(radius - 30) < 1.45) & (along > 0) & (along < 36)
    assert set(np.flatnonzero(inside)) <= set(near.member)
    middle = (near.along > 0.5) & (near.along < 35.5)
    assert near.left[middle] == pytest.approx(30 - radius[near.member][middle], abs=0.01)
    # Metres along the arc are those of the point's foot on it, to what a chord of 0.25 m differs from it.
    assert near.along[middle] == pytest.approx(along[near.member][middle], abs=0.03)


def test_points_go_to_the_nearest_row():
    curves = [np.array([[0, 0], [10.0, 0]]), np.array([[0, 2.0], [10.0, 2.0]])]
    xyz = np.random.default_rng(0).uniform([0, -1, 0], [10, 3, 1], (5000, 3))
    near = row_coordinates(xyz, curves, np.array([1.25, 1.25]))
    y = xyz[near.member, 1]
    assert (y[: near.start[1]] < 1.13).all()
    assert (y[near.start[1] :] > 0.87).all()
