"""Clouds in tiles on disk: no point lost or twice, and the same result as in memory."""

import json

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import rasterio
import shapely
from commands import python
from lasfiles import in_order
from pyproj import CRS
from systems import POSIX

from vinemap import paths
from vinemap.chain import map_rows, model_canopies
from vinemap.cloud.bins import block_side
from vinemap.cloud.las import collected
from vinemap.cloud.points import PointCloud
from vinemap.cloud.tiles import Collector, TiledCloud
from vinemap.config.settings import ReadingOptions, Settings
from vinemap.errors import InputError, OutputError
from vinemap.geo.place import Place
from vinemap.geo.raster import grid_over, squares, window
from vinemap.parcel import map_parcel
from vinemap.product.gltf import read_glb
from vinemap.stages import call
from vinemap.surfaces.canopy_height import canopy_height_model
from vinemap.surfaces.ground import terrain_model

UTM = CRS.from_epsg(32632)
PLACE = [414_690.0, 4_940_690.0]


def tiled(xyz, folder, *, chunk=30_000, block=1.0):
    """Points (n, 3) as a cloud in tiles, added chunk by chunk."""
    folder.mkdir()
    collector = Collector(folder, most=1000, block=block)
    for k in range(0, len(xyz), chunk):
        collector.add(xyz[k : k + chunk])
    cloud = collector.cloud(UTM, None)
    assert isinstance(cloud, TiledCloud)
    return cloud


def points_of(cloud):
    return np.concatenate([part.xyz for part in cloud.parts()])


def on_millimetres(n, *, seed=0, width=150.0):
    """Points (n, 3) on a hillside, many of them right on the edges of cells."""
    rng = np.random.default_rng(seed)
    xy = np.round(rng.uniform(PLACE, np.add(PLACE, width), (n, 2)), 3)
    xy[: n // 3] = np.round(xy[: n // 3] / 0.05) * 0.05
    return np.column_stack([xy.round(3), 300 + 0.1 * (xy[:, 0] - PLACE[0]) + rng.normal(0, 0.02, n)])


@pytest.fixture
def small_tiles(monkeypatch):
    """Tiles of 8 m, so that a small vineyard has many."""
    monkeypatch.setattr("vinemap.cloud.tiles.SIDE", 8.0)


def test_few_points_stay_in_memory(tmp_path):
    xyz = on_millimetres(1000)
    collector = Collector(tmp_path, most=1000)
    for k in range(0, 1000, 130):
        collector.add(xyz[k : k + 130])
    cloud = collector.cloud(UTM, "DHHN2016 height")
    assert isinstance(cloud, PointCloud)
    assert np.array_equal(cloud.xyz, xyz)
    assert cloud.vertical == "DHHN2016 height"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("chunk", [900, 7001, 50_000])
def test_every_point_is_in_one_tile(tmp_path, chunk):
    xyz = on_millimetres(20_000)
    cloud = tiled(xyz, tmp_path / "t", chunk=chunk)
    assert np.array_equal(in_order(points_of(cloud)), in_order(xyz))
    assert cloud.size == 20_000
    assert np.array_equal(cloud.extent, [xyz.min(axis=0), xyz.max(axis=0)])
    assert len(cloud.tiles) == len(list((tmp_path / "t").iterdir())) > 4
    passed = 0
    for tile, part in zip(cloud.tiles, cloud.parts(), strict=True):
        assert (tile.size, tile.first, part.first) == (part.size, passed, passed)
        assert np.array_equal((tile.low, tile.high), part.extent)
        assert (np.ptp(part.xyz[:, :2], axis=0) <= 64).all()
        passed += part.size


@pytest.mark.parametrize("resolution", [0.05, 0.07, 0.15, 0.25, 0.3, 0.35, 0.45, 0.6, 0.7, 1.0, 1.3, 1.7, 2.0])
def test_tiles_divide_no_block_of_the_terrain_model(tmp_path, resolution):
    block = block_side(resolution)
    xyz = on_millimetres(60_000)
    cloud = tiled(xyz, tmp_path / "t", block=block)
    multiple = round(block / resolution)
    grid = grid_over(*cloud.extent, resolution=resolution, multiple=multiple)
    taken = np.zeros(grid.shape, dtype=int)
    held = []
    for part in cloud.parts():
        held.append(np.unique(np.column_stack(squares(part.xyz, block)), axis=0))
        _, where = window(grid, *part.extent, multiple=multiple)
        taken[where] += 1
    assert taken.max() == 1
    assert len(np.unique(np.concatenate(held), axis=0)) == sum(map(len, held))


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.25, 0.5, 1.0, 2.0])
def test_terrain_and_heights_are_those_of_the_cloud_whole(tmp_path, resolution):
    xyz = on_millimetres(30_000, width=80.0)
    xyz[::5, 2] += np.random.default_rng(1).uniform(0, 2, len(xyz[::5]))
    whole, parts = PointCloud(xyz, UTM), tiled(xyz, tmp_path / "t", block=block_side(resolution))
    dtm, same = (terrain_model(cloud, resolution=resolution) for cloud in (whole, parts))
    assert dtm.grid == same.grid
    assert np.array_equal(dtm.values, same.values)
    chm, same = (canopy_height_model(cloud.above(dtm), resolution=resolution) for cloud in (whole, parts))
    assert np.array_equal(chm.values, same.values, equal_nan=True)


