"""Reading clouds: units, CRSs, clipping, and what can't be read."""

import struct

import laspy
import numpy as np
import pytest
import shapely
from lasfiles import in_order, write_copc
from pyproj import CRS, Transformer

from vinemap.cloud import copc, las
from vinemap.cloud.las import read_cloud
from vinemap.errors import InputError
from vinemap.geo.crs import parse_crs

UTM = CRS.from_epsg(32632)


def write_las(path, xyz, crs=UTM, scales=(0.001, 0.001, 0.001), classification=None, point_format=6, withheld=None):
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales = np.array(scales)
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    if crs is not None:
        header.add_crs(crs)
    data = laspy.LasData(header)
    data.xyz = xyz
    if classification is not None:
        data.classification = classification
    if withheld is not None:
        data.withheld = withheld
    data.write(path)
    return path


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform([414700, 4940700, 460], [414760, 4940750, 470], (5000, 3)).round(3)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_reads_las_and_laz(tmp_path, points, suffix):
    cloud = read_cloud(write_las(tmp_path / f"a.{suffix}", points))
    assert cloud.crs == UTM
    assert np.allclose(cloud.xyz, points, atol=0.0006)


def index_of(path):
    """Where the root page of a COPC file's index lies."""
    from laspy import CopcReader

    with CopcReader.open(path) as reader:
        begin = reader.copc_info.hierarchy_root_offset
        return begin, begin + reader.copc_info.hierarchy_root_size


@pytest.fixture
def through(monkeypatch):
    """Read through what would be queried by box."""

    def read(*args, **kwargs):
        with monkeypatch.context() as patch:
            patch.setattr(las, "SMALL", 0.0)
            return read_cloud(*args, **kwargs)

    return read


@pytest.fixture
def queried(monkeypatch):
    """Read, and fail where a file is read through."""

    def read(*args, **kwargs):
        with monkeypatch.context() as patch:
            patch.delattr(laspy.LasReader, "chunk_iterator")
            return read_cloud(*args, **kwargs)

    return read


CORNER = shapely.Polygon([(414701, 4940702), (414723, 4940707), (414712, 4940722)])


def test_reads_copc(tmp_path, points):
    cloud = read_cloud(write_copc(tmp_path / "a.copc.laz", points))
    assert cloud.crs == UTM
    assert np.allclose(in_order(cloud.xyz), in_order(points), atol=0.0011)


@pytest.mark.parametrize("levels", [1, 4])
def test_a_box_of_a_copc_is_what_reading_through_gives(tmp_path, points, queried, through, levels):
    path = write_copc(tmp_path / "a.copc.laz", points, levels=levels)
    found, clipped = (in_order(read(path, boundary=(CORNER, UTM)).xyz) for read in (queried, through))
    assert np.array_equal(found, clipped)
    inside = in_order(points[shapely.contains_xy(CORNER, points[:, :2])])
    assert len(inside) > 250
    assert np.allclose(found, inside, atol=1e-6)


def test_a_box_of_a_copc_in_degrees(tmp_path, points, queried, through):
    lon, lat = Transformer.from_crs(32632, 4326, always_xy=True).transform(points[:, 0], points[:, 1])
    degrees = np.column_stack([lon, lat, points[:, 2]])
    path = write_copc(tmp_path / "a.copc.laz", degrees, crs=CRS.from_epsg(4326), scales=(1e-9, 1e-9, 0.001))
    found, clipped = (read(path, boundary=(CORNER, UTM)) for read in (queried, through))
    assert found.crs == clipped.crs == UTM
    assert np.array_equal(in_order(found.xyz), in_order(clipped.xyz))
    assert len(found.xyz) == pytest.approx(shapely.contains_xy(CORNER, points[:, :2]).sum(), abs=2)


def test_noise_and_withheld_points_of_a_box_are_left_out(tmp_path, points, queried):
    inside = np.flatnonzero(shapely.contains_xy(CORNER, points[:, :2]))
    path = write_copc(tmp_path / "a.copc.laz", points, noise=set(inside[:10]), withheld=set(inside[10:30]))
    found = queried(path, boundary=(CORNER, UTM)).xyz
    assert np.allclose(in_order(found), in_order(points[inside[30:]]), atol=0.0011)


def test_a_wide_polygon_or_too_many_points_are_read_through(tmp_path, points, queried, monkeypatch):
    path = write_copc(tmp_path / "a.copc.laz", points)
    wide = shapely.box(414705, 4940705, 414755, 4940745)
    with pytest.raises(InputError, match="chunk_iterator"):
        queried(path, boundary=(wide, UTM))
    monkeypatch.setattr(copc, "MOST_FOUND", 1000)
    with pytest.raises(InputError, match="chunk_iterator"):
        queried(path, boundary=(CORNER, UTM))


