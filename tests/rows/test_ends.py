import numpy as np

from vinemap.rows.centre_line import CELL
from vinemap.rows.standing.canopy import cut_to_canopy


def test_a_wide_canopy_ends_where_its_middle_does():
    x, offsets = np.arange(400) * CELL, np.arange(-24, 25) * CELL
    inside = np.minimum(x - 3, 17 - x)
    half = np.where(inside > 0, 1.1 * np.sqrt(np.clip(inside / 0.5, 0, 1)), -1)
    image = (np.abs(offsets) < half[:, None]).astype(float)
    standing = cut_to_canopy(np.column_stack([x, 0 * x]), image, image, 0.6)
    assert standing is not None
    assert np.allclose(standing.curve[[0, -1], 0], [3, 17], atol=0.07)


def test_a_hedge_across_the_end_is_no_vine():
    x, offsets = np.arange(400) * CELL, np.arange(-24, 25) * CELL
    vines = ((x > 3) & (x < 12) & ~((x > 7) & (x < 9)))[:, None] & (np.abs(offsets) < 0.3)
    image = (vines | ((x > 13.5) & (x < 14.5))[:, None]).astype(float)
    standing = cut_to_canopy(np.column_stack([x, 0 * x]), image, image, 0.6)
    assert standing is not None
    assert np.allclose(standing.curve[[0, -1], 0], [3, 12], atol=0.1)
    assert not any(standing.goes_on)
    broad = (vines | ((x > 13.5) & (x < 19))[:, None]).astype(float)
    standing = cut_to_canopy(np.column_stack([x, 0 * x]), broad, broad, 0.6)
    assert standing is not None
    assert np.allclose(standing.curve[[0, -1], 0], [3, 19], atol=0.1)  # longer than a hedge is thick
    wide = (((x > 3) & (x < 12)) | ((x > 13.5) & (x < 14.5)))[:, None] & (np.abs(offsets) < 3)
    standing = cut_to_canopy(np.column_stack([x, 0 * x]), wide * 1.0, wide * 1.0, 0.6)
    assert standing is not None
    assert np.allclose(standing.curve[[0, -1], 0], [3, 14.5], atol=0.1)  # rows that touch all along


def test_a_car_behind_a_row_is_no_vine():
    """Far wider than its canopy, and not as long as rows; a last vine that is twice as wide is one."""
    x, offsets = np.arange(400) * CELL, np.arange(-24, 25) * CELL
    vines = ((x > 3) & (x < 12))[:, None] & (np.abs(offsets) < 0.3)
    for half, until, end in ((0.95, 17, 12), (0.6, 14, 14), (0.95, 19.5, 19.5)):
        behind = ((x > 13.5) & (x < until))[:, None] & (np.abs(offsets) < half)
        image = (vines | behind).astype(float)
        standing = cut_to_canopy(np.column_stack([x, 0 * x]), image, image, 0.6)
        assert standing is not None
        assert np.allclose(standing.curve[[0, -1], 0], [3, end], atol=0.1)