@pytest.mark.parametrize("resolution", [0.25, 0.3, 0.45, 2.0])
def test_points_on_the_edges_of_tiles_and_of_the_cloud(tmp_path, resolution):
    """Some tiles hold nothing but points of an edge that is the cloud's as well."""
    block = block_side(resolution)
    side = round(64 / block) * block
    corner = np.ceil(np.divide(PLACE, side)) * side
    rng = np.random.default_rng(0)
    xy = corner + rng.integers(0, 201, (40_000, 2)) * (side / 100)
    xyz = np.column_stack([xy, 300 + 0.05 * (xy[:, 0] - corner[0]) + rng.normal(0, 0.02, len(xy))])
    cloud = tiled(xyz, tmp_path / "t", block=block)
    assert min(tile.size for tile in cloud.tiles) < 3000 < max(tile.size for tile in cloud.tiles)
    dtm, same = (terrain_model(points, resolution=resolution) for points in (PointCloud(xyz, UTM), cloud))
    assert dtm.grid == same.grid
    off = np.abs(np.subtract(dtm.values, same.values))
    # Where blocks' edges are no whole numbers, a point that lies right on a cell's may count on its other side.
    assert off.max() == 0 if block == round(block) else np.quantile(off, 0.9) < 0.01


def test_parts_near_a_geometry(tmp_path, small_tiles):
    xyz = on_millimetres(20_000)
    cloud = tiled(xyz, tmp_path / "t")
    line = shapely.LineString([np.add(PLACE, 20), np.add(PLACE, [90, 40])])
    parts = list(cloud.parts(line, 2.0))
    near = shapely.dwithin(shapely.points(xyz[:, :2]), line, 2.0)
    assert 4 < len(parts) < len(cloud.tiles) / 2
    assert set(map(tuple, xyz[near])) <= set(map(tuple, np.concatenate([part.xyz for part in parts])))


def strays(n):
    """Coordinates that no survey has: zeros, other units, heights in the sky, all apart from each other."""
    rng = np.random.default_rng(7)
    far = rng.uniform(-5e6, 5e7, (n, 3))
    far[0] = 0.0
    far[1] = [4e11, -4e11, 0]
    far[2::3, :2] = rng.uniform(PLACE, np.add(PLACE, 100), (len(far[2::3]), 2))
    return far


