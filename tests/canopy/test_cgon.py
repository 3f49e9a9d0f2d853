"""C-gons against brute force and against the bilinear programme, and those of odd sections."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from polygons import canopy, cross, one, shoelace
from scipy.optimize import minimize, minimize_scalar
from shapely import MultiPoint, Point, Polygon

from vinemap.canopy.cgon import enclose
from vinemap.canopy.growth import grow
from vinemap.canopy.hull import hull


def outline(points, feet):
    """Vertices of the hull of points and feet from v2 to vc, by the package's own hull (tested by itself)."""
    both = np.vstack([feet[1:], points])
    ring = hull(both)
    ring = np.roll(ring, -int(np.flatnonzero(ring == 0)[0]))
    return both[ring[: int(np.flatnonzero(ring == 1)[0]) + 1]]


def meet(p, d, q, e):
    turn = d[0] * e[1] - d[1] * e[0]
    return None if turn <= 1e-12 else p + d * ((q - p)[0] * e[1] - (q - p)[1] * e[0]) / turn


def brute_force(q, feet, c):
    """Area of the best of all choices of c - 4 supporting lines: flush ones, or one of them turned at a vertex."""
    edges = np.diff(q, axis=0)
    flush = list(zip(q[:-1], edges, strict=True))

    def area(lines):
        corners = [meet(*a, *b) for a, b in pairwise(lines)]
        if any(x is None for x in corners):
            return 1e9
        return shoelace(np.vstack([feet[:2], corners, feet[2:]]))

    best = np.inf
    for chosen in combinations(range(1, len(edges) - 1), c - 4):
        best = min(best, area([flush[i] for i in (0, *chosen, len(edges) - 1)]))
    for chosen in combinations(range(1, len(edges) - 1), c - 5):
        for k in range(1, len(q) - 1):
            a, b = (np.arctan2(*edges[i][::-1]) for i in (k - 1, k))
            before = [flush[i] for i in (0, *chosen) if i < k]
            behind = [flush[i] for i in (*chosen, len(edges) - 1) if i >= k]

            def turned(angle, before=before, behind=behind, k=k):
                return area([*before, (q[k], np.array([np.cos(angle), np.sin(angle)])), *behind])

            end = a + (b - a) % (2 * np.pi)
            found = minimize_scalar(turned, bounds=(a, end), method="bounded", options={"xatol": 1e-12})
            best = min(best, found.fun)
    return best


@pytest.mark.parametrize("c", [5, 6, 7, 9])
def test_area_is_the_least_of_all_choices_of_edges(c):
    rng = np.random.default_rng(c)
    compared = 0
    while compared < (8 if c < 9 else 3):
        points, feet = canopy(rng, 25)
        q = outline(points, feet)
        if c <= len(q) <= 13:
            result = one(points, feet, c=c)
            # The search by angle ends up to 1e-8 above the minimum that it looks for.
            best = brute_force(q, feet, c)
            assert best * (1 - 1e-8) <= result.area[0] <= best * (1 + 1e-9)
            compared += 1


def test_an_edge_that_touches_at_its_midpoint_is_found():
    # A tall tip: between the two sides, which lean outwards, the best lid is level and flush with nothing.
    points = np.array([[-0.5, 1], [0.5, 1], [0, 1.1]])
    feet = np.array([[0, 0], [0.2, 0], [-0.2, 0]])
    polygon = one(points, feet, c=5).polygon[0]
    np.testing.assert_allclose(polygon[2:4], [[0.53, 1.1], [-0.53, 1.1]], atol=1e-12)


@pytest.mark.parametrize("fifth", range(5))
def test_bilinear_programme_never_beats_the_choice_of_edges(fifth):
    """Eq. 16 in the c - 3 free vertices, solved by SLSQP from several starts, on 200 random sets."""
    for seed in range(40 * fifth, 40 * fifth + 40):
        rng = np.random.default_rng(seed)
        c = (5, 6, 7)[seed % 3]
        points, feet = canopy(rng, 30)
        found = one(points, feet, c=c)
        around = outline(points, feet)
        starts = [found.polygon[0, 2 : c - 1], *(points.mean(axis=0) + sunray(rng, c - 3) for _ in range(4))]
        best = min(bilinear(feet, around, start + rng.normal(0, 0.01, start.shape)) for start in starts)
        assert best >= found.area[0] * (1 - 1e-9)
        assert best <= found.area[0] * (1 + 1e-6)


