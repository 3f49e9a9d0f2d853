"""Row field against waves and vineyards of known direction and spacing."""

import numpy as np
import pytest
from pyproj import CRS

from vinemap.cloud.points import PointCloud
from vinemap.geo.crs import parse_crs
from vinemap.geo.raster import Grid, Raster, sample
from vinemap.rows.field import estimate_row_field
from vinemap.simulate.families import family
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import hillside
from vinemap.surfaces.canopy_height import canopy_height_model
from vinemap.surfaces.cover import canopy_cover
from vinemap.surfaces.ground import terrain_model

UTM = CRS.from_epsg(32632)


def stripes(direction, spacing, size=60.0, width=0.5):
    """Cover of straight rows, a raster of 0.1 m."""
    n = int(size / 0.1)
    grid = Grid(1000.0, 1000.0 + size, 0.1, n, n)
    x, y = np.meshgrid(*grid.centres())
    across = -(x - 1000) * np.sin(np.radians(direction)) + (y - 1000) * np.cos(np.radians(direction))
    phase = (across / spacing + 0.5) % 1 - 0.5
    return Raster((np.abs(phase) * spacing < width / 2).astype(float), grid, UTM)


def axial(a, b):
    """Smallest angle in degrees between directions."""
    return np.abs((np.asarray(a) - b + 90) % 180 - 90)


@pytest.mark.parametrize("direction", [0, 16, 45, 89.5, 90, 137, 179])
@pytest.mark.parametrize("spacing", [1.8, 2.5, 3.5])
def test_direction_and_spacing_of_stripes(direction, spacing):
    field = estimate_row_field(stripes(direction, spacing))
    middle = (slice(24, -24), slice(24, -24))
    assert axial(field.direction.values[middle], direction).max() < 0.5
    assert np.abs(field.spacing.values[middle] / spacing - 1).max() < 0.02
    assert field.likelihood.values[middle].min() > 0.4


@pytest.mark.parametrize("direction", [0, 16, 90, 137])
def test_cylinders_see_stripes_as_well(direction):
    field = estimate_row_field(stripes(direction, 2.5, size=30.0), method="cylinders")
    middle = (slice(16, -16), slice(16, -16))
    assert axial(field.direction.values[middle], direction).max() < 3
    assert np.abs(field.spacing.values[middle] / 2.5 - 1).max() < 0.05
    assert field.likelihood.values[middle].min() > 0.4


@pytest.mark.parametrize("method", ["spectrum", "cylinders"])
def test_nothing_is_no_vineyard(method):
    cover = stripes(0, 2.5)
    field = estimate_row_field(Raster(np.zeros_like(cover.values), cover.grid, UTM), method=method)
    assert np.isnan(field.direction.values).all()
    assert field.likelihood.values.max() == 0


def test_curved_rows_on_a_slope():
    rows = rows_of(10, length=60, radius=40)
    survey = simulate([Vineyard("A", rows, dead=0.1)], hillside(0.2), seed=5)
    cloud = PointCloud(survey.xyz, parse_crs("EPSG:32632"))
    cloud = cloud.above(terrain_model(cloud))
    cover, _ = canopy_cover(cloud, canopy_height_model(cloud))
    field = estimate_row_field(cover)
    truth, places = [], []
    for row in rows[1:-1]:
        step = np.diff(row, axis=0)
        truth.append(np.degrees(np.arctan2(step[:, 1], step[:, 0])))
        places.append((row[1:] + row[:-1]) / 2)
    truth, places = np.concatenate(truth), np.concatenate(places)
    grid = field.direction.grid
    i = ((grid.north - places[:, 1]) / grid.resolution).astype(int)
    j = ((places[:, 0] - grid.west) / grid.resolution).astype(int)
    error = axial(field.direction.values[i, j], truth)
    assert np.median(error) < 1.0
    assert np.quantile(error, 0.95) < 4
    assert np.median(field.spacing.values[i, j]) == pytest.approx(2.5, rel=0.03)


