"""Rows of two dates, whose changes are known."""

from itertools import pairwise

import geopandas as gpd
import numpy as np
import pytest
import shapely
from shapely.ops import substring

from vinemap.evaluate.changes import compare_rows, estimate_shift, follow_rows, summarise
from vinemap.simulate.scenes import rows_of

SHIFT = np.array([0.3, 0.4])
"""Of half a metre, at a spacing of 2.5 m."""


def table(lines, *, suffix="F", crs="EPSG:32632", wander=0.0, **numbers):
    """Rows as in a product, numbered in the order given; lines may wander (m) as found ones do."""
    noise = np.random.default_rng(0)
    lines = [shapely.segmentize(shapely.LineString(line), 0.5) for line in lines]
    lines = shapely.transform(lines, lambda xy: xy + noise.normal(0, wander, xy.shape))
    n = len(lines)
    known = {"height_m": 1.9, "width_m": 0.5, "volume_m3": 40.0, "gap_m": 1.0, "n_missing": 1} | numbers
    columns = {
        "row_id": range(1, n + 1),
        "label": [f"{k + 1} {suffix}" for k in range(n)],
        "spacing_m": 2.5 if n > 1 else np.nan,
        "length_m": shapely.length(lines),
    }
    return gpd.GeoDataFrame(columns | known, geometry=list(lines), crs=crs)


def states(changes):
    rows = changes.rows[["state", "label", "earlier"]].astype(object)
    return {*rows.where(rows.notna(), None).itertuples(index=False, name=None)}


@pytest.mark.parametrize("azimuth", [0, 33, 90, 140])
def test_rows_are_known_again_renumbered_and_shifted(azimuth):
    before = rows_of(10, length=60, azimuth=azimuth)
    kept = [line + SHIFT for k, line in enumerate(before) if k != 3]
    new = 2 * kept[-1] - kept[-2]
    later = table([new, *reversed(kept)], wander=0.01, height_m=2.1, volume_m3=44.0, n_missing=3)
    changes = compare_rows(later, table(before, wander=0.01))
    assert changes.shift == pytest.approx(SHIFT, abs=0.02)
    names = [k for k in range(10) if k != 3]
    same = {("same", f"{2 + k} F", f"{name + 1} F") for k, name in enumerate(reversed(names))}
    assert states(changes) == {*same, ("new", "1 F", None), ("gone", None, "4 F")}
    found = summarise(changes)
    assert (found["same"], found["new"], found["gone"]) == (9, 1, 1)
    assert found["d_height_m"] == pytest.approx(0.2)
    assert found["d_volume"] == pytest.approx(0.1)
    assert found["d_n_missing"] == 18


def test_another_crs_makes_no_difference():
    lines = rows_of(6, length=40, azimuth=20)
    later = table([line + SHIFT for line in lines]).to_crs("EPSG:32633")
    changes = compare_rows(later, table(lines))
    assert len(changes.rows) == 6
    assert np.hypot(*changes.shift) == pytest.approx(0.5, abs=0.01)


def test_shortened_rows_are_no_shift():
    lines = [np.linspace(*line[[0, -1]], 50) for line in rows_of(8, length=50, azimuth=10)]
    later = [line[:30] if k < 3 else line for k, line in enumerate(lines)]
    changes = compare_rows(table(later), table(lines))
    assert changes.shift == pytest.approx((0, 0), abs=0.01)
    assert changes.rows["d_length_m"].round(0).tolist() == [-20, -20, -20, 0, 0, 0, 0, 0]


def test_curved_rows_tell_the_shift_without_their_ends():
    lines = np.array([shapely.LineString(line) for line in rows_of(6, length=60, radius=40)])
    cut = np.array([substring(line, 5 + k, 50 - k) for k, line in enumerate(lines)])
    moved = shapely.transform(cut, lambda xy: xy + SHIFT)
    assert estimate_shift(moved, lines, spacing=2.5) == pytest.approx(SHIFT, abs=0.05)


def test_split_and_joined_rows_are_named():
    lines = rows_of(4, length=40)
    (start, end), rest = lines[0][[0, -1]], lines[1:]
    pieces = [np.array([start, start + 0.6 * (end - start)]), np.array([start + 0.7 * (end - start), end])]
    split = compare_rows(table([*pieces, *rest]), table(lines)).rows
    assert split[split["state"] == "new"][["label", "part_of"]].to_numpy().tolist() == [["2 F", "1 F"]]
    joined = compare_rows(table(lines), table([*pieces, *rest])).rows
    assert joined[joined["state"] == "gone"][["earlier", "part_of"]].to_numpy().tolist() == [["2 F", "1 F"]]


def test_a_replanted_parcel_has_no_row_in_common():
    changes = compare_rows(table(rows_of(6, azimuth=90)), table(rows_of(6, azimuth=0)))
    assert set(changes.rows["state"]) == {"new", "gone"}
    assert len(changes.rows) == 12


