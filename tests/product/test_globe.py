"""3D Tiles: placed vertices brought back to WGS 84, volumes that hold them, and heights above a geoid."""

import json
import math
from urllib.parse import unquote

import geopandas as gpd
import numpy as np
import pyproj
import pytest
import rasterio
import shapely
import trimesh
from products import map_here
from pyproj import CRS, Transformer

from vinemap import paths
from vinemap.canopy.mesh import Mesh, loft
from vinemap.config.settings import Settings
from vinemap.config.surveys import survey_config
from vinemap.geo.crs import to_wgs84
from vinemap.geo.geoid import find_geoid
from vinemap.jobs.survey import _write_tileset
from vinemap.product.globe import parcel_tileset, survey_tileset
from vinemap.product.gltf import write_glb

Y_UP_TO_Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
"""What a reader of 3D Tiles does to glTF."""
UTM = CRS.from_epsg(32632)
PLACE = np.array([660_000.0, 4_950_000.0, 300.0])
"""160 km from the central meridian: north of the grid is 1.4° off."""


def to_geodetic(ecef):
    """Longitude, latitude (degrees) and ellipsoidal height of points (n, 3) on the globe."""
    return np.column_stack(Transformer.from_crs(4978, 4979, always_xy=True).transform(*ecef.T))


def metres(lon_lat, others):
    """Distances (n,) in space of points in degrees and metres."""
    convert = Transformer.from_crs(4979, 4978, always_xy=True).transform
    return np.linalg.norm(np.column_stack(convert(*lon_lat.T)) - np.column_stack(convert(*others.T)), axis=1)


def matrix_of(tile):
    return np.reshape(tile.get("transform", np.eye(4)), (4, 4)).T


def placed(path):
    """Vertices (n, 3) on the globe of the content of a parcel's tileset, read by trimesh."""
    root = json.loads(path.read_text())["root"]
    scene = trimesh.load_scene(path.parent / unquote(root["content"]["uri"]), process=False)
    points = np.concatenate([mesh.vertices for mesh in scene.dump()]) @ Y_UP_TO_Z_UP.T
    return points @ matrix_of(root)[:3, :3].T + matrix_of(root)[:3, 3]


def beyond(box, points):
    """Metres by which points are outside of a box (4, 3), at the most."""
    centre, axes = box[0], box[1:]
    half = np.linalg.norm(axes, axis=1)
    return (np.abs((points - centre) @ (axes / half[:, None]).T) - half).max()


def box_of(tile):
    """A tile's box (4, 3) on the globe."""
    box, matrix = np.reshape(tile["boundingVolume"]["box"], (4, 3)), matrix_of(tile)
    return np.vstack([matrix[:3, :3] @ box[0] + matrix[:3, 3], box[1:] @ matrix[:3, :3].T])


def corners(box):
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    return box[0] + signs @ box[1:]


def field(place=PLACE, reach=500.0):
    """Rows of a mesh to as many metres from a place."""
    rows = []
    for k, north in enumerate(np.linspace(-reach, reach, 3)):
        east = np.linspace(-reach, reach, 5)
        ring = [[0, 0.5, 0], [0, 0, 2], [0, -0.5, 0]]
        polygons = place + np.column_stack([east, np.full(5, north), 0.02 * east])[:, None] + ring
        rows.append(Mesh(*loft(polygons), row_id=k + 1, label=f"{k + 1} F"))
    return rows


