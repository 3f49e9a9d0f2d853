"""Confidence beside truth: as a table and as a picture."""

import numpy as np

from vinemap.measure.accuracy.trust import Trust, draw_trust, pool_trust, trust_table

SOME = Trust(
    np.array([0.2, 0.4, 0.7, 0.9, 0.95]),
    np.array([False, True, True, True, True]),
    np.array([0.3, 0.97, np.nan, 0.95]),
    np.array([-0.4, 0.02, 0.5, -0.04]),
)


def test_how_many_rows_of_a_confidence_are_right():
    _, low, middle, high = trust_table(SOME)
    assert low == ["below 0.5", "2, 50.0", "1, 40.0, 40.0"]
    assert middle == ["0.5 to 0.9", "1, 100.0", "0, –"]
    assert high == ["0.9 and more", "2, 100.0", "2, 3.0, 3.8"]
    assert trust_table(pool_trust([SOME, SOME]))[1][1] == "4, 50.0"


def test_a_picture_of_it(tmp_path):
    nothing = Trust(np.empty(0), np.empty(0, dtype=bool), np.empty(0), np.empty(0))
    for k, all_ in enumerate((SOME, nothing)):
        draw_trust(all_, tmp_path / f"{k}.png")
        assert (tmp_path / f"{k}.png").read_bytes().startswith(b"\x89PNG")


def test_what_misses_its_bar_is_marked():
    """Sure rows of which a fiftieth is wrong, and doubtful ones that are right."""
    confidence = np.repeat([0.95, 0.3], [50, 2])
    right = np.arange(52) != 0
    _, low, _, high = trust_table(Trust(confidence, right, np.empty(0), np.empty(0)))
    assert low[1] == "2, 100.0!"
    assert high[1] == "50, 98.0!"
