"""Vines one by one: on cover that is drawn of vines whose places are known, and on a simulated survey."""

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from vinemap.canopy.numbers import lengths_of, summarise_rows
from vinemap.chain import map_rows, model_canopies
from vinemap.evaluate.planting import Edges, estimate_spacing, place_vines
from vinemap.evaluate.shift import Shift
from vinemap.evaluate.trunks import vines_in_rows
from vinemap.evaluate.vines import find_vines
from vinemap.geo.raster import Raster, grid_over

STEP = 0.25
ROWS_APART = 2.5


def planted(spacing, *, extent=None, length=40.0, rows=8, dead=0.08, seed=0, block=1, south=0.0):
    """Rows from west to east and, of each, places of vines and which are dead; the first and the last never are."""
    rng = np.random.default_rng(seed)
    extent = spacing if extent is None else extent
    out = []
    for k in range(rows):
        n = round((length + rng.uniform(-2, 2) - extent) / spacing) + 1
        place = extent / 2 + np.arange(n) * spacing
        gone = rng.random(n) < dead
        gone[[0, -1]] = False
        out.append((south + k * ROWS_APART, place, gone, extent, block))
    return out


def tables(rows, *, unseen=()):
    """Rows, gaps, sections and cover of them; of vines ``unseen``, by row and number, nothing is there."""
    cover = np.zeros((round((max(r[0] for r in rows) + 3) / 0.1), 500), dtype=np.float32)
    grid = grid_over([0, -1.5], [50, 0.1 * len(cover) - 1.5], resolution=0.1)
    cover = np.zeros(grid.shape, dtype=np.float32)
    x, y = grid.centres()
    lines, gaps, sections = [], [], []
    for i, (north, place, gone, extent, block) in enumerate(rows, 1):
        hidden = np.isin(np.arange(len(place)), [k - 1 for row, k in unseen if row == i])
        there = place[~gone & ~hidden]
        length = place[-1] + extent / 2
        lines.append((i, block, 0.5, 0.0, 0, 1.0, shapely.LineString([[2, north, 100], [2 + length, north, 110]])))
        canopy = np.abs(x[None, :] - 2 - there[:, None]).min(axis=0) <= extent / 2
        cover[np.ix_(np.abs(y - north) <= 0.25, canopy)] = 0.8
        stations = np.arange(STEP / 2, length, STEP)
        stations = stations[np.abs(stations[:, None] - there).min(axis=1) <= extent / 2]
        sections += [(i, s, 1.8, 0.5, 0.7, 80, 0.4) for s in stations]
        edges = np.column_stack([there[:-1] + extent / 2, there[1:] - extent / 2])
        for a, b in edges[np.diff(edges, axis=1)[:, 0] > 0.8]:
            dark = ((place[hidden] > a) & (place[hidden] < b)).any()
            gaps.append((i, a, b, b - a, 1, "unseen" if dark else "missing"))
    columns = ["row_id", "block", "width_m", "gap_m", "n_missing", "vine_spacing_m", "geometry"]
    rows = pd.DataFrame(lines, columns=columns)
    gaps = pd.DataFrame(gaps, columns=["row_id", "start_m", "end_m", "length_m", "n_missing", "state"])
    seen = gaps[gaps["state"] == "missing"].groupby("row_id")["length_m"].sum()
    rows["gap_m"] = seen.reindex(rows["row_id"], fill_value=0.0).to_numpy()
    return (
        gpd.GeoDataFrame(rows, crs=32632),
        gpd.GeoDataFrame(gaps),
        pd.DataFrame(
            sections, columns=["row_id", "position_m", "height_m", "width_m", "area_m2", "n_points", "extent_m"]
        ),
        Raster(cover, grid, None),
    )


def compared(vines, rows, *, within):
    """Whether vines are as they were planted, in number, state and, but for what is given in metres, place."""
    for i, (_, place, gone, *_) in enumerate(rows, 1):
        own = vines[vines["row_id"] == i]
        np.testing.assert_array_equal(own["number"], np.arange(1, len(place) + 1))
        np.testing.assert_array_equal(own["state"] == "missing", gone)
        assert np.abs(own["position_m"].to_numpy() - place).max() < within


