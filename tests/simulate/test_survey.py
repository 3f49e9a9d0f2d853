"""Simulated surveys keep their own truth, and are as unkind as photogrammetry."""

from itertools import pairwise

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import shapely
from pyproj import CRS

from vinemap.geo.main import to_main
from vinemap.paths import TABLE_2_1
from vinemap.simulate.families import family
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle
from vinemap.simulate.scenes import TABLE_2_1_ORIGIN, barolo, rows_of
from vinemap.simulate.survey import simulate, write_survey
from vinemap.simulate.terrain import PLACE, hillside, surface_through, terraced

SLOPE = hillside(0.2, uphill=120, seed=4)


def scene(seed=0, density=400.0):
    vineyard = Vineyard("small", rows_of(4, length=27, azimuth=25), dead=0.04, gaps=(2, 4))
    tree = Obstacle(PLACE[0] + 14, PLACE[1] + 14, 1.5, 1.2, 5.0, bottom=1.5)
    hut = Obstacle(PLACE[0] - 14, PLACE[1] - 14, 1.5, 1.2, 2.6, solid=True)
    return simulate([vineyard], SLOPE, density=density, obstacles=[tree, hut], seed=seed)


@pytest.fixture(scope="module")
def survey():
    return scene()


@pytest.fixture(scope="module")
def parcel_f():
    survey = barolo(density=2, density_outside=1)
    rows = survey.rows[survey.rows.parcel == "F"]
    return rows.sort_values("row").geometry.to_numpy(), rows, survey


def in_row_frame(survey, row, half_width=0.5):
    """Arc length, offset to the left, height above the row's ground and share of length, of points near a row."""
    line = survey.rows.geometry.iloc[row]
    near = shapely.contains_xy(line.buffer(half_width, cap_style="flat"), *survey.xyz[:, :2].T)
    xyz = survey.xyz[near]
    s = shapely.line_locate_point(line, shapely.points(xyz[:, :2]))
    foot = shapely.get_coordinates(line.interpolate(s), include_z=True)
    ahead = shapely.get_coordinates(line.interpolate(s + 0.01)) - shapely.get_coordinates(line.interpolate(s - 0.01))
    offset = xyz - foot
    left = (ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0]) / np.linalg.norm(ahead, axis=1)
    return s, left, offset[:, 2]


def test_same_seed_same_survey(survey):
    again = scene()
    assert np.array_equal(survey.xyz, again.xyz)
    assert survey.rows.equals(again.rows)
    assert survey.dead_vines.equals(again.dead_vines)
    assert not np.array_equal(survey.xyz[:1000], scene(seed=1).xyz[:1000])


def test_density_is_as_asked(survey):
    area = survey.parcels.area.iloc[0]
    inside = shapely.contains_xy(survey.parcels.geometry.iloc[0], *survey.xyz[:, :2].T).sum() / area
    assert 320 < inside < 440
    assert np.array_equal(survey.xyz, np.round(survey.xyz, 3))


def test_rows_of_f_are_those_of_table_2_1(parcel_f):
    lines, rows, survey = parcel_f
    table = pd.read_csv(TABLE_2_1)
    assert list(rows.row) == list(table.id)
    for line, printed in zip(lines, table.itertuples(), strict=True):
        xyz = to_main(shapely.get_coordinates(line, include_z=True), survey.rows.crs, TABLE_2_1_ORIGIN)
        np.testing.assert_allclose(xyz[0], [printed.x1, printed.y1, printed.z1], atol=0.02)
        expected = [printed.xn_corrected, printed.yn_corrected, printed.zn_corrected]
        np.testing.assert_allclose(xyz[-1], expected, atol=0.02)
        steps = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
        assert steps.sum() == pytest.approx(printed.length_m, abs=0.3)
        middles = (xyz[1:, 2] + xyz[:-1, 2]) / 2
        assert np.average(middles, weights=steps) == pytest.approx(printed.elevation_as_printed_m, abs=0.05)
    np.testing.assert_allclose(rows.length_3d, table.length_m, atol=0.4)


