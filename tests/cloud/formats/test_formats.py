"""Clouds in other formats are the same points as in LAS, and what can't be read says why."""

import json

import formats
import numpy as np
import pytest
import shapely
from lasfiles import in_order
from pyproj import CRS

from vinemap import paths
from vinemap.cloud.files import cloud_files, is_cloud
from vinemap.cloud.formats import ept
from vinemap.cloud.formats.identity import digest_of, stamp_of
from vinemap.cloud.formats.text import read_text
from vinemap.cloud.las import read_cloud
from vinemap.compute import extras
from vinemap.errors import DependencyError, InputError
from vinemap.geo.crs import parse_crs

UTM = CRS.from_epsg(32632)
HEAD = "element camera 2\nproperty float x\nproperty int k\n"


@pytest.fixture(scope="module")
def points():
    low, high = (414_700, 4_940_700, 460), (414_760, 4_940_750, 470)
    return np.random.default_rng(0).uniform(low, high, (4_000, 3)).round(3)


WRITERS = {
    "little.ply": formats.write_ply,
    "big.ply": lambda path, xyz: formats.write_ply(path, xyz, order=">"),
    "text.PLY": lambda path, xyz: formats.write_ply(path, xyz, order="ascii"),
    "packed.pcd": formats.write_pcd,
    "text.pcd": lambda path, xyz: formats.write_pcd(path, xyz, form="ascii"),
    "plain.xyz": formats.write_text,
    "counted.pts": lambda path, xyz: formats.write_text(path, xyz, head=f"{len(xyz)}\n"),
    "cloudcompare.txt": lambda path, xyz: formats.write_text(path, xyz, head="//X,Y,Z\n", sep=","),
    "named.csv": lambda path, xyz: formats.write_text(
        path, xyz, head="# made here\nNorthing (m),Easting (m),Height (m)\n", sep=",", order=[1, 0, 2]
    ),
    "comma.csv": lambda path, xyz: formats.write_text(path, xyz, head="\ufeffX;Y;Z\n", sep=";", decimal=","),
    "tab.asc": lambda path, xyz: formats.write_text(path, xyz, sep="\t", decimal=","),
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_same_points(tmp_path, points, name):
    path = WRITERS[name](tmp_path / name, points)
    cloud = read_cloud(path, crs=UTM)
    assert cloud.crs == UTM
    assert np.abs(cloud.xyz - points).max() < 1e-6
    with pytest.raises(InputError, match=rf"{name}: states no CRS for its coordinates: give it with --crs EPSG:n"):
        read_cloud(path)


@pytest.mark.parametrize("kind", ["laszip", "binary"])
def test_entwine_point_tiles(tmp_path, points, kind, monkeypatch):
    formats.write_ept(tmp_path / "odm", points, UTM, kind=kind)
    files = cloud_files(tmp_path / "odm")
    assert paths.named_by(files) == paths.named_by(cloud_files(tmp_path)) == "odm"
    cloud = read_cloud(files)
    assert cloud.crs == UTM
    assert np.abs(in_order(cloud.xyz) - in_order(points)).max() < 1e-6
    read, count = [], ept._check
    monkeypatch.setattr(ept, "_check", lambda node, *counts: read.append(node) or count(node, *counts))
    polygon = shapely.box(414_702, 4_940_702, 414_708, 4_940_709)
    part = read_cloud(files, boundary=(polygon, UTM))
    assert len(read) < 0.3 * len(list((tmp_path / "odm" / "ept-data").iterdir()))
    assert np.array_equal(in_order(part.xyz), in_order(cloud.xyz[shapely.contains_xy(polygon, cloud.xyz[:, :2])]))


def test_all_files_of_tiles_are_looked_at(tmp_path, points):
    path = formats.write_ept(tmp_path / "odm", points[:500], UTM)
    before, digest = stamp_of(path), digest_of(path)
    node = next((tmp_path / "odm" / "ept-data").iterdir())
    formats.write_las(node, points[:3], None)
    assert stamp_of(path) != before
    assert digest_of(path) != digest
    with pytest.raises(InputError, match=rf"{node.name}: holds 3 points, and the hierarchy counts \d+: copy"):
        read_cloud(path)
    node.unlink()
    with pytest.raises(InputError, match=rf"{node.name}: no such file"):
        read_cloud(path)


def test_scans_of_e57(tmp_path, points):
    """Two scans, each turned and moved, one with points that aren't valid."""
    pye57 = pytest.importorskip("pye57", reason="needs pye57: pip install 'vinemap[e57]'")
    path, centre = tmp_path / "a.e57", points.mean(axis=0).round()
    with pye57.E57(str(path), mode="w") as file:
        for k, turn in enumerate((0.0, 0.5)):
            own = (points[k::2] - centre) @ [
                [np.cos(turn), -np.sin(turn), 0],
                [np.sin(turn), np.cos(turn), 0],
                [0, 0, 1],
            ]
            columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), own.T.copy(), strict=True))
            flag = {"cartesianInvalidState": (np.arange(len(own)) < 5).astype("i1")} if k else {}
            pose = {"rotation": np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)]), "translation": centre}
            file.write_scan_raw(columns | flag, name=str(k), **pose)
    expected = np.concatenate([points[::2], points[1::2][5:]])
    assert np.abs(read_cloud(path, crs=UTM).xyz - expected).max() < 1e-6  # though written in single precision
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(InputError, match=r"a\.e57: can't be read as E57 \(.*\): is it whole"):
        read_cloud(path, crs=UTM)


