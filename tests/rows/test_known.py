"""Known rows on vines in known places: what moves, what stays, and what is told."""

import dataclasses

import geopandas as gpd
import numpy as np
import pytest
import shapely
from shapely.ops import substring

from vinemap.chain import map_rows
from vinemap.config.settings import KnownRowOptions, Settings
from vinemap.errors import InputError
from vinemap.geo.raster import sample
from vinemap.rows.fit import fit_rows
from vinemap.rows.known import follow_lines, name_rows
from vinemap.rows.standing.canopy import Standing
from vinemap.rows.standing.known_ends import Known, cut_as_known
from vinemap.surfaces.cover import canopy_cover
from vinemap.surfaces.lines import USUAL, lines_here, space_lines
from vinemap.surfaces.map import map_surfaces


@pytest.fixture(scope="module")
def seen(cloud):
    """Surfaces of six rows."""
    cloud, dtm, chm, shown = map_surfaces(cloud, Settings())
    return cloud, dtm, chm, shown, *canopy_cover(cloud, chm)


@pytest.fixture(scope="module")
def truth(vineyard):
    return shapely.force_2d(vineyard.rows.geometry.to_numpy())


def moved(line, *, aside=0.0, along=0.0):
    """A line moved to its left and onwards."""
    (ax, ay), (bx, by) = np.array(line.coords)[[0, -1]]
    way = np.array([bx - ax, by - ay]) / np.hypot(bx - ax, by - ay)
    return shapely.transform(line, lambda xy: xy + along * way + aside * np.array([-way[1], way[0]]))


def measure(seen, lines, **how):
    """Rows, gaps and remarks of known lines, numbered from 1."""
    cloud, dtm, chm, shown, cover, levels = seen
    numbers = np.arange(1, len(lines) + 1)
    known = gpd.GeoDataFrame({"row_id": numbers, "label": [f"r{n}" for n in numbers]}, geometry=lines, crs=chm.crs)
    here, left = lines_here(known, shown, chm.crs)
    courses = follow_lines(here, cover, **how)
    rows, gaps = fit_rows(courses, cloud, cover, levels, dtm, shown)
    rows, gaps, told = name_rows(here, courses, rows.assign(flags=""), gaps)
    return rows, gaps, [*left, *told]


def off(rows, truth):
    """Greatest distance of each row from the true one, ends included."""
    return shapely.hausdorff_distance(shapely.force_2d(rows.geometry.to_numpy()), truth)


@pytest.mark.parametrize("together", [0.0, 0.5])
def test_lines_that_are_off_meet_their_own_rows(seen, truth, together):
    rng = np.random.default_rng(1)
    lines = [moved(line, aside=together + 0.3 * rng.choice([-1, 1]), along=rng.choice([-1, 1])) for line in truth]
    lines[2] = lines[2].reverse()
    rows, gaps, told = measure(seen, lines)
    assert off(rows, truth).max() < 0.1
    assert told == []
    assert rows["label"].tolist() == [f"r{k}" for k in range(1, 7)]
    starts = shapely.get_point(rows.geometry.to_numpy(), 0)
    assert (shapely.distance(starts, [shapely.Point(line.coords[0]) for line in lines]) < 1.5).all()
    assert set(gaps["row_id"]) <= set(rows["row_id"])
    assert "row" not in gaps


def test_what_is_kept_stays(seen, truth):
    lines = [moved(line, aside=0.2, along=0.7) for line in truth]
    rows, _, _ = measure(seen, lines, course="keep", ends="keep")
    assert off(rows, lines).max() < 1e-6
    rows, _, _ = measure(seen, lines, course="keep")
    along = [moved(line, aside=0.2) for line in truth]
    assert off(rows, along).max() < 0.1
    rows, _, _ = measure(seen, lines, ends="keep")
    aside = [moved(line, along=0.7) for line in truth]
    assert off(rows, aside).max() < 0.1


def test_a_line_without_canopy_stays_and_says_so(seen, truth):
    bare = moved(truth[0], aside=-2.5)
    rows, gaps, told = measure(seen, [bare, *truth])
    assert rows["support"].iloc[0] == 0
    assert rows["flags"].tolist() == ["no_canopy", *[""] * 6]
    assert off(rows, [bare, *truth]).max() < 0.1
    assert gaps[gaps["row_id"] == 1]["length_m"].tolist() == [pytest.approx(bare.length, abs=0.01)]
    assert told == ["1 of 7 known rows have no canopy: r1"]


@pytest.mark.parametrize("aside", [0.9, -1.0, 0.2])
def test_two_lines_do_not_end_on_one_row(seen, truth, aside):
    """The false one comes first or last, and may be nearly where the row is."""
    false = moved(substring(truth[2], 2, 20), aside=aside)
    for lines, place in (([false, *truth], 0), ([*truth, false], 6)):
        rows, _, told = measure(seen, [moved(line, aside=0.1) for line in lines])
        expected = [*truth]
        expected.insert(place, false)
        assert off(rows, expected).max() < 0.15
        assert rows["flags"].tolist()[place] in {"kept", "no_canopy"}
        assert rows["flags"].tolist().count("") == 6
        pair = f"r{place + 1} (that of r{3 + (place == 0)})"
        remark = "1 of 7 known rows would have come to lie on the canopy of another, and stay where they are: "
        assert told[0] == remark + pair


