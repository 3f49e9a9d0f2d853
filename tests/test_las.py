"""Reading clouds: units, CRSs, clipping, and what can't be read."""

import laspy
import numpy as np
import pytest
import shapely
from pyproj import CRS, Transformer

from vinemap.crs import parse_crs
from vinemap.errors import InputError
from vinemap.las import read_cloud

UTM = CRS.from_epsg(32632)


def write_las(path, xyz, crs=UTM, scales=(0.001, 0.001, 0.001), classification=None, point_format=6):
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales = np.array(scales)
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    if crs is not None:
        header.add_crs(crs)
    las = laspy.LasData(header)
    las.xyz = xyz
    if classification is not None:
        las.classification = classification
    las.write(path)
    return path


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform([414700, 4940700, 460], [414760, 4940750, 470], (5000, 3))


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_reads_las_and_laz(tmp_path, points, suffix):
    cloud = read_cloud(write_las(tmp_path / f"a.{suffix}", points))
    assert cloud.crs == UTM
    assert np.allclose(cloud.xyz, points, atol=0.0006)


def test_reads_copc(tmp_path, points):
    copclib = pytest.importorskip("copclib")
    offset = copclib.Vector3(*np.floor(points.min(axis=0)))
    config = copclib.CopcConfigWriter(7, copclib.Vector3(0.001, 0.001, 0.001), offset, UTM.to_wkt())
    config.las_header.min, config.las_header.max = (
        copclib.Vector3(*corner) for corner in (points.min(axis=0), points.max(axis=0))
    )
    config.copc_info.spacing = 10
    path = tmp_path / "a.copc.laz"
    writer = copclib.FileWriter(str(path), config)
    # A root node and one of its children, which a plain reader of LAZ must find as well.
    for key, part in (((0, 0, 0, 0), points[:1000]), ((1, 0, 0, 0), points[1000:3000])):
        node = copclib.Points(writer.copc_config.las_header)
        for x, y, z in part:
            point = node.CreatePoint()
            point.x, point.y, point.z = x, y, z
            node.AddPoint(point)
        writer.AddNode(copclib.VoxelKey(*key), node)
    writer.Close()
    cloud = read_cloud(path)
    assert cloud.crs == UTM
    assert len(cloud.xyz) == 3000
    order = [xyz[np.lexsort(xyz.T)] for xyz in (cloud.xyz.round(3), points[:3000].round(3))]
    assert np.allclose(*order, atol=0.0011)


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


def test_empty_cloud(tmp_path):
    with pytest.raises(InputError, match="holds no points"):
        read_cloud(write_las(tmp_path / "a.las", np.empty((0, 3))))


def test_all_noise(tmp_path, points):
    with pytest.raises(InputError, match="no usable points"):
        read_cloud(write_las(tmp_path / "a.las", points, classification=np.full(len(points), 7, dtype=np.uint8)))


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
