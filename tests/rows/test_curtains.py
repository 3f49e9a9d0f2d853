"""Rows of two curtains are told from rows in pairs: by the field where it tells, else by the gaps that both have."""

import numpy as np
import pytest
from pyproj import CRS

from vinemap.chain import map_rows
from vinemap.cloud.points import PointCloud
from vinemap.config.settings import Settings
from vinemap.evaluate.rows import evaluate_rows
from vinemap.geo.raster import Grid, Raster
from vinemap.rows.curtains import curtain_remarks
from vinemap.rows.key_points import detect_key_points
from vinemap.simulate.families import family
from vinemap.surfaces.waves import RowField

UTM = CRS.from_epsg(32632)
SIDE = 40.0


def key_points(rows, curtains, told, *, shared):
    """Key points of rows whose field tells spacings west and east; gaps are both curtains', or one's alone."""
    grid = Grid(0.0, SIDE, 0.1, 400, 400)
    x, y = np.meshgrid(*grid.centres())
    k = np.floor(y / rows)
    off = y - (k + 0.5) * rows
    cover = np.clip(1.5 - np.abs(np.abs(off) - curtains / 2) / 0.2, 0, 0.8)
    hung = k if shared else 2 * k + (off > 0)
    starts = np.random.default_rng(0).uniform(4, SIDE - 6, 60)[hung.astype(int)]
    cover[np.abs(x - starts) < 0.8] = 0.0
    coarse = Grid(0.0, SIDE, 1.0, 40, 40)

    def raster(west, east):
        return Raster(np.repeat([[west] * 25 + [east] * 15], 40, axis=0), coarse, UTM)

    field = RowField(raster(0.0, 0.0), raster(*told), raster(1.0, 1.0))
    points = detect_key_points(Raster(cover, grid, UTM), raster(0.0, 0.0), field)
    return points.cx[6 : SIDE - 6, 6 : SIDE - 6]


@pytest.mark.parametrize(
    ("rows", "curtains", "told"),
    [(4.0, 1.2, (4 / 3, 4 / 3)), (4.0, 1.2, (4.0, 4 / 3)), (4.0, 1.2, (2.0, 4 / 3)), (3.6, 1.5, (1.8, 1.8))],
)
def test_where_both_have_the_same_gaps_they_are_one_rows(rows, curtains, told):
    """Whatever the field tells, and all of a block."""
    points = key_points(rows, curtains, told, shared=True)
    assert points["told"].all()
    assert points["curtains_m"].to_numpy() == pytest.approx(curtains, abs=0.06)
    assert points["spacing_m"].to_numpy() == pytest.approx(rows, rel=0.02)
    off = (points.geometry.y / rows) % 1 - 0.5
    assert np.abs(off).max() * rows < 0.06


@pytest.mark.parametrize("told", [(4 / 3, 4 / 3), (4 / 3, 4.0)])
def test_pairs_with_gaps_of_their_own_stay_two_rows(told):
    """Also where the field tells otherwise in a few places."""
    points = key_points(4.0, 1.2, told, shared=False)
    assert (points["curtains_m"] == 0).all()
    assert points["spacing_m"].to_numpy() == pytest.approx(4 / 3, rel=0.02)
    off = (points.geometry.y / 4.0) % 1 - 0.5
    assert np.abs(np.abs(off) * 4.0 - 0.6).max() < 0.06


def test_what_the_field_alone_tells_is_said():
    points = key_points(4.0, 1.2, (4.0, 4.0), shared=False)
    assert (points["curtains_m"] > 0).all()
    assert not points["told"].any()
    (said,) = curtain_remarks(points[:3])
    assert said.startswith("3 rows are taken for such of two curtains, 1.2 m apart, by their distances alone: ")
    assert curtain_remarks(points.assign(told=True)) == curtain_remarks(points.assign(curtains_m=0.0)) == []


@pytest.mark.parametrize("seed", [1, 2])
def test_two_slim_curtains_are_one_row(seed):
    survey = family("double-slim", seed)
    found = map_rows(PointCloud(survey.xyz, survey.rows.crs), Settings()).rows
    told = evaluate_rows(found[["geometry"]], survey.rows[["geometry"]])
    assert len(told.pairs) == len(found) == len(survey.rows)
