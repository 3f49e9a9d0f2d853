"""What people change of a product in QGIS outlives the next one."""

import json
import os
import zipfile
from datetime import UTC, datetime

import geopandas as gpd
import pyogrio
import pytest
import shapely

from vinemap.product import store
from vinemap.product.qgis.changed import changed
from vinemap.product.recipe import product_in

RECORD = {"key": "k", "parcel": "F", "counts": {"rows": 2}, "length_m": 9.0, "warnings": []}
THEN = datetime(2026, 7, 1, 12, 30, 5, tzinfo=UTC).timestamp()


def fill(folder):
    table = gpd.GeoDataFrame({"label": ["1 F", "2 F"]}, geometry=shapely.points([[0, 0], [0, 2]]), crs=32632)
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": "2026-07-01T00:00:00.000Z"})
    try:
        for layer in ("rows", "parcel"):
            pyogrio.write_dataframe(table, folder / "F.gpkg", layer=layer)
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
    with zipfile.ZipFile(folder / "F.qgz", "w") as project:
        project.writestr("F.qgs", "<qgis/>")
    (folder / "F_dtm.tif").write_bytes(b"metres")
    sizes = {path.name: path.stat().st_size for path in folder.iterdir()}
    (folder / "run.json").write_text(json.dumps(RECORD | {"files": sizes}))


@pytest.fixture
def product(tmp_path):
    with store.product(tmp_path / "F") as draft:
        fill(draft)
    return tmp_path / "F"


def draw(product):
    """Add a row, as by hand."""
    row = pyogrio.read_dataframe(product / "F.gpkg", layer="rows").iloc[:1].assign(label="mine")
    pyogrio.write_dataframe(row, product / "F.gpkg", layer="rows", append=True)


def colour(product):
    with zipfile.ZipFile(product / "F.qgz", "a") as project:
        project.writestr("colours", "red")


@pytest.mark.parametrize("replace", [True, False])
def test_what_was_changed_stays_under_another_name(product, replace, monkeypatch):
    if not replace:
        monkeypatch.setattr(store, "_exchange", lambda *_: (_ for _ in ()).throw(OSError(18, "another disk")))
    draw(product)
    colour(product)
    for name in ("F.gpkg", "F.qgz"):
        os.utime(product / name, (THEN, THEN))
    kept = {"F.gpkg": "F_20260701T123005.gpkg", "F.qgz": "F_20260701T123005.qgz"}
    assert changed(product) == kept
    for _ in range(2):
        with store.product(product) as draft:
            fill(draft)
        assert changed(product) == {}
        assert pyogrio.read_dataframe(product / "F.gpkg", layer="rows")["label"].tolist() == ["1 F", "2 F"]
        assert "mine" in pyogrio.read_dataframe(product / kept["F.gpkg"], layer="rows")["label"].tolist()
        assert zipfile.ZipFile(product / kept["F.qgz"]).namelist() == ["F.qgs", "colours"]


def test_a_product_that_was_changed_is_still_one(product):
    assert changed(product) == {}
    draw(product)
    colour(product)
    assert product_in(product).parcel == "F"
    (product / "F_dtm.tif").write_bytes(b"m")
    assert product_in(product) is None


def test_what_is_damaged_is_no_change(product):
    for name in ("F.gpkg", "F.qgz"):
        whole = (product / name).read_bytes()
        draw(product) if name == "F.gpkg" else colour(product)
        for length in (0, 100, len(whole) // 2):
            os.truncate(product / name, length)
            assert changed(product) == {}
            assert product_in(product) is None
        (product / name).write_bytes(whole)
    assert product_in(product)
