"""Peeling against its definition, c-gons against brute force and against the bilinear programme, odd sections."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize, minimize_scalar
from shapely import MultiPoint, Point, Polygon

from vinemap.canopy.cgon import enclose
from vinemap.canopy.growth import grow
from vinemap.canopy.hull import hull
from vinemap.canopy.peeling import peel, peel_sections


def cross(a, b, p):
    return (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (p[..., 0] - a[..., 0])


def shoelace(polygon):
    y, z = (polygon - polygon[0]).T
    return (y * np.roll(z, -1) - np.roll(y, -1) * z).sum() / 2


def one(points, feet, **kwargs):
    return enclose(points, [0, len(points)], np.asarray(feet)[None], **kwargs)


def canopy(rng, n):
    """Points of a section of canopy, top-heavy, round or ragged, on one foot or two."""
    z = rng.beta(*rng.uniform(1, 4, 2), n)
    y = rng.normal(0, 0.1 + 0.2 * z ** rng.uniform(0, 2), n) + rng.normal(0, 0.05)
    points = np.column_stack([y, 0.5 + rng.uniform(0.5, 1.5) * z])
    low = points[:, 1].min() - rng.uniform(0.01, 0.1)
    half = rng.choice([0.02, 0.15, 0.5])
    return points, np.array([[0, low + rng.uniform(-0.3, 0.1)], [half, low], [-half, low]])


def outline(points, feet):
    """Vertices of the hull of points and feet from v2 to vc, by the package's own hull (tested by itself)."""
    both = np.vstack([feet[1:], points])
    ring = hull(both)
    ring = np.roll(ring, -int(np.flatnonzero(ring == 0)[0]))
    return both[ring[: int(np.flatnonzero(ring == 1)[0]) + 1]]


# Hull and peeling


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


@pytest.mark.parametrize("seed", range(12))
def test_peeling_removes_in_the_order_of_its_definition(seed):
    rng = np.random.default_rng(seed)
    points = (rng.normal(size=(60, 2)), rng.random((60, 2)), canopy(rng, 60)[0])[seed % 3]
    assert peel(points, 25).tolist() == naive_peel(points, 25)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=18))
def test_peeling_of_ties_duplicates_and_lines_follows_the_definition(cells):
    points = np.array(cells, dtype=float)
    assert peel(points, 12).tolist() == naive_peel(points, 12)


def test_peeling_stops_at_three_points():
    assert len(peel(np.random.default_rng(0).random((20, 2)), 99)) == 17
    assert len(peel(np.zeros((0, 2)), 1)) == len(hull(np.zeros((0, 2)))) == 0


def test_count_of_outliers_is_the_share_rounded_up():
    points = np.random.default_rng(0).random((100, 2))
    for share, kept in ((0, 100), (0.02, 98), (0.021, 97), (0.07, 93), (0.999, 3)):
        assert one(points, [[0.5, -1], [1, -1], [0, -1]], share=share).kept.sum() == kept


def test_hull_is_counter_clockwise_and_strict():
    square = [[0, 0], [2, 2], [1, 1], [2, 0], [0, 2], [1, 0], [0, 0]]
    assert hull(square).tolist() == [0, 3, 1, 4]


# The c-gon


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
            result = one(points, feet, c=c, share=0)
            # The search by angle ends up to 1e-8 above the minimum that it looks for.
            best = brute_force(q, feet, c)
            assert best * (1 - 1e-8) <= result.area[0] <= best * (1 + 1e-9)
            compared += 1


def test_an_edge_that_touches_at_its_midpoint_is_found():
    # A tall tip: between the two sides, which lean outwards, the best lid is level and flush with nothing.
    points = np.array([[-0.5, 1], [0.5, 1], [0, 1.1]])
    feet = np.array([[0, 0], [0.2, 0], [-0.2, 0]])
    polygon = one(points, feet, c=5, share=0).polygon[0]
    np.testing.assert_allclose(polygon[2:4], [[0.53, 1.1], [-0.53, 1.1]], atol=1e-12)


