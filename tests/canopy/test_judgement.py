"""How far to trust the canopies' numbers, and what is odd about them."""

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from vinemap.canopy.numbers import judge_canopies

STEP, LENGTH = 0.25, 20.0
N = round(LENGTH / STEP) + 1


def rows_of(heights, widths=0.5, block=1, apart=2.5):
    """Rows side by side; they are as high and as wide as told, NaN where nothing was modelled."""
    n = len(heights)
    lines = [shapely.LineString([(0, apart * k), (LENGTH, apart * k)]) for k in range(n)]
    table = {
        "row_id": np.arange(1, n + 1),
        "block": block,
        "spacing_m": apart,
        "gap_m": 0.0,
        "unseen_m": 0.0,
        "cut": 0.0,
        "bottom_m": 0.5,
        "flags": "",
    }
    return gpd.GeoDataFrame(table | {"height_m": heights, "width_m": widths}, geometry=lines, crs=32632)


def sections_of(n=N, seen=0.9, width=0.5, row_id=1, extent=0.4, full=1.0):
    sizes = {"width_m": np.broadcast_to(width, n), "area_m2": 1.2 * np.broadcast_to(width, n)}
    return pd.DataFrame(
        {"row_id": row_id, "position_m": STEP * np.arange(n), "seen": seen, "full": full, "extent_m": extent} | sizes
    )


def confidence(sections, **columns):
    return judge_canopies(rows_of([1.9]).assign(**columns), sections, step=STEP)["canopy_confidence"].iloc[0]


def test_a_canopy_that_was_seen_whole_is_sure():
    assert confidence(sections_of(width=0.5 + 0.02 * np.sin(np.arange(N)))) == pytest.approx(1, abs=0.01)


def test_what_was_not_modelled_not_seen_or_does_not_agree_is_doubtful():
    jagged = 0.5 + np.random.default_rng(0).uniform(-0.2, 0.2, N)
    assert confidence(sections_of(n=N // 2)) == pytest.approx(0.5, abs=0.02)
    assert confidence(sections_of(n=N // 2), gap_m=LENGTH / 2) == pytest.approx(1, abs=0.03)
    assert confidence(sections_of(n=N // 2), gap_m=LENGTH / 4, unseen_m=LENGTH / 4) == pytest.approx(1, abs=0.03)
    assert confidence(sections_of(), cut=0.7) == pytest.approx(0.3, abs=0.01)
    assert confidence(sections_of(seen=0.55)) == pytest.approx(2 / 7)
    assert confidence(sections_of(full=0.4)) == 0  # two curtains, and air between them
    assert confidence(sections_of(full=0.9)) == pytest.approx(1)
    assert confidence(sections_of(width=jagged)) < 0.5
    assert confidence(sections_of(n=3), gap_m=LENGTH - 1) == 0
    assert confidence(sections_of(width=2.2), width_m=2.2) < 0.6
    assert confidence(sections_of(width=3.0), width_m=3.0, bottom_m=1.6) == 0
    low = [
        confidence(sections_of(width=0.2), height_m=height, width_m=0.2, bottom_m=0.22) for height in (0.5, 0.65, 1.0)
    ]
    assert low == pytest.approx([0.05, 0.56, 1.0], abs=0.01)
    assert confidence(sections_of(), height_m=1.2, bottom_m=0.5) == pytest.approx(1)  # trunks show beneath it


def test_sections_that_share_points_do_not_speak_for_each_other():
    """Wide sections a metre apart have most points in common: only those that have none are two witnesses."""
    waving = 0.5 + 0.2 * np.sin(np.pi * STEP * np.arange(N) / 5.0)
    assert confidence(sections_of(width=waving)) > 0.6
    assert confidence(sections_of(width=waving, extent=5.0)) < 0.2
    assert confidence(sections_of(extent=5.0)) == pytest.approx(1)
    assert confidence(sections_of(extent=LENGTH + 1)) == 0


def test_without_a_canopy_there_is_neither_confidence_nor_flag():
    found = judge_canopies(rows_of([1.9, np.nan, 1.9, 1.9]), sections_of(), step=STEP)
    assert found["canopy_confidence"].notna().tolist() == [True, False, False, False]
    assert found["flags"].tolist() == [""] * 4
    assert judge_canopies(rows_of([]), sections_of(n=0), step=STEP).empty


def test_rows_unlike_their_block():
    heights, widths = [1.9, 0.9, 2.0, 1.95, 1.85], [0.5, 1.0, 0.52, 0.9, 0.48]
    rows = rows_of(heights, widths).assign(flags=["", "short", "", "", ""])
    assert judge_canopies(rows, sections_of(), step=STEP)["flags"].tolist() == [
        "",
        "short,height,width",
        "",
        "width",
        "",
    ]


def test_rows_of_a_block_that_differ_anyway_are_not_odd():
    assert set(judge_canopies(rows_of([1.0, 1.4, 2.0, 2.6, 1.7]), sections_of(), step=STEP)["flags"]) == {""}


def test_a_row_that_is_no_block_is_held_against_those_around():
    rows = rows_of([1.9, 2.0, 0.9, 1.95, 1.85], block=[1, 1, 2, 1, 1])
    assert judge_canopies(rows, sections_of(), step=STEP)["flags"].tolist() == ["", "", "height", "", ""]
    far = rows_of([1.9, 0.9], block=[1, 2], apart=30.0).assign(spacing_m=2.5)
    assert judge_canopies(far, sections_of(), step=STEP)["flags"].tolist() == ["", ""]
