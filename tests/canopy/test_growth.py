"""Foliage grows by its reach."""

import numpy as np
import pytest
from polygons import canopy
from shapely import MultiPoint

from vinemap.canopy.growth import grow


@pytest.mark.parametrize("seed", range(5))
def test_foliage_grows_by_its_reach_on_all_sides(seed):
    points, feet = canopy(np.random.default_rng(seed), 60)
    outline, start, moved = grow(points, [0, len(points)], feet[None], [0.05])
    body = MultiPoint(np.vstack([points, feet[1:]])).convex_hull
    grown = MultiPoint(outline).convex_hull
    assert start.tolist() == [0, len(outline)]
    assert grown.covers(body)
    # Sides move by the reach, blunt corners by a sixth more at the most.
    assert body.buffer(0.05 / np.cos(np.radians(30)), quad_segs=64).buffer(1e-4).covers(grown)
    assert grown.exterior.distance(body) > 0.02
    assert grown.area == pytest.approx(body.buffer(0.05).area, rel=0.03)
    np.testing.assert_allclose(moved[0] - feet, [[0, -0.05], [0.025, -0.05], [-0.025, -0.05]], atol=1e-12)


def test_no_reach_no_growth():
    points, feet = canopy(np.random.default_rng(0), 60)
    outline, _, moved = grow(points, [0, len(points)], feet[None], [0.0])
    assert MultiPoint(outline).convex_hull.equals(MultiPoint(np.vstack([points, feet[1:]])).convex_hull)
    assert (moved[0] == feet).all()