def test_strays_are_left_out_as_in_memory(tmp_path):
    rng = np.random.default_rng(3)
    xyz = rng.permutation(np.concatenate([on_millimetres(200_000), strays(300)]))
    clouds = []
    for name, most in (("memory", np.inf), ("tiles", 1000)):
        collector = Collector(tmp_path / name, most=most)
        (tmp_path / name).mkdir()
        for k in range(0, len(xyz), 50_000):
            collector.add(xyz[k : k + 50_000])
        clouds.append(collected(collector, Place(UTM), [tmp_path / "a.laz"]))
    whole, parts = clouds
    assert isinstance(whole, PointCloud)
    assert isinstance(parts, TiledCloud)
    assert whole.size == 200_000
    assert np.array_equal(in_order(points_of(parts)), in_order(whole.xyz))
    assert np.array_equal(parts.extent, whole.extent)
    assert [tile.first for tile in parts.tiles] == np.cumsum([0, *(tile.size for tile in parts.tiles)])[:-1].tolist()


def test_what_is_no_survey_is_refused_in_tiles_too(tmp_path):
    collector = Collector(tmp_path, most=1000)
    collector.add(np.random.default_rng(0).uniform(0, 1e6, (5000, 3)))
    with pytest.raises(InputError, match=r"a\.laz: heights span"):
        collected(collector, Place(UTM), [tmp_path / "a.laz"])


