"""Ground found by PDAL's filters, and by pipelines of people's own: of a cloud in memory, and in tiles."""

import json

import numpy as np
import pytest
from pyproj import CRS

from vinemap.cloud.pdal.engine import stages_of
from vinemap.cloud.pdal.ground import classified
from vinemap.cloud.points import PointCloud
from vinemap.cloud.tiles import Collector, TiledCloud, moved
from vinemap.config.settings import GroundOptions
from vinemap.errors import InputError
from vinemap.surfaces.ground import terrain_model

UTM = CRS.from_epsg(32632)


@pytest.fixture(scope="module")
def xyz():
    """Soil on a slope, and rows of canopy half a metre above it and more."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 100, (2, 60_000))
    rows = (np.abs(x % 2.5 - 1.25) < 0.25) & (rng.random(len(x)) < 0.8)
    z = 0.1 * x + rng.normal(0, 0.01, len(x)) + np.where(rows, rng.uniform(0.5, 1.8, len(x)), 0)
    return np.column_stack([x + 414_700, y + 4_940_700, z + 100]).round(3)


def soil(xyz):
    return np.abs(xyz[:, 2] - 100 - 0.1 * (xyz[:, 0] - 414_700)) < 0.1


def tiled(xyz, folder):
    collector = Collector(folder, most=1000)
    collector.add(xyz)
    return collector.cloud(UTM, "datum")


def by_pdal(**options):
    return GroundOptions(engine="pdal", **options)


def ordered(cloud):
    points = [np.column_stack([part.xyz, part.classification]) for part in cloud.parts()]
    together = np.concatenate(points)
    return together[np.lexsort(together[:, :3].T)]


def written(path, stages):
    path.write_text(json.dumps(stages))
    return path


@pytest.mark.parametrize("name", ["smrf", "csf", "pmf"])
def test_filters_tell_ground(pdal, xyz, name):
    cloud = classified(PointCloud(xyz, UTM, "datum", remarks=("far off",)), by_pdal(filter=name), Collector())
    assert (cloud.crs, cloud.vertical, cloud.remarks) == (UTM, "datum", ("far off",))
    ground = cloud.classification == 2
    assert ground[soil(cloud.xyz)].mean() > 0.95
    assert ground[~soil(cloud.xyz)].mean() < 0.01


def test_filters_are_given_their_options():
    options = {"cell": 0.3, "slope": 0.4, "window": 6.0, "scalar": 0.2, "threshold": 0.1}
    assert stages_of(by_pdal(smrf=options)) == [{"type": "filters.smrf"} | options]
    assert stages_of(by_pdal(filter="csf", csf={"rigidness": 2}))[0]["rigidness"] == 2
    assert stages_of(by_pdal(filter="pmf", pmf={"slope": 0.5}))[0] == {
        "type": "filters.pmf",
        "cell_size": 0.5,
        "slope": 0.5,
        "initial_distance": 0.15,
        "max_distance": 0.5,
        "max_window_size": 16.0,
        "exponential": True,
    }


def test_tiles_have_the_classes_of_the_whole(pdal, xyz, tmp_path):
    whole = classified(PointCloud(xyz, UTM), by_pdal(), Collector())
    tiles = classified(tiled(xyz, tmp_path / "a"), by_pdal(), Collector(tmp_path / "b"))
    assert isinstance(tiles, TiledCloud)
    assert len(tiles.tiles) > 2
    assert (tiles.size, tiles.vertical) == (len(xyz), "datum")
    one, other = ordered(whole), ordered(tiles)
    assert np.array_equal(one[:, :3], other[:, :3])
    assert (one[:, 3] != other[:, 3]).mean() < 0.002
    terrain = terrain_model(tiles, engine="pdal", resolution=0.5)
    assert np.abs(terrain.values - terrain_model(whole, engine="pdal", resolution=0.5).values).max() < 0.05
    away = moved(tiles, np.array([10.0, 0.0]), Collector(tmp_path / "c", most=1000))
    assert np.array_equal(ordered(away)[:, 3].sum(), other[:, 3].sum())


def test_a_pipeline_of_ones_own(pdal, xyz, tmp_path):
    """Its stages take the filter's place; what they call noise is left out, by tiles as well."""
    values = ["Classification = 2", "Classification = 7 WHERE X > 414750"]
    stages = [{"type": "filters.assign", "value": value} for value in values]
    path = written(tmp_path / "mine.json", {"pipeline": stages})
    for cloud in (PointCloud(xyz, UTM), tiled(xyz, tmp_path / "a")):
        mine = ordered(classified(cloud, by_pdal(pipeline=path), Collector(tmp_path / "b")))
        assert len(mine) == (xyz[:, 0] <= 414_750).sum()
        assert set(mine[:, 3]) == {2}


@pytest.mark.parametrize(
    ("stage", "said"),
    [
        ({"type": "filters.smrf", "cel": 1}, r"Unexpected argument 'cel'"),
        ({"type": "filters.expression", "expression": "Z > 1000"}, "leaves no point of the cloud"),
        ({"type": "filters.assign", "value": "X = X + 100"}, "moves points to elsewhere"),
    ],
)
def test_pipelines_that_do_not_go(pdal, xyz, tmp_path, stage, said):
    path = written(tmp_path / "mine.json", [stage])
    for cloud in (PointCloud(xyz, UTM), tiled(xyz, tmp_path / "a")):
        with pytest.raises(InputError, match=rf"mine\.json: [^\n]*{said}"):
            classified(cloud, by_pdal(pipeline=path), Collector(tmp_path / "b"))


def test_without_ground_there_is_no_terrain(pdal, xyz, tmp_path):
    path = written(tmp_path / "mine.json", [{"type": "filters.expression", "expression": "Z > 0"}])
    cloud = classified(PointCloud(xyz, UTM), by_pdal(pipeline=path), Collector())
    with pytest.raises(InputError, match="classified as ground"):
        terrain_model(cloud, engine="pdal")


def test_filters_run_in_a_process_of_their_own(stand_in, xyz):
    cloud = classified(PointCloud(xyz, UTM), by_pdal(), Collector())
    assert len(cloud.xyz) == len(xyz)
    assert stand_in.Pipeline.made == []