@pytest.mark.parametrize(("spacing", "extent"), [(0.9, None), (1.3, None), (1.0, 1.1), (2.1, 1.0), (1.6, 0.5)])
def test_vines_stand_where_gaps_tell(spacing, extent):
    rows = planted(spacing, extent=extent)
    out, gaps, vines = find_vines(*tables(rows))
    assert out["vine_spacing_m"].unique() == pytest.approx([spacing], rel=0.01)
    compared(vines, rows, within=0.15 * spacing)
    assert (vines["position_sd_m"] < 0.3 * spacing).all()
    assert out["n_missing"].tolist() == [gone.sum() for _, _, gone, *_ in rows]
    assert gaps["n_missing"].sum() == out["n_missing"].sum()


@pytest.mark.parametrize(("spacing", "extent"), [(2.4, 0.9), (1.6, 0.5), (1.0, 1.1)])
def test_the_space_between_vines_is_no_gap(spacing, extent):
    """Where they stand apart; what is missing among them is one."""
    told = tables(planted(spacing, extent=extent))
    rows, gaps, vines = find_vines(*told)
    gone = vines[vines["state"] == "missing"]
    among = [
        ((gone["row_id"] == g.row_id) & gone["position_m"].between(g.start_m, g.end_m)).sum() for g in gaps.itertuples()
    ]
    assert (gaps["n_missing"] > 0).all()
    assert among == gaps["n_missing"].tolist()
    lengths = gaps.groupby("row_id")["length_m"].sum().reindex(rows["row_id"], fill_value=0).to_numpy()
    np.testing.assert_allclose(rows["gap_m"], lengths, atol=1e-9)


def test_vines_lie_on_their_rows():
    rows = planted(1.2)
    out, _, vines = find_vines(*tables(rows))
    lines = out.set_index("row_id").geometry[vines["row_id"]].to_numpy()
    assert shapely.distance(lines, vines.geometry.to_numpy()).max() < 1e-6
    share = vines["position_m"] / shapely.length(shapely.force_2d(lines))
    np.testing.assert_allclose(shapely.get_z(vines.geometry.to_numpy()), 100 + 10 * share)


def test_hedges_without_gaps_have_so_many_vines_anywhere():
    rows = planted(1.1, dead=0)
    told = tables(rows)
    out, _, vines = find_vines(*told, vine_spacing=1.1)
    assert vines.groupby("row_id").size().tolist() == [len(place) for _, place, *_ in rows]
    np.testing.assert_allclose(vines["position_sd_m"], 1.1 / 12**0.5, rtol=0.02)
    assert not out["n_missing"].any()


def test_nothing_is_made_up_where_no_spacing_is_told():
    told = tables(planted(1.1, dead=0))
    out, _, vines = find_vines(*told)
    assert len(vines) == 0
    assert list(vines.columns[:3]) == ["row_id", "number", "position_m"]
    pd.testing.assert_frame_equal(pd.DataFrame(out), pd.DataFrame(told[0]))


def test_gaps_without_any_order_tell_no_spacing():
    rng, told = np.random.default_rng(5), 0
    for _ in range(40):
        rows = []
        for _ in range(8):
            starts = np.sort(rng.uniform(2, 38, 5))
            rows.append(Edges(40.0, np.append(starts, 40.0), np.append(starts + rng.uniform(0.5, 1.5, 5), 0.0)))
        told += estimate_spacing(rows) is not None
    assert told <= 1


def test_bushes_most_of_whose_narrow_gaps_are_hidden():
    """So that canopies are longer than vines that stand apart make, by whose width alone gaps would tell half of it."""
    rng = np.random.default_rng(0)
    rows = []
    for _, place, gone, extent, _ in planted(1.5, extent=0.95, length=60.0, rows=16):
        there = place[~gone]
        ends, begins = there[:-1] + extent / 2, there[1:] - extent / 2
        seen = (begins - ends > 1) | (rng.random(len(ends)) < 0.1)
        off = rng.normal(0, 0.03, (2, seen.sum()))
        length = place[-1] + extent / 2
        rows.append(Edges(length, np.append(ends[seen] + off[0], length), np.append(begins[seen] + off[1], 0.0)))
    assert np.concatenate([row.runs for row in rows]).mean() > 3
    assert estimate_spacing(rows) == pytest.approx(1.5, abs=0.02)