def bilinear(feet, around, start):
    """Least area that SLSQP finds from some free vertices, infinite where it ends outside the constraints."""
    edges = len(start) + 1

    def polygon(x):
        return np.vstack([feet[:2], x.reshape(-1, 2), feet[2:]])

    def gradient(x):
        v = polygon(x)
        return np.column_stack([v[3:, 1] - v[1:-2, 1], v[1:-2, 0] - v[3:, 0]]).ravel() / 2

    def sides(x):
        v = polygon(x)[1:]
        return cross(v[:-1, None], v[1:, None], around[None]).ravel()

    def slopes(x):
        v = polygon(x)[1:]
        out = np.zeros((edges, len(around), edges + 1, 2))
        for k in range(edges):
            out[k, :, k] = np.column_stack([v[k + 1, 1] - around[:, 1], around[:, 0] - v[k + 1, 0]])
            out[k, :, k + 1] = np.column_stack([around[:, 1] - v[k, 1], v[k, 0] - around[:, 0]])
        return out[:, :, 1:-1].reshape(-1, start.size)

    solution = minimize(
        lambda x: shoelace(polygon(x)),
        start.ravel(),
        jac=gradient,
        constraints={"type": "ineq", "fun": sides, "jac": slopes},
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 200},
    )
    return solution.fun if sides(solution.x).min() > -1e-10 else np.inf


def sunray(rng, count):
    angle = np.sort(rng.uniform(-0.2 * np.pi, 1.2 * np.pi, count))
    return rng.uniform(0.5, 2) * np.column_stack([np.cos(angle), np.sin(angle)])


def test_fewer_edges_than_c_halve_the_longest():
    points = np.array([[0.0, 1], [0.1, 1], [0, 1.1], [0.1, 1.1]])
    result = one(points, [[0.05, 0], [0.1, 0], [0, 0]], c=9)
    assert result.area[0] == pytest.approx(0.11)
    assert len(np.unique(result.polygon[0], axis=0)) == 9


def test_a_foot_inside_moves_out_sideways():
    points = np.array([[-1.0, 0], [1, 0], [1, 2], [-1, 2], [0, 1]])
    polygon = one(points, [[0, 0.5], [0.2, 1], [-0.3, 0.5]]).polygon[0]
    np.testing.assert_allclose(polygon[[0, 1, -1]], [[0, 0.5], [1, 1], [-1, 0.5]])


def test_feet_on_the_underside_move_to_its_ends_where_c_is_too_small():
    points = np.array([[-2.0, 0], [2, 0], [2.5, 1], [1, 2], [-1, 2], [-2.5, 1]])
    feet = [[0, -0.5], [0.5, 0], [-0.5, 0]]
    np.testing.assert_allclose(one(points, feet, c=7).polygon[0, [1, -1]], feet[1:])
    np.testing.assert_allclose(one(points, feet, c=5).polygon[0, [1, -1]], [[2, 0], [-2, 0]])


def test_feet_in_the_wrong_order_are_swapped():
    points, feet = canopy(np.random.default_rng(1), 50)
    np.testing.assert_array_equal(one(points, feet).polygon, one(points, feet[[0, 2, 1]]).polygon)


def test_v1_beyond_the_canopy_becomes_the_middle_of_the_feet():
    points = np.array([[-1.0, 1], [1, 1], [1, 2], [-1, 2]])
    result = one(points, [[0, 9], [1, 0], [-1, 0]])
    assert result.polygon[0, 0].tolist() == [0, 0]
    assert result.area[0] == pytest.approx(4)


def test_a_reflex_v1_keeps_its_place_and_cuts_the_void():
    points = np.array([[-1.0, 1], [1, 1], [1, 2], [-1, 2]])
    result = one(points, [[0, 0.5], [1, 0], [-1, 0]])
    assert result.polygon[0, 0].tolist() == [0, 0.5]
    assert result.area[0] == pytest.approx(3.5)


def test_sections_without_three_points_are_flagged_and_leave_the_others_alone():
    rng = np.random.default_rng(3)
    parts = [canopy(rng, max(n, 1))[0][:n] for n in (40, 0, 2, 40, 5)]
    parts[4][:3] = np.nan
    start = np.concatenate([[0], np.cumsum([len(p) for p in parts])])
    feet = np.tile([[[0.0, 0], [0.2, 0], [-0.2, 0]]], (5, 1, 1))
    result = enclose(np.vstack(parts), start, feet)
    assert result.valid.tolist() == [True, False, False, True, False]
    assert np.isnan(result.polygon[~result.valid]).all()
    assert np.isnan(result.area[~result.valid]).all()
    for k in (0, 3):
        alone = one(parts[k], feet[k])
        np.testing.assert_array_equal(result.polygon[k], alone.polygon[0])
    assert not enclose(parts[0], [0, 40], feet[:1] * np.nan).valid[0]
    assert enclose(np.zeros((0, 2)), [0], np.zeros((0, 3, 2)), c=8).polygon.shape == (0, 8, 2)


@pytest.mark.parametrize(("start", "options"), [([0, 9], {}), ([0, 10], {"c": 4})])
def test_wrong_arguments_are_named(start, options):
    with pytest.raises(ValueError, match=r"c is 4|climb from 0 to 10"):
        enclose(np.zeros((10, 2)), start, np.zeros((1, 3, 2)), **options)


