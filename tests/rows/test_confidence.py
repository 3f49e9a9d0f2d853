"""How sure rows are, and what is odd about them."""

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.geo.raster import Grid, Raster
from vinemap.rows.blocks import flag_rows, group_blocks
from vinemap.rows.confidence import believed, judge_rows

SPACING = 2.5


def judged(lines, *, standing=(), wide=0.5, high=1.9, support=0.95, contrast=1.0):
    """Rows judged over ground on which canopies stand along them, and along other lines."""
    table = {"spacing_m": np.full(len(lines), SPACING), "support": support, "contrast": contrast}
    rows = gpd.GeoDataFrame(table, geometry=[shapely.LineString(line) for line in lines], crs=32632)
    wide, high = (
        [*np.broadcast_to(v, len(lines)), *[usual] * len(standing)] for v, usual in ((wide, 0.5), (high, 1.9))
    )
    rasters = []
    for resolution, tall in ((0.1, False), (0.25, True)):
        grid = Grid(-5.0, 20.0, resolution, round(25 / resolution), round(75 / resolution))
        x, y = grid.centres()
        values = np.zeros(grid.shape)
        for line, w, h in zip([*lines, *standing], wide, high, strict=True):
            xs, ys = np.array(sorted(np.asarray(line).tolist())).T
            there = (np.abs(y[:, None] - np.interp(x, xs, ys)) <= w / 2) & (x >= xs[0]) & (x <= xs[-1])
            values[there] = h if tall else 1.0
        rasters.append(Raster(values, grid, rows.crs))
    return flag_rows(judge_rows(group_blocks(rows), *rasters))


def block(n, length=60.0, at=(0, 0)):
    return [np.array([[0, SPACING * k], [length, SPACING * k]]) + at for k in range(n)]


def test_flags():
    lines = block(6)
    lines[2] = lines[2] + [0, 1.5]
    lines[4] = lines[4] * [0.3, 1]
    t = np.linspace(0, 60, 50)
    lines[0] = np.column_stack([t, -1.5 * np.sin(np.pi * t / 60)])
    support = np.array([0.95, 0.95, 0.95, 0.3, 0.95, 0.95])
    found = judged(lines, support=support)
    assert [f.split(",") if f else [] for f in found["flags"]] == [
        ["curved"], [], ["spacing"], ["sparse", "spacing"], ["short"], [],
    ]  # fmt: skip


def test_rows_of_a_block_are_sure():
    assert judged(block(6))["confidence"].min() > 0.9
    few = flag_rows(judge_rows(judged(block(6)).iloc[:0], None, None))
    assert few.empty
    assert {"confidence", "flags"} <= set(few)


def test_a_row_by_itself_may_be_a_hedge():
    alone = judged(block(1))["confidence"].iloc[0]
    assert 0.5 < alone < 0.8


def test_less_speaks_for_what_is_short_bare_or_stands_out_little():
    whole = judged(block(5))["confidence"].iloc[2]
    for worse in ({"contrast": 0.4}, {"support": 0.3}):
        assert judged(block(5), **worse)["confidence"].iloc[2] < whole
    assert judged(block(5, length=4.0))["confidence"].iloc[2] < whole - 0.1


def test_a_row_that_stops_where_others_run_through_is_a_piece_of_one():
    rows = block(5)
    pieces = [rows[2] * [0.4, 1], rows[2] * [0.3, 1] + [42, 0]]
    found = judged([*rows[:2], *rows[3:], *pieces])
    assert found["confidence"].iloc[:4].min() > 0.9
    assert found["confidence"].iloc[4:].max() < 0.7


def test_a_row_that_crosses_where_all_others_end_is_two():
    left, right = block(5, length=28), block(5, length=28, at=(33, 0))
    across = np.array([[0, 2 * SPACING], [61, 2 * SPACING]])
    found = judged([*left[:2], *left[3:], *right[:2], *right[3:], across])
    assert found["confidence"].iloc[:8].min() > 0.9
    assert found["confidence"].iloc[8] < 0.7


def test_strips_between_rows_are_wider_for_their_height():
    rows, strips = block(6), [line + [0, SPACING / 2] for line in block(5)[::2]]
    found = judged([*rows, *strips], wide=[0.5] * 6 + [1.1] * 3, high=[1.9] * 6 + [0.9] * 3)
    assert found["confidence"].iloc[:6].min() > 0.9
    assert found["confidence"].iloc[6:].max() < 0.7


def test_canopy_beside_a_row_that_no_row_stands_for_is_a_block_that_was_not_understood():
    rows = block(6)
    assert judged(rows[::3], standing=rows)["confidence"].max() < 0.5


def test_it_does_not_matter_which_end_a_row_starts_at():
    lines = block(4)
    turned = judged([line[::-1] if k % 2 else line for k, line in enumerate(lines)])
    assert turned["confidence"].to_numpy() == pytest.approx(judged(lines)["confidence"].to_numpy())


def test_rows_that_are_hardly_sure_are_none():
    lines = [shapely.LineString([(0, k), (9, k)]) for k in range(3)]
    rows = gpd.GeoDataFrame({"confidence": [0.9, 0.1, 0.8], "block": [1, 2, 3]}, geometry=lines)
    gaps = gpd.GeoDataFrame({"row": [0, 1, 2, 2]}, geometry=list(rows.geometry.iloc[[0, 1, 2, 2]]))
    kept, theirs = believed(rows, gaps)
    assert list(kept["confidence"]) == [0.9, 0.8]
    assert list(kept["block"]) == [1, 2]
    assert list(theirs["row"]) == [0, 1, 1]
    assert all(line.equals(kept.geometry[row]) for row, line in zip(theirs["row"], theirs.geometry, strict=True))
    none, nothing = believed(rows, gaps, min_confidence=1.0)
    assert len(none) == len(nothing) == 0
