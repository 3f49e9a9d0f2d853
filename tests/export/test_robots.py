"""Exports for robots, read back by parsers written from the formats' own descriptions."""

import json
import math
from xml.etree import ElementTree as ET

import geopandas as gpd
import numpy as np
import pytest
import shapely
from exported import NAME, UTM, assert_same, graph
from pyproj import Transformer
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from vinemap.export.field import Field
from vinemap.export.lanes import lanes_between
from vinemap.export.opennav_coverage import write_opennav_coverage
from vinemap.export.write import export_products
from vinemap.geo.main import Corner

GML = "{http://www.opengis.net/gml}"


def in_main(xyz, origin):
    """Points of the product's CRS in the topocentric frame at an origin, by rotation of geocentric coordinates."""
    to_globe = Transformer.from_crs(UTM.to_3d(), 4978, always_xy=True)
    zero = Transformer.from_crs(4979, 4978, always_xy=True).transform(origin["lon"], origin["lat"], origin["alt"])
    lat, lon = np.radians([origin["lat"], origin["lon"]])
    east = [-math.sin(lon), math.cos(lon), 0]
    north = [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)]
    return (np.column_stack(to_globe.transform(*xyz.T)) - zero) @ np.column_stack([east, north])


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


def test_opennav_coverage_of_rows_that_are_numbered_and_drawn_anyhow(tmp_path):
    x = np.array([0, 2.5, 5, 7.5])
    ways = [[(at, 0, 0), (at + lean, 40, 0)] for at, lean in zip(x, (0.1, -0.1, 0.1, -0.1), strict=True)]
    drawn = [shapely.LineString(way if k % 2 else way[::-1]) for k, way in enumerate(ways)]
    rows = gpd.GeoDataFrame({"row_id": [1, 4, 2, 3], "block": 1, "spacing_m": 2.5}, geometry=drawn, crs=UTM)
    rows = rows.sort_values("row_id", ignore_index=True)
    outline = gpd.GeoDataFrame(geometry=[shapely.union_all(drawn).buffer(2)], crs=UTM)
    rest = {"folder": tmp_path, "parcel": "A", "survey": "A", "flown": "2026-06-01", "key": "", "outline": outline}
    lanes = lanes_between(rows)
    field = Field(**rest, origin=Corner(0, 0, 0), rows=rows, lanes=lanes, row_ends=rows, gaps=rows, bounded=True)
    write_opennav_coverage(field, tmp_path, frame="map", grid=True, vertices=None)
    for kind, middles in (("rows", x), ("lanes", x[:-1] + 1.25)):
        _, lines = field_of(tmp_path / f"A_{kind}.xml", "map")
        assert [line[:, 0].mean() for line in lines] == pytest.approx(middles, abs=0.1)
