"""Foliage grows by its reach."""

import numpy as np
import pytest
from polygons import canopy
from sections import many_sections
from shapely import MultiPoint

from vinemap.canopy.growth import foliage_reach, grow
from vinemap.canopy.peeling import peel_sections


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


@pytest.mark.parametrize("n", [25, 60, 200, 800])
def test_foliage_reaches_as_far_as_its_hulls_fall_short(n):
    """Points drawn evenly from an ellipse of leaves: however few they are, its area comes out."""
    rng = np.random.default_rng(n)
    angle, radius = rng.uniform(0, 2 * np.pi, (80, n)), np.sqrt(rng.random((80, n)))
    points = list(np.stack([0.3 * radius * np.cos(angle), 1.2 + 0.7 * radius * np.sin(angle)], axis=2))
    sections = many_sections(points)
    peeled = peel_sections(sections.points, sections.start, share=0)
    reach = foliage_reach(sections, peeled.area, peeled.perimeter, np.diff(peeled.start))
    assert len(np.unique(reach)) == 1
    hulls, true = peeled.area.mean(), np.pi * 0.3 * 0.7
    grown = hulls + reach[0] * peeled.perimeter.mean()
    assert abs(grown / true - 1) < 0.4 * (1 - hulls / true) + 0.005
