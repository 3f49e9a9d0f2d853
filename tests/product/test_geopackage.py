"""The GeoPackage's contract, its styles, and boundaries."""

import sqlite3
import xml.etree.ElementTree as ET

import geopandas as gpd
import pandas as pd
import pyogrio
import pytest
import shapely

from vinemap.errors import OutputError
from vinemap.product.geopackage import write_geopackage, write_layer
from vinemap.product.layers import LAYERS, conform

CONTRACT = {
    "rows": (
        "row_id label length_m orientation_deg elevation_m elevation_diff_m n_key_points e1_x e1_y e1_z en_x en_y en_z "
        "e1_lat e1_lon e1_alt en_lat en_lon en_alt spacing_m height_m width_m volume_m3 gap_m "
        "n_missing block support confidence flags bottom_m trv_m3_ha lwa_m2_ha canopy_confidence unseen_m "
        "mesh_error_m"
    ).split(),
    "row_ends": "row_id label end beyond".split(),
    "key_points": "row_id label order position_m".split(),
    "sections": (
        "row_id label position_m height_m bottom_m width_m area_m2 n_points extent_m "
        "trv_m3_ha lwa_m2_ha good under over reduction quality"
    ).split(),
    "gaps": "row_id label start_m end_m length_m n_missing state".split(),
    "vines": "row_id label number position_m state height_m width_m volume_m3 position_sd_m".split(),
    "unmapped": "reason area_m2 share height_m width_m".split(),
    "parcel": (
        "parcel n_rows rows_length_m area_m2 spacing_m orientation_deg gap_m n_missing vine_spacing_m vertical_datum "
        "unseen_m"
    ).split(),
}
GEOMETRY = {
    "rows": "LineString Z",
    "row_ends": "Point Z",
    "key_points": "Point Z",
    "sections": "LineString Z",
    "gaps": "LineString Z",
    "vines": "Point Z",
    "unmapped": "MultiPolygon",
    "parcel": "MultiPolygon",
}


def table(layer, n=2):
    shapes = {
        "LineString Z": shapely.LineString([[0, 0, 1], [3, 4, 2]]),
        "Point Z": shapely.Point(1, 2, 3),
        "MultiPolygon": shapely.MultiPolygon([shapely.box(0, 0, 5, 5)]),
    }
    sample = {"str": "a", "int64": 1, "float64": 0.5}
    columns = {name: [sample[kind]] * n for name, kind in LAYERS[layer].columns.items()}
    crs = 4326 if layer == "row_ends" else 32632
    return gpd.GeoDataFrame(columns, geometry=[shapes[LAYERS[layer].geometry]] * n, crs=crs)


def test_layers_and_columns_are_the_contracts():
    assert {name: list(layer.columns) for name, layer in LAYERS.items()} == CONTRACT
    assert {name: layer.geometry for name, layer in LAYERS.items()} == GEOMETRY


@pytest.mark.parametrize("n", [0, 2])
def test_geopackage_opens_with_all_layers(tmp_path, n):
    path = tmp_path / "a.gpkg"
    write_geopackage({name: table(name, n) for name in LAYERS}, path)
    listed = {str(name): geometry for name, geometry in pyogrio.list_layers(path)}
    assert {k: v for k, v in listed.items() if k != "layer_styles"} == GEOMETRY
    for name, columns in CONTRACT.items():
        frame = gpd.read_file(path, layer=name)
        assert [c for c in frame.columns if c != "geometry"] == columns
        assert len(frame) == n
        assert frame.crs.to_epsg() == (4326 if name == "row_ends" else 32632)
    assert pyogrio.read_info(path, layer="rows")["geometry_name"] == "geom"


def test_styles_are_what_qgis_looks_for(tmp_path):
    path = tmp_path / "a.gpkg"
    write_geopackage({name: table(name) for name in LAYERS}, path)
    with sqlite3.connect(path) as db:
        styles = pd.read_sql("SELECT * FROM layer_styles", db)
        contents = dict(db.execute("SELECT table_name, data_type FROM gpkg_contents").fetchall())
        version = db.execute("PRAGMA user_version").fetchone()[0]
    db.close()
    assert version == 10200
    assert contents["layer_styles"] == "attributes"
    assert set(styles["f_table_name"]) == set(LAYERS)
    assert (styles["f_geometry_column"] == "geom").all()
    assert (styles["f_table_schema"] == "").all()
    assert styles["useAsDefault"].astype(bool).all()
    for name, text in zip(styles["f_table_name"], styles["styleQML"], strict=True):
        style = ET.fromstring(text)
        aliases = {a.get("field"): a.get("name") for a in style.iter("alias")}
        assert list(aliases) == CONTRACT[name]
        assert style.find(".//symbol/layer") is not None


def test_missing_column_is_named():
    with pytest.raises(ValueError, match="rows lacks length_m"):
        conform(table("rows").drop(columns="length_m"), "rows")


def test_a_layer_replaces_an_earlier_one_and_nothing_else(tmp_path):
    pairs, drawn, text = (tmp_path / name for name in ("pairs.gpkg", "drawn.gpkg", "text.gpkg"))
    lines = gpd.GeoDataFrame(geometry=[shapely.LineString([(0, 0), (9, 9)])], crs=32632)
    for _ in range(2):
        write_layer(lines, pairs, layer="pairs")
    lines.to_file(drawn, layer="reference")
    lines.to_file(drawn, layer="pairs")
    text.write_text("notes")
    for path, why in ((drawn, "holds other layers"), (text, "is there, and isn't a GeoPackage of pairs")):
        before = path.read_bytes()
        with pytest.raises(OutputError, match=why):
            write_layer(lines, path, layer="pairs")
        assert path.read_bytes() == before
