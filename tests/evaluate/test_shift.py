"""How far rows lie off known ones: shifts of any direction, and how surely each is told."""

import json

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.chain import map_rows
from vinemap.evaluate.shift import measure_shift
from vinemap.product.notices import shift_notices
from vinemap.simulate.scenes import rows_of

SHIFT = np.array([0.21, -0.13])


def measure(courses, *, shift=SHIFT, short=0.0, told=True, seed=0, moves=True, longer=()):
    """The shift of rows off lines that were surveyed to 1.5 cm; rows are found to 2 cm across and 10 cm at their ends.

    They end ``short`` of the lines, and those at places ``longer`` a metre beyond one end.
    """
    rng = np.random.default_rng(seed)
    given, found = [], []
    for k, xy in enumerate(courses):
        ends = xy[[0, -1]] + rng.normal(0, 0.015, (2, 2))
        way = (xy[-1] - xy[0]) / np.hypot(*(xy[-1] - xy[0]))
        aside = rng.normal(0, 0.02) * np.array([-way[1], way[0]])
        first, last = short + rng.normal(0, 0.1, 2) + [0, -1.0 * (k in longer)]
        given.append(shapely.LineString(ends if len(xy) < 3 else xy))
        inner = xy[1:-1] if len(xy) > 2 else xy[:0]
        found.append(shapely.LineString(np.vstack([xy[0] + first * way, inner, xy[-1] - last * way]) + aside + shift))
    lines = gpd.GeoDataFrame({"spacing_m": 2.5}, geometry=given, crs=32632, index=range(len(given)))
    table = {"support": 1.0, "start_told": told, "end_told": told}
    rows = gpd.GeoDataFrame(table, geometry=found, crs=32632, index=lines.index)
    return measure_shift(lines, rows, np.full(len(rows), moves))


def straight(n, *, azimuth=0.0, centre=(500000.0, 5000000.0)):
    return [row[[0, -1]] for row in rows_of(n, length=40, azimuth=azimuth, centre=centre)]


def test_any_shift_is_found_with_an_honest_deviation():
    rng = np.random.default_rng(1)
    errors, deviations = [], []
    for seed in range(40):
        shift = rng.uniform(-0.3, 0.3, 2)
        courses = straight(rng.integers(4, 12), azimuth=rng.uniform(0, 180))
        courses = [row[::-1] if rng.random() < 0.3 else row for row in courses]
        told = measure(courses, shift=shift, short=rng.uniform(-0.2, 0.4), seed=seed, longer=(1,))
        errors.append(told.axes @ (told.metres - shift))
        deviations.append(told.deviation)
    off = np.array(errors) / deviations
    assert np.hypot(*np.transpose(errors)).mean() < 0.03
    assert np.mean(np.abs(off) < 2.5) > 0.95
    assert (np.sqrt((off**2).mean(axis=0)) > 0.4).all()
    assert np.abs(errors)[:, 0].mean() < np.abs(errors)[:, 1].mean()


def test_rows_of_two_directions_tell_it_without_their_ends():
    told = measure([*straight(5), *straight(5, azimuth=70, centre=(500060.0, 5000000.0))], told=False)
    assert told.metres == pytest.approx(SHIFT, abs=0.04)
    assert told.deviation.max() < 0.04
    assert (told.rows, told.ends) == (10, 0)


def test_along_rows_of_one_direction_only_ends_tell_it():
    told = measure(straight(6, azimuth=90), told=False)
    assert told.metres == pytest.approx([SHIFT[0], 0], abs=0.03)
    assert np.isinf(told.deviation[1])
    record = json.loads(json.dumps(told.record()))
    assert record["east_sd_m"] is record["north_sd_m"] is None
    across, along = record["axes"]
    assert np.cos(np.radians([across["deg"], along["deg"] - 90])) ** 2 == pytest.approx(1, abs=1e-4)
    assert abs(across["m"]) == pytest.approx(SHIFT[0], abs=0.03)
    assert across["sd_m"] < 0.05
    assert along["m"] is along["sd_m"] is None


def test_nothing_is_told_by_rows_that_canopy_does_not_show():
    assert measure(straight(5), moves=False) is None


def test_a_row_that_was_taken_for_another_does_not_count():
    courses = straight(8, azimuth=20)
    told = measure(courses)
    lines = gpd.GeoDataFrame({"spacing_m": 2.5}, geometry=[shapely.LineString(c) for c in courses], index=range(8))
    shapes = [shapely.LineString(xy + SHIFT + [0, 1.2 * (k == 3)]) for k, xy in enumerate(courses)]
    rows = gpd.GeoDataFrame({"support": 1.0, "start_told": True, "end_told": True}, geometry=shapes, index=range(8))
    wrong = measure_shift(lines, rows, np.ones(8, dtype=bool))
    assert wrong.metres == pytest.approx(SHIFT, abs=0.02)
    assert wrong.rows == told.rows - 1


def test_a_large_shift_across_rows_is_a_warning():
    """Along rows it takes none for the next."""
    courses = straight(5)
    rows = gpd.GeoDataFrame({"spacing_m": [2.5] * 5}, geometry=[shapely.LineString(xy) for xy in courses])
    way = np.diff(courses[0], axis=0)[0] / np.hypot(*np.diff(courses[0], axis=0)[0])
    along, across = 1.1 * way, 1.1 * np.array([-way[1], way[0]])
    assert shift_notices(measure(courses, shift=along), rows) == shift_notices(None, rows) == []
    (remark,) = shift_notices(measure(courses, shift=along + across), rows)
    assert remark.startswith("the flight lies 1.1")


def test_of_a_survey(vineyard, cloud):
    """Lines that were given off the canopy by the shift turned round, with what may move as it is by default or not."""
    from vinemap.config.settings import Settings

    lines = [shapely.transform(row, lambda xy: xy - SHIFT) for row in shapely.force_2d(vineyard.rows.geometry)]
    known = gpd.GeoDataFrame({"row_id": range(1, 7), "label": list("abcdef")}, geometry=lines, crs=32632)
    kept = map_rows(cloud, Settings(rows={"course": "keep", "ends": "keep"}), known=known)
    assert shapely.hausdorff_distance(shapely.force_2d(kept.rows.geometry.to_numpy()), lines).max() < 1e-6
    assert kept.shift.metres == pytest.approx(SHIFT, abs=2.5 * kept.shift.deviation.max())
    assert kept.shift.deviation.max() < 0.06
