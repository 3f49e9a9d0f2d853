"""Exports, read back by parsers written from the formats' own descriptions, against rows and lanes in metres."""

import json
import math
import shutil
import struct
from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import pyogrio
import pytest
import shapely
from commands import assert_refused, vinemap
from products import tree
from pyproj import Transformer
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vinemap.errors import InputError, OutputError
from vinemap.export import FORMATS
from vinemap.export.lanes import lanes_between
from vinemap.export.write import export_products
from vinemap.geo.crs import parse_crs
from vinemap.parcel import map_parcel
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate, write_survey
from vinemap.simulate.terrain import hillside

NAME = "Côte 1"
UTM = parse_crs("EPSG:32632")
GML = "{http://www.opengis.net/gml}"


@pytest.fixture(scope="module")
def product(tmp_path_factory):
    """A parcel of two blocks: four rows on arcs, and three straight ones across their end."""
    place = np.mean(rows_of(1)[0], axis=0)
    arcs = rows_of(4, length=30, radius=45, azimuth=20)
    rows = [*arcs, *rows_of(3, length=16, azimuth=110, centre=tuple(place + [28, 0]))]
    survey = simulate([Vineyard(NAME, rows)], hillside(0.15), name="small", density=200, seed=3)
    cloud = write_survey(survey, tmp_path_factory.mktemp("in"))
    folder = tmp_path_factory.mktemp("products") / NAME
    map_parcel(cloud, folder, parcel=NAME, boundary=cloud.with_name("parcels.gpkg"))
    return folder


@pytest.fixture(scope="module")
def rows(product):
    return gpd.read_file(product / f"{NAME}.gpkg", layer="rows")


@pytest.fixture(scope="module")
def lanes(rows):
    lanes = lanes_between(rows)
    assert lanes["block"].tolist() == [1, 1, 1, 2, 2]
    return lanes


@pytest.fixture(scope="module")
def outline(product):
    return shapely.get_parts(gpd.read_file(product / f"{NAME}.gpkg", layer="parcel").geometry.to_numpy())[0]


@pytest.fixture(scope="module")
def exported(product, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    line, table = export_products([product], out, formats=FORMATS, lines="both")
    assert line.startswith(f"{NAME}: 7 rows, 5 lanes → ")
    assert table.startswith("table: 7 lines of rows, 0 lines of vines (csv")
    return out / NAME


def in_grid(lon_lat):
    """Degrees in the product's CRS."""
    to_grid = Transformer.from_crs(4326, UTM, always_xy=True)
    return np.column_stack(to_grid.transform(*np.asarray(lon_lat, dtype=float)[:, :2].T))


def in_main(xyz, origin):
    """Points of the product's CRS in the topocentric frame at an origin, by rotation of geocentric coordinates."""
    to_globe = Transformer.from_crs(UTM.to_3d(), 4978, always_xy=True)
    zero = Transformer.from_crs(4979, 4978, always_xy=True).transform(origin["lon"], origin["lat"], origin["alt"])
    lat, lon = np.radians([origin["lat"], origin["lon"]])
    east = [-math.sin(lon), math.cos(lon), 0]
    north = [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)]
    return (np.column_stack(to_globe.transform(*xyz.T)) - zero) @ np.column_stack([east, north])


def assert_same(found, truth, *, within=0.01):
    """Lines lie on each other within a centimetre and have one direction."""
    assert len(found) == len(truth)
    for line, true in zip(found, truth, strict=True):
        true_xy = shapely.get_coordinates(true)
        assert shapely.hausdorff_distance(shapely.LineString(line), shapely.force_2d(true), 0.02) < within
        assert np.abs(line[[0, -1]] - true_xy[[0, -1]]).max() < within


def coordinates(path):
    collection = json.loads(path.read_text(encoding="utf-8"))
    assert collection["type"] == "FeatureCollection"
    assert "crs" not in collection
    return collection["features"]