@pytest.mark.parametrize("spacing", [1.8, 2.2, 2.8])
@pytest.mark.parametrize("told", [None, (0.0, 0.0)])
def test_a_parcel_replanted_along_its_old_rows_has_none_in_common(spacing, told):
    later, earlier = table(rows_of(18, spacing=spacing), wander=0.01), table(rows_of(18), wander=0.01)
    changes = compare_rows(later.assign(spacing_m=spacing), earlier, shift=told)
    assert (changes.rows["state"] != "same").all()
    assert len(changes.rows) == 36


def test_rows_between_others_and_a_stretched_flight_leave_rows_the_same():
    rows = rows_of(18)
    between = [*rows, *(0.5 * (a + b) for a, b in pairwise(rows))]
    stretched = [line + 0.02 * (line - np.mean(rows, axis=(0, 1))) for line in rows]
    for later, earlier, same in ((between, rows, 18), (rows, between, 18), (stretched, rows, 18)):
        found = summarise(compare_rows(table(later, wander=0.01), table(earlier, wander=0.01)))
        assert found["same"] == same


@pytest.mark.parametrize(("later", "earlier"), [(0, 0), (3, 0), (0, 3), (1, 1)])
def test_few_or_no_rows(later, earlier):
    now, then = table(rows_of(3)[:later]), table(rows_of(3)[:earlier])
    changes = compare_rows(now, then)
    assert changes.shift == pytest.approx((0, 0), abs=1e-6)
    found = summarise(changes)
    assert (found["same"], found["new"] + found["gone"]) == (min(later, earlier), abs(later - earlier))


def test_what_was_not_seen_on_one_date_is_no_change():
    before, lines = {"unseen_m": [0.0, 2.0, 0.0]}, rows_of(3, length=40)
    now = table(lines, height_m=2.0, gap_m=3.0, n_missing=3, volume_m3=[44.0, 50, 40], unseen_m=[0.0, 0, 4])
    changes = compare_rows(now, table(lines, **before))
    for name, gained in (("d_gap_m", 2), ("d_n_missing", 2), ("d_volume_m3", 4)):
        assert changes.rows[name].to_numpy() == pytest.approx([gained, np.nan, np.nan], nan_ok=True)
        assert summarise(changes)[name] == gained
    assert changes.rows["n_missing"].tolist() == [3, 3, 3]
    assert changes.rows["d_height_m"].to_numpy() == pytest.approx(0.1)
    assert summarise(changes)["d_volume"] == pytest.approx(0.1)
    without = now.drop(columns="unseen_m")
    assert compare_rows(without, table(lines, **before)).rows["d_gap_m"].isna().tolist() == [False, True, False]
    assert compare_rows(without, table(lines)).rows["d_gap_m"].notna().all()
    none = summarise(compare_rows(now.assign(unseen_m=1.0), table(lines)))
    assert np.isnan([none[name] for name in ("d_gap_m", "d_n_missing", "d_volume")]).all()


def test_a_shift_that_is_known_is_taken_out():
    """One of more than half the spacing, which rows alone don't tell."""
    lines = rows_of(6, length=40, azimuth=20)
    far = np.array([0.5, 1.6])
    tables = [table([lines[k] + far for k in (0, 1, 2, 4, 5)]), table(lines)]
    assert states(compare_rows(*tables)) != states(compare_rows(*tables, shift=tuple(far)))
    changes = compare_rows(*tables, shift=tuple(far))
    assert changes.shift == pytest.approx(far)
    assert states(changes) == {
        *(("same", f"{now} F", f"{then} F") for now, then in ((1, 1), (2, 2), (3, 3), (4, 5), (5, 6))),
        ("gone", None, "4 F"),
    }
    assert [found.tolist() for found in follow_rows(tables, shifts=[tuple(far)])] == [[*range(5)], [0, 1, 2, 5, 3, 4]]


def test_rows_are_followed_through_dates_on_which_they_arent():
    """Four flights, each off the others: one row is missed once, one is gone, one is new."""
    lines = rows_of(6, length=40, azimuth=20)
    dates = [(0, 1, 2, 3, 5), (5, 3, 2, 0), (0, 1, 2, 3, 4), (0, 1, 2, 3, 4)]
    tables = [table([lines[k] + turn * SHIFT for k in kept]) for kept, turn in zip(dates, (0, 1, -1, 0.5), strict=True)]
    tables[3] = tables[3].to_crs("EPSG:32633")
    numbers = [found.tolist() for found in follow_rows(tables)]
    assert numbers == [[0, 1, 2, 3, 4], [4, 3, 2, 0], [0, 1, 2, 3, 5], [0, 1, 2, 3, 5]]
    assert [found.tolist() for found in follow_rows([tables[0].iloc[:0], tables[1]])] == [[], [0, 1, 2, 3]]