@pytest.mark.parametrize("fifth", range(5))
def test_bilinear_programme_never_beats_the_choice_of_edges(fifth):
    """Eq. 16 in the c - 3 free vertices, solved by SLSQP from several starts, on 200 random sets."""
    for seed in range(40 * fifth, 40 * fifth + 40):
        rng = np.random.default_rng(seed)
        c = (5, 6, 7)[seed % 3]
        points, feet = canopy(rng, 30)
        found = one(points, feet, c=c, share=0)
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
    result = one(points, [[0.05, 0], [0.1, 0], [0, 0]], c=9, share=0)
    assert result.area[0] == pytest.approx(0.11)
    assert len(np.unique(result.polygon[0], axis=0)) == 9


def test_a_foot_inside_moves_out_sideways():
    points = np.array([[-1.0, 0], [1, 0], [1, 2], [-1, 2], [0, 1]])
    polygon = one(points, [[0, 0.5], [0.2, 1], [-0.3, 0.5]], share=0).polygon[0]
    np.testing.assert_allclose(polygon[[0, 1, -1]], [[0, 0.5], [1, 1], [-1, 0.5]])


def test_feet_on_the_underside_move_to_its_ends_where_c_is_too_small():
    points = np.array([[-2.0, 0], [2, 0], [2.5, 1], [1, 2], [-1, 2], [-2.5, 1]])
    feet = [[0, -0.5], [0.5, 0], [-0.5, 0]]
    np.testing.assert_allclose(one(points, feet, c=7, share=0).polygon[0, [1, -1]], feet[1:])
    np.testing.assert_allclose(one(points, feet, c=5, share=0).polygon[0, [1, -1]], [[2, 0], [-2, 0]])


def test_feet_in_the_wrong_order_are_swapped():
    points, feet = canopy(np.random.default_rng(1), 50)
    np.testing.assert_array_equal(one(points, feet).polygon, one(points, feet[[0, 2, 1]]).polygon)


def test_v1_beyond_the_canopy_becomes_the_middle_of_the_feet():
    points = np.array([[-1.0, 1], [1, 1], [1, 2], [-1, 2]])
    result = one(points, [[0, 9], [1, 0], [-1, 0]], share=0)
    assert result.polygon[0, 0].tolist() == [0, 0]
    assert result.area[0] == pytest.approx(4)


def test_a_reflex_v1_keeps_its_place_and_cuts_the_void():
    points = np.array([[-1.0, 1], [1, 1], [1, 2], [-1, 2]])
    result = one(points, [[0, 0.5], [1, 0], [-1, 0]], share=0)
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
    assert not result.kept[-5:-2].any()
    for k in (0, 3):
        alone = one(parts[k], feet[k])
        np.testing.assert_array_equal(result.polygon[k], alone.polygon[0])
    assert not enclose(parts[0], [0, 40], feet[:1] * np.nan).valid[0]
    assert enclose(np.zeros((0, 2)), [0], np.zeros((0, 3, 2)), c=8).polygon.shape == (0, 8, 2)


@pytest.mark.parametrize(("start", "options"), [([0, 9], {}), ([0, 10], {"c": 4}), ([0, 10], {"share": 1})])
def test_wrong_arguments_are_named(start, options):
    with pytest.raises(ValueError, match=r"c is 4|share is 1|climb from 0 to 10"):
        enclose(np.zeros((10, 2)), start, np.zeros((1, 3, 2)), **options)


def check(points, feet, c, share):
    """What holds for any section of three points: c vertices, and every kept point left of every edge not at v1."""
    result = one(points, feet, c=c, share=share)
    polygon, kept = result.polygon[0], points[result.kept]
    assert result.valid[0]
    assert polygon.shape == (c, 2)
    assert np.isfinite(polygon).all()
    assert len(kept) >= 3
    assert result.area[0] == pytest.approx(shoelace(polygon), abs=1e-9, rel=1e-9)
    extent = max(1, np.ptp(np.vstack([points, feet]), axis=0).max())
    a, b = polygon[1:-1, None], polygon[2:, None]
    length = np.linalg.norm(b - a, axis=-1)
    assert (cross(a, b, np.vstack([kept, polygon[[1, -1]]])[None]) >= -1e-9 * extent * length - 1e-15 * extent).all()
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
    check(points, feet, data.draw(st.integers(5, 11)), data.draw(st.sampled_from([0, 0.02, 0.3])))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(3, 200), st.integers(5, 11))