def test_geojson(exported, rows, lanes, product):
    folder = exported / "geojson"
    for name, truth in (("rows", rows), ("lanes", lanes)):
        features = coordinates(folder / f"{NAME}_{name}.geojson")
        xyz = [np.array(feature["geometry"]["coordinates"]) for feature in features]
        assert_same([in_grid(line) for line in xyz], truth.geometry, within=0.001)
        for line, true in zip(xyz, truth.geometry, strict=True):
            assert line[:, 2] == pytest.approx(shapely.get_coordinates(true, include_z=True)[:, 2], abs=0.001)
        assert {feature["properties"]["label"] for feature in features} == set(truth["label"])
    numbers = {f["properties"]["row_id"]: f["properties"] for f in coordinates(folder / f"{NAME}_rows.geojson")}
    for row in rows.itertuples():
        assert numbers[row.row_id]["e1_lon"] == pytest.approx(row.e1_lon, abs=2e-9)
        assert numbers[row.row_id]["length_m"] == pytest.approx(row.length_m)
    (parcel,) = coordinates(folder / f"{NAME}_parcel.geojson")
    assert all(shapely.LinearRing(part[0]).is_ccw for part in parcel["geometry"]["coordinates"])
    ends = coordinates(folder / f"{NAME}_row_ends.geojson")
    true = gpd.read_file(product / f"{NAME}.gpkg", layer="row_ends")
    found = in_grid([feature["geometry"]["coordinates"] for feature in ends])
    assert found == pytest.approx(shapely.get_coordinates(true.to_crs(UTM).geometry), abs=0.01)
    assert (folder / f"{NAME}_gaps.geojson").exists() == (
        len(pyogrio.read_dataframe(product / f"{NAME}.gpkg", layer="gaps")) > 0
    )


def polylines(path):
    """Parts of a .shp of PolyLineZ (13) or PolygonZ/Polygon, after ESRI's description: coordinates (n, 2), heights."""
    data, at, parts = path.read_bytes(), 100, []
    assert struct.unpack(">i", data[:4]) == (9994,)
    while at < len(data):
        words, kind = struct.unpack(">4xi", data[at : at + 8]) + struct.unpack("<i", data[at + 8 : at + 12])
        n_parts, n = struct.unpack("<2i", data[at + 44 : at + 52])
        points = at + 52 + 4 * n_parts
        xy = np.frombuffer(data, "<f8", 2 * n, points).reshape(-1, 2)
        z = np.frombuffer(data, "<f8", n, points + 16 * n + 16) if kind == 13 else np.empty(0)
        parts.append((xy, z))
        at += 8 + 2 * words
    return parts


def table(path):
    """Columns of a .dbf, their values as text."""
    data = path.read_bytes()
    n, start, width = struct.unpack("<IHH", data[4:12])
    fields = [(data[k : k + 11].split(b"\0")[0].decode(), data[k + 16]) for k in range(32, start - 1, 32)]
    columns, at = {}, 1
    for name, size in fields:
        values = [data[start + k * width + at :][:size].decode("utf-8").strip() for k in range(n)]
        columns[name], at = values, at + size
    return columns


def test_shapefile(exported, rows, lanes):
    folder = exported / "shapefile"
    for name, truth in (("rows", rows), ("lanes", lanes)):
        shapes = polylines(folder / f"{NAME}_{name}.shp")
        assert_same([in_grid(xy) for xy, _ in shapes], truth.geometry, within=0.001)
        for (_, z), true in zip(shapes, truth.geometry, strict=True):
            assert z == pytest.approx(shapely.get_coordinates(true, include_z=True)[:, 2], abs=0.001)
        columns = table(folder / f"{NAME}_{name}.dbf")
        assert columns["label"] == truth["label"].tolist()
        assert max(map(len, columns)) <= 10
        assert list(map(float, columns["length_m"])) == pytest.approx(truth["length_m"].tolist())
        assert (folder / f"{NAME}_{name}.cpg").read_text() == "UTF-8"
        assert "WGS_1984" in (folder / f"{NAME}_{name}.prj").read_text()
    assert table(folder / f"{NAME}_parcel.dbf")["parcel"] == [NAME]


