"""Sections along rows, and canopy told from terrain in them."""

from itertools import pairwise

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS
from sections import many_sections, separate

from vinemap.canopy.feet import find_feet
from vinemap.canopy.foliage import living_canopies, separate_canopy
from vinemap.canopy.model import find_canopies, model_sections
from vinemap.canopy.numbers import (
    complexity_reduction,
    measure_sections,
    modelling_indices,
    quantile_of,
    summarise_rows,
    tabulate_sections,
)
from vinemap.canopy.points import NO_SECTIONS, join
from vinemap.canopy.sections import cut_sections
from vinemap.cloud.points import PointCloud
from vinemap.config.settings import Settings
from vinemap.geo.raster import Grid, Raster
from vinemap.surfaces.ground import terrain_model

UTM = CRS.from_epsg(32632)


def rows_frame(lines, spacing=2.5):
    geometry = [shapely.LineString(np.column_stack([c, np.zeros(len(c))])) for c in lines]
    return gpd.GeoDataFrame({"row_id": np.arange(1, len(lines) + 1), "spacing_m": spacing}, geometry=geometry, crs=UTM)


def gaps_frame(*gaps):
    row, start, end = zip(*gaps, strict=True) if gaps else ((), (), ())
    columns = {"row_id": np.array(row, int), "start_m": np.array(start, float), "end_m": np.array(end, float)}
    return gpd.GeoDataFrame(columns, geometry=[None] * len(gaps), crs=UTM)


def cut(xyz, rows, gaps, dtm, **options):
    """Sections of a cloud whose heights are its z."""
    return join(cut_sections(PointCloud(xyz, UTM, heights=xyz[:, 2]), rows, gaps, dtm, lambda s: s, **options))


def flat(west, south, size=60.0, level=0.0):
    return Raster(np.full((2, 2), level), Grid(west, south + size, size / 2, 2, 2), UTM)


def test_every_section_holds_the_points_around_its_station():
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, 300)
    line = np.column_stack([30 * np.sin(t), 30 - 30 * np.cos(t)])
    xyz = np.column_stack([rng.uniform(-3, 30, 40000), rng.uniform(-3, 20, 40000), rng.uniform(0, 2, 40000)])
    rows = rows_frame([line])
    sections = cut(xyz, rows, gaps_frame(), flat(-5, -5), min_points=0)
    length = rows.length.iloc[0]
    assert len(sections.row_id) == round(length / 0.25) + 1
    assert sections.position[[0, -1]] == pytest.approx([0, length])
    assert np.allclose(np.diff(sections.position), 0.25, atol=0.002)
    # The rings between radius 30 ± 1.25, cut into wedges: along and across from their definition.
    radius = np.hypot(xyz[:, 0], xyz[:, 1] - 30)
    along = 30 * np.arctan2(xyz[:, 0], 30 - xyz[:, 1])
    for k in (0, 10, 57, len(sections.row_id) - 1):
        members = (np.abs(along - sections.position[k]) <= 0.2) & (np.abs(radius - 30) <= 1.25)
        found = sections.points[sections.start[k] : sections.start[k + 1]]
        assert len(found) == pytest.approx(members.sum(), abs=0.06 * members.sum() + 2)
        assert np.sort(found[:, 0]).mean() == pytest.approx((30 - radius[members]).mean(), abs=0.06)


def test_sections_leave_gaps_out():
    line = np.array([[0, 0], [20.0, 0]])
    xyz = np.random.default_rng(0).uniform([-1, -1, 0], [21, 1, 2], (5000, 3))
    sections = cut(xyz, rows_frame([line]), gaps_frame((1, 5.0, 9.0)), flat(-5, -5))
    assert not ((sections.position > 5) & (sections.position < 9)).any()
    assert sections.position.max() == 20


def test_points_go_to_the_nearest_row():
    lines = [np.array([[0, 0], [10.0, 0]]), np.array([[0, 2.0], [10.0, 2.0]])]
    xyz = np.random.default_rng(0).uniform([0, -1, 0], [10, 3, 2], (8000, 3))
    sections = cut(xyz, rows_frame(lines, 3.0), gaps_frame(), flat(-5, -5))
    n = np.diff(sections.start)
    y, row = sections.points[:, 0] + np.repeat(sections.origin[:, 1], n), np.repeat(sections.row_id, n)
    assert (y[row == 1] <= 1.13).all()
    assert (y[row == 2] >= 0.87).all()


