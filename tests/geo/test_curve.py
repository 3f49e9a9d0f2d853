"""Places along curves in plan."""

import numpy as np
import pytest

from vinemap.geo.curve import between, extend, resample, way_along


def test_lengths_ends_and_parts():
    curve = np.array([[0, 0], [3, 4.0], [3, 10]])
    assert list(way_along(curve)) == [0, 5, 11]
    assert way_along(extend(curve, 2))[-1] == pytest.approx(15)
    assert len(resample(curve, 0.5)) == 23
    assert resample(curve, 0.5)[[0, -1]].tolist() == [[0, 0], [3, 10]]
    assert between(curve, 5, 8).tolist() == [[3, 4], [3, 7]]