def test_isoxml(exported, rows, lanes, outline):
    path = exported / "isoxml" / "TASKDATA" / "TASKDATA.XML"
    root = ET.parse(path).getroot()
    assert root.tag == "ISO11783_TaskData"
    assert (root.get("VersionMajor"), root.get("DataTransferOrigin")) == ("4", "1")
    (field,) = root.findall("PFD")
    assert field.get("C") == NAME
    assert field.get("F") == root.find("FRM").get("A")
    (boundary,) = field.findall("PLN")
    assert boundary.get("A") == "1"
    ring = shapely.Polygon(in_grid(points(boundary.find("LSG[@A='1']"))))
    assert ring.symmetric_difference(outline).area < 0.5
    assert int(field.get("D")) == round(outline.area)
    for group, truth, name in zip(field.findall("GGP"), (lanes, rows), ("lanes", "rows"), strict=True):
        patterns = group.findall("GPN")
        assert group.get("B") == f"{NAME} {name}"
        assert [pattern.get("B") for pattern in patterns] == truth["label"].tolist()
        assert {(pattern.get("E"), pattern.get("F")) for pattern in patterns} == {("4", "4")}
        lines = [pattern.find("LSG[@A='5']") for pattern in patterns]
        assert_same([in_grid(points(line)) for line in lines], truth.geometry)
        for pattern, line in zip(patterns, lines, strict=True):
            kinds = [point.get("A") for point in line]
            assert kinds == ["6", *["9"] * (len(kinds) - 2), "7"]
            assert pattern.get("C") == ("1" if len(kinds) == 2 else "3")
    numbers = [element.get("A") for element in root.iter("GPN")]
    assert len(set(numbers)) == len(lanes) + len(rows)


def test_isoxml_of_a_long_name(tmp_path, product):
    folder = few(product, tmp_path / "long", 2)
    record = json.loads((folder / "run.json").read_text())
    name = "Vigna Superiore di San Lorenzo in Collina presso la Cascina Alta"
    (folder / "run.json").write_text(json.dumps(record | {"parcel": name}))
    (folder / f"{NAME}.gpkg").rename(folder / f"{name}.gpkg")
    list(export_products([folder], tmp_path / "out", formats=["isoxml"], lines="both"))
    root = ET.parse(tmp_path / "out" / name / "isoxml" / "TASKDATA" / "TASKDATA.XML").getroot()
    assert [group.get("B") for group in root.iter("GGP")] == [f"{name[:26]} lanes", f"{name[:27]} rows"]


def points(line):
    return [(float(point.get("D")), float(point.get("C"))) for point in line.findall("PNT")]


def test_isoxml_holds_to_the_schema_of_iso_11783_10(exported):
    schemas = pytest.importorskip("isoxml_writer", reason="brings the schema of ISO 11783-10").__path__[0]
    etree = pytest.importorskip("lxml.etree", reason="checks XML against it")
    schema = etree.XMLSchema(file=f"{schemas}/ISOXML_schema/ISO11783_TaskFile_V4-3.xsd")
    assert schema.validate(etree.parse(exported / "isoxml" / "TASKDATA" / "TASKDATA.XML")), schema.error_log


def from_agopengps(en, start):
    """Degrees of eastings and northings, as AgOpenGPS has it."""
    east, north = np.asarray(en, dtype=float)[:, :2].T
    f = math.radians(start[0])
    lat = start[0] + north / (111132.92 - 559.82 * math.cos(2 * f) + 1.175 * math.cos(4 * f) - 0.0023 * math.cos(6 * f))
    r = np.radians(lat)
    lon = start[1] + east / (111412.84 * np.cos(r) - 93.5 * np.cos(3 * r) + 0.118 * np.cos(5 * r))
    return np.column_stack([lon, lat])


def numbers(line, n):
    values = [float(part) for part in line.split(",")]
    assert len(values) == n
    return values


def test_agopengps(exported, rows, lanes, outline):
    folder = exported / "agopengps" / NAME
    header = (folder / "Field.txt").read_text(encoding="utf-8").splitlines()
    assert header[1:8] == ["$FieldDir", NAME, "$Offsets", "0,0", "Convergence", "0", "StartFix"]
    start = numbers(header[8], 2)

    text = iter((folder / "TrackLines.txt").read_text(encoding="utf-8").splitlines())
    assert next(text) == "$TrackLines"
    tracks = {}
    for name in text:
        heading = float(next(text))
        ends = [numbers(next(text), 2), numbers(next(text), 2)]
        assert [next(text), next(text), next(text)] == ["0", "4", "True"]
        course = np.array([numbers(next(text), 3) for _ in range(int(next(text)))])
        step = np.diff(course[:, :2], axis=0)
        assert ends == course[[0, -1], :2].tolist()
        assert np.hypot(*step.T).max() < 1.01
        way = np.arctan2(*step.mean(axis=0))
        assert math.cos(heading - way) > 0.9999
        assert np.cos(course[:-1, 2] - np.arctan2(*step.T)).min() > 0.99
        tracks[name] = in_grid(from_agopengps(course, start))
    assert list(tracks) == [f"lane {label}" for label in lanes["label"]] + [f"row {label}" for label in rows["label"]]
    assert_same(list(tracks.values()), [*lanes.geometry, *rows.geometry])

    fence, drive, count, *course = (folder / "Boundary.txt").read_text(encoding="utf-8").splitlines()
    assert (fence, drive, int(count)) == ("$Boundary", "False", len(course))
    ring = shapely.Polygon(in_grid(from_agopengps([numbers(line, 3) for line in course], start)))
    assert ring.symmetric_difference(outline).area < 0.5


