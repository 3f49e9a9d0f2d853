"""Clouds in many files: tiles and flights read as one, each of them once."""

import os
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import pytest
import shapely
from lasfiles import in_order
from pyproj import CRS, Transformer
from systems import POSIX

from vinemap import paths
from vinemap.cloud.files import cloud_files
from vinemap.cloud.las import read_cloud
from vinemap.cloud.pieces import read_piece, split_cloud
from vinemap.cloud.tiles import Collector
from vinemap.errors import InputError
from vinemap.product.recipe import recipe_of

UTM = CRS.from_epsg(32632)


@dataclass
class Survey:
    """Points (n, 3), and files of those with an x below and above the middle."""

    points: np.ndarray
    tiles: list[Path]


def write(path, xyz, crs=UTM):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.min(axis=0))
    header.add_crs(crs)
    las = laspy.LasData(header)
    las.xyz = xyz
    las.write(path)
    return path


@pytest.fixture
def survey(tmp_path):
    points = np.random.default_rng(0).uniform([414700, 4940700, 460], [414760, 4940750, 470], (5000, 3)).round(3)
    west = points[:, 0] < 414730
    (tmp_path / "tiles").mkdir()
    parts = [write(tmp_path / "tiles" / f"{k}.laz", points[west == k]) for k in (1, 0)]
    return Survey(points, sorted(parts))


def test_tiles_are_read_as_one(survey, tmp_path):
    whole = read_cloud(write(tmp_path / "whole.laz", survey.points))
    cloud = read_cloud(survey.tiles)
    assert np.allclose(in_order(cloud.xyz), in_order(whole.xyz), atol=1e-6)
    square = shapely.box(414720, 4940710, 414750, 4940740), UTM
    (piece,) = split_cloud(survey.tiles, [square], tmp_path)
    assert np.array_equal(read_piece(piece, Collector()).xyz, read_cloud(survey.tiles, boundary=square).xyz)
    assert piece.clouds == tuple(survey.tiles)


def test_flights_in_other_crss_come_to_the_first_ones(survey):
    west = survey.points[survey.points[:, 0] < 414730]
    x, y = Transformer.from_crs(UTM, 3857, always_xy=True).transform(*west[:, :2].T)
    write(survey.tiles[1], np.column_stack([x, y, west[:, 2]]), CRS.from_epsg(3857))
    cloud = read_cloud(survey.tiles)
    assert cloud.crs == UTM
    assert np.allclose(in_order(cloud.xyz.round(2)), in_order(survey.points.round(2)), atol=0.02)


def test_flights_above_other_datums_are_refused(survey):
    write(survey.tiles[1], survey.points, CRS.from_user_input("EPSG:32632+5773"))
    said = r"1\.laz: its heights are above EGM96 height, those of 0\.laz above none: say with --crs EPSG:n\+m"
    with pytest.raises(InputError, match=said):
        read_cloud(survey.tiles)
    assert read_cloud(survey.tiles, crs=CRS.from_user_input("EPSG:32632+5773")).vertical == "EGM96 height"


def test_one_bad_file_is_named(survey):
    survey.tiles[1].write_bytes(b"no cloud" * 100)
    with pytest.raises(InputError, match=r"1\.laz: can't be read as LAS or LAZ"):
        read_cloud(survey.tiles)


def test_folders_and_files(survey, tmp_path):
    folder = survey.tiles[0].parent
    assert cloud_files(folder) == tuple(survey.tiles)
    assert cloud_files([folder, tmp_path / "other.laz"]) == (*survey.tiles, tmp_path / "other.laz")
    assert paths.named_by(survey.tiles) == "tiles"
    assert paths.named_by(survey.tiles[:1]) == "0"
    flights = [tmp_path / "flight 2026.05.12" / name for name in ("a.laz", "b.laz")]
    assert paths.named_by(flights) == "flight 2026.05.12"
    assert paths.named_by([tmp_path / "may.5.COPC.laz"]) == "may.5"
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty: holds no cloud"):
        cloud_files(tmp_path / "empty")
    with pytest.raises(InputError, match="there is no cloud"):
        cloud_files([])


@pytest.mark.parametrize("name", ["0 of 1.las", "again.laz"])
def test_the_same_points_under_another_name_count_once(survey, name):
    other = survey.tiles[0].with_name(name)
    laspy.read(survey.tiles[0]).write(other)
    assert set(cloud_files(other.parent)) - {other} <= set(survey.tiles)
    assert read_cloud(cloud_files(other.parent)).size == len(survey.points)


@POSIX
def test_what_is_no_file_is_one_line_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.laz")
    (tmp_path / "gone.laz").symlink_to("nowhere")
    for path in (tmp_path / "pipe.laz", tmp_path / "gone.laz", Path("/dev/zero")):
        with pytest.raises(InputError, match=f"{path}: can't be read: it is no file"):
            cloud_files(path)
    with pytest.raises(InputError, match=r"gone\.laz: can't be read: it is no file"):
        cloud_files(tmp_path)


def test_a_local_flight_and_one_on_the_globe_do_not_go_together(survey):
    write(survey.tiles[1], survey.points, CRS.from_wkt('LOCAL_CS["site",UNIT["metre",1]]'))
    with pytest.raises(InputError, match=r"1\.laz: site can't be brought to WGS 84 / UTM zone 32N, that of 0\.laz"):
        read_cloud(survey.tiles)


def test_each_cloud_counts_once(survey):
    first = survey.tiles[0]
    twin = first.with_name("0.copc.laz")
    twin.write_bytes(first.read_bytes())
    assert cloud_files(first.parent) == (twin, survey.tiles[1])
    first.with_name("0 (copy).laz").write_bytes(first.read_bytes())
    recipe = recipe_of(first.parent, parcel="A")
    assert recipe.clouds == (twin, survey.tiles[1])
    assert [source.path for source in recipe.sources] == list(recipe.clouds)
    assert recipe.key != recipe_of(first, parcel="A").key
    write(twin, survey.points)
    with pytest.raises(InputError, match="hold another number of points: keep the one that is right"):
        cloud_files(first.parent)
    twin.write_bytes(first.read_bytes()[:200])
    assert twin in cloud_files(first.parent)
    with pytest.raises(InputError, match=r"0\.copc\.laz: its header isn't whole"):
        read_cloud(cloud_files(first.parent))
