"""The whole chain on small vineyards: products, their contract, and what is left when something is wrong."""

import json
import re

import geopandas as gpd
import laspy
import numpy as np
import pygltflib
import pyogrio
import pytest
import rasterio
import shapely
import trimesh
from click.testing import CliRunner

from vinemap import paths
from vinemap.cli.main import commands
from vinemap.config.settings import Settings
from vinemap.errors import InputError, OutputError
from vinemap.evaluate.rows import evaluate_rows
from vinemap.export.write import export_products
from vinemap.geo.crs import LOCAL
from vinemap.geo.main import Origin, main_to_wgs84
from vinemap.parcel import map_parcel
from vinemap.product.layers import LAYERS
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate, write_survey
from vinemap.simulate.terrain import hillside
from vinemap.stages import STAGES, call

RASTERS = ("dtm", "chm", "row_direction", "row_spacing", "vineyard_likelihood")


@pytest.fixture(scope="module")
def product(survey, tmp_path_factory):
    folder = tmp_path_factory.mktemp("products") / "A"
    boundary = survey.parent / "parcels.gpkg"
    named = []

    def step(name, function, *args, **kwargs):
        named.append(name)
        return call(name, function, *args, **kwargs)

    summary = map_parcel(survey, folder, parcel="A", boundary=boundary, origin=Origin(44.6, 7.9, 250.0), step=step)
    assert tuple(named) == STAGES
    return summary


def test_rows_are_found_where_they_are(product, vineyard):
    found = evaluate_rows(gpd.read_file(paths.geopackage(product.folder, "A"), layer="rows"), vineyard.rows)
    assert (found.good, found.extra, found.missed) == (100, 0, 0)
    assert found.dep.mean < 0.08
    assert found.dek.mean < 0.02
    assert found.cof.mean < 0.02
    assert np.abs(found.pairs[["e1_along_m", "en_along_m"]].to_numpy().mean()) < 0.04
    assert product.rows == 6


def test_missing_vines_are_gaps(product, vineyard):
    gaps = gpd.read_file(paths.geopackage(product.folder, "A"), layer="gaps")
    dead = vineyard.dead_vines
    run = ((dead["row"] != dead["row"].shift()) | (dead["vine"] != dead["vine"].shift() + 1)).cumsum()
    runs = dead[run.map(run.value_counts()) >= 2]
    assert runs.distance(gaps.union_all()).max() < 0.5
    long = gaps[gaps["length_m"] > 1.5]
    assert long.distance(dead.union_all()).max() < 0.5


def test_product_is_the_contracts(product):
    folder = product.folder
    record = json.loads((folder / "run.json").read_text())
    expected = {"A.gpkg", "A.qgz", "A_canopy.glb", "A_report.html", "A_stac.json", "tileset.json"}
    expected |= {f"A_{kind}.{suffix}" for kind in RASTERS for suffix in ("tif", "qml")}
    assert {p.name for p in folder.iterdir()} == expected | {"run.json"}
    assert set(record["files"]) == expected
    assert record["origin"] == {"lat": 44.6, "lon": 7.9, "alt": 250.0}
    assert record["counts"]["rows"] == 6
    assert len(record["inputs"][0]["sha256"]) == 64
    assert set(record["seconds"]) == {*STAGES, "All"}
    assert record["settings"]["polygon"]["c"] == 7
    assert [p.name for p in folder.parent.iterdir()] == ["A"]
    listed = [str(name) for name, _ in pyogrio.list_layers(folder / "A.gpkg")]
    assert listed == [*LAYERS, "layer_styles"]


def test_local_metres_give_all_but_a_place_on_the_globe(vineyard, tmp_path):
    near = vineyard.xyz - np.floor(vineyard.xyz.min(axis=0))
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = np.full(3, 0.001)
    las = laspy.LasData(header)
    las.xyz = near
    las.write(tmp_path / "a.laz")
    folder = tmp_path / "products" / "A"
    summary = map_parcel(tmp_path / "a.laz", folder, parcel="A", crs=LOCAL)
    assert (summary.rows, summary.warnings) == (6, ())
    rows, ends = (gpd.read_file(folder / "A.gpkg", layer=layer) for layer in ("rows", "row_ends"))
    assert [column for column in LAYERS["rows"].columns if column not in rows] == [
        f"{end}_{axis}" for end in ("e1", "en") for axis in ("lat", "lon", "alt")
    ]
    record = json.loads((folder / "run.json").read_text())
    corner = np.array([record["origin"][axis] for axis in "xyz"])
    first = shapely.get_coordinates(ends.geometry[ends["end"] == "e1"], include_z=True)
    assert np.allclose(rows[["e1_x", "e1_y", "e1_z"]].to_numpy() + corner, first)
    assert not (folder / "tileset.json").exists()
    (told,) = export_products([folder], tmp_path / "out", formats=["nav2", "gazebo", "ply"])
    assert "6 rows, 5 lanes" in told
    with pytest.raises(InputError, match=r"its coordinates are local.* take nav2"):
        list(export_products([folder], tmp_path / "out", formats=["geojson"]))


