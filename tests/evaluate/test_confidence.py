"""How sure rows are, and what is odd about them."""

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.evaluate.confidence import believed, judge_rows
from vinemap.geo.raster import Grid, Raster
from vinemap.rows.blocks import flag_rows, group_blocks
from vinemap.surfaces.seen import Seen
from vinemap.surfaces.waves import RowField

SPACING = 2.5
NO_GAPS = gpd.GeoDataFrame({"row": np.empty(0, dtype=int)}, geometry=[])


def judged(
    lines,
    *,
    standing=(),
    wide=0.5,
    high=1.9,
    support=0.95,
    contrast=1.0,
    voids=(),
    houses=(),
    likelihood=0.7,
    plain=0.0,
    noise=0.0,
    leaves=0.0,
):
    """Rows judged over ground on which canopies stand along them, and along other lines; nothing is seen in voids.

    Heights are off by noise, and those of canopies by leaves, too: metres, standard deviations.
    """
    rng = np.random.default_rng(0)
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
            values[there] = h + rng.normal(0, leaves, np.count_nonzero(there)) if tall else 1.0
        hidden = shapely.contains_xy(shapely.union_all(list(voids)), *np.meshgrid(x, y))
        values[hidden] = np.nan if tall else 0.0
        values[shapely.contains_xy(shapely.union_all(list(houses)), *np.meshgrid(x, y))] = 5.0 if tall else 0.0
        values += rng.normal(0, noise, grid.shape) * tall
        rasters.append(Raster(values, grid, rows.crs))
    grid = rasters[0].grid
    shown = ~shapely.contains_xy(shapely.union_all(list(voids)), *np.meshgrid(*grid.centres()))
    told = [Raster(np.full(grid.shape, value), grid, rows.crs) for value in (0.0, SPACING, likelihood, plain)]
    field = RowField(*told[:3], plain=told[3])
    rows = judge_rows(group_blocks(rows), *rasters, field, Seen(shown, grid, shown, grid))
    return flag_rows(rows)


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
    few = flag_rows(judge_rows(judged(block(6)).iloc[:0], None, None, None, None))
    assert few.empty
    assert {"confidence", "flags"} <= set(few)


def test_a_row_by_itself_may_be_a_hedge():
    alone = judged(block(1))["confidence"].iloc[0]
    assert 0.5 < alone < 0.8


@pytest.mark.parametrize(("stands", "least"), [(0.4, 0.7), (0.15, 0.5)])
def test_a_row_beside_which_most_of_the_next_is_grubbed_up_is_still_one(stands, least):
    lines = block(6)
    lines[1] = lines[1] * [stands, 1]
    assert judged(lines)["confidence"].min() > least


def test_less_speaks_for_what_is_short_bare_or_stands_out_little():
    whole = judged(block(5))["confidence"].iloc[2]
    for worse in ({"contrast": 0.4}, {"support": 0.3}):
        assert judged(block(5), **worse)["confidence"].iloc[2] < whole
    assert judged(block(5, length=4.0))["confidence"].iloc[2] < whole - 0.1


def test_what_wanders_where_there_is_no_wave_of_rows_is_none():
    x = np.linspace(0, 60, 121)
    line = np.column_stack([x, np.sin(x)])
    assert judged([line])["confidence"].iloc[0] < 0.3
    assert judged(block(1), likelihood=0.2)["confidence"].iloc[0] < 0.3
    assert judged(block(1), likelihood=0.1, plain=0.8)["confidence"].iloc[0] > 0.5
    assert judged(block(5), likelihood=0.4)["confidence"].min() > 0.9


def test_what_is_as_even_as_the_ground_has_no_leaves():
    """Tables of solar panels, or bales in a line; where noise hides leaves nothing tells them."""
    assert judged(block(5), wide=1.2, noise=0.01)["confidence"].max() < 0.45
    assert judged(block(5), wide=1.2, noise=0.01, leaves=0.04)["confidence"].min() > 0.9
    assert judged(block(5), wide=0.5, noise=0.01)["confidence"].min() > 0.9  # its sides are steep
    assert judged(block(5), wide=1.2, noise=0.06)["confidence"].min() > 0.9