def test_blocks_have_their_own_spacing_and_lend_it_to_those_without():
    rows = planted(0.9, rows=6) + planted(1.5, rows=6, block=2, south=20, seed=1)
    rows += planted(0.9, rows=2, block=3, south=40, seed=2, dead=0)
    out, _, vines = find_vines(*tables(rows))
    spacing = out.groupby("block")["vine_spacing_m"].first()
    assert spacing[[1, 2]].tolist() == pytest.approx([0.9, 1.5], rel=0.01)
    assert (vines.groupby("row_id").size().reindex(out["row_id"]) > 0).all()
    compared(vines[vines["row_id"] <= 12], rows[:12], within=0.2)


def test_what_was_not_seen_is_not_missing():
    rows = planted(1.2)
    unseen = [(3, k) for k in range(10, 16)]
    for _, k in unseen:
        rows[2][2][k - 1] = False
    rows[2][2][[8, 15]] = False
    out, _, vines = find_vines(*tables(rows, unseen=unseen))
    own = vines[vines["row_id"] == 3]
    assert own.loc[own["state"] == "unseen", "number"].tolist() == [k for _, k in unseen]
    assert own.loc[own["state"] == "unseen", ["height_m", "width_m", "volume_m3"]].isna().all(axis=None)
    assert out["n_missing"].tolist() == [gone.sum() for _, _, gone, *_ in rows]


def test_where_canopy_has_few_points_one_vine_without_any_may_stand():
    rows = planted(1.2, dead=0.0)
    rows[2][2][7], rows[5][2][10:14] = True, True
    told = tables(rows)
    told[2][["n_points", "extent_m"]] = 20, 8.0
    _, _, vines = find_vines(*told, vine_spacing=1.2)
    gone = vines[vines["state"] == "missing"]
    assert gone[["row_id", "number"]].to_numpy().tolist() == [[6, k] for k in (11, 12, 13, 14)]


def test_canopies_of_vines_add_up_to_their_rows_and_weak_ones_are_told():
    rows = planted(1.2)
    told = tables(rows)
    sections = told[2]
    first = (sections["row_id"] == 2) & sections["position_m"].between(1.2, 2.4)
    sections.loc[first, "area_m2"] *= 0.3
    sections.loc[first, "height_m"] = 1.0
    out, _, vines = find_vines(*told)
    total = (sections["area_m2"] * lengths_of(sections, STEP)).groupby(sections["row_id"]).sum()
    np.testing.assert_allclose(vines.groupby("row_id")["volume_m3"].sum(), total)
    weak = vines[vines["state"] == "weak"]
    assert weak[["row_id", "number"]].to_numpy().tolist() == [[2, 2]]
    assert weak["height_m"].iloc[0] == pytest.approx(1.0, abs=0.25)
    gone = vines[vines["state"] == "missing"]
    assert (gone["volume_m3"] == 0).all()
    assert gone["height_m"].isna().all()
    assert out["n_missing"].sum() == len(gone)


@pytest.mark.parametrize("length", [0.5, 1.08, 1.1, 2.0])
def test_rows_no_longer_than_a_vine_have_one(length):
    """Though the block's other rows tell of vines of just that extent."""
    edges = [Edges(length, np.array([length]), np.zeros(1)), Edges(20.08, np.array([20.08]), np.zeros(1))]
    places = place_vines(edges, 1.0, 1.08)
    assert np.bincount(places.row).tolist() == [round(max(length - 1.08, 0)) + 1, 20]
    assert ((places.position >= 0) & (places.position <= np.array([length, 20.08])[places.row])).all()
    assert np.isfinite(places.deviation).all()


def surveyed(rows, *, shift=(0.0, 0.0)):
    """Points of vines to 2 cm, of missing ones too, in any order and another CRS."""
    rng = np.random.default_rng(0)
    xy = np.concatenate([np.column_stack([2 + place, np.full(len(place), north)]) for north, place, *_ in rows])
    xy = rng.permutation(xy) + rng.normal(0, 0.02, xy.shape) + shift
    return gpd.GeoSeries(shapely.points(xy + [500_000, 5_000_000]), crs=32632).to_crs(4326)


