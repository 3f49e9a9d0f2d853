"""The benchmark of accuracy sees every kind of error, and marks what misses its bar."""

import geopandas as gpd
import numpy as np
import pytest
import shapely
import shapely.affinity
import shapely.ops
from click.testing import CliRunner
from commands import python

from vinemap.chain import RowMap
from vinemap.geo.raster import Grid, Raster
from vinemap.measure.accuracy.__main__ import main
from vinemap.measure.accuracy.family import measure
from vinemap.measure.accuracy.figures import CANOPY_COLUMNS, COLUMNS, MESH_COLUMNS, table
from vinemap.measure.accuracy.rows import compare, pool
from vinemap.measure.tables import as_markdown, as_text, fill
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import hillside
from vinemap.surfaces.waves import RowField

AZIMUTH, SPACING = 40.0, 2.4


def found(survey, dtm, field):
    """A map that holds the survey's true rows and gaps."""
    return RowMap(
        None, dtm, None, field.likelihood, None, field, 0, survey.rows[["geometry"]], survey.gaps[["geometry"]]
    )


@pytest.fixture(scope="module")
def survey():
    rows = rows_of(4, length=20, spacing=SPACING, azimuth=AZIMUTH)
    return simulate([Vineyard("A", rows, dead=0, gaps=(3, 4))], hillside(0.2), density=20, seed=1)


@pytest.fixture
def perfect(survey):
    """What a chain without error would find."""
    west, south, east, north = np.round(survey.parcels.total_bounds)
    grid = Grid(west - 2, north + 2, 0.5, int(2 * (north - south) + 8), int(2 * (east - west) + 8))
    x, y = np.meshgrid(*grid.centres())

    def raster(value):
        return Raster(np.full(grid.shape, value), grid, survey.rows.crs)

    field = RowField(raster(AZIMUTH), raster(SPACING), raster(1.0))
    dtm = Raster(survey.terrain(x, y), grid, survey.rows.crs)
    return found(survey, dtm, field)


def numbers(errors):
    return {(heading, key): m.value(errors) for heading, measures in COLUMNS.items() for key, m in measures.items()}


def changed(survey, perfect, **parts):
    return numbers(compare(survey, perfect._replace(**parts))[0])


def moved(lines, step):
    return gpd.GeoDataFrame(geometry=[shapely.transform(line, lambda xy: xy + step) for line in lines], crs=lines.crs)


def test_no_error_is_no_error(survey, perfect):
    errors, worst = compare(survey, perfect)
    right = {
        ("rows", "true"): 4,
        ("rows", "found"): 4,
        ("rows %", "good"): 100,
        ("gaps", "recall"): 1,
        ("gaps", "precision"): 1,
    }
    for key, value in numbers(errors).items():
        assert value == pytest.approx(right.get(key, 0), abs=0.02 if key[0] in {"direction °", "DTM m"} else 1e-3), key
    assert worst.badness < 0.01
    assert "!" not in "".join(table({"straight": errors})[1])


def test_rows_beside_the_true_ones(survey, perfect):
    left = np.array([-np.sin(np.radians(AZIMUTH)), np.cos(np.radians(AZIMUTH))])
    got = changed(survey, perfect, rows=moved(survey.rows.geometry, 0.1 * left))
    for key in ("DEP m", "DEK m", "COF m"):
        assert got[key, "mean"] == pytest.approx(0.1, abs=0.04 if key == "DEP m" else 0.002)
    assert got["ends m", "mean"] == pytest.approx(0, abs=1e-6)


def test_rows_that_run_too_far(survey, perfect):
    long = [shapely.LineString(np.array(line.coords)[[0, -1]]) for line in survey.rows.geometry]
    long = [shapely.affinity.scale(line, 1 + 0.4 / line.length, 1 + 0.4 / line.length) for line in long]
    got = changed(survey, perfect, rows=gpd.GeoDataFrame(geometry=long, crs=survey.rows.crs))
    assert got["ends m", "mean"] == pytest.approx(0.2, abs=0.01)
    assert got["DEP m", "worst"] == pytest.approx(0.2, abs=0.1)


def test_rows_missed_and_extra(survey, perfect):
    rows = survey.rows.geometry
    away = moved(rows.iloc[:1], np.array([0.0, 30.0])).geometry
    found = gpd.GeoDataFrame(geometry=[*rows.iloc[1:], *away], crs=rows.crs)
    errors, worst = compare(survey, perfect._replace(rows=found))
    got = numbers(errors)
    assert [got["rows %", key] for key in ("good", "extra", "missed")] == [75, 25, 25]
    assert worst.what in {"missed row", "extra row"}
    cells = table({"straight": errors})[1]
    assert cells[1] == "4, 4"
    assert cells[2] == "75.0!, 25.0!, 25.0!"


def test_terrain_direction_and_spacing(survey, perfect):
    def plus(raster, by):
        return Raster(raster.values + by, raster.grid, raster.crs)

    field = RowField(plus(perfect.field.direction, 182), plus(perfect.field.spacing, -0.24), perfect.field.likelihood)
    got = changed(survey, perfect, dtm=plus(perfect.dtm, -0.1), field=field)
    assert got["DTM m", "median"] == pytest.approx(0.1, abs=0.01)
    assert got["direction °", "median"] == pytest.approx(2, abs=0.02)
    assert got["spacing %", "95%"] == pytest.approx(10, abs=0.1)
    blank = Raster(np.full_like(perfect.dtm.values, np.nan), perfect.dtm.grid, perfect.dtm.crs)
    unknown = changed(survey, perfect, field=RowField(blank, blank, blank))
    assert unknown["direction °", "median"] == 90
    assert unknown["spacing %", "median"] == 100


