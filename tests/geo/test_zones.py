"""Points dealt to polygons, against what shapely says of each point and each polygon."""

import numpy as np
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shapely import affinity

from vinemap.geo.zones import deal, zones_of

PLACE = np.array([414_700.0, 4_940_700.0])
SQUARE = shapely.box(*PLACE, *(PLACE + 10))


def cloud(n, *, seed=0, width=30.0):
    """Points (n, 3) about the place whose third coordinate is their number."""
    xy = np.random.default_rng(seed).uniform(-width / 3, width, (n, 2)) + PLACE
    return np.column_stack([xy, np.arange(n)])


def assert_dealt(polygons, xyz):
    """Every polygon has exactly the points that it contains, in their order."""
    dealt, start = deal(xyz, zones_of(polygons))
    assert start[0] == 0
    assert start[-1] == len(dealt)
    for k, polygon in enumerate(polygons):
        expected = xyz[shapely.contains_xy(polygon, *xyz[:, :2].T)]
        assert np.array_equal(dealt[start[k] : start[k + 1]], expected)


def star(rng, middle, radius):
    """A polygon with spikes and notches about a point."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 12)))
    reach = rng.uniform(0.1, 1, len(angle)) * radius
    ring = middle + np.column_stack([np.cos(angle), np.sin(angle)]) * reach[:, None]
    return shapely.make_valid(shapely.Polygon(ring)).buffer(0)


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_polygons_of_any_kind(seed):
    rng = np.random.default_rng(seed)
    places = PLACE + rng.uniform(0, 20, (6, 2))
    holed = shapely.difference(star(rng, places[0], 15), star(rng, places[0], 6))
    parts = shapely.union_all([star(rng, place, 4) for place in places[1:4]])
    sliver = affinity.rotate(shapely.box(*places[4], *(places[4] + [20, 0.02])), rng.uniform(0, 180))
    tiny = shapely.box(*places[5], *(places[5] + rng.uniform(0.01, 0.3, 2)))
    polygons = [p for p in (holed, parts, sliver, tiny, star(rng, places[1], 12)) if not p.is_empty]
    near = [p.centroid.coords[0] + rng.normal(0, 0.1, (100, 2)) for p in (sliver, tiny)]
    xyz = np.concatenate([cloud(2000, seed=seed), *(np.column_stack([xy, np.zeros(100)]) for xy in near)])
    assert_dealt(polygons, xyz)


def test_overlapping_polygons_share_points_in_their_order():
    polygons = [shapely.box(*(PLACE + k), *(PLACE + k + 8)) for k in range(4)]
    xyz = cloud(5000)
    assert_dealt(polygons, xyz)
    assert deal(xyz, zones_of(polygons))[1][-1] > len(xyz[shapely.contains_xy(shapely.union_all(polygons), *xyz.T[:2])])


def test_neighbours_share_no_point():
    polygons = [shapely.box(*(PLACE + [k, 0]), *(PLACE + [k + 1, 9])) for k in range(9)]
    assert_dealt(polygons, cloud(5000))


def test_points_on_an_outline_are_nobodys():
    on = np.array([[0, 0], [10, 10], [0, 5], [5, 0], [10, 5], [5, 10], [2.5, 10]]) + PLACE
    beside = np.array([[1e-6, 5], [10 - 1e-6, 5], [-1e-6, 5]]) + PLACE
    xyz = np.column_stack([np.concatenate([on, beside]), np.arange(10)])
    dealt, start = deal(xyz, zones_of([SQUARE]))
    assert start.tolist() == [0, 2]
    assert dealt[:, 2].tolist() == [7, 8]


def test_far_away_and_no_numbers_are_nobodys():
    odd = [[0, 0, 0], [1e9, -1e9, 0], [-1e300, 1e300, 0], [np.nan, PLACE[1] + 5, 0], [np.inf, PLACE[1] + 5, 0]]
    inside = [*(PLACE + 5), 7.0]
    dealt, start = deal(np.array([*odd, inside]), zones_of([SQUARE]))
    assert start.tolist() == [0, 1]
    assert dealt.tolist() == [inside]


def test_polygons_far_apart():
    """Cells grow with the distance, far beyond the polygons' own size."""
    xyz = cloud(3000)
    away = xyz + [200_000, 300_000, 0]
    polygons = [SQUARE, affinity.translate(SQUARE, 200_000, 300_000)]
    assert_dealt(polygons, np.concatenate([xyz, away]))


def test_no_points():
    dealt, start = deal(np.empty((0, 3)), zones_of([SQUARE, SQUARE]))
    assert dealt.shape == (0, 3)
    assert start.tolist() == [0, 0, 0]


def test_a_polygon_without_points():
    xyz = cloud(2000)
    assert_dealt([affinity.translate(SQUARE, 500, 0), SQUARE, affinity.translate(SQUARE, 0, -500)], xyz)
