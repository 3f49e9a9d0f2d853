import geopandas as gpd
import numpy as np
import pytest
import shapely

from vinemap.cloud.points import PointCloud
from vinemap.geo.raster import Raster, grid_over
from vinemap.rows.fit import fit_rows
from vinemap.surfaces.cover import Levels
from vinemap.surfaces.seen import seen_cells


@pytest.mark.parametrize(("start", "end"), [(2.5, 13.5), (6, 11)])
def test_wide_canopies_have_their_middle_between_their_flanks_and_are_followed_to_their_ends(start, end):
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(0, 16, 20_000), rng.uniform(-1.5, 1.5, 20_000), np.zeros(20_000)])
    body = np.column_stack([rng.uniform(2, 14, 10_000), rng.uniform(-0.9, 0.9, 10_000), rng.uniform(0.7, 1.2, 10_000)])
    crown = np.column_stack([rng.uniform(2, 14, 4_000), rng.uniform(-0.1, 0.7, 4_000), rng.uniform(1.4, 1.7, 4_000)])
    xyz = np.concatenate([ground, body, crown])
    cloud = PointCloud(xyz, None, heights=xyz[:, 2])
    fine, metres = (grid_over(xyz.min(axis=0), xyz.max(axis=0), resolution=side) for side in (0.1, 1.0))
    x, y = np.meshgrid(*fine.centres())
    of_ridges = ((x > 2) & (x < 14) & (y > -0.1) & (y < 0.7)).astype(np.float32)
    heights = (Raster(np.full(metres.shape, level, np.float32), metres, None) for level in (0.5, 1.3))
    levels = Levels(*heights, np.zeros(metres.shape, dtype=bool))
    course = gpd.GeoDataFrame(
        {"spacing_m": [2.4], "curtains_m": [0.0], "alone": [False]},
        geometry=[shapely.LineString([(start, 0.3), (end, 0.3)])],
    )
    dtm = Raster(np.zeros(metres.shape, np.float32), metres, None)
    rows, _ = fit_rows(course, cloud, Raster(of_ridges, fine, None), levels, dtm, seen_cells(cloud, fine))
    line = shapely.get_coordinates(rows.geometry.iloc[0])
    assert np.abs(line[:, 1]).max() < 0.03
    assert np.allclose(line[[0, -1], 0], [2, 14], atol=0.06)
