"""Filters of images, held against SciPy's."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, gaussian_filter

from vinemap.compute.filters import blurred, distance_to


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (37, 53)])
@pytest.mark.parametrize("share", [0.02, 0.4])
def test_distances_are_exact(shape, share):
    rng = np.random.default_rng(1)
    cells = rng.random(shape) < share
    cells.flat[rng.integers(cells.size)] = True
    np.testing.assert_array_equal(distance_to(cells), distance_transform_edt(~cells))


def test_nothing_is_far_from_nothing():
    assert np.isinf(distance_to(np.zeros((3, 5), dtype=bool))).all()


def test_an_image_is_blurred_as_by_scipy():
    image = np.random.default_rng(2).random((30, 20))
    np.testing.assert_allclose(blurred(image, 1.7), gaussian_filter(image, 1.7), atol=1e-12)