def test_row_14_bends_away_from_the_start_of_row_15(parcel_f):
    lines, _, _ = parcel_f
    start = shapely.Point(lines[14].coords[0])
    chord = shapely.LineString([lines[13].coords[0], lines[13].coords[-1]])
    assert shapely.distance(chord, start) == pytest.approx(0.9, abs=0.02)
    assert shapely.distance(lines[13], start) == pytest.approx(1.5, abs=0.05)
    assert shapely.distance(lines[12], lines[13]) > 1.7


def test_barolo_has_three_parcels_apart_from_each_other(parcel_f):
    survey = parcel_f[2]
    assert list(survey.parcels.name) == ["F", "curved", "blocks"]
    polygons = survey.parcels.geometry.to_numpy()
    assert all(polygons[i].distance(polygons[j]) > 1.0 for i, j in [(0, 1), (0, 2), (1, 2)])
    for parcel in survey.parcels.itertuples():
        own = survey.rows[survey.rows.parcel == parcel.name]
        assert own.within(parcel.geometry).all()
        assert own.n_dead.sum() == (survey.dead_vines.parcel == parcel.name).sum() > 0
    up = (
        survey.rows[survey.rows.parcel == "curved"]
        .geometry.interpolate(0.5, normalized=True)
        .get_coordinates(include_z=True)
    )
    slope = (up.z.iloc[-1] - up.z.iloc[0]) / (9 * 2.5)
    assert slope == pytest.approx(0.25, abs=0.03)


def test_ground_points_lie_on_the_terrain(survey):
    away = ~shapely.contains_xy(survey.rows.union_all().buffer(0.8), *survey.xyz[:, :2].T)
    error = survey.xyz[away, 2] - survey.terrain(*survey.xyz[away, :2].T)
    assert np.median(np.abs(error)) <= 0.03
    assert abs(np.median(error)) < 0.015
    assert 0.001 < np.mean((error > 0.1) & (error < 0.4)) < 0.1  # weeds


def test_foliage_fills_living_vines_and_leaves_dead_ones_empty(survey):
    living, dead = [], []
    for i, row in enumerate(survey.rows.itertuples()):
        s, _, height = in_row_frame(survey, i)
        pitch = row.geometry.length / row.n_vines
        vine = np.floor(s / pitch)
        middle = (np.abs(s / pitch - vine - 0.5) < 0.25) & (height > 0.5) & (height < 2.6)
        count = np.bincount(vine[middle].astype(int), minlength=row.n_vines)[: row.n_vines]
        gone = survey.dead_vines.vine[survey.dead_vines.row == row.row].to_numpy() - 1
        dead += list(count[gone])
        living += list(np.delete(count, gone))
        spots = survey.dead_vines.geometry[survey.dead_vines.row == row.row].to_numpy()
        np.testing.assert_allclose(shapely.line_locate_point(row.geometry, spots), (gone + 0.5) * pitch, atol=0.01)
    assert len(dead) >= 6
    assert np.mean(dead) < 0.03 * np.mean(living)
    assert np.percentile(living, 5) > 10 * max(np.mean(dead), 1)


def test_foliage_begins_and_ends_with_the_row(survey):
    for i, row in enumerate(survey.rows.itertuples()):
        line = shapely.get_coordinates(row.geometry)
        outward = line[[0, -1]] - line[[1, -2]]
        for end, out in zip(line[[0, -1]], outward / np.linalg.norm(outward, axis=1, keepdims=True), strict=True):
            offset = survey.xyz[:, :2] - end
            height = survey.xyz[:, 2] - survey.terrain(*survey.xyz[:, :2].T)
            near = (np.abs(offset @ [-out[1], out[0]]) < 0.5) & (height > 0.7) & (height < 2.2)
            beyond = (offset @ out)[near]
            assert np.sum((beyond > 0.12) & (beyond < 1.0)) <= 3, (i, end)
            assert np.sum((beyond > -0.25) & (beyond < 0.05)) > 15, (i, end)


