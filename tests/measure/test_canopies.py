"""True canopies have no error, and what is wrong with others is seen."""

import numpy as np
import pandas as pd
import pytest
import shapely

from vinemap.canopy.model import CanopyModel
from vinemap.canopy.numbers import measure_sections, tabulate_sections
from vinemap.canopy.points import Sections
from vinemap.chain import RowMap
from vinemap.measure.accuracy.canopies import compare_canopies, pool_canopies
from vinemap.simulate.plants import Vineyard, foliage_outlines
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import hillside


@pytest.fixture(scope="module")
def survey():
    rows = rows_of(3, length=12, azimuth=20)
    return simulate([Vineyard("A", rows, dead=0)], hillside(0.1), density=20, seed=1)


def model(survey, grown=0.0):
    """The true foliage at every station as a model, its sides moved outward by some metres."""
    foliage = survey.foliage
    m = len(foliage.row)
    way = np.array([[np.cos(np.radians(20)), np.sin(np.radians(20))]]).repeat(m, axis=0)
    drawn = foliage_outlines(foliage)
    drawn[:, :, 0] += grown * np.repeat([1, -1], drawn.shape[1] // 2)
    area = shapely.area(shapely.polygons(drawn))
    tops = np.repeat(foliage.top, 4)
    points = np.column_stack([np.tile([-1, -1, 1, 1], m) * np.repeat(foliage.half_width, 4), tops])
    position = np.concatenate([np.cumsum(foliage.step[foliage.row == k]) for k in range(3)])
    origin = np.column_stack([foliage.xy, np.zeros(m)])
    start = np.arange(0, 4 * m + 1, 4)
    of_each = np.full(m, 2.5), foliage.step
    canopy = Sections(foliage.row + 1, position, origin, way, *of_each, start, points, tops, np.arange(4 * m))
    measures = measure_sections(canopy, foliage.bottom, (area, area, area), c=drawn.shape[1])
    table = tabulate_sections(canopy, drawn, measures, crs=survey.rows.crs)
    return CanopyModel(canopy, drawn, table, np.zeros(m), np.ones(m, dtype=bool), canopy)


def errors(survey, ours):
    rows = survey.rows[["geometry"]].assign(row_id=survey.rows["row"])
    found = RowMap(None, None, None, None, None, None, 0, rows, None)
    pairs = pd.DataFrame({"row_id": [1, 2, 3], "reference": [1, 2, 3]})
    return compare_canopies(survey, found, ours, ours, pairs, step=0.1)


def test_the_truth_has_no_error(survey):
    right = errors(survey, model(survey))
    assert right.good.mean() > 0.97  # the truth is a mean over 0.4 m
    assert right.over.mean() < 0.03
    assert np.abs(right.height).max() < 0.001
    assert np.abs(right.width).max() < 0.001
    assert np.abs(right.volume).max() < 0.02


def test_too_much_and_too_little_are_told_apart(survey):
    for grown, growing, falling in ((0.1, "over", "under"), (-0.1, "under", "over")):
        wrong = errors(survey, model(survey, grown))
        assert getattr(wrong, growing).mean() > 0.25
        assert getattr(wrong, falling).mean() < 0.02
        assert (np.sign(wrong.volume) == np.sign(grown)).all()
    assert wrong.soil.mean() == pytest.approx((wrong.good - wrong.under - wrong.over).mean())


def test_no_vines_no_errors(survey):
    nothing = errors(survey._replace(foliage=survey.foliage._replace(row=np.empty(0, int))), model(survey))
    assert all(len(values) == 0 for values in nothing)
    both = pool_canopies([nothing, errors(survey, model(survey))])
    assert len(both.height) == 3
