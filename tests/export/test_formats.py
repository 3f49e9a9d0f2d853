"""Exports of maps, and of all formats alike, read back by parsers written from the formats' own descriptions."""

import json
import shutil
import struct
from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import pyogrio
import pytest
import shapely
from commands import assert_refused, vinemap
from exported import NAME, UTM, assert_same, coordinates, few, graph, in_grid
from products import tree

from vinemap.errors import InputError, OutputError
from vinemap.export import FORMATS
from vinemap.export.write import export_products


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


def test_the_same_again_and_what_others_put_there_stays(tmp_path, product, exported):
    list(export_products([product], tmp_path, formats=FORMATS, lines="both"))
    assert tree(tmp_path / NAME) == tree(exported)
    folder = tmp_path / NAME / "geojson"
    mine = [folder / "notes.txt", folder.parent / "isoxml" / "TASKDATA" / "TLG00001.XML"]
    mine.append(folder.parent / "agopengps" / NAME / "Sections.txt")
    for path in mine:
        path.write_text("mine")
    list(export_products([product], tmp_path, formats=["geojson", "isoxml", "agopengps"], lines="rows"))
    assert [path.read_text() for path in mine] == ["mine"] * 3
    assert not (folder / f"{NAME}_lanes.geojson").exists()
    assert (folder / f"{NAME}_rows.geojson").exists()
    assert not list(tmp_path.rglob(".*"))


def test_that_of_another_survey_is_not_replaced_unseen(tmp_path, product):
    """As where parcels of two have one name."""
    record = json.loads((product / "run.json").read_text(encoding="utf-8"))
    for survey in ("may", "june"):
        shutil.copytree(product, tmp_path / survey)
        (tmp_path / survey / "run.json").write_text(json.dumps(record | {"survey": survey}), encoding="utf-8")
    out = tmp_path / "out"
    lines = [*export_products([tmp_path / "may"], out, formats=["geojson"])]
    lines += export_products([tmp_path / "june"], out, formats=["geojson", "nav2"])
    lines += export_products([tmp_path / "june"], out, formats=["nav2"])
    assert [line.partition("; ")[2] for line in lines] == ["", "it replaces that of the survey may", ""]


def test_the_command(tmp_path, product):
    done = vinemap("export", product, "--format", "isoxml", "--format", "geojson", "--outer", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{NAME}: 7 rows, 9 lanes → exports/{NAME} (isoxml, geojson)\n"
    assert sorted(path.name for path in (tmp_path / "exports" / NAME).iterdir()) == ["geojson", "isoxml"]
    assert_refused(vinemap("export", tmp_path, "--format", "all", cwd=tmp_path), str(tmp_path), "no product")
    assert_refused(vinemap("export", product, cwd=tmp_path), "--format")


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
    (told,) = export_products([one], out, formats=["isoxml"], lines="rows")
    assert told == f"{NAME}: 1 rows → {out / NAME} (isoxml)"
    list(export_products([one], out, formats=["nav2"], outer=True))
    assert sorted(path.name for path in (out / NAME).iterdir()) == ["isoxml", "nav2"]


def test_products_without_rows_or_lanes_cost_others_nothing(tmp_path, product):
    none, one = few(product, tmp_path / "none", 0), few(product, tmp_path / "one", 1)
    with pytest.raises(InputError, match=r"none.*has no row to export; .*one.*no two rows are neighbours"):
        list(export_products([none, one, product], tmp_path / "out", formats=["geojson", "nav2"]))
    assert sorted(path.name for path in (tmp_path / "out" / NAME).iterdir()) == ["geojson", "nav2"]


@pytest.mark.parametrize(
    ("column", "drawn_as"),
    [("row_id", None), ("label", None), ("block", None), ("geometry", None), ("geometry", shapely.LineString())],
)
def test_a_row_drawn_by_hand(tmp_path, product, column, drawn_as):
    drawn = few(product, tmp_path / "drawn", 3)
    rows = pyogrio.read_dataframe(drawn / f"{NAME}.gpkg", layer="rows").astype({"row_id": "Int64", "block": "Int64"})
    rows.loc[1, column] = drawn_as
    pyogrio.write_dataframe(rows, drawn / f"{NAME}.gpkg", layer="rows", geometry_type="LineString Z")
    for format_ in ("geojson", "table"):
        with pytest.raises(InputError, match=rf"{NAME}\.gpkg: row with fid 2 has no {column}: fill that in, or delete"):
            list(export_products([drawn], tmp_path / "out", formats=[format_]))


@pytest.mark.parametrize("lost", ["width_m", "spacing_m", "heights"])
def test_a_product_that_was_saved_anew_without_something(tmp_path, product, lost):
    saved = few(product, tmp_path / "saved", 3)
    rows = pyogrio.read_dataframe(saved / f"{NAME}.gpkg", layer="rows")
    rows = rows.set_geometry(rows.geometry.force_2d()) if lost == "heights" else rows.drop(columns=lost)
    pyogrio.write_dataframe(rows, saved / f"{NAME}.gpkg", layer="rows")
    for format_ in ("geojson", "table"):
        with pytest.raises(InputError, match=f"its rows have no {lost} any more.*: map the parcel again"):
            list(export_products([saved], tmp_path / "out", formats=[format_]))


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