@pytest.mark.parametrize("n", [1, 999, 5000, 20_000])
def test_samples_are_even(tmp_path, n, small_tiles):
    """Tiles of a single point must not tell more than others of a thousand."""
    xyz = np.concatenate([on_millimetres(18_000, width=20), on_millimetres(2000, width=3000)])
    collector = Collector(tmp_path, most=1000)
    collector.add(xyz)
    sample = collector.sample(n)
    assert len(sample) == -(-20_000 // (20_000 // n))
    assert set(map(tuple, sample)) <= set(map(tuple, xyz))
    inside = (sample[:, :2] < np.add(PLACE, 20)).all(axis=1).mean()
    assert n < 900 or inside == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("order", ["as surveyed", "shuffled"])
def test_rows_and_canopies_are_those_of_the_cloud_whole(tmp_path, cloud, order, small_tiles):
    xyz = cloud.xyz if order == "as surveyed" else np.random.default_rng(0).permutation(cloud.xyz)
    parts = tiled(xyz, tmp_path / "t")
    assert len(parts.tiles) > 9
    whole, found = (map_rows(points, Settings()) for points in (cloud, parts))
    assert len(whole.rows) == 6
    for name in ("rows", "gaps"):
        assert_same_table(getattr(found, name), getattr(whole, name))
    for mine, theirs in (
        (found.dtm, whole.dtm),
        (found.chm, whole.chm),
        (found.cover, whole.cover),
        (found.field.direction, whole.field.direction),
        (found.field.spacing, whole.field.spacing),
        (found.field.likelihood, whole.field.likelihood),
    ):
        assert mine.grid == theirs.grid
        np.testing.assert_allclose(mine.values, theirs.values, rtol=0, atol=1e-6)
    one, other = (model_canopies(result, Settings()) for result in (whole, found))
    assert_same_table(other.table, one.table)
    np.testing.assert_allclose(other.polygons, one.polygons, rtol=0, atol=1e-6)


def assert_same_table(mine, theirs):
    """The same to a micrometre, or a millionth, geometries and all."""
    assert len(mine) == len(theirs)
    for a, b in zip(mine.geometry, theirs.geometry, strict=True):
        np.testing.assert_allclose(
            shapely.get_coordinates(a, include_z=True), shapely.get_coordinates(b, include_z=True), rtol=0, atol=1e-6
        )
    plain = [table.drop(columns="geometry") for table in (mine, theirs)]
    pd.testing.assert_frame_equal(*plain, check_exact=False, rtol=1e-6, atol=1e-6)


IN_TILES = Settings(reading=ReadingOptions(max_points=1000))


def test_product_of_a_cloud_in_tiles(tmp_path, survey, small_tiles):
    boundary = survey.parent / "parcels.gpkg"
    seen = []

    def step(name, function, *args, **kwargs):
        seen.extend(path.name for path in tmp_path.glob(".tiled.*/tiles/*") if name == "DTM")
        return call(name, function, *args, **kwargs)

    classified = IN_TILES.product.model_copy(update={"classified": True})
    for name, settings in (("whole", Settings()), ("tiled", IN_TILES)):
        own = settings.model_copy(update={"product": classified})
        map_parcel(survey, tmp_path / name, parcel="A", boundary=boundary, settings=own, step=step)
    assert len(seen) > 9
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiled", "whole"]
    whole, tiled = (sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("whole", "tiled"))
    assert tiled == whole
    assert "tiles" not in tiled
    records = [json.loads((tmp_path / name / "run.json").read_text()) for name in ("whole", "tiled")]
    for record in records:
        del record["files"]["A_classified.laz"]
    # Points come in another order: sums of theirs have other last digits, which make the page a few bytes longer.
    _, pages = [[record["files"].pop(name) for record in records] for name in ("A_canopy.glb", "A_report.html")]
    assert pages[0] == pytest.approx(pages[1], abs=100)
    meshes = [read_glb(paths.canopy_mesh(tmp_path / name, "A")).meshes for name in ("whole", "tiled")]
    assert [mesh.row_id for mesh in meshes[0]] == [mesh.row_id for mesh in meshes[1]] == [1, 2, 3, 4, 5, 6]
    for mine, theirs in zip(*meshes, strict=True):
        assert np.array_equal(mine.faces, theirs.faces)
        np.testing.assert_allclose(mine.vertices, theirs.vertices, rtol=0, atol=1e-3)
    for key in ("counts", "files", "origin", "modelling"):
        assert records[0][key] == records[1][key]
    for kind in ("dtm", "chm", "row_direction", "row_spacing", "vineyard_likelihood"):
        rasters = []
        for name in ("whole", "tiled"):
            with rasterio.open(paths.raster(tmp_path / name, "A", kind)) as source:
                rasters.append(source.read(1))
        np.testing.assert_allclose(*rasters, rtol=0, atol=1e-6)
    clouds = [laspy.read(paths.classified_cloud(tmp_path / name, "A")) for name in ("whole", "tiled")]
    tables = [
        in_order(np.column_stack([cloud["row_id"], np.round(cloud["HeightAboveGround"], 3), *cloud.xyz.T]))
        for cloud in clouds
    ]
    assert len(tables[0]) == records[0]["counts"]["points"]
    np.testing.assert_allclose(*tables, rtol=0, atol=1.1e-3)


def test_an_error_leaves_no_tiles(tmp_path, survey):
    def step(name, function, *args, **kwargs):
        if name == "Row field":
            assert len(list(tmp_path.glob(".A.*/tiles/*.xyz"))) > 0
            raise OSError(28, "No space left on device")
        return function(*args, **kwargs)

    with pytest.raises(OutputError, match=r"A: can't be written \(No space left on device\)"):
        map_parcel(survey, tmp_path / "A", parcel="A", settings=IN_TILES, step=step)
    assert list(tmp_path.iterdir()) == []


LIMITED = """
import resource, sys
from vinemap.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, 500_000))
main()
"""


@POSIX
@pytest.mark.parametrize("command", ["run", "survey"])
def test_a_full_disk_is_one_line(tmp_path, survey, command):
    """Files that may not grow further are written as to a full disk."""
    (tmp_path / "s.yaml").write_text("reading: {max_points: 1000}\n")
    halves = shapely.box(0, 4e6, 414_700, 5e6), shapely.box(414_700, 4e6, 5e5, 5e6)
    gpd.GeoDataFrame({"name": ["A", "B"]}, geometry=list(halves), crs=32632).to_file(tmp_path / "b.gpkg")
    words = ["--settings", "s.yaml"] if command == "run" else ["--boundaries", "b.gpkg"]
    done = python("-c", LIMITED, command, survey, "--out", tmp_path / "new" / "out", *words, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    assert "can't be written (File too large): choose another folder" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.gpkg", "s.yaml"]
