"""What lies beside the points of lines, held against a search through all of them."""

import numpy as np
import pytest

from vinemap.compute.beside import nearest_beside


def search(xy, way, line, reach, along, apart, parallel):
    away = np.full((len(xy), 2), np.inf)
    which = np.full((len(xy), 2), -1)
    for i in range(len(xy)):
        for j in range(len(xy)):
            offset = xy[j] - xy[i]
            left = way[i, 0] * offset[1] - way[i, 1] * offset[0]
            side = int(left <= 0)
            counts = line[i] != line[j] and np.hypot(*offset) <= reach[i] and abs(offset @ way[i]) <= along
            if counts and apart < abs(left) < away[i, side] and abs(way[i] @ way[j]) >= parallel:
                away[i, side], which[i, side] = abs(left), j
    return away, which


@pytest.mark.parametrize(("along", "apart", "parallel"), [(0.75, 0.0, 0.0), (0.4, 0.3, 0.0), (2.0, 0.0, 0.95)])
def test_the_nearest_beside_is_found(along, apart, parallel):
    rng = np.random.default_rng(3)
    angle = rng.uniform(0, np.pi, 300)
    xy, way = rng.uniform(0, 20, (300, 2)), np.column_stack([np.cos(angle), np.sin(angle)])
    line, reach = rng.integers(0, 9, 300), rng.uniform(0.5, 4, 300)
    found = nearest_beside(xy, way, line, reach, along=along, apart=apart, parallel=parallel)
    expected = search(xy, way, line, reach, along, apart, parallel)
    assert np.isfinite(expected[0]).any(axis=0).all()
    np.testing.assert_allclose(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])


def test_points_on_a_line_have_none_beside_them():
    xy = np.column_stack([np.arange(40.0), np.zeros(40)])
    away, which = nearest_beside(xy, np.tile([1.0, 0.0], (40, 1)), np.arange(40), np.full(40, 3.0), along=0.5)
    assert np.isinf(away).all()
    assert (which == -1).all()
    none = nearest_beside(xy[:0], xy[:0], np.arange(0), np.empty(0), along=0.5)
    assert [len(part) for part in none] == [0, 0]


def test_what_has_no_direction_is_beside_nothing():
    xy, way = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 2.0]]), np.array([[np.nan, np.nan], [1.0, 0.0], [1.0, 0.0]])
    away, which = nearest_beside(xy, way, np.arange(3), np.full(3, 3.0), along=0.5)
    assert away.tolist() == [[np.inf, np.inf], [1.0, np.inf], [np.inf, 1.0]]
    assert which.tolist() == [[-1, -1], [2, -1], [-1, 1]]