def write(folder, *, plain=False, name="F", place=PLACE, reach=500.0, crs=UTM, **heights):
    """A product's mesh and tileset, as far as they go; gives the meshes and the tileset's file."""
    folder.mkdir(parents=True, exist_ok=True)
    meshes, file = field(place, reach), paths.canopy_mesh(folder, name)
    write_glb(meshes, file, origin=place, crs="EPSG:32632", plain=plain)
    tileset = parcel_tileset(meshes, file.name, origin=place, crs=crs, **({"vertical": None} | heights))
    paths.tileset(folder).write_text(json.dumps(tileset))
    return meshes, paths.tileset(folder)


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize(("reach", "most"), [(100, 0.01), (500, 0.05)])
def test_vertices_come_to_where_they_are(tmp_path, plain, reach, most):
    meshes, path = write(tmp_path, plain=plain, reach=reach)
    convert = Transformer.from_crs(UTM, 4326, always_xy=True).transform
    x, y, z = np.concatenate([mesh.vertices for mesh in meshes]).T
    truth = np.column_stack([*convert(x, y), z])
    found = to_geodetic(placed(path))
    away = np.array([metres(found, np.tile(point, (len(found), 1))).min() for point in truth])
    assert away.max() < most
    said = json.loads(path.read_text())["asset"]["extras"]["placement_error_m"]
    assert away.max() - 0.02 < said < most
    assert said > 0.9 * 2 * (reach**2) / (2 * 6_371_000)  # the corner's d²/2R


def test_the_grid_is_turned_and_scaled_to_the_globe(tmp_path):
    _, path = write(tmp_path)
    matrix = matrix_of(json.loads(path.read_text())["root"])
    factors = pyproj.Proj(UTM).get_factors(*to_wgs84(PLACE, UTM)[0, 1::-1])
    lat, lon, _ = np.radians(to_wgs84(PLACE, UTM)[0])
    east = np.array([-math.sin(lon), math.cos(lon), 0])
    north = np.array([-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)])
    turned = math.degrees(math.atan2(matrix[:3, 1] @ east, matrix[:3, 1] @ north))
    assert abs(factors.meridian_convergence) > 1.4
    assert turned == pytest.approx(factors.meridian_convergence, abs=1e-4)
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    # At 300 m the ellipsoid's normals have spread by 300 m / R.
    assert scale == pytest.approx([(1 + 300 / 6.38e6) / factors.meridional_scale] * 2 + [1], abs=1e-6)


def test_the_box_holds_all_and_no_more(tmp_path):
    _, path = write(tmp_path)
    tileset = json.loads(path.read_text())
    box, points = box_of(tileset["root"]), placed(path)
    assert -0.02 < beyond(box, points) < 0
    for axis in box[1:]:
        along = (points - box[0]) @ axis / np.linalg.norm(axis)
        assert np.ptp(along) == pytest.approx(2 * np.linalg.norm(axis), abs=0.03)
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["geometricError"] == pytest.approx(np.hypot(1001, 1000), rel=0.01)
    assert (tileset["root"]["refine"], tileset["root"]["geometricError"]) == ("ADD", 0)


def test_rows_without_canopy_have_no_tileset():
    nothing = [Mesh(np.empty((0, 3)), np.empty((0, 3), dtype=int), label="1 F")]
    for meshes in ([], nothing):
        assert parcel_tileset(meshes, "F.glb", origin=PLACE, crs=UTM, vertical=None) is None


# Heights


def extras(**heights):
    tileset = parcel_tileset(field(), "F.glb", origin=PLACE, crs=UTM, **heights)
    return tileset["asset"]["extras"]


def height_of(folder, **heights):
    """Ellipsoidal heights of the placed vertices, of which the lowest stands at 290 m above the datum."""
    return to_geodetic(placed(write(folder, **heights)[1]))[:, 2]


@pytest.mark.parametrize(
    ("vertical", "given", "geoid", "words"),
    [
        (None, 48.6, 48.6, "the setting product.geoid"),
        ("EGM96 height", 48.6, 48.6, "the setting product.geoid"),
        (None, None, 0, "states no vertical datum"),
        ("ellipsoidal height", None, 0, "heights are ellipsoidal"),
        ("WGS 84 Ellipsoid (m)", None, 0, "heights are ellipsoidal"),
        ("the cellar's floor", None, 0, "doesn't know \"the cellar's floor\""),
        ("EPSG:5773", None, 0, "doesn't know 'EPSG:5773'"),
        ("EGM96 height", None, 0, "no geoid grid for 'EGM96 height'"),
        # PROJ's best is to leave such heights alone.
        ("DHHN2016 height", None, 0, "no geoid grid for 'DHHN2016 height'"),
    ],
)
def test_what_heights_are_taken_for(tmp_path, vertical, given, geoid, words):
    assert np.ptp(height_of(tmp_path, vertical=vertical, geoid=given) - geoid) > 20
    assert height_of(tmp_path, vertical=vertical, geoid=given).min() == pytest.approx(290 + geoid, abs=0.05)
    said = extras(vertical=vertical, geoid=given)
    assert (said["vertical"], said["geoid_m"]) == (vertical, geoid)
    assert words in said["geoid_source"]