@pytest.mark.parametrize(
    ("per_metre", "half", "width"), [(200, 0.35, 0.4), (75, 0.35, 0.6), (15, 0.35, 3.0), (75, 1.0, 1.6)]
)
def test_sections_are_wider_where_points_are_few_for_the_canopy(per_metre, half, width):
    n = 20 * per_metre
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 20, n), rng.uniform(-half, half, n), rng.uniform(1, 2, n)])
    rows = rows_frame([np.array([[0, 0], [20.0, 0]])], spacing=4.0)
    sections = cut(xyz, rows, gaps_frame(), flat(-5, -5))
    inner = (sections.position > 2) & (sections.position < 18)
    assert np.diff(sections.start)[inner].mean() == pytest.approx(per_metre * width, rel=0.15)
    assert sections.extent == pytest.approx(width, rel=0.1)


def test_wide_sections_do_not_reach_over_the_space_between_bushes():
    """Of bushes of 0.8 m, 1.6 m apart, with 80 points a metre."""
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(at, at + 0.8, 64) for at in np.arange(0, 32, 1.6)])
    xyz = np.column_stack([x, rng.uniform(-0.4, 0.4, len(x)), rng.uniform(0.4, 1.2, len(x))])
    sections = cut(xyz, rows_frame([np.array([[0, 0], [32.0, 0]])]), gaps_frame(), flat(-5, -5))
    assert sections.extent.max() > 0.6
    into = sections.position % 1.6
    assert np.minimum(np.abs(into - 0.4), np.abs(into - 2.0)).max() < 0.61
    assert len(sections.row_id) > 60


def test_wide_sections_follow_the_soil_along_the_row():
    """Of a flat canopy at 1.5 m over a slope along the row a section is as thin as at a station."""
    rng, slope = np.random.default_rng(0), 0.5
    x, n = rng.uniform(0, 20, 200), 200
    soil = 30 * slope + slope * x
    xyz = np.column_stack([x, rng.uniform(-0.4, 0.4, n), soil + 1.5])
    grid = Grid(-5, 35, 1.0, 40, 40)
    dtm = Raster(np.tile(slope * (25.5 + np.arange(40)), (40, 1)), grid, UTM)
    cloud, rows = PointCloud(xyz, UTM, heights=xyz[:, 2] - soil), rows_frame([np.array([[0, 0], [20.0, 0]])])
    sections = join(cut_sections(cloud, rows, gaps_frame(), dtm, lambda s: s))
    assert sections.extent.min() > 3
    assert sections.points[:, 1] == pytest.approx(1.5, abs=0.01)


def test_no_rows_no_sections():
    xyz = np.zeros((5, 3))
    cloud = PointCloud(xyz, UTM, heights=xyz[:, 2])
    canopies = cut_sections(cloud, rows_frame([]), gaps_frame(), flat(-5, -5), separate_canopy)
    assert living_canopies(canopies) == []
    canopy, feet = find_feet(NO_SECTIONS)
    none = np.empty(0)
    measures = measure_sections(canopy, none, (none, none, none), c=7)
    table = tabulate_sections(canopy, np.empty((0, 7, 2)), measures, crs=UTM)
    assert len(table) == len(feet) == 0
    assert len(summarise_rows(rows_frame([]), table, step=0.25)) == 0


