"""Canopies as PLY, OBJ and a Gazebo model: read by trimesh, they stand where the product's rows do."""

import json
import shutil
import xml.etree.ElementTree as ET

import geopandas as gpd
import numpy as np
import pytest
import rasterio
import trimesh
from meshes import ORIGIN, bumpy, rows
from pyproj import Transformer

from vinemap import paths
from vinemap.canopy.mesh import volume
from vinemap.errors import InputError
from vinemap.export.write import export_products
from vinemap.geo.main import Origin, main_to_wgs84, to_main
from vinemap.parcel import map_parcel
from vinemap.product.gltf import read_glb, write_glb
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate, write_survey
from vinemap.simulate.terrain import hillside


@pytest.fixture(scope="module")
def product(vineyard, tmp_path_factory):
    cloud = write_survey(vineyard, tmp_path_factory.mktemp("survey"))
    return map_parcel(cloud, tmp_path_factory.mktemp("products") / "A", parcel="A").folder


def export(product, folder, kind, **options):
    """Where one format of a product lies, and its files but the record."""
    list(export_products([product], folder, formats=[kind], **options))
    place = folder / "A" / kind
    files = [path for path in sorted(place.rglob("*")) if path.is_file() and path.name != "run.json"]
    listed = {path.relative_to(place).as_posix() for path in files}
    assert set(json.loads((place / "run.json").read_text())["files"]) == listed
    return place, files


def origin_of(product):
    return Origin(**json.loads(paths.run_record(product).read_text())["origin"])


@pytest.mark.parametrize("plain", [False, True])
def test_a_glb_comes_back(tmp_path, plain):
    meshes = [*rows(), bumpy(300, row_id=4, label="4 F"), bumpy(41, turn=-1, row_id=5, label="5 F")]
    write_glb(meshes, tmp_path / "x.glb", origin=ORIGIN, crs="EPSG:32632", extras={"vertical": "Genoa"}, plain=plain)
    found = read_glb(tmp_path / "x.glb")
    assert (found.crs.to_epsg(), found.vertical, found.origin.tolist()) == (32632, "Genoa", ORIGIN.tolist())
    assert [(mesh.row_id, mesh.label) for mesh in found.meshes] == [(mesh.row_id, mesh.label) for mesh in meshes]
    for mesh, again in zip(meshes, found.meshes, strict=True):
        assert again.vertices.shape == mesh.vertices.shape
        assert np.abs(again.vertices - mesh.vertices).max(initial=0) < 0.002
        assert len(again.faces) == len(mesh.faces)
        # Strips split some quadrilaterals along the other diagonal.
        assert volume(again) == pytest.approx(volume(mesh), rel=0.01)
        if len(mesh.faces):
            shape = trimesh.Trimesh(again.vertices - ORIGIN, again.faces, process=False)
            assert shape.is_watertight
            assert shape.is_winding_consistent


@pytest.mark.parametrize("content", [b"", b"glTF", b"glTF\2\0\0\0\x10\0\0\0\0\0\0\0JSON{}"])
def test_what_is_no_mesh_of_ours(tmp_path, content):
    (tmp_path / "x.glb").write_bytes(content)
    with pytest.raises(InputError, match=r"x\.glb"):
        read_glb(tmp_path / "x.glb")
    with pytest.raises(InputError, match=r"gone\.glb: can't be read .*: map the parcel again"):
        read_glb(tmp_path / "gone.glb")


def test_ply_stands_on_the_rows_in_main(product, tmp_path):
    _, (file, about) = export(product, tmp_path, "ply")
    assert (file.name, about.name) == ("A_canopy.ply", "A_canopy_frame.json")
    mesh = trimesh.load_mesh(file, process=False)
    row_id = mesh.metadata["_ply_raw"]["vertex"]["data"]["row_id"].ravel()
    table = gpd.read_file(paths.geopackage(product, "A"), layer="rows").set_index("row_id")
    assert set(row_id) == set(table.index)
    for row, line in table.iterrows():
        points = np.asarray(mesh.vertices)[row_id == row]
        ends = line[["e1_x", "e1_y", "e1_z", "en_x", "en_y", "en_z"]].to_numpy(dtype=float).reshape(2, 3)
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        across = np.cross(along, [0, 0, 1])
        assert abs((points - ends[0]) @ across).max() < 1.2
        assert abs(((points - ends[0]) @ across).mean()) < 0.1
        position = (points - ends[0]) @ along
        assert -0.7 < position.min() < 1
        assert -1 < position.max() - line["length_m"] < 0.7
        assert 0 < (points[:, 2] - ends[0, 2] - position * along[2]).min() < 1.2
    said = json.loads(about.read_text())
    assert said["origin"] == origin_of(product)._asdict()
    head = file.read_bytes().split(b"end_header")[0].decode()
    assert f"comment origin: {json.dumps(said['origin'])}" in head
    assert mesh.is_watertight