def test_spacing_is_that_of_a_fan():
    rows = rows_of(5, length=30, spacing=2.5, fan=8)
    survey = simulate([Vineyard("A", rows)], hillside(0), density=2)
    grid = Grid(*np.add(survey.parcels.total_bounds[[0, 3]], (-1, 1)), 1.0, 30, 45)
    x, _ = np.meshgrid(*grid.centres())
    middle = survey.parcels.total_bounds[[0, 2]].mean()
    wanted = 2.5 + 2 * np.tan(np.radians(1)) * (x - middle)
    values = [Raster(v, grid, survey.rows.crs) for v in (np.zeros_like(x), wanted, np.ones_like(x))]
    errors, _ = compare(survey, found(survey, values[0], RowField(*values)))
    assert np.quantile(errors.spacing, 0.95) < 0.02
    assert np.median(errors.direction) == pytest.approx(2, abs=0.3)


def test_gaps_missed_invented_and_misjudged(survey, perfect):
    gaps = survey.gaps.geometry
    assert (survey.gaps.n_vines >= 2).all()
    assert changed(survey, perfect, gaps=perfect.gaps.iloc[:1])["gaps", "recall"] < 0.7
    dead = shapely.MultiPoint(survey.dead_vines.geometry.to_list())
    line = next(row for row in survey.rows.geometry if row.distance(dead) > 1)
    invented = gpd.GeoDataFrame(geometry=[*gaps, shapely.ops.substring(line, 5, 8)], crs=gaps.crs)
    assert changed(survey, perfect, gaps=invented)["gaps", "precision"] == pytest.approx(2 / 3)
    one_vine = survey._replace(dead_vines=survey.dead_vines.iloc[:1])
    assert changed(one_vine, perfect, gaps=perfect.gaps.iloc[:1])["gaps", "precision"] == 1
    shorter = [shapely.ops.substring(gap, 0.2, gap.length - 0.2) for gap in gaps]
    got = changed(survey, perfect, gaps=gpd.GeoDataFrame(geometry=shorter, crs=gaps.crs))
    assert got["gaps", "recall"] == 1
    assert got["gaps", "length m"] == pytest.approx(0.4, abs=0.01)


def test_maps_are_pooled_row_by_row(survey, perfect):
    half = compare(survey, perfect._replace(rows=perfect.rows.iloc[:2]))[0]
    both = pool([half, compare(survey, perfect)[0]])
    assert (both.rows, both.found, len(both.pairs)) == (8, 6, 6)
    assert numbers(both)["rows %", "missed"] == 25
    assert len(both.terrain) == 2 * len(half.terrain)


def test_bars_are_lower_for_thin_canopies(survey, perfect):
    errors = compare(survey, perfect)[0]
    errors = errors._replace(pairs=errors.pairs.assign(dep_m=0.09))
    assert table({"straight": errors})[1][3] == "0.090!, 0.090"
    assert table({"thin": errors})[1][3] == "0.090, 0.090"


def test_no_vineyard_has_nothing_to_measure(survey, perfect):
    survey = survey._replace(rows=survey.rows[:0], dead_vines=survey.dead_vines[:0], gaps=survey.gaps[:0])
    errors, worst = compare(survey, perfect._replace(rows=perfect.rows[:0], gaps=perfect.gaps[:0]))
    assert worst is None
    cells = table({"none": errors})[1]
    assert cells[1:4] == ["0, 0", "–, 0.0, 0.0", "–, –"]
    assert "!" not in "".join(cells)
    invented = table({"none": compare(survey, perfect)[0]})[1]
    assert invented[2] == "–, 400.0!, 0.0"


def test_tables_for_readers_and_for_markdown(survey, perfect):
    lines = table({"straight": compare(survey, perfect)[0]})
    plain, marked = as_text(lines).splitlines(), as_markdown(lines).splitlines()
    assert plain[0].startswith("family")
    assert plain[-1].startswith("straight  4, 4")
    assert len({line.count("|") for line in marked}) == 1
    assert marked[1].startswith("| --- | --- |")


def test_a_table_is_filled_between_its_marks():
    text = "a <!-- rows -->old<!-- /rows --> b <!-- canopies --><!-- /canopies --> c"
    assert fill(text, "rows", as_markdown([["x"], ["1"]])) == (
        "a <!-- rows -->\n| x |\n| --- |\n| 1 |\n<!-- /rows --> b <!-- canopies --><!-- /canopies --> c"
    )
    assert fill(text, "none", "x") == text


def test_a_family_is_measured_and_drawn(tmp_path):
    errors, canopy, meshes, trust = measure("short", 1, tmp_path)
    assert len(trust.right) == errors.found
    assert trust.right.sum() == len(errors.pairs) == len(trust.volume)
    assert len(meshes.told) == errors.found
    assert "!" not in "".join(table({"short": meshes}, MESH_COLUMNS)[1])
    assert len(canopy.height) == len(errors.pairs)
    assert len(canopy.good) > 200
    assert "–" not in "".join(table({"short": canopy}, CANOPY_COLUMNS)[1])
    assert errors.rows >= 6
    assert len(errors.pairs) >= 0.8 * errors.rows
    assert (tmp_path / "short.png").read_bytes().startswith(b"\x89PNG")


def test_the_command(tmp_path):
    run = python("-m", "vinemap.measure.accuracy", "short", "--seeds", "1", "--markdown", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert run.stdout.splitlines()[2].startswith("| short | ")
    assert "surveys: 1, in" in run.stderr
    assert CliRunner().invoke(main, ["vines"]).exit_code == 2