@pytest.fixture
def egm96(tmp_path):
    """PROJ with a made-up geoid of a known slope in the place of EGM96's: its height at (longitude, latitude)."""

    def geoid(lon, lat):
        return 40 + 3 * (np.asarray(lon) - 11) - 2 * (np.asarray(lat) - 44.7)

    lon, lat = np.arange(10, 12.01, 0.25), np.arange(46, 43.99, -0.25)
    values = geoid(lon, lat[:, None]).astype(np.float32)
    transform = rasterio.Affine(0.25, 0, 10 - 0.125, 0, -0.25, 46 + 0.125)
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "crs": "EPSG:4979", "transform": transform}
    path = tmp_path / "us_nga_egm96_15.tif"
    with rasterio.open(path, "w", height=len(lat), width=len(lon), **profile) as grid:
        grid.write(values, 1)
        grid.set_band_description(1, "geoid_undulation")
        grid.update_tags(AREA_OR_POINT="Point", TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL")
    before = pyproj.datadir.get_data_dir()
    pyproj.datadir.append_data_dir(str(tmp_path))
    yield geoid
    pyproj.datadir.set_data_dir(before)


def test_heights_follow_an_installed_geoid(tmp_path, egm96):
    meshes, path = write(tmp_path / "F", vertical="EGM96 height")
    x, y, z = np.concatenate([mesh.vertices for mesh in meshes]).T
    lon, lat = Transformer.from_crs(UTM, 4326, always_xy=True).transform(x, y)
    truth, found = np.column_stack([lon, lat, z + egm96(lon, lat)]), to_geodetic(placed(path))
    assert np.ptp(egm96(lon, lat)) > 0.04
    away = np.array([metres(found, np.tile(point, (len(found), 1))).min() for point in truth])
    assert away.max() < 0.05
    said = json.loads(path.read_text())["asset"]["extras"]
    at = to_wgs84(PLACE, UTM)[0]
    assert said["geoid_m"] == pytest.approx(egm96(at[1], at[0]), abs=0.01)
    assert "EGM96 height" in said["geoid_source"]
    assert said["geoid_source"].startswith("PROJ: ")


def test_a_geoid_that_ends_elsewhere_is_none(egm96):
    for there in ([[500_000.0, 5_500_000.0, 100.0]], [PLACE, PLACE + [0, 300_000, 0]]):
        assert "no geoid grid" in find_geoid("EGM96 height", UTM, there).source
    assert "no geoid grid" not in find_geoid("EGM96 height", UTM, PLACE).source


# Surveys


@pytest.mark.parametrize("n", [1, 2, 16, 17, 300])
def test_a_survey_holds_its_parcels(tmp_path, n):
    draw = np.random.default_rng(n)
    files = []
    for k in range(n):
        place = PLACE + draw.uniform([-3000, -2000, -50], [3000, 2000, 50])
        files.append(write(tmp_path / f"Größe #{k} 1%", place=place, reach=draw.uniform(20, 200), name="F 1")[1])
    tileset = survey_tileset([*files, tmp_path / "gone" / "tileset.json"])
    found = []

    def walk(tile, depth=0):
        assert 0 < len(tile["children"]) <= 16
        for child in tile["children"]:
            assert child["geometricError"] <= tile["geometricError"]
            assert beyond(box_of(tile), corners(box_of(child))) < 1e-3
            if "children" in child:
                walk(child, depth + 1)
                continue
            path = tmp_path / unquote(child["content"]["uri"])
            assert child["content"]["uri"].isascii()
            inner = json.loads(path.read_text())
            assert beyond(box_of(child), placed(path)) < 0
            assert child["geometricError"] >= inner["geometricError"] - 0.2
            assert "transform" not in child
            found.append(path)
        assert depth < 3

    walk(tileset["root"])
    assert sorted(found) == sorted(files)
    assert (tileset["asset"]["version"], tileset["root"]["refine"]) == ("1.1", "ADD")
    assert tileset["geometricError"] == tileset["root"]["geometricError"]


def test_without_parcels_there_is_none(tmp_path):
    (tmp_path / "F").mkdir()
    for text in ("{", "[]", '{"root": {"boundingVolume": {"box": [1]}}}'):
        paths.tileset(tmp_path / "F").write_text(text)
        assert survey_tileset([paths.tileset(tmp_path / "F")]) is None


@pytest.fixture(scope="module")
def mapped(three, tmp_path_factory):
    """Products of a survey whose geoid is known."""
    folder = tmp_path_factory.mktemp("globe") / "products"
    config = survey_config(
        survey="three",
        cloud=three,
        boundaries=three.with_name("parcels.gpkg"),
        settings=Settings.model_validate({"product": {"geoid": 48.0}}),
    )
    assert {outcome.state for outcome in map_here(config, folder)} == {"done"}
    return folder


def test_products_stand_on_their_rows(mapped):
    root = json.loads(paths.tileset(mapped).read_text())["root"]
    files = [mapped / child["content"]["uri"] for child in root["children"]]
    assert [path.parent.name for path in files] == ["A", "B", "C"]
    for path in files:
        name = path.parent.name
        rows = gpd.read_file(paths.geopackage(path.parent, name), layer="rows")
        curves, points = rows.to_crs(4326).geometry, to_geodetic(placed(path))
        around = metres_around(points)
        lines = shapely.transform(shapely.multilinestrings(list(shapely.force_2d(curves))), around)
        feet = shapely.points(around(points[:, :2]))
        away = shapely.distance(feet, lines)
        assert away.max() < 1.2
        assert np.quantile(away, 0.5) < 0.5
        # The middle of the canopy is on the curve: what lies left and right of it cancels out.
        assert abs(offset(feet, lines)) < 0.05
        ground = shapely.get_coordinates(list(curves), include_z=True)[:, 2]
        above = points[:, 2] - 48.0
        assert ground.min() < above.min() < ground.min() + 1.5
        assert ground.max() + 1 < above.max() < ground.max() + 3
        item = json.loads(paths.stac_item(path.parent, name).read_text())
        assert item["assets"]["tileset"]["href"] == "./tileset.json"
        assert item["assets"]["tileset"]["type"] == "application/json"


def metres_around(points):
    """Function from degrees to metres about the middle of points in degrees."""
    lon, lat = points[:, :2].mean(axis=0)
    plane = Transformer.from_crs(4326, CRS(f"+proj=aeqd +lat_0={lat} +lon_0={lon} +datum=WGS84"), always_xy=True)
    return lambda lon_lat: np.column_stack(plane.transform(*lon_lat.T))


def offset(feet, lines):
    """Mean vector's length from lines to points around them, m."""
    parts = shapely.get_parts(lines)
    nearest = parts[np.argmin(shapely.distance(feet[:, None], parts), axis=1)]
    on = shapely.line_interpolate_point(nearest, shapely.line_locate_point(nearest, feet))
    return np.linalg.norm((shapely.get_coordinates(feet) - shapely.get_coordinates(on)).mean(axis=0))


def test_a_survey_without_products_has_none(mapped, tmp_path):
    path = paths.tileset(tmp_path)
    _write_tileset(path, [mapped / "A"])
    assert json.loads(path.read_text())["root"]["children"][0]["content"]["uri"] == "A/tileset.json"
    _write_tileset(path, [])
    assert list(tmp_path.iterdir()) == []