def test_without_what_reads_e57(tmp_path, monkeypatch):
    def absent(module):
        raise ModuleNotFoundError(module)

    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    monkeypatch.setattr(extras, "import_module", absent)
    with pytest.raises(DependencyError, match=r"reading E57 needs pye57, .*: pip install 'vinemap\[e57\]'"):
        read_cloud(tmp_path / "a.e57", crs=UTM)


def test_a_compressed_pcd(tmp_path, points):
    open3d = pytest.importorskip("open3d", reason="needs Open3D: pip install 'vinemap[mesh]'", exc_type=ImportError)
    near = points - np.floor(points.min(axis=0))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(near))
    open3d.io.write_point_cloud(str(tmp_path / "a.pcd"), cloud, compressed=True)
    found = read_cloud(tmp_path / "a.pcd", crs=CRS.from_wkt(LOCAL))
    assert np.abs(found.xyz - near).max() < 1e-9


LOCAL = 'ENGCRS["local",EDATUM["local"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'


def test_several_formats_at_once(tmp_path, points):
    formats.write_ply(tmp_path / "a.ply", points[:1000])
    formats.write_pcd(tmp_path / "b.pcd", points[1000:2000])
    formats.write_las(tmp_path / "c.laz", points[2000:3000], UTM)
    formats.write_ply(tmp_path / "c.ply", points[2000:3000])  # the same, as programs leave them
    formats.write_text(tmp_path / "log.csv", points[:10])
    (tmp_path / "ortho.tif").write_bytes(b"a photograph")
    files = cloud_files([tmp_path, formats.write_text(tmp_path / "d.txt", points[3000:])])
    assert [path.name for path in files] == ["a.ply", "b.pcd", "c.laz", "d.txt"]
    assert np.abs(read_cloud(files, crs=UTM).xyz - points).max() < 1e-6
    assert not is_cloud(tmp_path / "log.csv")


def test_noise_and_what_is_no_number_are_left_out(tmp_path):
    rows = [
        "414700.5 4940700.5 460.1 2",
        "414701.5 4940701.5 460.2 7",
        "414702.5 4940702.5 nan 2",
        "414703.5 4940703 460 1",
    ]
    (tmp_path / "a.xyz").write_text("# x y z Classification\n" + "\n".join(rows))
    assert read_cloud(tmp_path / "a.xyz", crs=UTM).xyz[:, 0].tolist() == [414700.5, 414703.5]


NAMED = [
    ("X,Y,Height_Above_Ground,Z", "124"),
    ("Height (above ground),Elevation (m),Easting (m),Northing (m)", "342"),
    ("N,X,Y,Z", "234"),
    ("N,lon,lat,Height", "234"),
    ("No,lat,lon,h,E,N", "564"),
    ("z_dtm,Y_utm,X_utm,z", "324"),
    ("h,Altitude,North,East", "432"),
    ("Y,X,Elev,", "213"),
]


@pytest.mark.parametrize(("names", "order"), NAMED)
def test_columns_are_told_by_the_likeliest_names(tmp_path, names, order):
    xyz = dict(zip(order, (414_700, 4_940_700, 469), strict=True))
    values = [str(xyz.get(str(k + 1), 1)) for k in range(len(names.strip(",").split(",")))]
    (tmp_path / "a.csv").write_text(f"{names}\n{','.join(values)}\n")
    (found,) = read_text(tmp_path / "a.csv").chunks
    assert found.tolist() == [[414_700, 4_940_700, 469]]


FEET, SURVEY = 0.3048, 1200 / 3937


@pytest.mark.parametrize(
    ("names", "metres"),
    [
        ("X,Y,Z", 1),
        ("X(m),Y(m),Z [ft]", FEET),
        ("Easting,Northing,Elevation (US ft)", SURVEY),
        ("x,y,height_ft", FEET),
        ("x,y,Z (US survey feet)", SURVEY),
        ("x,y,Z (NAVD88)", 1),
        ("X (m) Y (m) Z [US ft]", SURVEY),
    ],
)
def test_heights_are_in_the_unit_behind_their_name(tmp_path, points, names, metres):
    sep = "," if "," in names else " "
    path = formats.write_text(tmp_path / "a.csv", points[:100], head=f"{names}\n", sep=sep)
    assert read_cloud(path, crs=UTM).xyz[:, 2] == pytest.approx(metres * points[:100, 2])