def test_table_2_1_holds_together(product):
    rows = gpd.read_file(paths.geopackage(product.folder, "A"), layer="rows")
    assert list(rows["label"]) == [f"{k} A" for k in range(1, 7)]
    ends = np.array([shapely.get_coordinates(g, include_z=True)[[0, -1]] for g in rows.geometry])
    for k, end in enumerate(("e1", "en")):
        wgs84 = rows[[f"{end}_lat", f"{end}_lon", f"{end}_alt"]].to_numpy()
        main = rows[[f"{end}_x", f"{end}_y", f"{end}_z"]].to_numpy()
        assert np.allclose(main_to_wgs84(main, Origin(44.6, 7.9, 250.0)), wgs84, rtol=0, atol=1e-8)
        points = gpd.GeoSeries(gpd.points_from_xy(wgs84[:, 1], wgs84[:, 0]), crs=4326).to_crs(rows.crs)
        assert np.allclose(points.get_coordinates(), ends[:, k, :2], atol=0.002)
    assert np.allclose(rows["elevation_diff_m"], ends[:, 1, 2] - ends[:, 0, 2])
    assert rows["orientation_deg"].to_numpy() == pytest.approx(33 + 0.75, abs=0.5)
    assert rows["spacing_m"].to_numpy() == pytest.approx(2.5, rel=0.03)
    assert rows["height_m"].between(1.6, 2.3).all()
    assert rows["width_m"].between(0.4, 0.8).all()
    assert (rows["volume_m3"] > 8).all()