def check(points, feet, c):
    """What holds for any section of three points: c vertices, and every point left of every edge not at v1."""
    result = one(points, feet, c=c)
    polygon = result.polygon[0]
    assert result.valid[0]
    assert polygon.shape == (c, 2)
    assert np.isfinite(polygon).all()
    assert result.area[0] == pytest.approx(shoelace(polygon), abs=1e-9, rel=1e-9)
    extent = max(1, np.ptp(np.vstack([points, feet]), axis=0).max())
    a, b = polygon[1:-1, None], polygon[2:, None]
    length = np.linalg.norm(b - a, axis=-1)
    assert (cross(a, b, np.vstack([points, polygon[[1, -1]]])[None]) >= -1e-9 * extent * length - 1e-15 * extent).all()
    return result


metres = st.floats(-3, 3)
whole = st.integers(-3, 3).map(float)
fine = st.integers(-3, 3).map(lambda i: 1 + i * 2.0**-40)


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_any_section_gives_a_defined_polygon(data):
    number = data.draw(st.sampled_from([metres, whole, fine, metres.map(lambda x: 30 * x)]))
    pair = st.tuples(number, number)
    points = np.array(data.draw(st.lists(pair, min_size=3, max_size=30)))
    if data.draw(st.booleans()):
        points = points[:, :1] @ np.array([[0.3, 1.7]])
    feet = np.array(data.draw(st.lists(pair, min_size=3, max_size=3)))
    check(points, feet, data.draw(st.integers(5, 11)))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(3, 200), st.integers(5, 11))
def test_canopies_on_their_feet_are_held_whole(seed, n, c):
    points, feet = canopy(np.random.default_rng(seed), n)
    feet[:, 0] = [0, 9, -9]
    feet[0, 1] = feet[1, 1]
    result = check(points, feet, c)
    polygon = Polygon(result.polygon[0]).buffer(1e-9)
    assert all(polygon.covers(Point(p)) for p in points)


def test_long_outlines_are_simplified_from_outside():
    angle = np.linspace(0, 2 * np.pi, 5000, endpoint=False)
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    result = check(points, np.array([[0, -2], [0.5, -1.5], [-0.5, -1.5]]), 7)
    fewer = check(points[::25], np.array([[0, -2], [0.5, -1.5], [-0.5, -1.5]]), 7)
    assert result.area[0] == pytest.approx(fewer.area[0], rel=2e-3)


def test_a_million_points():
    points = np.random.default_rng(0).random((1_000_000, 2))
    result = check(points, np.array([[0.5, -0.1], [1, -0.1], [0, -0.1]]), 7)
    assert result.area[0] == pytest.approx(1.1, abs=0.01)


@pytest.mark.parametrize("seed", range(8))
def test_sliding_feet_stand_where_the_area_is_least(seed):
    rng = np.random.default_rng(seed)
    points, feet = canopy(rng, 40)
    feet[:] = [[0, feet[1, 1]], [0.15, feet[1, 1]], [-0.15, feet[1, 1]]]
    outline, start, moved = grow(points, [0, len(points)], feet[None], [0.03])
    slid = enclose(outline, start, moved, c=7, slide=True)
    polygon, level = slid.polygon[0], moved[0, 0, 1]
    np.testing.assert_allclose(polygon[[0, 1, -1], 1], level, atol=1e-9)
    assert polygon[-1, 0] < polygon[0, 0] < polygon[1, 0]
    assert Polygon(polygon).buffer(1e-9).covers(MultiPoint(outline))
    # No pair of fixed feet on that line does better.
    for left in np.linspace(polygon[1, 0] - 0.1, polygon[1, 0] + 0.1, 9):
        for right in np.linspace(polygon[-1, 0] - 0.1, polygon[-1, 0] + 0.1, 9):
            fixed = enclose(outline, start, [[moved[0, 0], [left, level], [right, level]]], c=7)
            if Polygon(fixed.polygon[0]).buffer(1e-9).covers(MultiPoint(outline)):
                assert fixed.area[0] >= slid.area[0] - 1e-9


def test_feet_stay_where_no_edge_holds_v1():
    points, feet = canopy(np.random.default_rng(0), 40)
    feet[0, 1] -= 0.3
    plain, slid = (one(points, feet, slide=slide) for slide in (False, True))
    np.testing.assert_array_equal(plain.polygon, slid.polygon)


@pytest.mark.parametrize("seed", range(6))
def test_shared_area_is_that_of_the_intersection(seed):
    points, feet = canopy(np.random.default_rng(seed), 80)
    result = one(points, feet)
    body = MultiPoint(points).convex_hull
    assert result.hull_area[0] == pytest.approx(body.area)
    assert result.shared_area[0] == pytest.approx(
        Polygon(result.polygon[0]).buffer(0).intersection(body).area, rel=1e-6
    )