def graph(path):
    """Nodes and edges of a Nav2 route graph; an unknown or a missing key fails."""
    nodes, edges = {}, {}
    for feature in coordinates(path):
        assert set(feature) == {"type", "properties", "geometry"}
        properties, geometry = feature["properties"], feature["geometry"]
        if geometry["type"] == "Point":
            assert set(properties) == {"id", "frame"}
            nodes[properties["id"]] = (properties["frame"], *geometry["coordinates"])
        else:
            assert geometry["type"] == "MultiLineString"
            assert set(properties) == {"id", "startid", "endid", "cost", "overridable", "metadata"}
            way = [nodes[properties["startid"]][1:], nodes[properties["endid"]][1:]]
            assert geometry["coordinates"] == [[list(xy) for xy in way]]
            assert properties["cost"] == pytest.approx(math.dist(*way), abs=0.001)
            assert properties["cost"] > 0
            assert properties["overridable"] is True
            edges[properties["id"]] = properties
    assert not set(nodes) & set(edges)
    return nodes, edges


def test_nav2(exported, rows, lanes):
    nodes, edges = graph(exported / "nav2" / f"{NAME}_graph.geojson")
    origin = json.loads((exported / "nav2" / "run.json").read_text(encoding="utf-8"))["origin"]
    assert {frame for frame, *_ in nodes.values()} == {"map"}
    ways = {(edge["startid"], edge["endid"]) for edge in edges.values()}
    assert len(ways) == len(edges)
    assert {(b, a) for a, b in ways} == ways

    found, ends = [], []
    for lane in lanes["lane_id"]:
        mine = [e for e in edges.values() if e["metadata"].get("lane") == lane and e["startid"] < e["endid"]]
        assert all(set(e["metadata"]) == {"class", "lane", "clear_m"} for e in mine)
        chain = [mine[0]["startid"], *(e["endid"] for e in mine)]
        assert [e["startid"] for e in mine] == chain[:-1]
        found.append(np.array([nodes[k][1:] for k in chain]))
        ends.append((chain[0], chain[-1]))
    truth = [shapely.LineString(in_main(shapely.get_coordinates(g, include_z=True), origin)) for g in lanes.geometry]
    assert_same(found, truth)

    headlands = [e for e in edges.values() if e["metadata"]["class"] == "headland"]
    assert {(e["startid"], e["endid"]) for e in headlands if e["startid"] < e["endid"]} == {
        (ends[a][k], ends[a + 1][k]) for a in (0, 1, 3) for k in (0, 1)
    }
    vines = [shapely.LineString(in_main(shapely.get_coordinates(g, include_z=True), origin)) for g in rows.geometry]
    for edge in headlands:
        way = shapely.LineString([nodes[edge["startid"]][1:], nodes[edge["endid"]][1:]])
        assert edge["metadata"]["clear_m"] == pytest.approx(2 * shapely.distance(way, vines).min(), abs=0.02)
        assert edge["metadata"]["clear_m"] > 4
    for a, b in ways:
        assert not shapely.intersects(vines, shapely.LineString([nodes[a][1:], nodes[b][1:]])).any()
    a, b = np.array(sorted(ways)).T
    assert connected_components(coo_array((np.ones(len(a)), (a, b)), shape=[len(nodes)] * 2))[0] == 2