@pytest.mark.parametrize(("along", "length"), [(2.0, 30), (1.6, 20), (2.0, 20)])
def test_vines_in_a_square_have_rows_in_one_direction(along, length):
    """Bushes 2 m apart: rows run where they are closer together, or where rows are longer."""
    x, y = np.meshgrid(np.arange(0, 40, 0.1), np.arange(0, 40, 0.1))
    wide, high = (length, 20) if along == 2 and length == 30 else (20, 30 if along == 2 else 20)
    inside = (np.abs(x - 20) < wide / 2) & (np.abs(y - 20) < high / 2)
    bushes = np.hypot((x - 20 + along / 2) % along - along / 2, (y - 20 + 1.0) % 2.0 - 1.0) < 0.4
    noise = np.random.default_rng(0).random(x.shape) < 0.9
    cover = Raster((inside & bushes & noise)[::-1].astype(np.float32), Grid(0.0, 40.0, 0.1, 400, 400), UTM)
    field = estimate_row_field(cover)
    assert field.square
    held = field.likelihood.values > 0.1
    rows = 0.0 if along < 2 or wide > high else 90.0
    assert np.quantile(axial(field.direction.values[held], rows), 0.95) < 3
    assert np.median(field.spacing.values[held]) == pytest.approx(2.0, rel=0.03)
    other = estimate_row_field(cover, row_direction=rows + 92)
    held = other.likelihood.values > 0.1
    assert held.any()
    assert not other.square
    assert np.quantile(axial(other.direction.values[held], rows + 90), 0.95) < 3


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_vines_in_a_quincunx_have_rows_in_one_direction_of_three(seed):
    """Every other row is set off by half a step; some vines are dead, and none is quite in its place."""
    rng = np.random.default_rng(seed)
    row, vine = (places.ravel() for places in np.mgrid[-4:5, -6:7])
    heads = np.column_stack([2.8 * (vine + row % 2 / 2), 2.5 * row]) + rng.normal(20, 0.1, (len(row), 2))
    x, y = np.meshgrid(np.arange(0, 40, 0.1), np.arange(0, 40, 0.1))
    cover = np.zeros(x.shape, dtype=np.float32)
    for east, north in heads[rng.random(len(heads)) > 0.1]:
        cover[np.hypot(x - east, y - north) < rng.uniform(0.35, 0.6)] = 1
    field = estimate_row_field(Raster(cover[::-1], Grid(0.0, 40.0, 0.1, 400, 400), UTM))
    assert field.square
    directions = field.direction.values[field.likelihood.values > 0.1]
    assert max((axial(directions, way) < 5).mean() for way in (0, 60.8, 119.2)) > 0.98


@pytest.mark.parametrize("away", [2.0, 3.0, 4.0])
@pytest.mark.parametrize("weak", [1.0, 0.4])
def test_a_hedge_across_the_ends_turns_no_row(away, weak):
    """Rows end on both sides of a hedge; where they have little canopy, its wave is the stronger one beside it."""
    cover = stripes(0, 2.4)
    x, _ = cover.grid.centres()
    values = np.where(np.abs(x - 1030) > away, weak * cover.values, 0.0)
    values[:, np.abs(x - 1030) < 0.6] = 1.0
    field = estimate_row_field(Raster(values, cover.grid, UTM))
    assert not field.square
    x, _ = field.direction.grid.centres()
    rows = field.direction.values[24:-24, (np.abs(x - 1030) > 4.8) & (np.abs(x - 1030) < 18)]
    assert axial(rows, 0).max() < 5


@pytest.mark.parametrize("seed", [5, 8])
def test_heads_that_all_but_touch_tell_the_rows_of_a_square(seed):
    """As far apart both ways, and columns of them as long as rows: only how the canopies are drawn out tells."""
    survey = family("square", seed)
    cloud = PointCloud(survey.xyz, survey.rows.crs)
    cloud = cloud.above(terrain_model(cloud))
    cover, _ = canopy_cover(cloud, canopy_height_model(cloud))
    field = estimate_row_field(cover)
    (ax, ay), (bx, by) = np.array(survey.rows.geometry.iloc[0].coords)[[0, -1], :2]
    held = field.likelihood.values > 0.1
    assert np.median(axial(field.direction.values[held], np.degrees(np.arctan2(by - ay, bx - ax)))) < 2


@pytest.mark.parametrize("direction", [0, 20, 48])
def test_a_lone_row_shows_by_its_grain(direction):
    rows = rows_of(1, length=45, azimuth=direction)
    survey = simulate([Vineyard("A", rows, gaps=(3, 4))], hillside(0.1), density=250, seed=1)
    cloud = PointCloud(survey.xyz, survey.rows.crs)
    cloud = cloud.above(terrain_model(cloud))
    cover, _ = canopy_cover(cloud, canopy_height_model(cloud))
    field = estimate_row_field(cover)
    on_row = rows[0][10:-10:5]
    found, _, likelihood = field.at(on_row)
    assert np.median(axial(found, direction)) < 5
    assert np.median(likelihood) > 0.1
    assert np.median(sample(field.plain, on_row)) > 0.6


def test_a_square_shows_in_any_direction_that_is_prescribed():
    x, y = np.meshgrid(np.arange(0, 40, 0.1), np.arange(0, 40, 0.1))
    bushes = np.hypot((x + 1.0) % 2.0 - 1.0, (y + 1.0) % 2.0 - 1.0) < 0.4
    cover = Raster(bushes.astype(np.float32), Grid(0.0, 40.0, 0.1, 400, 400), UTM)
    for told in (None, 0.0, 90.0):
        field = estimate_row_field(cover, row_direction=told)
        assert field.square is (told is None)
        assert field.plain.values[30:50, 30:50].min() == 1


def test_where_rows_meet_a_hedge_aslant_none_runs_between_their_directions():
    """Else the ends of rows, one after the other, would hang together along the hedge."""
    rows, hedge = stripes(0, 2.4), stripes(60, 60.0, width=1.2)
    x, y = (centres - 1000 for centres in rows.grid.centres())
    beyond = x - y[:, None] / np.tan(np.radians(60))
    field = estimate_row_field(Raster(np.where(beyond < -3, rows.values, hedge.values), rows.grid, UTM))
    directions = field.direction.values[24:-24, 24:-24]
    directions = directions[field.likelihood.values[24:-24, 24:-24] > 0]
    off = np.minimum(axial(directions, 0), axial(directions, 60))
    assert off.max() < 15
    assert np.count_nonzero(axial(directions, 60) < 15) > 100