def test_rows_of_an_earlier_product_are_measured_again(product, survey, tmp_path):
    """As they were edited: one deleted, one turned round, one renamed, one drawn where nothing stands."""
    earlier = gpd.read_file(paths.geopackage(product.folder, "A"), layer="rows")
    edited = earlier[earlier["row_id"] != 3][["row_id", "label", "geometry"]].reset_index(drop=True)
    turned, bare = edited.geometry[3].reverse(), shapely.affinity.translate(edited.geometry[0], 1.2, -2)
    shapes = gpd.GeoSeries([*edited.geometry[:3], turned, edited.geometry[4], bare], crs=edited.crs)
    rows = gpd.GeoDataFrame({"row_id": [*edited["row_id"], 9], "label": [*edited["label"], "new"]}, geometry=shapes)
    rows.loc[1, "label"] = "Müller's"
    rows.to_crs(4326).to_file(tmp_path / "rows.gpkg", layer="rows")
    (tmp_path / "keep.yaml").write_text("rows: {ends: keep}\n")
    given = {"boundary": survey.parent / "parcels.gpkg", "parcel": "A", "rows": tmp_path / "rows.gpkg"}
    given |= {"settings": tmp_path / "keep.yaml", "out": tmp_path / "out"}
    words = ["run", survey, *(word for name, value in given.items() for word in (f"--{name}", value))]
    done = CliRunner().invoke(commands, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0
    assert "A: 6 rows, " in done.output
    assert "1 of 6 known rows have no canopy: new" in done.output
    found = gpd.read_file(tmp_path / "out" / "A.gpkg", layer="rows")
    assert found["row_id"].tolist() == [1, 2, 4, 5, 6, 9]
    assert found["label"].tolist() == ["1 A", "Müller's", "4 A", "5 A", "6 A", "new"]
    flat = [shapely.force_2d(frame.geometry.to_numpy()) for frame in (found, rows)]
    assert shapely.hausdorff_distance(*flat)[:5].max() < 0.03
    assert shapely.distance(*(shapely.get_point(lines, 0) for lines in flat)).max() < 0.05
    assert found["support"].tolist()[5] == 0
    assert found["confidence"][5] < 0.3
    assert found["confidence"][:5].min() > 0.7
    assert np.isnan(found["height_m"][5])
    same = earlier[earlier["row_id"].isin(found["row_id"])].reset_index()
    for name in ("length_m", "height_m", "width_m", "spacing_m"):
        assert found[name][:5].to_numpy() == pytest.approx(same[name].to_numpy(), rel=0.03)
    unmapped = gpd.read_file(tmp_path / "out" / "A.gpkg", layer="unmapped")
    third = earlier.geometry[earlier["row_id"] == 3].iloc[0].buffer(0.5)
    assert unmapped.intersection(third).area.sum() > 0.5 * unmapped.area.sum() > 3
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [one["file"] for one in record["inputs"]][1:] == ["parcels.gpkg", "rows.gpkg"]
    assert set(STAGES) - set(record["seconds"]) == {"Key points", "Clusters"}


def test_a_cloud_is_moved_onto_known_rows(product, survey, tmp_path):
    """By a run in tiles on disk, of rows that stand elsewhere than they were found."""
    shift = np.array([0.22, -0.16])
    found = gpd.read_file(paths.geopackage(product.folder, "A"), layer="rows")
    rows = found[["row_id", "label", "geometry"]].set_geometry(found.translate(*-shift))
    rows.to_file(tmp_path / "rows.gpkg", layer="rows")
    settings = Settings(rows={"align": True}, reading={"max_points": 1000})
    aligned = map_parcel(survey, tmp_path / "out", parcel="A", rows=tmp_path / "rows.gpkg", settings=settings)
    assert sorted(path.name for path in aligned.folder.iterdir() if path.is_dir()) == []
    record = json.loads(paths.run_record(aligned.folder).read_text())
    told = record["shift"]
    assert [told["east_m"], told["north_m"]] == pytest.approx(shift, abs=0.03)
    assert told["in_rows"] is False
    again = gpd.read_file(paths.geopackage(aligned.folder, "A"), layer="rows")
    off = shapely.hausdorff_distance(*(shapely.force_2d(table.geometry.to_numpy()) for table in (again, rows)))
    assert np.median(off) < 0.1
    with rasterio.open(paths.raster(aligned.folder, "A", "chm")) as chm:
        points = shapely.line_interpolate_point(rows.geometry, 0.3, normalized=True)
        assert np.median([value[0] for value in chm.sample([(p.x, p.y) for p in points])]) > 1.5


def test_vines_stand_where_they_were_surveyed(vineyard, survey, tmp_path):
    """In a file in degrees, with a point that is no vine, beside layers of other things."""
    lines = shapely.force_2d(vineyard.rows.geometry.to_numpy())
    share = [(np.arange(n) + 0.5) / n for n in vineyard.rows["n_vines"]]
    points = np.concatenate(
        [shapely.line_interpolate_point(line, own, normalized=True) for line, own in zip(lines, share, strict=True)]
    )
    stray = shapely.Point(shapely.get_coordinates(points[0])[0] - [5, 0])
    path = tmp_path / "planted.gpkg"
    gpd.GeoDataFrame(geometry=lines, crs=32632).to_file(path, layer="rows")
    gpd.GeoDataFrame(geometry=[*points, stray], crs=32632).to_crs(4326).to_file(path, layer="vines")
    words = ["run", survey, "--parcel", "A", "--rows", path, "--vines", path, "--out", tmp_path / "out"]
    done = CliRunner().invoke(commands, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0
    assert f"1 of {len(points) + 1} known vines stand farther than half a spacing from any row" in done.output
    vines = gpd.read_file(paths.geopackage(tmp_path / "out", "A"), layer="vines")
    assert vines.groupby("row_id").size().tolist() == vineyard.rows["n_vines"].tolist()
    assert (vines["position_sd_m"] < 0.05).all()
    assert shapely.distance(shapely.force_2d(vines.geometry.to_numpy()), points).max() < 0.12
    gone = shapely.force_2d(vines.geometry[vines["state"] == "missing"].to_numpy())
    dead = vineyard.dead_vines.geometry.to_numpy()
    assert len(gone) == len(dead)
    assert shapely.distance(gone[:, None], dead).min(axis=0).max() < 0.15
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [one["file"] for one in record["inputs"]][1:] == ["planted.gpkg"] * 2


def test_rasters(product):
    for kind in RASTERS:
        with rasterio.open(paths.raster(product.folder, "A", kind)) as src:
            assert src.crs.to_epsg() == 32632
            assert src.nodata == -9999
            assert src.units[0]
            assert src.descriptions[0]
    with rasterio.open(paths.raster(product.folder, "A", "row_direction")) as src:
        assert np.median(src.read(1, masked=True).compressed()) == pytest.approx(33, abs=1.5)
    with rasterio.open(paths.raster(product.folder, "A", "vineyard_likelihood")) as src:
        likelihood = src.read(1, masked=True)
        assert 0 <= likelihood.min() <= likelihood.max() <= 1


def test_meshes_are_closed_named_and_in_place(product):
    path = paths.canopy_mesh(product.folder, "A")
    scene = trimesh.load(path)
    # A row's pieces, which gaps divide, hang under its node.
    parents = scene.graph.transforms.parents
    holders = {name if parents[name] == "canopy" else parents[name] for name in scene.graph.nodes_geometry}
    assert sorted(holders) == [f"{k} A" for k in range(1, 7)]
    pieces = scene.dump()
    assert all(g.is_watertight and g.volume > 0 for g in pieces)
    rows = gpd.read_file(paths.geopackage(product.folder, "A"), layer="rows")
    total = sum(g.volume for g in pieces)
    assert total == pytest.approx(rows["volume_m3"].sum(), rel=0.05)
    low, high = scene.bounds
    assert 2 < (high - low)[1] < 12
    gltf = pygltflib.GLTF2().load(path)
    origin = np.array(gltf.nodes[0].extras["origin"])
    west, south, east, north = rows.total_bounds
    assert low[[0]] + origin[0] == pytest.approx(west, abs=0.6)
    assert -low[2] + origin[1] == pytest.approx(north, abs=0.6)
    assert high[0] + origin[0] == pytest.approx(east, abs=0.6)
    assert -high[2] + origin[1] == pytest.approx(south, abs=0.6)
    assert sorted(n.name for n in gltf.nodes if n.mesh is not None) == [f"{k} A" for k in range(1, 7)]
    planted = (rows["length_m"] * rows["spacing_m"]).sum() / 10_000
    assert path.stat().st_size / planted < 2e6  # rows as short as these weigh more: a longer one's bar is 1.5 MB
    node = next(n for n in gltf.nodes if n.name == "3 A")
    assert node.extras["length_m"] == pytest.approx(rows.set_index("row_id")["length_m"][3])


def test_where_a_tree_stands_alone_a_product_has_no_rows(tmp_path):
    bare = Vineyard("bare", rows_of(4, length=20), leafiness=0.0)
    x, y = bare.rows[0].mean(axis=0) + [0, 4]
    survey = simulate([bare], hillside(0.1), obstacles=[Obstacle(x, y, 2, 2, 5, 1)], seed=1, name="meadow", density=100)
    summary = map_parcel(write_survey(survey, tmp_path / "in"), tmp_path / "out", parcel="meadow")
    assert summary.rows == 0
    assert "no vine row found" in summary.line()
    assert "too tall for vines" in summary.line()
    for layer, contract in LAYERS.items():
        frame = gpd.read_file(paths.geopackage(tmp_path / "out", "meadow"), layer=layer)
        assert [c for c in frame.columns if c != "geometry"] == list(contract.columns)
        assert len(frame) == (1 if layer in ("parcel", "unmapped") else 0)
    for kind in RASTERS:
        assert paths.raster(tmp_path / "out", "meadow", kind).is_file()
    assert len(pygltflib.GLTF2().load(paths.canopy_mesh(tmp_path / "out", "meadow")).nodes) == 1
    assert not paths.tileset(tmp_path / "out").exists()
    tree = gpd.read_file(paths.geopackage(tmp_path / "out", "meadow"), layer="unmapped").iloc[0]
    assert tree["reason"] == "too tall"
    assert tree["height_m"] == pytest.approx(5, abs=0.7)
    assert tree["area_m2"] == pytest.approx(4 * np.pi, rel=0.4)
    assert shapely.distance(tree.geometry, shapely.Point(x, y)) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["unmapped_m2"] == {"too tall": pytest.approx(tree["area_m2"], abs=0.05)}
    item = json.loads(paths.stac_item(tmp_path / "out", "meadow").read_text())
    assert item["properties"]["vinemap:unmapped_m2"] == 0, "no vines"
    page = paths.report(tmp_path / "out", "meadow").read_text(encoding="utf-8")
    (drawn,) = re.findall(r'"unmapped":(\{"reason":\["too tall"\].*?\})', page)
    (ring,) = json.loads(drawn)["outline"][0]
    assert len(ring) == len(shapely.get_coordinates(tree.geometry))


def test_a_fault_in_the_page_costs_no_product(tmp_path, survey, product, monkeypatch):
    def faulty(*args):
        raise ZeroDivisionError("of the page")

    monkeypatch.setattr("vinemap.product.pages.parcel.parcel_page", faulty)
    summary = map_parcel(survey, tmp_path / "A", parcel="A", boundary=survey.parent / "parcels.gpkg")
    assert "it has no page: a fault of vinemap's own (ZeroDivisionError: of the page)" in summary.line()
    files = {path.name for path in product.folder.iterdir()} - {"A_report.html"}
    assert {path.name for path in (tmp_path / "A").iterdir()} == files
    assert "report" not in json.loads(paths.stac_item(tmp_path / "A", "A").read_text())["assets"]


def test_bad_input_leaves_nothing(tmp_path, survey):
    with pytest.raises(InputError):
        map_parcel(tmp_path / "none.laz", tmp_path / "out", parcel="A")
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError):
        map_parcel(survey, tmp_path / "file" / "out", parcel="A")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