def field_of(path, frame):
    """Outline and rows of a file for opennav_row_coverage; what its parser wouldn't take fails."""
    root = ET.parse(path).getroot()
    assert root.tag == "GAOS_parcel"
    # Its XML parser knows no namespaces and takes tags as they are written.
    text = path.read_text(encoding="utf-8")
    assert all(
        f"<gml:{tag}" in text for tag in ("Polygon", "outerBoundaryIs", "LinearRing", "coordinates", "LineString")
    )
    (field,) = root.findall("Field")
    polygon = field.find(f"geometry/{GML}Polygon")
    rows = {int(row.get("id")): row.find(f"geometry/{GML}LineString") for row in root.findall("Row")}
    assert {polygon.get("srsName"), *(row.get("srsName") for row in rows.values())} == {frame}
    ring = pairs(polygon.find(f"{GML}outerBoundaryIs/{GML}LinearRing/{GML}coordinates").text)
    assert list(rows) == list(range(1, len(rows) + 1))
    lines = [pairs(row.find(f"{GML}coordinates").text) for row in rows.values()]
    assert len({len(line) for line in lines}) == 1
    assert (ring[0] == ring[-1]).all()
    assert all((line[-1] - line[0]) @ (lines[0][-1] - lines[0][0]) > 0 for line in lines)
    return shapely.Polygon(ring), lines


def pairs(text):
    assert "\n" not in text
    return np.array([[float(part) for part in pair.split(",")] for pair in text.split(" ")])


def test_opennav_coverage(exported, rows, lanes, outline):
    folder = exported / "opennav_coverage"
    origin = json.loads((folder / "run.json").read_text(encoding="utf-8"))["origin"]
    assert len(list(folder.glob("*.xml"))) == 4
    for block in (1, 2):
        for kind, layer in (("rows", rows), ("lanes", lanes)):
            polygon, lines = field_of(folder / f"{NAME}_{block}_{kind}.xml", "map")
            members = layer[layer["block"] == block]
            truth = [in_main(shapely.get_coordinates(g, include_z=True), origin) for g in members.geometry]
            assert_same(lines, [shapely.LineString(line) for line in truth])
            assert polygon.area == pytest.approx(outline.area, rel=0.002)


def test_robots_in_the_grid_and_another_frame_and_without_headland(tmp_path, product, rows, lanes):
    how = {"formats": ["nav2", "opennav_coverage"], "frame": "utm", "grid": True, "vertices": 9}
    list(export_products([product / f"{NAME}.gpkg"], tmp_path, **how))
    nodes, _ = graph(tmp_path / NAME / "nav2" / f"{NAME}_graph.geojson")
    vertices = shapely.get_coordinates(lanes_between(rows, vertices=9).geometry)
    assert len(vertices) == 9 * len(lanes)
    assert np.array([xy for _, *xy in nodes.values()]) == pytest.approx(vertices, abs=0.001)
    assert {frame for frame, *_ in nodes.values()} == {"utm"}
    _, lines = field_of(tmp_path / NAME / "opennav_coverage" / f"{NAME}_2_rows.xml", "utm")
    assert len(lines[0]) == 9
    list(export_products([product], tmp_path, formats=["nav2"], headland=0))
    _, edges = graph(tmp_path / NAME / "nav2" / f"{NAME}_graph.geojson")
    assert {edge["metadata"]["class"] for edge in edges.values()} == {"lane"}
    assert_same(lines, rows[rows["block"] == 2].geometry, within=0.05)


def test_the_same_again_and_what_others_put_there_stays(tmp_path, product, exported):
    list(export_products([product], tmp_path, formats=FORMATS, lines="both"))
    assert tree(tmp_path / NAME) == tree(exported)
    folder = tmp_path / NAME / "geojson"
    (folder / "notes.txt").write_text("mine")
    list(export_products([product], tmp_path, formats=["geojson"], lines="rows"))
    assert (folder / "notes.txt").read_text() == "mine"
    assert not (folder / f"{NAME}_lanes.geojson").exists()
    assert (folder / f"{NAME}_rows.geojson").exists()
    assert not list(tmp_path.rglob(".*"))


