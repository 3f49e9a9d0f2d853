"""Rows that run into rows of another block end where their own canopies do."""

import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.cloud.points import PointCloud
from vinemap.config.settings import Settings
from vinemap.geo.crs import parse_crs
from vinemap.geo.curve import extend
from vinemap.rows.fit import fit_rows
from vinemap.rows.standing.parting import own_rows
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import PLACE, hillside
from vinemap.surfaces.cover import canopy_cover
from vinemap.surfaces.map import map_surfaces

SPACING = 2.2


def line(end, angle, length):
    """A row that ends at a place, coming down to it at degrees from eastwards."""
    turn = np.radians(angle)
    return np.linspace(np.array(end) - length * np.array([np.cos(turn), -np.sin(turn)]), end, round(4 * length) + 1)


def abutting(angle, *, beside):
    """Four rows eastwards, and four of another direction, each of which ends ``beside`` metres from one of them.

    Steep ones meet the first row of the others in a T. Those at a small angle end beside the beginnings of the others'
    rows, 0.4 to 1.6 m on.
    """
    east = rows_of(4, length=16, spacing=SPACING)
    if angle > 50:
        along = (np.arange(4) - 1.5) * SPACING / np.sin(np.radians(angle))
        ends = np.array(PLACE) + np.column_stack([along, np.full(4, 1.5 * SPACING + beside)])
    else:
        ends = [row[0] + [0.4 + 0.4 * k, beside] for k, row in enumerate(east)]
    return [*east, *(line(end, angle, 10) for end in ends)]


def off(lines, *, beyond, also=()):
    """Metres (rows, 2) by which ends of rows are off whose courses lead so many metres beyond them.

    Other courses are of no rows.
    """
    crs, settings = parse_crs("EPSG:32632"), Settings()
    vines = Vineyard("A", lines, dead=0.0)
    survey = simulate([vines], hillside(0.05), density=120, density_outside=40, surroundings=3, seed=2)
    cloud, dtm, chm, seen = map_surfaces(PointCloud(survey.xyz, crs), settings)
    cover, levels = canopy_cover(cloud, chm, None, **settings.cover.model_dump())
    courses = [shapely.LineString(course) for course in (*(extend(row, beyond) for row in lines), *also)]
    columns = {"spacing_m": np.full(len(courses), SPACING), "curtains_m": 0.0, "alone": False}
    rows, _ = fit_rows(gpd.GeoDataFrame(columns, geometry=courses, crs=crs), cloud, cover, levels, dtm, seen)
    ends = (np.array([shapely.get_coordinates(g)[[0, -1]] for g in t.geometry]) for t in (rows, survey.rows))
    return np.hypot(*np.moveaxis(np.subtract(*ends), -1, 0))


@pytest.mark.parametrize("angle", [15, 20, 33, 60, 90])
def test_rows_end_where_they_run_into_rows_of_another_direction(angle):
    assert off(abutting(angle, beside=0.45), beyond=1.0).max() < 0.3


def test_a_row_that_comes_near_another_keeps_its_ends():
    """A point row ends a metre beside a long one."""
    long, (x, y) = rows_of(3, length=24, spacing=SPACING), PLACE
    assert off([*long, line((x + 3, y + SPACING + 1), 5, 12)], beyond=0.5).max() < 0.1


def test_what_runs_across_the_ends_of_rows_is_none_and_takes_nothing_of_them():
    rows = rows_of(6, length=20, spacing=SPACING)
    across = [[rows[0][0] + [1, -1], rows[-1][0] + [1, 1]], [rows[0][0] + [10, -1], rows[-1][0] + [10, 1]]]
    assert off(rows, beyond=0.5, also=np.array(across)).max() < 0.1


def test_there_may_be_no_rows():
    assert own_rows({}) == {}