def test_canopy_is_told_from_terrain_and_measured(vineyard, cloud):
    dtm = terrain_model(cloud)
    truth = vineyard.rows.assign(row_id=vineyard.rows["row"], spacing_m=2.5)
    canopies = living_canopies(cut_sections(cloud.above(dtm), truth, gaps_frame(), dtm, separate_canopy))
    canopy, soil = join([c.sections for c in canopies]), np.concatenate([c.soil for c in canopies])
    # Sections where vines are dead fall away, those of living vines stay.
    dead = vineyard.dead_vines
    dead = dead[dead.groupby("row")["vine"].transform("size") >= 3]
    at = gpd.GeoSeries(gpd.points_from_xy(canopy.origin[:, 0], canopy.origin[:, 1]), crs=UTM)
    assert at.distance(dead.union_all()).min() > 0.2
    living = truth["n_vines"].sum() - truth["n_dead"].sum()
    assert len(canopy.row_id) == pytest.approx(living * 0.9 / 0.25, rel=0.05)
    assert canopy.height.min() >= 0.4
    canopy, feet = find_feet(canopy)
    assert np.median(feet[:, 0, 1]) == pytest.approx(0.55, abs=0.06)
    # The thesis's stand on the soil, under the walls.
    assert (soil[:, 0] == 0).all()
    assert np.median(soil[:, 1, 0]) == pytest.approx(0.25, abs=0.12)
    assert np.median(soil[:, 2, 0]) == pytest.approx(-0.25, abs=0.12)
    assert np.abs(np.median(soil[:, 1:, 1], axis=0)).max() < 0.3
    assert (feet[:, 1, 0] >= feet[:, 2, 0]).all()
    m = len(canopy.row_id)
    half = 0.5 * np.ones(m)
    measures = measure_sections(canopy, feet[:, 0, 1], (half, half, half), c=3)
    table = tabulate_sections(canopy, feet, measures, crs=UTM)
    rows = summarise_rows(truth, table, step=0.25)
    assert np.abs(rows["height_m"] - truth["mean_height"]).max() < 0.08
    assert np.abs(rows["width_m"] - truth["mean_width"]).max() < 0.12
    assert rows["volume_m3"].sum() == pytest.approx(0.5 * 0.25 * m, rel=0.03)


def test_canopies_of_lidar_are_as_large_as_those_of_a_dense_cloud(vineyard, cloud):
    """Of 12 points a square metre few are a canopy's; by the metre of row they would be lost as noise."""
    truth = vineyard.rows.assign(row_id=vineyard.rows["row"], spacing_m=2.5)
    chosen = np.random.default_rng(0).random(len(cloud.xyz)) < 12 / 350
    told = []
    for points in (cloud, PointCloud(cloud.xyz[chosen], UTM)):
        dtm = terrain_model(points)
        found = find_canopies(points.above(dtm), truth, gaps_frame(), dtm, Settings())
        told.append(summarise_rows(truth, model_sections(found, UTM).table, step=0.25))
    dense, sparse = told
    assert sparse["volume_m3"].sum() == pytest.approx(dense["volume_m3"].sum(), rel=0.1)
    assert np.abs(sparse["volume_m3"] / dense["volume_m3"] - 1).max() < 0.25
    assert np.abs(sparse["height_m"] - truth["mean_height"]).max() < 0.08
    assert np.abs(sparse["width_m"] - truth["mean_width"]).max() < 0.15


def test_canopies_end_where_the_cover_does():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(0, 20, 6000), rng.normal(30, 0.1, 6000), rng.uniform(1, 4.6, 6000)])
    cloud, line = PointCloud(wall, UTM, heights=wall[:, 2]), rows_frame([[(0, 30), (20, 30)]])
    for high, height in ((3.6, 3.6), (5.5, 4.6)):
        found = find_canopies(cloud, line, gaps_frame(), flat(0, 0), Settings(cover={"high": high}))
        assert model_sections(found, UTM).table["height_m"].median() == pytest.approx(height, abs=0.1)


def test_quantile_of_each_section():
    rng = np.random.default_rng(0)
    n = np.array([1, 0, 5, 100, 2])
    values = rng.normal(size=n.sum())
    start = np.concatenate([[0], np.cumsum(n)])
    for q in (0.02, 0.5, 0.985):
        expected = [np.quantile(values[a:b], q) if b > a else 0 for a, b in pairwise(start)]
        assert np.allclose(quantile_of(values, start, q), expected)


