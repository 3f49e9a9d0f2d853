"""Key points: the thesis's worked example, and canopies in known places."""

import numpy as np
import pytest
from pyproj import CRS

from vinemap.geo.raster import Grid, Raster
from vinemap.rows.key_points import central_points, detect_key_points
from vinemap.surfaces.waves import RowField

UTM = CRS.from_epsg(32632)


def test_worked_example_of_equation_3():
    """Four maxima in the cylinder around [200, 130] m, whose rows run at 65.2°."""
    offsets = np.array([-3.45, -0.90, 1.65, 4.25])
    printed = [[203.13, 128.55], [200.82, 129.62], [198.50, 130.69], [196.14, 131.78]]
    found = central_points(np.full((4, 2), [200.0, 130.0]), offsets, np.full(4, np.radians(65.2)))
    assert np.abs(found - printed).max() < 0.01


@pytest.mark.parametrize("direction", [0.0, 30.0, 90.0, 155.0])
def test_centres_of_straight_rows(direction):
    spacing, grid = 2.5, Grid(0.0, 40.0, 0.1, 400, 400)
    x, y = np.meshgrid(*grid.centres())
    across = -x * np.sin(np.radians(direction)) + y * np.cos(np.radians(direction)) - 0.37
    cover = np.clip(1.5 - np.abs((across / spacing + 0.5) % 1 - 0.5) * spacing / 0.3, 0, 1)
    coarse = Grid(0.0, 40.0, 1.0, 40, 40)

    def constant(value):
        return Raster(np.full((40, 40), value), coarse, UTM)

    points = detect_key_points(
        Raster(cover, grid, UTM), constant(7.0), RowField(constant(direction), constant(spacing), constant(1.0))
    )
    xy = points.get_coordinates().to_numpy()
    inside = ((xy > 3) & (xy < 37)).all(axis=1)
    off = -xy[:, 0] * np.sin(np.radians(direction)) + xy[:, 1] * np.cos(np.radians(direction)) - 0.37
    assert np.abs((off / spacing + 0.5) % 1 - 0.5)[inside].max() * spacing < 0.02
    assert inside.sum() > 34 * 34 / spacing * 2
    assert np.allclose(points.get_coordinates(include_z=True)["z"], 7.0)
    assert set(points.columns) == {"cover", "direction_deg", "spacing_m", "curtains_m", "told", "geometry"}
    assert (points["curtains_m"] == 0).all()


@pytest.mark.parametrize(("spacing", "curtains", "told"), [(3.8, 1.1, 3.8), (3.2, 1.2, 1.6), (3.2, 1.6, 1.6)])
def test_two_curtains_are_one_row(spacing, curtains, told):
    """Also where the field takes a curtain's distance for the rows'; but equal distances are those of rows."""
    grid, direction = Grid(0.0, 30.0, 0.1, 300, 300), 30.0
    x, y = np.meshgrid(*grid.centres())
    across = -x * np.sin(np.radians(direction)) + y * np.cos(np.radians(direction))
    off = np.abs((across / spacing + 0.5) % 1 - 0.5) * spacing
    cover = np.clip(1.5 - np.abs(off - curtains / 2) / 0.2, 0, 0.8)
    coarse = Grid(0.0, 30.0, 1.0, 30, 30)

    def constant(value):
        return Raster(np.full((30, 30), value), coarse, UTM)

    field = RowField(constant(direction), constant(told), constant(1.0))
    points = detect_key_points(Raster(cover, grid, UTM), constant(0.0), field)
    xy = points.get_coordinates().to_numpy()
    inside = ((xy > 4) & (xy < 26)).all(axis=1)
    off = (xy[:, 1] * np.cos(np.radians(direction)) - xy[:, 0] * np.sin(np.radians(direction)))[inside]
    double = curtains < spacing / 2
    off = off if double else off - curtains / 2
    row = spacing if double else spacing / 2
    assert np.abs((off / row + 0.5) % 1 - 0.5).max() * row < 0.03
    assert points["spacing_m"][inside].to_numpy() == pytest.approx(row, rel=0.03)
    assert points["curtains_m"][inside].to_numpy() == pytest.approx(curtains if double else 0, abs=0.05)


def test_no_likelihood_no_key_points():
    grid = Grid(0.0, 10.0, 0.1, 100, 100)
    coarse = Grid(0.0, 10.0, 1.0, 10, 10)
    zero = Raster(np.zeros((10, 10)), coarse, UTM)
    nan = Raster(np.full((10, 10), np.nan), coarse, UTM)
    assert len(detect_key_points(Raster(np.ones((100, 100)), grid, UTM), zero, RowField(nan, nan, zero))) == 0