def test_ply_in_the_crs_is_off_by_what_it_says(product, tmp_path):
    _, (file, about) = export(product, tmp_path, "ply", grid=True)
    offset = json.loads(about.read_text())["offset"]
    found = np.asarray(trimesh.load_mesh(file, process=False).vertices) + offset
    truth = np.concatenate([mesh.vertices for mesh in read_glb(paths.canopy_mesh(product, "A")).meshes])
    assert np.abs(found - truth).max() < 1e-4
    assert f"comment offset: {offset}".encode() in file.read_bytes()


def test_obj_has_a_named_object_a_row(product, tmp_path):
    _, (file, about) = export(product, tmp_path, "obj")
    scene = trimesh.load_scene(file, split_objects=True, process=False)
    meshes = read_glb(paths.canopy_mesh(product, "A")).meshes
    assert set(scene.geometry) == {mesh.label for mesh in meshes}
    assert f"# origin: {json.dumps(json.loads(about.read_text())['origin'])}" in file.read_text()
    for mesh in meshes:
        shape = scene.geometry[mesh.label]
        truth = to_main(mesh.vertices, read_glb(paths.canopy_mesh(product, "A")).crs, origin_of(product))
        assert shape.bounds == pytest.approx(np.array([truth.min(axis=0), truth.max(axis=0)]), abs=1e-3)
        assert shape.is_watertight
        assert shape.volume == pytest.approx(volume(mesh), rel=2e-3)


def test_a_gazebo_world_is_the_vineyard(product, tmp_path):
    place, files = export(product, tmp_path, "gazebo")
    assert {path.relative_to(place).as_posix() for path in files} == {
        "A_vineyard.sdf",
        "A_vineyard/model.config",
        "A_vineyard/model.sdf",
        "A_vineyard/meshes/canopy.obj",
        "A_vineyard/meshes/terrain.obj",
        "A_vineyard/meshes/vineyard.mtl",
    }
    world, model = (ET.parse(place / name).getroot() for name in ("A_vineyard.sdf", "A_vineyard/model.sdf"))
    about = world.find("world/spherical_coordinates")
    found = [float(about.find(name).text) for name in ("latitude_deg", "longitude_deg", "elevation")]
    assert found == list(origin_of(product))
    config = ET.parse(place / "A_vineyard/model.config").getroot()
    assert config.find("sdf").text == "model.sdf"
    assert world.find("world/include/uri").text == "model://A_vineyard"
    for part in model.iter("uri"):
        assert (place / part.text.removeprefix("model://")).is_file()
    ground = trimesh.load_mesh(place / "A_vineyard/meshes/terrain.obj")
    assert ground.face_normals[:, 2].min() > 0.5
    lat, lon, alt = main_to_wgs84(ground.vertices, origin_of(product)).T
    with rasterio.open(paths.raster(product, "A", "dtm")) as dtm:
        nodes = Transformer.from_crs(4326, dtm.crs, always_xy=True).transform(lon, lat)
        heights = np.array([value[0] for value in dtm.sample(np.column_stack(nodes))])
    assert np.quantile(np.abs(heights - alt), 0.95) < 0.1
    canopy = trimesh.load_mesh(place / "A_vineyard/meshes/canopy.obj")
    assert (canopy.bounds[0, :2] > ground.bounds[0, :2]).all()
    assert (canopy.bounds[1, :2] < ground.bounds[1, :2]).all()


def test_a_parcel_of_a_single_row_has_meshes_without_lanes(tmp_path):
    plots = [Vineyard("A", rows_of(1, length=20))]
    cloud = write_survey(simulate(plots, hillside(0.1), name="one", density=200, seed=1), tmp_path)
    product = map_parcel(cloud, tmp_path / "product", parcel="A").folder
    _, (file, _) = export(product, tmp_path, "ply")
    assert trimesh.load_mesh(file).is_watertight


def test_a_product_whose_meshes_are_gone_leaves_nothing(product, tmp_path):
    broken = shutil.copytree(product, tmp_path / "broken")
    paths.canopy_mesh(broken, "A").unlink()
    for kind in ("ply", "obj", "gazebo"):
        with pytest.raises(InputError, match=r"A_canopy\.glb"):
            list(export_products([broken], tmp_path / "out", formats=[kind]))
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file() and not path.name.endswith(".lock")]
