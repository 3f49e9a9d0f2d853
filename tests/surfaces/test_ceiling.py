"""What grows or hangs among vines and is none is out of sight; vines are not."""

from itertools import pairwise

import numpy as np
import pytest
import shapely

from vinemap.chain import map_rows
from vinemap.cloud.points import HIDDEN, PointCloud
from vinemap.config.settings import Settings
from vinemap.evaluate.rows import evaluate_rows
from vinemap.geo.raster import sample
from vinemap.simulate.families import family
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Sheet
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate
from vinemap.simulate.terrain import hillside
from vinemap.surfaces.ceiling import heights_of_vines
from vinemap.surfaces.ground import terrain_model


def heights(cloud, rows, **scene):
    """A survey of rows, its points with their heights, and the canopy height."""
    survey = simulate([Vineyard("A", rows, dead=0)], hillside(0.05), **{"density": 200, "seed": 4} | scene)
    points = PointCloud(survey.xyz, cloud.crs)
    return survey, *heights_of_vines(points, terrain_model(points))


def along(chm, lines):
    return sample(chm, np.concatenate([line[2:-2] for line in lines]))


@pytest.mark.parametrize(("width", "vines"), [(2.0, False), (1.0, True)])
def test_strips_of_a_cover_crop_are_no_vines(cloud, width, vines):
    """Half as high as the rows on both sides, and twice as wide; what is no wider is a row of young vines."""
    rows = rows_of(4, length=16, spacing=2.6, azimuth=20)
    strips = [(one + other) / 2 for one, other in pairwise(rows)]
    crop = Vineyard("", strips, height=0.95, half_width=0.27 * width, bottom=0.0, dead=0)
    _, _, chm = heights(cloud, rows, beside=[crop])
    on_rows, on_strips = (
        np.median(sample(chm, np.concatenate([line[2:-2] for line in part]))) for part in (rows, strips)
    )
    assert on_rows == pytest.approx(1.95, abs=0.1)
    assert on_strips == pytest.approx(0.95 if vines else 0, abs=0.1)


def test_a_cover_crop_that_few_points_show(cloud):
    """Cells show a single stalk, or none: all of it goes, also where it has vines on one side only."""
    rows = rows_of(4, length=16, spacing=2.6, azimuth=20)
    step = rows[1] - rows[0]
    strips = [rows[0] - step / 2, *(row + step / 2 for row in rows)]
    crop = Vineyard("", strips, height=0.6, half_width=0.65, bottom=0.0, leafiness=2.0, dead=0)
    *_, chm = heights(cloud, rows, beside=[crop], density=90)
    on_rows, on_strips = (along(chm, part) for part in (rows, strips))
    assert np.nanmedian(on_rows) == pytest.approx(1.95, abs=0.15)
    assert np.nanquantile(on_strips, 0.9) < 0.3


@pytest.mark.parametrize(("height", "seen"), [(3.2, True), (2.0, False)])
def test_vines_are_seen_through_a_net(cloud, height, seen):
    """But not through one that lies on them, of which nothing is taken away."""
    rows = rows_of(4, length=16, spacing=2.6, azimuth=20)
    outline = shapely.MultiLineString(rows).convex_hull.buffer(1.0)
    net = Sheet(outline, height, depth=0.03, caught=0.35)
    survey, found, chm = heights(cloud, rows, sheets=[net])
    on_net = np.abs(survey.xyz[:, 2] - survey.terrain(*survey.xyz[:, :2].T) - height) < 0.05
    assert np.mean(found.heights[on_net] == HIDDEN) == pytest.approx(float(seen), abs=0.01)
    assert np.median(along(chm, rows)) == pytest.approx(1.95, abs=0.12)


@pytest.mark.parametrize("seed", [0, 1])
def test_rows_beside_a_cover_crop_that_few_points_show(seed):
    survey = family("cover-crop", seed)
    found = map_rows(PointCloud(survey.xyz, survey.rows.crs), Settings()).rows
    assert len(evaluate_rows(found[["geometry"]], survey.rows[["geometry"]]).pairs) == len(found) == len(survey.rows)