def test_the_command(tmp_path, product):
    done = vinemap("export", product, "--format", "isoxml", "--format", "geojson", "--outer", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{NAME}: 7 rows, 9 lanes → exports/{NAME} (isoxml, geojson)\n"
    assert sorted(path.name for path in (tmp_path / "exports" / NAME).iterdir()) == ["geojson", "isoxml"]
    assert_refused(vinemap("export", tmp_path, "--format", "all", cwd=tmp_path), str(tmp_path), "no product")
    assert_refused(vinemap("export", product, cwd=tmp_path), "--format")


def few(product, folder, n, **columns):
    """Copy a product, with its first n rows."""
    shutil.copytree(product, folder)
    path = folder / f"{NAME}.gpkg"
    rows = pyogrio.read_dataframe(path, layer="rows").assign(**columns)
    pyogrio.write_dataframe(rows[:n], path, layer="rows", geometry_type="LineString Z")
    return folder


def test_rows_of_unknown_width_and_a_single_one_of_unknown_spacing(tmp_path, product):
    bare = few(product, tmp_path / "bare", 4, width_m=np.nan)
    list(export_products([bare], tmp_path / "out", formats=FORMATS))
    _, edges = graph(tmp_path / "out" / NAME / "nav2" / f"{NAME}_graph.geojson")
    assert {"class": "lane", "lane": 1} in [edge["metadata"] for edge in edges.values()]
    single = few(product, tmp_path / "single", 1, spacing_m=np.nan)
    list(export_products([single], tmp_path / "out", formats=["isoxml"], lines="rows"))
    (line,) = ET.parse(tmp_path / "out" / NAME / "isoxml" / "TASKDATA" / "TASKDATA.XML").iterfind(".//GPN/LSG")
    assert "C" not in line.attrib


@pytest.mark.parametrize(("name", "file"), [("con", "_con"), ("con_1", "con_1"), ("a._1", "a._1")])
def test_files_of_blocks_are_not_taken_for_parcels(tmp_path, product, name, file):
    folder = shutil.copytree(product, tmp_path / "product")
    (folder / f"{NAME}.gpkg").rename(folder / f"{file}.gpkg")
    record = json.loads((folder / "run.json").read_text(encoding="utf-8")) | {"parcel": name}
    (folder / "run.json").write_text(json.dumps(record), encoding="utf-8")
    list(export_products([folder], tmp_path / "out", formats=["geojson", "opennav_coverage"]))
    written = {path.name for path in (tmp_path / "out" / file).rglob("*.*") if path.name != "run.json"}
    kinds = [f"{layer}.geojson" for layer in ("rows", "lanes", "row_ends", "gaps", "parcel")]
    kinds += [f"{block}_{layer}.xml" for block in (1, 2) for layer in ("rows", "lanes")]
    assert written == {f"{file}_{kind}" for kind in kinds}


def test_products_without_rows_or_lanes(tmp_path, product):
    none, one = few(product, tmp_path / "none", 0), few(product, tmp_path / "one", 1)
    out = tmp_path / "out"
    with pytest.raises(InputError, match="no row"):
        list(export_products([none], out, formats=FORMATS))
    with pytest.raises(InputError, match="no lane: ask for --outer"):
        list(export_products([one], out, formats=["isoxml"]))
    with pytest.raises(InputError, match="needs lanes"):
        list(export_products([one], out, formats=["nav2"], lines="rows"))
    with pytest.raises(InputError, match="two rows"):
        list(export_products([one], out, formats=["opennav_coverage"], lines="rows"))
    assert not out.exists()
    list(export_products([one], out, formats=["isoxml"], lines="rows"))
    list(export_products([one], out, formats=["nav2"], outer=True))
    assert sorted(path.name for path in (out / NAME).iterdir()) == ["isoxml", "nav2"]


def test_wrong_products_and_places(tmp_path, product):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=r"file.*can't be written"):
        list(export_products([product], tmp_path / "file" / "out", formats=["geojson"]))
    with pytest.raises(InputError, match=r"several products are called Côte 1"):
        list(export_products([product, product], tmp_path / "out", formats=["geojson"]))
    with pytest.raises(InputError, match=r"Côte 1\.gpkg is one"):
        list(export_products([product / f"{NAME}_dtm.tif"], tmp_path / "out", formats=["geojson"]))
    broken = tmp_path / "broken"
    broken.mkdir()
    shutil.copy(product / "run.json", broken)
    with pytest.raises(InputError, match="can't be read"):
        list(export_products([broken], tmp_path / "out", formats=["geojson"]))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken", "file"]