@pytest.mark.parametrize("broken", ["zeros", "ones", "half", "swapped"])
def test_a_copc_with_a_broken_index_is_read_through(tmp_path, points, broken):
    path = write_copc(tmp_path / "a.copc.laz", points)
    whole = read_cloud(path, boundary=(CORNER, UTM)).xyz
    data, (begin, end) = path.read_bytes(), index_of(path)
    index = data[begin:end]
    index = {
        "zeros": bytes(len(index)),
        "ones": b"\xff" * len(index),
        "half": index[: len(index) // 64 * 32] + bytes(len(index) - len(index) // 64 * 32),
        "swapped": index[::-1],
    }[broken]
    path.write_bytes(data[:begin] + index + data[end:])
    assert np.array_equal(in_order(read_cloud(path, boundary=(CORNER, UTM)).xyz), in_order(whole))


@pytest.mark.parametrize("part", [0.3, 0.7])
def test_a_copc_cut_short(tmp_path, points, part):
    path = write_copc(tmp_path / "a.copc.laz", points)
    path.write_bytes(path.read_bytes()[: int(part * index_of(path)[0])])
    for boundary in (None, (CORNER, UTM)):
        with pytest.raises(InputError, match=r"a\.copc\.laz: ends before .* copy or download it again"):
            read_cloud(path, boundary=boundary, crs=UTM)


@pytest.mark.parametrize("suffix", ["laz", "copc.laz"])
@pytest.mark.parametrize("away", [(70.0, 0.0), (0.0, 1e7), (-414700.0, -4940700.0)])
def test_polygon_beside_the_cloud(tmp_path, points, suffix, away):
    write = write_copc if suffix == "copc.laz" else write_las
    path = write(tmp_path / f"a.{suffix}", points)
    beside = shapely.transform(CORNER, lambda xy: xy + away)
    with pytest.raises(InputError, match=r"a\..*laz: no point lies inside the boundary"):
        read_cloud(path, boundary=(beside, UTM))


def test_clips_to_a_polygon_in_another_crs(tmp_path, points):
    square = shapely.box(414710, 4940710, 414730, 4940740)
    to_degrees = Transformer.from_crs(32632, 4326, always_xy=True).transform
    degrees = shapely.transform(shapely.segmentize(square, 1), lambda c: np.column_stack(to_degrees(*c.T)))
    cloud = read_cloud(write_las(tmp_path / "a.laz", points), boundary=(degrees, CRS.from_epsg(4326)))
    assert len(cloud.xyz) == pytest.approx(shapely.contains_xy(square, points[:, :2]).sum(), abs=2)


def test_degrees_become_utm(tmp_path, points):
    lon, lat = Transformer.from_crs(32632, 4326, always_xy=True).transform(points[:, 0], points[:, 1])
    path = write_las(
        tmp_path / "a.las", np.column_stack([lon, lat, points[:, 2]]), CRS.from_epsg(4979), scales=(1e-9, 1e-9, 0.001)
    )
    cloud = read_cloud(path)
    assert cloud.crs.to_epsg() == 32632
    assert np.allclose(cloud.xyz, points, atol=0.002)


def test_feet_become_metres(tmp_path):
    feet = np.random.default_rng(0).uniform([6e6, 2.1e6, 1000], [6e6 + 300, 2.1e6 + 300, 1100], (500, 3))
    cloud = read_cloud(write_las(tmp_path / "a.laz", feet, CRS.from_epsg(2227)))
    assert cloud.crs.to_epsg() == 32610
    assert np.ptp(cloud.xyz, axis=0) == pytest.approx(np.ptp(feet, axis=0) * 0.3048, rel=0.02)
    assert cloud.xyz[:, 2].mean() == pytest.approx(feet[:, 2].mean() * 1200 / 3937, abs=0.01)


def test_compound_crs_names_its_vertical_datum(tmp_path, points):
    cloud = read_cloud(write_las(tmp_path / "a.laz", points, CRS.from_user_input("EPSG:25832+7837")))
    assert cloud.crs.to_epsg() == 25832
    assert cloud.vertical == "DHHN2016 height"


def test_noise_classes_and_strays_are_left_out(tmp_path, points):
    points[0] = [414700, 4940700, 9000]
    points[1] = [500000, 4990000, 465]
    classes = np.zeros(len(points), dtype=np.uint8)
    classes[10:20] = 7
    cloud = read_cloud(write_las(tmp_path / "a.laz", points, classification=classes))
    assert len(cloud.xyz) == len(points) - 12


@pytest.mark.parametrize("point_format", [3, 6])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_withheld_points_are_left_out(tmp_path, points, suffix, point_format):
    withheld = np.arange(len(points)) % 7 == 0
    classes = np.where(np.arange(len(points)) % 5 == 0, 18 if point_format == 6 else 7, 2).astype(np.uint8)
    path = write_las(
        tmp_path / f"a.{suffix}", points, classification=classes, withheld=withheld, point_format=point_format
    )
    assert np.allclose(read_cloud(path).xyz, points[~withheld & (classes == 2)], atol=0.0006)


def test_chunks_come_in_the_files_order_and_the_file_is_closed(tmp_path, points, monkeypatch):
    monkeypatch.setattr(las, "CHUNK", 700)
    path = write_las(tmp_path / "a.laz", points)
    assert np.allclose(read_cloud(path).xyz, points, atol=0.0006)
    with las.open_cloud(path) as (_, chunks):
        assert len(next(chunks)) == 700
    assert read_cloud(path, boundary=(CORNER, UTM)).size == shapely.contains_xy(CORNER, points[:, :2]).sum()


def test_a_fault_while_points_are_taken_is_the_takers(tmp_path, points, monkeypatch):
    monkeypatch.setattr(las, "CHUNK", 700)

    class Full:
        size = 0

        def add(self, xyz):
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        read_cloud(write_las(tmp_path / "a.laz", points), collector=Full())


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"none\.laz: no such file"):
        read_cloud(tmp_path / "none.laz")