def test_indices_and_their_score():
    good, under, over = modelling_indices(np.array([0.9, 1.0]), np.array([1.1, 1.0]), np.array([1.0, 1.0]))
    assert good == pytest.approx([0.9, 1])
    assert under == pytest.approx([0.1, 0])
    assert over == pytest.approx([0.2, 0])
    # 120 points a section, of which 50 lie in the one before, too: 7 vertices and 14 faces stand for the other 70.
    member = [np.arange(k * 70, k * 70 + 120) for k in range(5)]
    sections = many_sections([np.zeros((120, 2))] * 5, member=member)
    assert complexity_reduction(sections, c=7)[1:] == pytest.approx(0.1 * (1 - 49 / 70))
    assert complexity_reduction(sections, c=7)[0] == pytest.approx(0.1 * (1 - 49 / 120))


def test_volumes_of_rows_and_of_hectares():
    rng = np.random.default_rng(0)
    points = [np.column_stack([rng.uniform(-0.25, 0.25, 4000), rng.uniform(0.5, 2.0, 4000)]) for _ in range(41)]
    sections = many_sections(points, spacing=2.0)
    ones = np.ones(41)
    measures = measure_sections(sections, 0.5 * ones, (0.75 * ones, 0.75 * ones, 0.75 * ones), c=7)
    table = tabulate_sections(sections, np.zeros((41, 7, 2)), measures, crs=UTM)
    assert table["height_m"].mean() == pytest.approx(1.98, abs=0.01)
    assert table["width_m"].mean() == pytest.approx(0.48, abs=0.01)
    assert np.allclose(table["trv_m3_ha"], table["height_m"] * table["width_m"] * 10_000 / 2.0)
    assert np.allclose(table["lwa_m2_ha"], 2 * (table["height_m"] - 0.5) * 10_000 / 2.0)
    rows = summarise_rows(rows_frame([np.array([[0, 0], [10.0, 0]])]), table, step=0.25)
    assert rows["volume_m3"].tolist() == pytest.approx([0.75 * 10])
    assert rows["bottom_m"].tolist() == [0.5]
    # A short row's stations lie further apart than a step.
    far = table.iloc[:2].assign(position_m=[0.0, 0.3])
    assert summarise_rows(rows, far, step=0.25)["volume_m3"].tolist() == pytest.approx([0.75 * 0.3])
    # Where sections lack, the foliage ends half a step past the last one.
    left = summarise_rows(rows, table.drop(index=range(10, 20)).reset_index(drop=True), step=0.25)
    assert left["volume_m3"].tolist() == pytest.approx([0.75 * (10 - 11 * 0.25 + 0.25)])


points_of = st.lists(st.tuples(st.floats(-1.2, 1.2), st.floats(-0.3, 3)), max_size=25)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.one_of(points_of, st.just([(0.1, 1.5)] * 12), st.just([(0.0, 0.1 * k) for k in range(25)])), max_size=6)
)
def test_any_sections_give_a_defined_model(sections):
    """Sections without points, with three, on a line, of one point many times, of one side only."""
    points = [np.array(p, dtype=float).reshape(-1, 2) for p in sections]
    model = model_sections(separate(many_sections(points)), UTM)
    assert len(model.polygons) == len(model.table) == len(model.at.row_id)
    assert np.isfinite(model.polygons).all()
    assert np.isfinite(model.table.drop(columns="geometry").to_numpy()).all()
    assert (model.table["n_points"] >= 3).all()
    assert (model.table["lwa_m2_ha"] >= 0).all()


def test_a_million_points_in_a_section():
    rng = np.random.default_rng(0)
    crowd = np.column_stack([rng.normal(0, 0.15, 1_000_000), rng.uniform(0.5, 2, 1_000_000)])
    model = model_sections(separate(many_sections([crowd, crowd[:200]])), UTM)
    assert model.table["n_points"].max() > 900_000
    assert model.table["height_m"].iloc[0] == pytest.approx(1.98, abs=0.01)


def test_a_row_shorter_than_a_step():
    xyz = np.column_stack([np.random.default_rng(0).uniform([0, -0.2, 0.5], [0.1, 0.2, 2], (500, 3))])
    rows = rows_frame([np.array([[0, 0], [0.1, 0]])])
    sections = cut(xyz, rows, gaps_frame(), flat(-5, -5))
    model = model_sections(separate(sections), UTM)
    assert len(model.table) == 2
    assert summarise_rows(rows, model.table, step=0.25)["volume_m3"].iloc[0] < 0.1