@pytest.mark.parametrize(
    ("names", "crs", "said"),
    [
        ("X [ft],Y,Z", "EPSG:32632", "its x tells a unit of 0.3048 m, but WGS 84 / UTM zone 32N has metre"),
        ("X,Y,Z [ft]", "EPSG:32632+5773", r"its z tells a unit of 0.3048 m, but .* EGM96 height has 1 m"),
        ("X,Y,Z [ft]", "local", "its z tells a unit of 0.3048 m, but local metres has 1 m"),
    ],
)
def test_a_unit_behind_a_name_that_is_not_the_crss_is_refused(tmp_path, points, names, crs, said):
    path = formats.write_text(tmp_path / "a.csv", points[:100], head=f"{names}\n", sep=",")
    with pytest.raises(InputError, match=rf"a\.csv: the name of {said}: give the CRS that the coordinates have"):
        read_cloud(path, crs=parse_crs(crs))


def test_what_stands_before_the_points(tmp_path, points):
    whole = formats.write_ply(tmp_path / "a.ply", points, before=HEAD)
    data = whole.read_bytes().replace(b"end_header\n", b"end_header\n" + bytes(16), 1)
    whole.write_bytes(data)
    assert np.array_equal(read_cloud(whole, crs=UTM).xyz, points)


TEXT_PLY = b"ply\nformat ascii 1.0\n"
WRONG = [
    ("a.ply", b"ply of mine", "it doesn't begin as such a file"),
    (
        "a.ply",
        b"ply\nformat ascii 1.0\nelement face 3\nproperty float x\nend_header\n",
        "holds no points: export the cloud",
    ),
    (
        "a.ply",
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty list uchar int x\nend_header\n",
        "lists stand before",
    ),
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n", "its points have no y"),
    ("a.ply", b"ply\nformat ascii 1.0\nvertices 3\n", "its header has a line 'vertices 3'"),
    ("a.pcd", b"VERSION .7\nFIELDS x y z\n", "can't be read as PCD: it doesn't begin as such a file"),
    ("a.xyz", b"one two three\nfour five six\n", "no line of it begins with x, y and z"),
    ("a.csv", b"X,Y,Z_dsm,z_dtm\n1,2,3,4\n", "any of its columns Z_dsm, z_dtm may be z: rename what isn't"),
    ("a.csv", b"X,Y,Height_above_ground\n1,2,3\n", r"its names \(X, Y, Height_above_ground\) say x and y, but no z"),
    ("a.csv", b"Y;X;Z;Class\n1;2;3\n", r"it has 4 names \(Y, X, Z, Class\), but 3 numbers a point: give each a name"),
    ("a.asc", b"ncols 3\nnrows 1\n460 461 462\n", "is a raster as text: convert it to GeoTIFF, and give that"),
    ("a.xyz", bytes(100), "can't be read as text: it is packed"),
    ("a.xyz", b"414700 4940700 460\nbroken off here\n", r"can't be read as text \(could not convert"),
    ("a.tif", b"II*\0 no raster", "can't be read as GeoTIFF"),
    ("ept.json", b"{}", "can't be read as EPT"),
]


@pytest.mark.parametrize(("name", "content", "reason"), WRONG)
def test_what_cannot_be_read_says_why(tmp_path, name, content, reason):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"{name}: .*{reason}") as caught:
        read_cloud(tmp_path / name, crs=UTM)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["little.ply", "packed.pcd", "text.PLY", "text.pcd"])
def test_a_file_that_was_cut_off(tmp_path, points, name):
    path = WRITERS[name](tmp_path / name, points)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=rf"{name}: ends after [\d,]+ of 4,000 points: copy or download it again"):
        read_cloud(path, crs=UTM)


def test_coordinates_in_single_precision_are_refused(tmp_path, points):
    near = points.mean(axis=0) + 0.2 * (points - points.mean(axis=0))
    path = formats.write_text(tmp_path / "a.xyz", near.astype(np.float32))
    with pytest.raises(InputError, match=r"a\.xyz: its y is stored in steps of 0\.5"):
        read_cloud(path, crs=UTM)


def test_tiles_packed_in_another_way(tmp_path, points):
    path = formats.write_ept(tmp_path, points[:200], UTM)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"dataType": "zstandard"}))
    with pytest.raises(InputError, match="its points are packed as zstandard: export them as LAZ or COPC"):
        read_cloud(path)