def test_no_las_at_all(tmp_path):
    path = tmp_path / "a.laz"
    path.write_bytes(b"not a point cloud" * 100)
    with pytest.raises(InputError, match=r"a\.laz: can't be read"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("part", [0.3, 0.9, 0.999])
def test_truncated_file(tmp_path, points, suffix, part):
    whole = write_las(tmp_path / f"a.{suffix}", points).read_bytes()
    path = tmp_path / f"b.{suffix}"
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(InputError, match=r"b\."):
        read_cloud(path)


def test_a_panic_of_the_decompressor_is_one_line(tmp_path, points, monkeypatch):
    class PanicException(BaseException):
        pass

    def panic(reader, size):
        raise PanicException("capacity overflow")

    path = write_las(tmp_path / "a.laz", points)
    monkeypatch.setattr(laspy.LasReader, "chunk_iterator", panic)
    with pytest.raises(InputError, match=r"a\.laz: can't be read as LAS or LAZ \(capacity overflow\)"):
        read_cloud(path)


def test_empty_cloud(tmp_path):
    with pytest.raises(InputError, match="holds no points"):
        read_cloud(write_las(tmp_path / "a.las", np.empty((0, 3))))


def test_all_noise(tmp_path, points):
    with pytest.raises(InputError, match="no usable points"):
        read_cloud(write_las(tmp_path / "a.las", points, classification=np.full(len(points), 7, dtype=np.uint8)))


def test_tiles_without_points_are_left_out_and_named(tmp_path, points):
    noise = {"classification": np.full(len(points), 7, dtype=np.uint8)}
    empty, noisy = write_las(tmp_path / "a.las", np.empty((0, 3))), write_las(tmp_path / "b.las", points, **noise)
    cloud = read_cloud([empty, write_las(tmp_path / "c.las", points), noisy])
    assert cloud.size == len(points)
    assert cloud.remarks == tuple(f"{name} holds no usable points, and is left out" for name in ("a.las", "b.las"))
    with pytest.raises(InputError, match="no usable points"):
        read_cloud([empty, noisy])


def test_coordinates_that_are_no_numbers(tmp_path, points):
    path = write_las(tmp_path / "a.las", points)
    data = bytearray(path.read_bytes())
    data[131:139] = np.array([np.nan]).tobytes()
    path.write_bytes(data)
    with pytest.raises(InputError, match="is no number"):
        read_cloud(path)


def test_absurd_coordinates(tmp_path, points):
    points[::2, 0] += 3e5
    with pytest.raises(InputError, match="span"):
        read_cloud(write_las(tmp_path / "a.las", points, scales=(0.01, 0.01, 0.01)))


def test_no_crs(tmp_path, points):
    path = write_las(tmp_path / "a.las", points, crs=None)
    with pytest.raises(InputError, match="--crs EPSG:n"):
        read_cloud(path)
    assert read_cloud(path, crs=UTM).crs == UTM


def test_degrees_without_a_crs(tmp_path):
    points = np.random.default_rng(0).uniform([7.9, 44.6, 400], [7.9001, 44.6001, 410], (500, 3))
    path = write_las(tmp_path / "a.las", points, crs=None, scales=(1e-8, 1e-8, 0.001))
    with pytest.raises(InputError, match="EPSG:4326"):
        read_cloud(path)


def test_metres_given_as_degrees(tmp_path, points):
    path = write_las(tmp_path / "a.las", points, crs=None)
    with pytest.raises(InputError, match="can't be degrees"):
        read_cloud(path, crs=parse_crs("EPSG:4326"))


def test_boundary_that_misses_the_cloud(tmp_path, points):
    path = write_las(tmp_path / "a.laz", points)
    with pytest.raises(InputError, match="no point lies inside the boundary"):
        read_cloud(path, boundary=(shapely.box(0, 0, 10, 10), UTM))


def test_a_box_that_was_never_set(tmp_path, points):
    path = write_las(tmp_path / "a.las", points)
    data = bytearray(path.read_bytes())
    data[179:227] = struct.pack("<6d", *[-1.7e308, 1.7e308] * 3)
    path.write_bytes(data)
    assert read_cloud(path).size == len(points)
