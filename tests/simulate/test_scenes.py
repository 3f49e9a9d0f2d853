"""Scenes that aren't hedges in one block: heads in a square, roofs of leaves, blocks that fill an outline, a yard."""

from itertools import pairwise

import numpy as np
import pytest
import shapely

from vinemap.simulate.families import family
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle, Sheet
from vinemap.simulate.scenes import FLIGHTS, estate, rows_in, rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import PLACE, hillside
from vinemap.simulate.yard import posts

FLAT = hillside(0.0, undulation=0.0, elevation=0.0)
QUIET = {"weeds": 0.0, "floaters": 0.0, "bled": 0.0, "noise": 0.005}


def seen(vineyards, *, density=150, **options):
    """The survey, and what of it lies about :data:`PLACE` (n, 3), above ground that is flat."""
    survey = simulate(vineyards, FLAT, density=density, density_outside=density, **(QUIET | options))
    return survey, survey.xyz - [*PLACE, 0]


def meadow(size=10.0):
    return [Vineyard("meadow", (), outline=shapely.box(*np.subtract(PLACE, size), *np.add(PLACE, size)))]


def test_heads_of_bush_vines_stand_alone_and_end_their_rows():
    heads = {"crown": 1.0, "half_width": 0.5, "height": 1.1, "bottom": 0.2, "vine_spacing": 2.0, "dead": 0.0}
    survey, xyz = seen([Vineyard("bush", rows_of(5, length=9, spacing=2.0), gaps=(1, 1), **heads)])
    assert list(survey.rows.n_vines) == [5] * 5
    x, y, height = xyz[xyz[:, 2] > 0.25].T
    off = np.hypot((x + 1) % 2 - 1, (y + 1) % 2 - 1)
    assert np.quantile(off, 0.98) < 0.62
    assert np.quantile(height[off < 0.15], 0.5) == pytest.approx(1.1, abs=0.12)
    assert np.quantile(height[off > 0.35], 0.5) < 0.9
    assert x.min() == pytest.approx(-4.5, abs=0.1)
    assert x.max() == pytest.approx(4.5, abs=0.1)
    alive = np.histogram2d(x, y, bins=[np.arange(-5, 6, 2), np.arange(-5, 6, 2)])[0]
    assert (alive < 5).sum() == len(survey.dead_vines) == len(survey.gaps) == 2
    spots = shapely.get_coordinates(survey.dead_vines.geometry) - PLACE
    assert (alive[tuple(((spots + 5) // 2).astype(int).T)] < 5).all()


def test_a_roof_of_leaves_hides_most_of_the_ground_and_a_net_some():
    outline = shapely.box(*np.subtract(PLACE, 5), *np.add(PLACE, 5))
    for caught in (0.75, 0.3):
        _, xyz = seen(meadow(), sheets=[Sheet(outline, 2.0, caught=caught)], density=80)
        x, y, height = xyz.T
        under = np.maximum(np.abs(x), np.abs(y)) < 4
        assert np.mean(height[under] > 1) == pytest.approx(caught, abs=0.06)
        assert ((height < 0.05) | (height > 1.5)).all()
        assert np.quantile(height, 0.99) < 2.15
        assert height[np.maximum(np.abs(x), np.abs(y)) > 5.1].max() < 0.1


def test_rows_fill_an_outline_to_its_edges():
    outline = shapely.Polygon([(0, 0), (30, 0), (36, 20), (6, 20)])
    lines = [shapely.LineString(row) for row in rows_in(outline, spacing=2.0, azimuth=30)]
    assert len(lines) > 8
    assert [a.distance(b) for a, b in pairwise(lines)] == pytest.approx([2.0] * (len(lines) - 1))
    for line in lines:
        assert line.length >= 6
        assert shapely.distance(shapely.points(np.array(line.coords)[[0, -1]]), outline.boundary).max() < 1e-6


def test_a_hall_has_a_ridge():
    hall = Obstacle(*PLACE, 5, 3, 4.0, solid=True, eaves=2.5, azimuth=90)
    _, xyz = seen(meadow(8), obstacles=[hall], density=60)
    x, _, height = xyz[(np.abs(xyz[:, 0]) < 2.9) & (np.abs(xyz[:, 1]) < 4.9)].T
    np.testing.assert_allclose(height, 4.0 - 1.5 * np.abs(x) / 3, atol=0.04)


def test_hedges_and_strips_are_grown_but_no_truth():
    rows = rows_of(3, length=12)
    strip = Vineyard("strip", [rows[0] + [0, 1.25]], height=0.8, half_width=0.5, bottom=0.0, dead=0.0)
    survey, xyz = seen([Vineyard("vines", rows, dead=0.0)], beside=[strip])
    assert len(survey.rows) == 3
    assert set(survey.foliage.row) == {0, 1, 2}
    between = xyz[(np.abs(xyz[:, 0]) < 5) & (np.abs(xyz[:, 1] + 1.25) < 0.25)]
    assert np.mean((between[:, 2] > 0.4) & (between[:, 2] < 1.0)) > 0.8


def test_posts_stand_in_rows_and_outside_of_their_ends():
    trellis = posts(rows_of(1, length=20), every=5, top=2.0, beyond=1.0)
    np.testing.assert_allclose([post.x - PLACE[0] for post in trellis], [-11, 11, -5, 0, 5], atol=1e-6)
    _, xyz = seen(meadow(), obstacles=trellis[3:4], density=600, surroundings=0.0)
    x, y, height = xyz[xyz[:, 2] > 0.3].T
    assert len(x) > 5
    assert np.hypot(x, y).max() < 0.1
    assert 1.8 < height.max() < 2.05


def test_an_estate_has_two_directions_at_a_track_and_a_yard_that_is_no_row():
    survey = family("estate", 0)
    lines = {name: rows.geometry for name, rows in survey.rows.groupby("parcel")}
    ways = {name: np.subtract(rows.iloc[0].coords[-1], rows.iloc[0].coords[0])[:2] for name, rows in lines.items()}
    turn = {name: np.degrees(np.arctan2(*way[::-1])) % 180 for name, way in ways.items()}
    assert turn["A"] == pytest.approx(turn["B"]) == pytest.approx(turn["E"])
    assert 11 < abs((turn["D"] - turn["A"] + 90) % 180 - 90) < 61
    main = shapely.union_all([*lines["A"], *lines["B"], *lines["C"]])
    assert 2.9 < lines["D"].distance(main).min() < 6.5
    assert 4.9 < lines["E"].distance(main).min() < 9
    widths = survey.rows.groupby("parcel").mean_width.mean()
    assert widths["B"] > 0.9
    assert widths["F"] < 0.25
    height = survey.xyz[:, 2] - survey.terrain(*survey.xyz[:, :2].T)
    near = shapely.contains_xy(shapely.union_all(survey.rows.geometry.to_numpy()).buffer(1.2), *survey.xyz[:, :2].T)
    assert np.sum(~near & (height > 0.5)) > 5000


def test_square_plantings_are_as_close_along_as_across():
    survey = family("square", 0)
    spacing = survey.rows.geometry.iloc[1].distance(survey.rows.geometry.iloc[2])
    one = survey.rows.iloc[0]
    crown = (one.geometry.length - (one.n_vines - 1) * spacing) / spacing
    assert 0.35 < crown < 0.72
    alive = survey.rows.n_vines.sum() - survey.rows.n_dead.sum()
    blobs = shapely.union_all(shapely.points(survey.foliage.xy)).buffer(0.2)
    assert len(blobs.geoms) == alive


def test_two_curtains_hang_on_one_row():
    rows = rows_of(2, length=14, spacing=4.0)
    vines = Vineyard("gdc", rows, curtains=1.0, height=1.6, bottom=0.8, half_width=0.22, dead=0.0, gaps=(3,))
    survey, xyz = seen([vines])
    assert len(survey.rows) == 2
    np.testing.assert_allclose(survey.rows.mean_width, 1.44, atol=0.15)
    assert list(survey.gaps.n_vines) == [3]
    x, y, _ = xyz[(np.abs(xyz[:, 0]) < 6.5) & (xyz[:, 2] > 0.7)].T
    off = np.abs(y) - 2
    assert np.mean(off > 0) == pytest.approx(0.5, abs=0.08)
    assert np.median(np.abs(off)) == pytest.approx(0.5, abs=0.05)
    assert np.mean(np.abs(off) < 0.15) < 0.02
    gap = shapely.get_coordinates(survey.gaps.geometry.iloc[0])[[0, -1]] - PLACE
    within = (x > gap[:, 0].min() + 0.3) & (x < gap[:, 0].max() - 0.3) & (np.abs(y - gap[0, 1]) < 1)
    assert within.sum() < 0.01 * len(x)


@pytest.mark.parametrize(
    ("name", "width", "height", "bar"),
    [("sprawl", (1.4, 1.75), (1.5, 2.0), 0.75), ("full-crowns", (1.9, 2.5), (2.8, 3.3), 0.6)],
)
def test_wide_canopies_stand_on_their_rows(name, width, height, bar):
    survey = family(name, 1)
    assert survey.rows.mean_width.between(*width).all()
    assert survey.rows.mean_height.between(*height).all()
    lines = shapely.force_2d(survey.rows.geometry.to_numpy())
    spacing = shapely.distance(lines[1], lines[2])
    assert 0.4 < survey.rows.mean_width.mean() / spacing < bar
    up = survey.xyz[:, 2] - survey.terrain(*survey.xyz[:, :2].T) > 0.6
    xy = survey.xyz[up, :2]
    for line in lines:
        near = xy[shapely.contains_xy(line.buffer(0.55 * width[1], cap_style="flat"), *xy.T)]
        (x0, y0), (x1, y1) = line.coords[0], line.coords[-1]
        left = ((x1 - x0) * (near[:, 1] - y0) - (y1 - y0) * (near[:, 0] - x0)) / line.length
        assert abs(np.quantile(left, 0.03) + np.quantile(left, 0.97)) < 0.2
        assert np.ptp(np.quantile(left, [0.02, 0.98])) == pytest.approx(survey.rows.mean_width.mean(), abs=0.35)


def test_strips_are_half_as_high_and_twice_as_wide_as_their_rows():
    survey = family("strips", 0)
    height = survey.xyz[:, 2] - survey.terrain(*survey.xyz[:, :2].T)
    lines = shapely.force_2d(survey.rows.geometry.to_numpy())
    middle = shapely.LineString((np.array(lines[0].coords)[[5, -5]] + np.array(lines[1].coords)[[5, -5]]) / 2)
    near = shapely.contains_xy(middle.buffer(0.15, cap_style="flat"), *survey.xyz[:, :2].T) & (height > 0.2)
    assert np.quantile(height[near], 0.9) == pytest.approx(survey.rows.mean_height.mean() / 2, abs=0.15)


def test_flights_of_the_estate_see_the_same_vines_but_for_what_is_told():
    first, second, third = (estate(flight, density=2) for flight in FLIGHTS)
    dead = [
        {(parcel, row): group["vine"].tolist() for (parcel, row), group in one.dead_vines.groupby(["parcel", "row"])}
        for one in (first, second, third)
    ]
    assert dead[0] == {("Bric", 2): [19, 20], ("Conca", 4): [26]}
    assert dead[1] == dead[2] == dead[0] | {("Bric", 5): [31, 32, 33]}
    lengths = [one.rows.set_index(["parcel", "row"])["n_vines"] for one in (first, second, third)]
    assert [of["Bric", 3] for of in lengths] == [41, 41, 45]
    assert (lengths[0] == lengths[1]).all()
    assert len(lengths[2]["Costa"]) != len(lengths[0]["Costa"])
    assert first.parcels.geometry.geom_equals(third.parcels.geometry).all()
    centres = [one.rows.geometry[0].centroid for one in (first, second, third)]
    assert centres[0].distance(centres[1]) == pytest.approx(np.hypot(0.24, 0.16), abs=1e-6)
