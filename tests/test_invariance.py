"""The same rows, wherever the parcel lies, however it is turned, and in whatever order its points come."""

import numpy as np
import pytest
import shapely

from vinemap.chain import map_rows
from vinemap.cloud.points import PointCloud
from vinemap.config.settings import Settings

PLACE = np.array([500_000.0, 4_900_000.0])


@pytest.fixture(scope="module")
def local(cloud):
    """Points about their middle."""
    return cloud.xyz - cloud.xyz.mean(axis=0) * [1, 1, 0]


def rows(xyz, crs):
    found = map_rows(PointCloud(xyz, crs), Settings()).rows
    return [shapely.get_coordinates(line) for line in found.geometry]


@pytest.fixture(scope="module")
def reference(local, cloud):
    return rows(local + [*PLACE, 0], cloud.crs)


def assert_same(found, reference):
    """Curves and ends within 1 cm; rows may be numbered and run the other way."""
    assert len(found) == len(reference)
    for curve in reference:
        line = shapely.LineString(curve)
        other = min(found, key=lambda c: shapely.hausdorff_distance(line, shapely.LineString(c)))
        ends = (
            other[[0, -1]] if np.hypot(*(other[0] - curve[0])) < np.hypot(*(other[-1] - curve[0])) else other[[-1, 0]]
        )
        assert np.hypot(*(ends - curve[[0, -1]]).T).max() < 0.01
        between = shapely.get_coordinates(shapely.segmentize(shapely.LineString(other), 0.25))[2:-2]
        assert shapely.distance(line, shapely.points(between)).max() < 0.01


def test_shuffled_points(local, reference, cloud):
    shuffled = np.random.default_rng(0).permutation(local) + [*PLACE, 0]
    for found, curve in zip(rows(shuffled, cloud.crs), reference, strict=True):
        assert np.allclose(found, curve, rtol=0, atol=1e-6)  # sums of floats depend on their order


@pytest.mark.parametrize("shift", [(1e6, 0.0), (0.037, 0.061)])
def test_shifted_parcel(local, reference, cloud, shift):
    found = rows(local + [*(PLACE + shift), 0], cloud.crs)
    assert_same([curve - shift for curve in found], reference)


@pytest.mark.parametrize("angle", [7, 45, 90, 133])
def test_rotated_parcel(local, reference, cloud, angle):
    t = np.radians(angle)
    turn = np.array([[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]])
    turned = np.column_stack([local[:, :2] @ turn.T + PLACE, local[:, 2]])
    found = rows(turned, cloud.crs)
    assert_same([(curve - PLACE) @ turn + PLACE for curve in found], reference)
