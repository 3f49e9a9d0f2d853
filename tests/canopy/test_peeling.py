"""Hulls and peeling against their definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from polygons import canopy, cross, shoelace
from shapely import MultiPoint, Polygon

from vinemap.canopy.hull import hull
from vinemap.canopy.peeling import peel_sections


def naive_hull(points, alive):
    """Indices of the hull of some points, in exact arithmetic where the coordinates are small whole numbers."""
    order = []
    for i in sorted(alive, key=lambda i: (*points[i], i)):
        if not order or tuple(points[i]) != tuple(points[order[-1]]):
            order.append(i)
    ring = []
    for part in (order, order[::-1]):
        chain = []
        for i in part:
            while len(chain) > 1 and cross(points[chain[-2]], points[chain[-1]], points[i]) <= 0:
                chain.pop()
            chain.append(i)
        ring += chain[:-1]
    return ring


def naive_peel(points, count):
    """Algorithm 1 as it is written: whole hulls, once for every vertex of every hull."""
    alive = list(range(len(points)))
    removed = []
    while len(removed) < count and len(alive) > 3:
        ring = naive_hull(points, alive)
        if len(ring) < 3:
            break
        areas = {}
        for i in sorted(ring):
            rest = naive_hull(points, [j for j in alive if j != i])
            areas[i] = shoelace(points[rest]) if len(rest) > 2 else 0.0
        removed.append(min(areas, key=areas.get))
        alive.remove(removed[-1])
    return removed


def outliers(points, count):
    """Indices of so many outliers."""
    return set(np.flatnonzero(~peel_sections(points, [0, len(points)], share=count / len(points)).kept).tolist())


@pytest.mark.parametrize("seed", range(12))
def test_peeling_removes_in_the_order_of_its_definition(seed):
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(60, 2)), rng.random((60, 2)), canopy(rng, 60)[0])[seed % 3]
    order = naive_peel(points, 25)
    assert [outliers(points, k) for k in range(26)] == [set(order[:k]) for k in range(26)]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=18))
def test_peeling_of_ties_duplicates_and_lines_follows_the_definition(cells):
    points = np.array(cells, dtype=float)
    order, counts = naive_peel(points, 12), range(min(13, len(points)))
    assert [outliers(points, k) for k in counts] == [set(order[:k]) for k in counts]


def test_count_of_outliers_is_the_share_rounded_up():
    points = np.random.default_rng(0).random((100, 2))
    for share, kept in ((0, 100), (0.02, 98), (0.021, 97), (0.07, 93), (0.999, 3)):
        assert peel_sections(points, [0, 100], share=share).kept.sum() == kept
    with pytest.raises(ValueError, match="share is 1"):
        peel_sections(points, [0, 100], share=1)


def test_hull_is_counter_clockwise_and_strict():
    square = [[0, 0], [2, 2], [1, 1], [2, 0], [0, 2], [1, 0], [0, 0]]
    assert hull(square).tolist() == [0, 3, 1, 4]
    assert len(hull(np.zeros((0, 2)))) == 0


def test_peeling_all_sections_is_peeling_each():
    rng = np.random.default_rng(1)
    sections = [canopy(rng, n)[0] if n else np.empty((0, 2)) for n in (2, 3, 40, 0, 150)]
    sections[2][5] = np.nan
    start = np.concatenate([[0], np.cumsum([len(p) for p in sections])])
    peeled = peel_sections(np.concatenate(sections), start, share=0.05)
    for k, points in enumerate(sections):
        kept = peeled.kept[start[k] : start[k + 1]]
        finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        if len(finite) < 3:
            assert np.isnan(peeled.area[k])
            assert np.diff(peeled.start)[k] == 0
            continue
        gone = finite[list(outliers(points[finite], np.ceil(0.05 * len(finite))))]
        assert set(np.flatnonzero(~kept)) == set(gone) | set(np.flatnonzero(~np.isfinite(points).all(axis=1)))
        shape = MultiPoint(points[kept]).convex_hull
        assert peeled.area[k] == pytest.approx(shape.area)
        assert peeled.perimeter[k] == pytest.approx(shape.length)
        assert np.diff(peeled.start)[k] == len(shape.exterior.coords) - 1
        assert Polygon(peeled.hull[peeled.start[k] : peeled.start[k + 1]]).equals(shape)