def test_tops_are_seen_well_feet_and_ground_below_badly(survey):
    _, left, height = in_row_frame(survey, 1)
    canopy = np.abs(left) < 0.45
    foot, top = (np.sum(canopy & (height > low) & (height < low + 0.4)) for low in (0.5, 1.5))
    assert 0 < foot < 0.35 * top
    ground = np.abs(height) < 0.12
    below, beside = np.sum(ground & (np.abs(left) < 0.15)) / 0.3, np.sum(ground & (np.abs(left) > 0.4)) / 0.2
    assert 0 < below < 0.45 * beside


def test_one_side_is_seen_better_than_the_other():
    survey = scene(seed=5)
    shares = []
    for i in range(len(survey.rows)):
        s, left, height = in_row_frame(survey, i)
        side = (np.abs(left) > 0.12) & (height > 0.6) & (height < 1.5)
        piece = (s[side] / 4).astype(int)
        shares += list(np.bincount(piece, left[side] > 0) / np.bincount(piece))
    assert np.mean(np.abs(np.array(shares) - 0.5)) > 0.06


def test_floaters_hang_above_and_below_ground(survey):
    height = survey.xyz[:, 2] - survey.terrain(*survey.xyz[:, :2].T)
    assert 0.5e-4 < np.mean(height < -0.5) < 5e-4
    assert np.sum(height > 5.5) > 3
    assert np.mean(height < -0.2) < 1e-3


def test_bled_points_hang_between_canopy_and_ground():
    vineyards = [Vineyard("p", rows_of(3, length=20), dead=0)]
    flat = hillside(0.0, undulation=0.0)

    def hanging(**options):
        height = simulate(vineyards, flat, weeds=0, floaters=0, **options).xyz[:, 2] - 300
        return np.mean((height > 0.15) & (height < 0.4))

    assert hanging(bled=0.0) < 1e-4
    assert 0.0005 < hanging(bled=0.01) < 0.01


def test_tree_and_hut_stand_where_they_were_put(survey):
    height = survey.xyz[:, 2] - survey.terrain(*survey.xyz[:, :2].T)
    at_tree = np.hypot(*(survey.xyz[:, :2] - np.add(PLACE, 14)).T) < 0.8
    assert 4.0 < np.percentile(height[at_tree], 90) < 5.3
    roof = np.abs(survey.xyz[:, :2] - np.add(PLACE, -14)).max(axis=1) < 0.9
    ground = survey.terrain(np.array([PLACE[0] - 14]), np.array([PLACE[1] - 14]))
    assert np.median(survey.xyz[roof, 2]) == pytest.approx(ground[0] + 2.6, abs=0.05)


STEEP = hillside(0.45, uphill=90, undulation=0.3, seed=2)
THIN = {"height": 1.4, "half_width": 0.15, "leafiness": 4.0}


@pytest.mark.parametrize(
    ("rows", "terrain", "canopy", "density"),
    [
        (rows_of(4, length=25), STEEP, {}, 400),
        (rows_of(4, length=25), terraced(STEEP, rows_of(4, length=25)), {}, 400),
        (rows_of(4, length=25, radius=-30, spacing=2.0), SLOPE, {}, 400),
        (rows_of(4, length=25, fan=8), SLOPE, THIN, 150),
        (rows_of(3, length=15), SLOPE, {}, 1200),
        (rows_of(4, length=25), SLOPE, {"gaps": (8,)}, 60),
    ],
    ids=["steep", "terraces", "curved", "thin", "dense", "sparse"],
)
def test_canopies_stand_on_their_rows(rows, terrain, canopy, density):
    survey = simulate([Vineyard("p", rows, **canopy)], terrain, density=density, seed=3)
    for i, row in enumerate(survey.rows.itertuples()):
        s, left, height = in_row_frame(survey, i, 0.6)
        leaf = (height > 0.6) & (height < 2.7) & (s > 1) & (s < row.geometry.length - 1)
        assert leaf.sum() > 0.1 * density * row.geometry.length
        assert np.percentile(height[leaf], 97) == pytest.approx(row.mean_height, abs=0.25)
        assert abs(np.median(left[leaf])) < 0.1
        assert np.ptp(np.percentile(left[leaf], [4, 96])) == pytest.approx(row.mean_width, abs=0.15)
        ground = survey.terrain(*shapely.get_coordinates(row.geometry).T)
        np.testing.assert_allclose(shapely.get_coordinates(row.geometry, include_z=True)[:, 2], ground, atol=1e-9)


