"""Files read by PDAL: what our own reader reads, and what it doesn't; names that are patterns; files that end it."""

import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
import shapely
from lasfiles import write_copc
from pyproj import CRS, Transformer
from systems import POSIX

from vinemap.cloud.las import read_cloud
from vinemap.cloud.tiles import Collector, TiledCloud
from vinemap.errors import InputError, OutsideError

UTM = CRS.from_epsg(32632)
DEGREES = CRS.from_epsg(4326)
SQUARE = shapely.box(414710, 4940710, 414730, 4940740)
ELSEWHERE = shapely.box(414910, 4940910, 414930, 4940940)


def write_las(path, xyz, crs=UTM, scales=(0.001, 0.001, 0.001), **dimensions):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.array(scales), np.floor(xyz.min(axis=0))
    if crs is not None:
        header.add_crs(crs)
    las = laspy.LasData(header)
    las.xyz = xyz
    for name, values in dimensions.items():
        las[name] = values
    las.write(path)
    return path


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform([414700, 4940700, 460], [414760, 4940750, 470], (3000, 3))


def in_degrees(xy):
    return np.column_stack(Transformer.from_crs(UTM, DEGREES, always_xy=True).transform(*xy.T))


def by_pdal(path, **options):
    return read_cloud(path, engine="pdal", **options)


def assert_same(path, **options):
    """PDAL's points are those of our own reader, in any order."""
    ours, theirs = read_cloud(path, **options), by_pdal(path, **options)
    assert (theirs.crs, theirs.vertical, theirs.remarks) == (ours.crs, ours.vertical, ours.remarks)
    assert theirs.xyz.shape == ours.xyz.shape
    order = [cloud.xyz[np.lexsort(cloud.xyz.round(3).T)] for cloud in (ours, theirs)]
    assert np.allclose(*order, rtol=0, atol=1e-6)
    return theirs


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_reads_what_our_own_reader_reads(pdal, tmp_path, points, suffix):
    assert_same(write_las(tmp_path / f"a.{suffix}", points))


def test_reads_degrees(pdal, tmp_path, points):
    xyz = np.column_stack([in_degrees(points[:, :2]), points[:, 2]])
    path = write_las(tmp_path / "a.las", xyz, CRS.from_epsg(4979), scales=(1e-9, 1e-9, 0.001))
    assert assert_same(path).crs.to_epsg() == 32632
    assert len(assert_same(path, boundary=(SQUARE, UTM)).xyz) > 500


def test_reads_feet(pdal, tmp_path):
    feet = np.random.default_rng(0).uniform([6e6, 2.1e6, 1000], [6e6 + 300, 2.1e6 + 300, 1100], (500, 3))
    assert assert_same(write_las(tmp_path / "a.laz", feet, CRS.from_epsg(2227))).xyz[:, 2].max() < 336


def test_reads_heights_of_a_stated_datum_and_another_crs_on_demand(pdal, tmp_path, points):
    path = write_las(tmp_path / "a.laz", points, CRS.from_user_input("EPSG:25832+7837"))
    assert assert_same(path).vertical == "DHHN2016 height"
    assert assert_same(path, crs=UTM).crs == UTM


def test_clips_to_a_boundary_of_parts_in_another_crs(pdal, tmp_path, points):
    parts = shapely.union_all([SQUARE, shapely.box(414740, 4940710, 414750, 4940740)])
    degrees = shapely.transform(shapely.segmentize(parts, 1), in_degrees)
    cloud = assert_same(write_las(tmp_path / "a.laz", points), boundary=(degrees, DEGREES))
    assert len(cloud.xyz) == pytest.approx(shapely.contains_xy(parts, points[:, :2]).sum(), abs=2)


def test_leaves_noise_withheld_points_and_strays_out(pdal, tmp_path, points):
    points[:2] = [[414700, 4940700, 9000], [500000, 4990000, 465]]
    classes, withheld = np.zeros((2, len(points)), dtype=np.uint8)
    classes[10:20], classes[20:25], classes[30:50], withheld[60:63] = 7, 18, 2, 1
    path = write_las(tmp_path / "a.laz", points, classification=classes, withheld=withheld)
    assert len(assert_same(path).xyz) == len(points) - 20


def test_of_a_copc_only_what_is_near_is_read(stand_in, pdal, tmp_path, points):
    pytest.importorskip("copclib", reason="needs copclib, which writes COPC files")
    path = write_copc(tmp_path / "a.copc.laz", points)
    cloud = assert_same(path, boundary=(SQUARE, UTM))
    assert len(cloud.xyz) > 500
    options = stand_in.Pipeline.made[-1].stages[0].options
    assert options["type"] == "readers.copc"
    west, east, south, north = stand_in.numbers(options["bounds"])
    assert (west, east, south, north) == pytest.approx((414710, 414730, 4940710, 4940740), abs=0.1)
    path.rename(tmp_path / "a.laz")  # which only its header tells
    assert_same(tmp_path / "a.laz", boundary=(SQUARE, UTM))
    assert stand_in.Pipeline.made[-1].stages[0].type == "readers.copc"