def at_home(told):
    """Tables at a place on the globe, with the rows' distance."""
    rows, gaps, sections, cover = told
    place = 500_000, 5_000_000
    grid = cover.grid._replace(west=cover.grid.west + place[0], north=cover.grid.north + place[1])
    rows = rows.set_geometry(rows.translate(*place)).assign(spacing_m=ROWS_APART)
    return rows, gaps, sections, Raster(cover.values, grid, None)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.2)])
def test_known_vines_stand_where_they_are_known_to(shift):
    """In rows that tell nothing, and in some of several; those of others are estimated."""
    rows = planted(1.2, rows=4, dead=0) + planted(1.2, south=4 * ROWS_APART, seed=1)
    told = at_home(tables(rows))
    off = Shift(-np.array(shift), np.eye(2), np.full(2, 0.01), 9, 9)
    known, remarks = vines_in_rows(surveyed(rows[:6], shift=shift), told[0], off)
    assert (sorted(known), remarks) == ([*range(6)], [])
    out, gaps, vines = find_vines(*told, known=known)
    compared(vines[vines["row_id"] <= 6], rows[:6], within=0.08)
    compared(vines[vines["row_id"] > 6].assign(row_id=lambda table: table["row_id"] - 6), rows[6:], within=0.2)
    assert (vines["position_sd_m"] < 0.05).to_numpy().tolist() == (vines["row_id"] <= 6).tolist()
    assert out["n_missing"].tolist() == [gone.sum() for _, _, gone, *_ in rows]
    assert gaps["n_missing"].sum() == out["n_missing"].sum()
    assert (vines.loc[vines["state"] == "vine", "volume_m3"] > 0).all()


def test_known_vines_that_stand_in_no_row_are_told():
    rows = planted(1.2)
    told = at_home(tables(rows))
    (north, place, *_), far = rows[0], planted(1.2, rows=1, south=-1.4)
    known, remarks = vines_in_rows(surveyed([*rows, *far, (north, place[-1:] + [0.7, 1.9], 0)]), told[0])
    assert sum(map(len, known.values())) == sum(len(place) for _, place, *_ in rows) + 1
    lost, n = len(far[0][1]) + 1, sum(len(one[1]) for one in (*rows, *far)) + 2
    words = "known vines stand farther than half a spacing from any row, or beyond its ends, and are left out"
    assert remarks == [f"{lost} of {n} {words}"]
    _, remarks = vines_in_rows(surveyed(rows, shift=(0, 0.8)), told[0])
    assert [remark.split(",")[0] for remark in remarks] == [
        "half of the known vines in rows stand 0.80 m or more aside of them"
    ]
    assert vines_in_rows(surveyed(rows, shift=(0, 500)), told[0]) == ({}, [f"{n - lost - 1} of {n - lost - 1} {words}"])
    assert vines_in_rows(surveyed(rows), told[0][:0])[0] == {}
    assert vines_in_rows(None, told[0]) == ({}, [])


def test_a_parcel_without_rows_has_no_vines():
    rows, gaps, sections, cover = tables(planted(1.2))
    out, no_gaps, vines = find_vines(rows[:0], gaps[:0], sections[:0], cover)
    assert len(out) == len(no_gaps) == len(vines) == 0


def test_vines_of_a_survey(vineyard, cloud):
    found = map_rows(cloud)
    sections = model_canopies(found).table
    rows = summarise_rows(found.rows, sections, step=STEP)
    _, _, vines = find_vines(rows, found.gaps, sections, found.cover)
    truth = vineyard.rows["n_vines"].sum()
    assert abs(len(vines) - truth) <= 0.02 * truth
    gone = vines[vines["state"] == "missing"].geometry.to_numpy()
    dead = vineyard.dead_vines.geometry.to_numpy()
    apart = shapely.distance(shapely.force_2d(gone)[:, None], shapely.force_2d(dead))
    assert len(gone) == len(dead)
    assert apart.min(axis=0).max() < 0.3 * 0.9