def test_a_row_that_stops_at_a_house_is_whole():
    rows = block(5)
    pieces = [rows[2] * [0.4, 1], rows[2] * [0.4, 1] + [36, 0]]
    lines = [*rows[:2], *rows[3:], *pieces]
    assert judged(lines)["confidence"].iloc[-2:].max() < 0.8
    assert judged(lines, houses=[shapely.box(25, 3, 35, 7)])["confidence"].iloc[-2:].min() > 0.9


@pytest.mark.parametrize(("spacing", "radius"), [(2.5, 8.0), (5.0, 9.0)])
def test_rows_that_bend_are_as_sure(spacing, radius):
    turn = np.linspace(-1, 1, 121)
    radii = radius + spacing * np.arange(3)
    bent = [np.column_stack([30 + r * np.sin(turn), 16 - r * np.cos(turn)]) for r in radii]
    assert judged(bent)["confidence"].min() > 0.9


def test_a_row_that_stops_where_others_run_through_is_a_piece_of_one():
    rows = block(5)
    pieces = [rows[2] * [0.4, 1], rows[2] * [0.3, 1] + [42, 0]]
    found = judged([*rows[:2], *rows[3:], *pieces])
    assert found["confidence"].iloc[:4].min() > 0.9
    assert found["confidence"].iloc[4:].max() < 0.7


def test_that_others_run_through_says_nothing_where_it_was_not_seen():
    rows = block(5)
    pieces = [rows[2] * [0.4, 1], rows[2] * [0.3, 1] + [42, 0]]
    found = judged([*rows[:2], *rows[3:], *pieces], voids=[shapely.box(23, 3.5, 43, 6.5)])
    assert found["confidence"].min() > 0.9


@pytest.mark.parametrize(
    ("voids", "cut"),
    [
        ([], 0),
        ([shapely.box(-5, -5, 70, -0.1)], 1),  # a boundary through the canopy, or the end of the cloud
        ([shapely.box(-5, -5, 70, 0)], 1),
        ([shapely.box(20, -5, 70, -0.1)], 2 / 3),
        ([shapely.Polygon([(-5, -5), (70, -5), (70, 0.5), (-5, -4)])], 0.15),  # oblique
        ([shapely.box(30, 0.1, 36, 1.8)], 0.1),  # a void beside it
        ([shapely.box(-5, -5, 70, -0.8)], 0),  # ground was seen beside it
        ([shapely.box(20, -5, 26, 20)], 0),  # across it
    ],
)
def test_a_row_whose_canopy_is_cut_is_at_an_edge_and_less_sure(voids, cut):
    found, whole = (believed(judged(block(5), voids=cut_by), NO_GAPS)[0] for cut_by in (voids, ()))
    assert found["cut"].iloc[0] == pytest.approx(cut, abs=0.05)
    assert found["flags"].tolist() == ["edge" if cut else "", "", "", "", ""]
    odds, before = (np.log(one["confidence"] / (1 - one["confidence"])).iloc[0] for one in (found, whole))
    assert before - odds == pytest.approx(2 * cut, abs=0.1)  # e² times less, where all of it is cut
    assert found["confidence"].iloc[1:].to_numpy() == pytest.approx(whole["confidence"].iloc[1:].to_numpy(), abs=0.02)


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
    rows = gpd.GeoDataFrame({"confidence": [0.9, 0.1, 0.8], "cut": 0.0, "block": [1, 2, 3]}, geometry=lines)
    gaps = gpd.GeoDataFrame({"row": [0, 1, 2, 2]}, geometry=list(rows.geometry.iloc[[0, 1, 2, 2]]))
    kept, theirs = believed(rows, gaps)
    assert list(kept["confidence"]) == [0.9, 0.8]
    assert list(kept["block"]) == [1, 2]
    assert list(theirs["row"]) == [0, 1, 1]
    assert all(line.equals(kept.geometry[row]) for row, line in zip(theirs["row"], theirs.geometry, strict=True))
    none, nothing = believed(rows, gaps, min_confidence=1.0)
    assert len(none) == len(nothing) == 0
    less = believed(rows.assign(cut=[0.5, 0, 1]), gaps, min_confidence=0.3)[0]["confidence"]
    assert less.tolist() == pytest.approx([0.9 / (0.9 + 0.1 * np.e), 0.8 / (0.8 + 0.2 * np.e**2)])
    assert believed(rows.assign(cut=1.0), gaps, min_confidence=0.7)[0]["confidence"].tolist() == [0.7, 0.7]