def test_rows_of_keeps_spacing_direction_and_radius():
    lines = [shapely.LineString(row) for row in rows_of(5, length=30, spacing=2.2, azimuth=40)]
    assert [line.length for line in lines] == pytest.approx([30] * 5)
    assert [a.distance(b) for a, b in pairwise(lines)] == pytest.approx([2.2] * 4)
    way = np.subtract(lines[0].coords[-1], lines[0].coords[0])
    assert np.degrees(np.arctan2(way[1], way[0])) == pytest.approx(40)
    assert np.cross([*way, 0], [*np.subtract(lines[1].coords[0], lines[0].coords[0]), 0])[2] > 0

    arcs = rows_of(3, length=30, spacing=2.5, radius=40)
    for row, radius in zip(arcs, [42.5, 40, 37.5], strict=True):
        np.testing.assert_allclose(np.hypot(*(row - [PLACE[0], PLACE[1] + 40]).T), radius)
    fan = [np.subtract(row[-1], row[0]) for row in rows_of(3, fan=6)]
    assert np.degrees(np.arctan2(*fan[2][::-1])) == pytest.approx(3)


def test_terraces_have_level_treads_and_meet_the_slope_half_way():
    rows = rows_of(4, length=20)
    terrain = terraced(hillside(0.4, undulation=0.0), rows)
    x, y = PLACE[0], PLACE[1] + 1.25
    across = terrain(np.full(5, x), y + np.array([-0.8, 0.0, 0.8, 1.25, 1.7]))
    np.testing.assert_allclose(across, 300 + 0.4 * np.array([1.25, 1.25, 1.25, 2.5, 3.75]), atol=1e-9)


def test_surface_through_meets_points_and_means():
    rng = np.random.default_rng(0)
    spots = rng.uniform(0, 60, (6, 2))
    line = np.column_stack([np.linspace(0, 60, 50), np.full(50, 30.0)])
    wanted = [(spot[None], 100.0 + i) for i, spot in enumerate(spots)]
    surface = surface_through([*wanted, (line, 104.0)], hillside(0.1, centre=(0, 0)))
    np.testing.assert_allclose(surface(*spots.T), 100.0 + np.arange(6), atol=0.02)
    assert surface(*line.T).mean() == pytest.approx(104.0, abs=0.01)


def test_files_hold_what_the_survey_holds(survey, tmp_path):
    path = write_survey(survey, tmp_path / "new")
    assert path.name == "synthetic.laz"
    assert {file.name for file in path.parent.iterdir()} == {"synthetic.laz", "parcels.gpkg", "truth.gpkg"}
    cloud = laspy.read(path)
    np.testing.assert_allclose(cloud.xyz, survey.xyz, atol=1e-6)
    assert cloud.header.parse_crs() == CRS.from_epsg(32632)
    assert not np.any(cloud.classification)
    rows = gpd.read_file(path.parent / "truth.gpkg", layer="rows")
    assert rows.crs == survey.rows.crs
    assert rows.geometry.geom_equals_exact(survey.rows.geometry, 1e-9).all()
    pd.testing.assert_frame_equal(
        pd.DataFrame(rows.drop(columns="geometry")),
        pd.DataFrame(survey.rows.drop(columns="geometry")),
        check_dtype=False,
    )
    assert len(gpd.read_file(path.parent / "truth.gpkg", layer="dead_vines")) == len(survey.dead_vines)
    assert gpd.read_file(path.parent / "parcels.gpkg", layer="parcels").name.tolist() == ["small"]