@pytest.mark.parametrize("name", ["a.copc.laz", "a.laz"])
def test_a_boundary_elsewhere(pdal, tmp_path, points, name):
    """Where PDAL gives no array at all."""
    pytest.importorskip("copclib", reason="needs copclib, which writes COPC files")
    path = write_copc(tmp_path / name, points) if "copc" in name else write_las(tmp_path / name, points)
    with pytest.raises(OutsideError, match="no point lies inside the boundary"):
        by_pdal(path, boundary=(ELSEWHERE, UTM))


def test_bad_clouds(pdal, tmp_path, points):
    with pytest.raises(InputError, match=r"none\.laz: no such file"):
        by_pdal(tmp_path / "none.laz")
    noise = np.full(len(points), 7, dtype=np.uint8)
    with pytest.raises(InputError, match=r"n\.las: holds no usable points"):
        by_pdal(write_las(tmp_path / "n.las", points, classification=noise))
    with pytest.raises(InputError, match="--crs EPSG:n"):
        by_pdal(write_las(tmp_path / "b.las", points, crs=None))
    (tmp_path / "text.laz").write_text("no cloud" * 100)
    (tmp_path / "a.odd").write_text("no cloud" * 100)
    for name in ("text.laz", "a.odd"):
        with pytest.raises(InputError, match=rf"{name}: can't be read by PDAL \([^\n]+\): is it whole\?$"):
            by_pdal(tmp_path / name)


def test_files_that_end_early_or_lie_elsewhere(stand_in, pdal, tmp_path, points, monkeypatch):
    path = write_las(tmp_path / "a.las", points)
    monkeypatch.setattr(stand_in, "readers_las", lambda *args, **options: [stand_in._records(points[:2000])])
    with pytest.raises(InputError, match=r"a\.las: ends after 2000 of 3000 points"):
        by_pdal(path)
    monkeypatch.setattr(stand_in, "readers_las", lambda *args, **options: [stand_in._records(points + [99, 0, 0])])
    with pytest.raises(InputError, match="points lie outside of the box that its header states"):
        by_pdal(path)


@pytest.mark.skipif(not POSIX, reason="names that other systems don't have")
@pytest.mark.parametrize("name", ["a[1].las", "a*.las", "a?.las", "~a.las", "a\\1.las"])
def test_names_that_are_patterns_are_those_of_one_file(pdal, tmp_path, points, name, monkeypatch):
    """PDAL would read a1.las instead, or as well."""
    write_las(tmp_path / "a1.las", points[:500])
    write_las(tmp_path / name, points)
    monkeypatch.chdir(tmp_path)
    assert_same(Path(name))
    assert {path.name for path in tmp_path.iterdir()} == {"a1.las", name}


@pytest.mark.skipif(not POSIX, reason="names that other systems don't have")
def test_folders_whose_names_are_patterns(pdal, tmp_path, points):
    (tmp_path / "in [2]").mkdir()
    (tmp_path / "in 2").mkdir()
    path = write_las(tmp_path / "in [2]" / "a.laz", points)
    write_las(tmp_path / "in 2" / "a.laz", points[:500])
    assert_same(path)


def test_reads_what_laspy_does_not(pdal, tmp_path, points):
    """Text and BPF, whose CRS is given: nothing asks laspy."""
    np.savetxt(tmp_path / "a.txt", points, delimiter=",", header="X,Y,Z", comments="", fmt="%.3f")
    assert np.allclose(by_pdal(tmp_path / "a.txt", crs=UTM).xyz, points, atol=0.001)
    with pytest.raises(InputError, match=r"a\.txt: .*--crs EPSG:n"):
        by_pdal(tmp_path / "a.txt")


def test_what_does_not_stream_is_read_all_the_same(stand_in, pdal, tmp_path, points):
    points.tofile(tmp_path / "a.bpf")
    assert np.array_equal(by_pdal(tmp_path / "a.bpf", crs=UTM).xyz, points)


def test_more_points_than_memory_is_for_go_to_tiles(pdal, tmp_path, points, monkeypatch):
    monkeypatch.setattr("vinemap.cloud.pdal.stages.CHUNK", 700)
    path = write_las(tmp_path / "a.laz", points)
    tiles = by_pdal(path, collector=Collector(tmp_path / "tiles", most=1000))
    assert isinstance(tiles, TiledCloud)
    held = np.concatenate([part.xyz for part in tiles.parts()])
    assert np.array_equal(*(xyz[np.lexsort(xyz.T)] for xyz in (held, read_cloud(path).xyz)))


def test_files_that_end_pdal(stand_in, tmp_path, points):
    """Its process dies of one; the next file is read by another process."""
    path = write_las(tmp_path / "a.las", points)
    bad = tmp_path / "bad.las"
    shutil.copy(path, bad)
    with bad.open("r+b") as file:
        file.seek(26)  # the program's name
        file.write(stand_in.CRASHES)
    with pytest.raises(InputError, match=r"bad\.las: can't be read by PDAL \(its process died of SIGSEGV\): is it"):
        by_pdal(bad)
    assert len(by_pdal(path).xyz) == len(points)
