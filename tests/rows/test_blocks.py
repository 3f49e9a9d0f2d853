"""Blocks and missing vines."""

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.rows.blocks import flag_rows, group_blocks, outline_blocks
from vinemap.rows.numbers import count_missing


def rows_frame(lines, spacing=2.5, **columns):
    table = {"spacing_m": np.broadcast_to(spacing, len(lines))} | columns
    return gpd.GeoDataFrame(table, geometry=[shapely.LineString(c) for c in lines], crs=32632)


def parallel(n, azimuth, at, length=30.0, spacing=2.5):
    angle = np.radians(azimuth)
    way, normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    return [np.array([at + k * spacing * normal, at + k * spacing * normal + length * way]) for k in range(n)]


def test_blocks_of_other_direction_spacing_or_beyond_a_track_are_apart():
    blocks = [
        parallel(5, 0, np.array([0, 0])),
        parallel(5, 0, np.array([36, 0])),  # in line with the first, across a track of 6 m
        parallel(5, 70, np.array([75, 0])),
        parallel(4, 0, np.array([0, 13.5]), spacing=3.2),
    ]
    spacing = np.repeat([2.5, 2.5, 2.5, 3.2], [5, 5, 5, 4])
    found = group_blocks(rows_frame([line for block in blocks for line in block], spacing))
    assert found["block"].nunique() == 4
    assert found.groupby(spacing.cumsum() * 0 + np.repeat([0, 1, 2, 3], [5, 5, 5, 4]))["block"].nunique().eq(1).all()
    west = found.groupby("block").apply(lambda b: b.geometry.centroid.x.mean(), include_groups=False)
    assert west.is_monotonic_increasing


def test_outline_is_the_ground_that_rows_take():
    truth = shapely.box(0, -1.25, 30, 11.25)
    outline = outline_blocks(group_blocks(rows_frame(parallel(5, 0, np.array([0, 0])))))
    assert len(outline) == 1
    polygon = outline.geometry.iloc[0]
    assert polygon.intersection(truth).area / polygon.union(truth).area > 0.98
    assert outline_blocks(group_blocks(rows_frame([]))).empty


@pytest.mark.parametrize("seed", [181, 189, 227])
def test_an_outline_holds_rows_whose_ends_are_ragged(seed):
    rng = np.random.default_rng(seed)
    lines = []
    for k in range(9):
        first, last = rng.uniform(0, 0.5, 2)
        lines.append([(first, 2.6 * k), (10 - last, 2.6 * k + rng.uniform(-0.1, 0.1))])
    rows = rows_frame(lines, rng.uniform(2.58, 2.63, 9), block=1)
    outline = outline_blocks(rows).union_all()
    assert rows.difference(outline).length.max() < 0.02


def gaps_of(rng, spacing, n_rows=15, n_vines=100, dead=0.05, jitter=0.05):
    records = []
    for row in range(1, n_rows + 1):
        alive = rng.random(n_vines) > dead
        alive[[0, -1]] = True
        edges = np.flatnonzero(np.diff(np.concatenate([[True], alive, [True]]).astype(int)))
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            start, end = (spacing * np.array([a, b]) + rng.normal(0, jitter, 2)).tolist()
            records.append((row, start, end, end - start, b - a))
    table = np.array(records)
    names = ["row_id", "start_m", "end_m", "length_m", "truth"]
    columns = dict(zip(names, table.T, strict=True)) | {"state": "missing"}
    return gpd.GeoDataFrame(columns, geometry=[None] * len(table)).astype({"row_id": int})


@pytest.mark.parametrize("spacing", [0.8, 1.0, 1.5])
def test_missing_vines_of_gaps(spacing):
    gaps = gaps_of(np.random.default_rng(0), spacing)
    rows = rows_frame(parallel(15, 0, np.array([0, 0])), row_id=np.arange(1, 16))
    given = None if spacing == 1.0 else spacing
    rows, counted = count_missing(rows, gaps, vine_spacing=given)
    assert (counted["n_missing"] == counted["truth"]).all()
    assert rows["n_missing"].sum() == counted["truth"].sum()
    assert rows["vine_spacing_m"].unique() == [spacing]


def test_known_rows_that_cross_each_other_are_odd():
    lines = [[(0, 0), (30, 0)], [(0, 3), (30, 3)], [(0, -1), (30, 4)]]
    rows = rows_frame(lines, block=1, support=1.0, cut=0.0)
    assert flag_rows(rows)["flags"].tolist() == ["spacing"] * 3


@pytest.mark.parametrize(
    ("support", "flags"), [([0.3, 0.35, 0.3, 0.1], ["", "", "", "sparse"]), ([0.9, 0.4], ["", "sparse"])]
)
def test_rows_of_bushes_are_sparse_beside_each_other_alone(support, flags):
    lines = [[(0, 3 * k), (30, 3 * k)] for k in range(len(support))]
    rows = rows_frame(lines, block=1, support=support, cut=0.0)
    assert flag_rows(rows)["flags"].tolist() == flags