def test_a_broken_write_leaves_nothing_half_made(survey, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(laspy.LasData, "write", fail)
    with pytest.raises(OSError, match="disk full"):
        write_survey(survey, tmp_path)
    assert not list(tmp_path.iterdir())


def test_gaps_are_what_dead_vines_leave_of_foliage(survey):
    assert survey.gaps.n_vines.sum() == len(survey.dead_vines)
    for gap in survey.gaps.itertuples():
        row = survey.rows[survey.rows.row == gap.row].iloc[0]
        vines = gap.n_vines * row.geometry.length / row.n_vines
        assert gap.geometry.length == pytest.approx(vines - 0.07, abs=0.3)
        own = survey.dead_vines[survey.dead_vines.row == gap.row]
        assert (own.distance(gap.geometry) < 0.01).sum() == gap.n_vines
        near = shapely.contains_xy(gap.geometry.buffer(0.3, cap_style="flat"), *survey.xyz[:, :2].T)
        height = survey.xyz[near, 2] - survey.terrain(*survey.xyz[near, :2].T)
        assert np.mean((height > 0.7) & (height < 2.3)) < 0.1


def test_a_meadow_has_no_rows(tmp_path):
    outline = shapely.box(*np.subtract(PLACE, 10), *np.add(PLACE, 10))
    hedge = Obstacle(*PLACE, 5.0, 0.5, 2.0, azimuth=60)
    survey = simulate([Vineyard("meadow", (), outline=outline)], SLOPE, density=100, obstacles=[hedge], seed=1)
    assert (len(survey.rows), len(survey.gaps), len(survey.dead_vines)) == (0, 0, 0)
    assert survey.parcels.geometry.iloc[0].equals(outline)
    height = survey.xyz[:, 2] - survey.terrain(*survey.xyz[:, :2].T)
    x, y = (survey.xyz[(height > 0.6) & (height < 2.5), :2] - PLACE).T
    assert len(x) > 200
    assert np.degrees(np.arctan2(*np.linalg.svd(np.cov(x, y))[0][::-1, 0])) % 180 == pytest.approx(60, abs=6)
    write_survey(survey, tmp_path)
    assert len(gpd.read_file(tmp_path / "truth.gpkg", layer="rows")) == 0


@pytest.mark.parametrize("name", ["short", "single", "contour", "kinked"])
def test_families_vary_with_the_seed(name):
    one, same, other = family(name, 0), family(name, 0), family(name, 1)
    assert one.name == name
    assert np.array_equal(one.xyz, same.xyz)
    assert len(one.xyz) != len(other.xyz)


def test_headland_divides_rows_that_are_in_line():
    """By one width, of a track or more."""
    survey = family("headland", 0)
    one, other = (survey.rows[survey.rows.parcel == parcel].geometry for parcel in "AB")
    across = [line.distance(other).min() for line in one]
    assert 3.2 <= min(across) <= 6
    assert max(across) < min(across) + 1
    for line in one:
        ahead = shapely.LineString(np.array(line.coords)[[0, -1], :2])
        start, end = np.array(ahead.coords)
        longer = shapely.LineString([start - 2 * (end - start), end + 2 * (end - start)])
        assert longer.distance(other).min() < 0.05


def test_a_close_row_starts_by_its_neighbour():
    survey = family("close", 0)
    lines = survey.rows.geometry.to_numpy()
    start = shapely.Point(lines[4].coords[0])
    assert shapely.distance(lines[3], start) == pytest.approx(1.5, abs=0.1)
    assert lines[4].length < 0.85 * lines[3].length
    assert shapely.distance(lines[3], lines[2]) > 1.7