def test_what_was_not_seen_of_a_line_is_told(seen, truth):
    """A void in the middle of one on which nothing stands."""
    cloud, dtm, chm, shown, cover, levels = seen
    bare = moved(truth[0], aside=-2.5)
    void = substring(bare, 0.4, 0.6, normalized=True).buffer(1, cap_style="flat")
    points = shown.points & ~shapely.contains_xy(void, *np.meshgrid(*shown.fine.centres()))
    holed = cloud, dtm, chm, shown._replace(points=points), cover, levels
    rows, gaps, told = measure(holed, [bare, *truth])
    assert gaps["state"][gaps["row_id"] == 1].tolist() == ["missing", "unseen", "missing"]
    assert rows["unseen_m"].tolist() == pytest.approx([0.2 * bare.length, *[0] * 6], abs=0.5)
    assert rows["gap_m"][0] + rows["unseen_m"][0] == pytest.approx(bare.length, abs=0.01)
    assert told == ["1 of 7 known rows have no canopy: r1"]


def test_missing_vines_at_the_end_are_a_gap_where_lines_are_good(seen, truth):
    (ax, ay), (bx, by) = np.array(truth[1].coords)[[0, -1]]
    way = np.array([bx - ax, by - ay]) / truth[1].length
    longer = shapely.LineString([*truth[1].coords, (bx + 1.8 * way[0], by + 1.8 * way[1])])
    rows, gaps, _ = measure(seen, [truth[0], longer, *truth[2:]])
    assert rows.geometry.iloc[1].length == pytest.approx(longer.length, abs=0.1)
    assert gaps[gaps["row_id"] == 2]["length_m"].iloc[-1] == pytest.approx(1.8, abs=0.15)


def test_some_of_the_rows_are_known(seen, truth, cloud):
    found = map_rows(
        cloud,
        known=gpd.GeoDataFrame(
            {"row_id": [9, 4], "label": ["nine", "four"]},
            geometry=[moved(truth[k], aside=0.25) for k in (3, 1)],
            crs=32632,
        ),
    )
    assert found.rows["row_id"].tolist() == [9, 4]
    assert off(found.rows, truth[[3, 1]]).max() < 0.1
    assert found.rows["spacing_m"].to_numpy() == pytest.approx(2.5, rel=0.05)
    assert found.n_key_points == 0


def test_lines_outside_are_told(seen, truth):
    far = shapely.transform(truth[0], lambda xy: xy + 500)
    beyond = moved(truth[1], along=14)
    slip = shapely.LineString(np.array(truth[2].coords)[:4])
    rows, _, told = measure(seen, [truth[0], far, beyond, slip])
    assert rows["row_id"].tolist() == [1, 3]
    assert told[0] == "1 of 4 known rows lie outside of the cloud, and are left out: r2"
    assert told[1] == "1 of 4 known rows are shorter than 2 m, and are left out: r4"
    assert told[2] == "1 of 4 known rows reach out of the cloud: r3"
    with pytest.raises(InputError, match="none of the 1 known rows lies in the cloud: do both show the same place"):
        measure(seen, [far])


def test_under_a_closed_roof_nothing_moves(seen, truth):
    cloud, dtm, chm, shown, cover, levels = seen
    roof = dataclasses.replace(cover, values=np.full_like(cover.values, 0.8))
    lines = [moved(line, aside=0.3, along=1) for line in truth]
    rows, _, told = measure((cloud, dtm, chm, shown, roof, levels), lines)
    assert off(rows, lines).max() < 1e-6
    assert rows["flags"].tolist() == ["kept"] * 6
    assert told[0].startswith("nothing shows where 6 of 6 known rows run, as canopies are closed or too few")


def test_what_is_wide_counts_beside_known_rows(seen, truth, monkeypatch):
    """With a width at which no canopy is closed, all are too wide but where rows are known."""
    cloud, _, chm, *_ = seen
    monkeypatch.setattr("vinemap.surfaces.cover.WIDEST", 0.3)
    lines = gpd.GeoDataFrame(geometry=truth[:4], crs=chm.crs)
    cover, _ = canopy_cover(cloud, chm, space_lines(lines))
    along = shapely.line_interpolate_point(truth[:, None], np.linspace(0.1, 0.9, 20)[None], normalized=True)
    there = sample(cover, shapely.get_coordinates(along)).reshape(6, 20).mean(axis=1)
    assert (there[:3] > 0.5).all()
    assert there[5] < 0.05


def test_spacing_is_the_mean_of_those_thereabouts_but_for_tracks():
    x = np.array([0, 2.2, 5.3, 7.4, 10.1, 17.0, 19.4])
    lines = gpd.GeoDataFrame(geometry=[shapely.LineString([(v, 0), (v, 40)]) for v in x])
    assert space_lines(lines)["spacing_m"].to_numpy() == pytest.approx(2.5, abs=0.15)
    assert space_lines(lines.iloc[:1])["spacing_m"].tolist() == [USUAL]


def test_a_hedge_across_the_end_is_no_part_of_a_row():
    curve = np.column_stack([np.linspace(0, 30, 601), np.zeros(601)])
    row = Standing(curve, np.array([[2.0, 25.0], [26.6, 27.1]]), 0.8, sides=np.array([0.1, 0.9]))
    known = Known(start=1.0, end=26.0, slack=2.0, moves=True, least=0.02)
    (cut,) = cut_as_known([row], [known])
    assert cut.curve[[0, -1], 0] == pytest.approx([2, 25])
    (cut,) = cut_as_known([row._replace(sides=np.array([0.1, 0.1]))], [known])
    assert cut.curve[-1, 0] == pytest.approx(27.1)
    (cut,) = cut_as_known([row], [known._replace(slack=0.0)])
    assert cut.curve[[0, -1], 0] == pytest.approx([1, 26])
    assert cut.runs.tolist() == [pytest.approx([1, 24])]


def test_options_are_those_of_the_settings():
    assert Settings().rows == KnownRowOptions(course="fit", ends="fit", align=False)