def test_canopies_on_their_feet_are_held_whole(seed, n, c):
    points, feet = canopy(np.random.default_rng(seed), n)
    feet[:, 0] = [0, 9, -9]
    feet[0, 1] = feet[1, 1]
    result = check(points, feet, c, 0.02)
    polygon = Polygon(result.polygon[0]).buffer(1e-9)
    assert all(polygon.covers(Point(p)) for p in points[result.kept])


def test_long_outlines_are_simplified_from_outside():
    angle = np.linspace(0, 2 * np.pi, 5000, endpoint=False)
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    result = check(points, np.array([[0, -2], [0.5, -1.5], [-0.5, -1.5]]), 7, 0)
    fewer = check(points[::25], np.array([[0, -2], [0.5, -1.5], [-0.5, -1.5]]), 7, 0)
    assert result.area[0] == pytest.approx(fewer.area[0], rel=2e-3)


def test_a_million_points():
    points = np.random.default_rng(0).random((1_000_000, 2))
    result = check(points, np.array([[0.5, -0.1], [1, -0.1], [0, -0.1]]), 7, 0.0001)
    assert result.area[0] == pytest.approx(1.1, abs=0.01)


# Foliage's outlines


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
        gone = finite[peel(points[finite], int(np.ceil(0.05 * len(finite))))]
        assert set(np.flatnonzero(~kept)) == set(gone) | set(np.flatnonzero(~np.isfinite(points).all(axis=1)))
        shape = MultiPoint(points[kept]).convex_hull
        assert peeled.area[k] == pytest.approx(shape.area)
        assert peeled.perimeter[k] == pytest.approx(shape.length)
        assert np.diff(peeled.start)[k] == len(shape.exterior.coords) - 1
        assert Polygon(peeled.hull[peeled.start[k] : peeled.start[k + 1]]).equals(shape)


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


@pytest.mark.parametrize("seed", range(8))
def test_sliding_feet_stand_where_the_area_is_least(seed):
    rng = np.random.default_rng(seed)
    points, feet = canopy(rng, 40)
    feet[:] = [[0, feet[1, 1]], [0.15, feet[1, 1]], [-0.15, feet[1, 1]]]
    outline, start, moved = grow(points, [0, len(points)], feet[None], [0.03])
    slid = enclose(outline, start, moved, c=7, share=0, slide=True)
    polygon, level = slid.polygon[0], moved[0, 0, 1]
    np.testing.assert_allclose(polygon[[0, 1, -1], 1], level, atol=1e-9)
    assert polygon[-1, 0] < polygon[0, 0] < polygon[1, 0]
    assert Polygon(polygon).buffer(1e-9).covers(MultiPoint(outline))
    # No pair of fixed feet on that line does better.
    for left in np.linspace(polygon[1, 0] - 0.1, polygon[1, 0] + 0.1, 9):
        for right in np.linspace(polygon[-1, 0] - 0.1, polygon[-1, 0] + 0.1, 9):
            fixed = enclose(outline, start, [[moved[0, 0], [left, level], [right, level]]], c=7, share=0)
            if Polygon(fixed.polygon[0]).buffer(1e-9).covers(MultiPoint(outline)):
                assert fixed.area[0] >= slid.area[0] - 1e-9


def test_feet_stay_where_no_edge_holds_v1():
    points, feet = canopy(np.random.default_rng(0), 40)
    feet[0, 1] -= 0.3
    plain, slid = (one(points, feet, share=0, slide=slide) for slide in (False, True))
    np.testing.assert_array_equal(plain.polygon, slid.polygon)


@pytest.mark.parametrize("seed", range(6))
def test_shared_area_is_that_of_the_intersection(seed):
    points, feet = canopy(np.random.default_rng(seed), 80)
    result = one(points, feet)
    body = MultiPoint(points[result.kept]).convex_hull
    assert result.hull_area[0] == pytest.approx(body.area)
    assert result.shared_area[0] == pytest.approx(
        Polygon(result.polygon[0]).buffer(0).intersection(body).area, rel=1e-6
    )
