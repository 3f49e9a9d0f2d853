"""Tables of rows and vines over dates, read back as other tools read them."""

import json
import shutil
from datetime import date
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
import shapely
from products import place_product

from vinemap.errors import InputError
from vinemap.export.table import ROWS
from vinemap.export.write import export_products
from vinemap.product.layers import LAYERS

JUNE, SEPTEMBER = "2026-06-18", "2026-09-14"


def lines(kept, *, shift=(0.0, 0.0), length=40.0):
    """Rows 2.5 m apart, of so many places those that are kept."""
    x, y = np.add([400_000.0, 5_000_000.0], shift)
    return [shapely.LineString([(x, y + 2.5 * k, 100), (x + length, y + 2.5 * k, 101)]) for k in kept]


def test_a_table_has_the_columns_of_the_layer():
    in_main = {f"{end}_{axis}" for end in ("e1", "en") for axis in "xyz"}
    left_out = {*in_main, "e1_alt", "en_alt", "n_key_points"}
    assert set(LAYERS["rows"].columns) - set(ROWS) == left_out


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Products of two surveys: B, called b later, lies elsewhere; of A's rows the second is gone, another is new."""
    folder = tmp_path_factory.mktemp("products")
    for survey, flown, kept, shift in (
        ("june", JUNE, (0, 1, 2, 3), (0.3, -0.2)),
        ("fall", SEPTEMBER, (0, 2, 3, 4), (0, 0)),
    ):
        height = [1.5, np.nan, 1.5, 1.5] if survey == "june" else 1.8
        place_product(folder / survey, "A", lines(kept, shift=shift), survey=survey, flown=flown, height_m=height)
        name, far = ("B" if survey == "june" else "b"), np.add(shift, [0, 90])
        place_product(folder / survey, name, lines((0, 1), shift=far), survey=survey, flown=flown)
        (folder / survey / "survey.json").write_text("{}")
    return folder


@pytest.fixture
def seasons(flown, tmp_path):
    return Path(shutil.copytree(flown, tmp_path / "products"))


def export(products, out):
    *_, told = export_products(products, out, formats=["table"])
    return told, out / "table"


def test_a_line_a_row_and_date(seasons, tmp_path):
    told, folder = export(
        [seasons / "june", seasons / "fall" / "A", seasons / "fall" / "b" / "b.gpkg"], tmp_path / "out"
    )
    assert told.startswith("table: 12 lines of rows (csv")
    table = pd.read_csv(folder / "rows.csv")
    assert len(table) == 12
    assert not table.duplicated(["survey", "date", "parcel", "label"]).any()
    assert table["date"].tolist() == [JUNE] * 6 + [SEPTEMBER] * 6
    mine = table[table["parcel"] == "A"]
    assert mine[mine["survey"] == "june"]["row"].tolist() == ["1 A", f"2 A ({JUNE})", "2 A", "3 A"]
    assert mine[mine["survey"] == "fall"]["row"].tolist() == ["1 A", "2 A", "3 A", "4 A"]
    grown = mine.pivot_table(index="row", columns="date", values="height_m").dropna()
    assert (grown[SEPTEMBER] - grown[JUNE]).round(3).tolist() == [0.3] * 3
    assert np.isnan(mine["height_m"].iloc[1])
    assert table[table["parcel"].isin(["B", "b"])]["row"].tolist() == ["1 b", "2 b"] * 2


def test_what_the_columns_are_stands_beside_them(seasons, tmp_path):
    _, folder = export([seasons / "fall"], tmp_path / "out")
    package = json.loads((folder / "datapackage.json").read_text(encoding="utf-8"))
    (resource,) = package["resources"]
    table = pd.read_csv(folder / resource["path"])
    fields = {field["name"]: field for field in resource["schema"]["fields"]}
    assert list(fields) == table.columns.tolist()
    assert all(field["description"] for field in fields.values())
    assert (fields["height_m"]["type"], fields["height_m"]["unit"]) == ("number", "m")
    assert (fields["n_missing"]["type"], fields["date"]["type"]) == ("integer", "date")
    assert set(resource["schema"]["primaryKey"]) <= set(fields)
    numbers = [name for name, field in fields.items() if field["type"] == "number"]
    assert all(pd.api.types.is_numeric_dtype(table[name]) and fields[name]["unit"] for name in numbers)
    record = json.loads((folder / "run.json").read_text())
    assert [one["parcel"] for one in record["products"]] == ["A", "b"]


def test_vines_come_where_there_are_some(seasons, tmp_path):
    path = seasons / "fall" / "A" / "A.gpkg"
    vines = {"row_id": 2, "label": "2 A", "number": [1, 2], "position_m": [0.5, 1.5], "state": ["vine", "missing"]}
    places = gpd.points_from_xy([400_000.5, 400_001.5], [5_000_005.0] * 2, [100, 100])
    frame = gpd.GeoDataFrame(vines | {"height_m": [1.8123456, np.nan]}, geometry=places, crs=32632)
    pyogrio.write_dataframe(frame, path, layer="vines", driver="GPKG", append=True)
    told, folder = export([seasons / "june", seasons / "fall"], tmp_path / "out")
    assert "12 lines of rows, 2 lines of vines" in told
    table = pd.read_csv(folder / "vines.csv")
    assert table["row"].tolist() == ["2 A"] * 2
    assert table["state"].tolist() == ["vine", "missing"]
    assert table["height_m"].iloc[0] == 1.812
    assert table["volume_m3"].isna().all()
    assert table["lat"].iloc[0] == pytest.approx(45.14, abs=0.1)
    names = [r["name"] for r in json.loads((folder / "datapackage.json").read_text())["resources"]]
    assert names == ["rows", "vines"]


def test_rows_whose_ends_have_changed_places_are_told(tmp_path):
    for survey, flown, turned in (("june", JUNE, (1,)), ("fall", SEPTEMBER, ())):
        rows = [shapely.reverse(line) if k in turned else line for k, line in enumerate(lines(range(4)))]
        place_product(tmp_path / survey, "A", rows, survey=survey, flown=flown)
    _, folder = export([tmp_path / survey / "A" for survey in ("june", "fall")], tmp_path / "out")
    table = pd.read_csv(folder / "rows.csv")
    assert table.loc[table["turned"] == 1, ["survey", "row"]].to_numpy().tolist() == [["june", "2 A"]]


def test_parquet_holds_the_same_with_units(seasons, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow: pip install 'vinemap[parquet]'")
    _, folder = export([seasons / "fall"], tmp_path / "out")
    table = parquet.read_table(folder / "rows.parquet")
    assert table.schema.field("height_m").metadata == {
        b"unit": b"m",
        b"description": b"Height of the canopy above ground",
    }
    assert set(table["date"].to_pylist()) == {date(2026, 9, 14)}
    assert table["height_m"].to_pylist() == pd.read_csv(folder / "rows.csv")["height_m"].tolist()


def test_without_pyarrow_it_is_said(seasons, tmp_path, monkeypatch):
    monkeypatch.setattr("vinemap.export.table.find_spec", lambda name: None)
    told, folder = export([seasons / "fall"], tmp_path / "out")
    assert "Parquet needs pyarrow" in told
    assert not (folder / "rows.parquet").exists()


def test_one_given_twice_counts_once_and_two_of_one_date_are_refused(seasons, tmp_path):
    told, _ = export([seasons / "fall" / "A", seasons / "fall"], tmp_path / "out")
    assert "table: 6 lines" in told
    place_product(tmp_path / "again", "A", lines((0, 1)), survey="fall", flown=SEPTEMBER)
    with pytest.raises(InputError, match=f"both are A of fall, flown on {SEPTEMBER}: leave one out"):
        export([seasons / "fall", tmp_path / "again" / "A"], tmp_path / "out2")
    assert not (tmp_path / "out2").exists()


def test_a_folder_of_products_means_all_of_them(seasons, tmp_path):
    (seasons / "fall" / "survey.json").unlink(missing_ok=True)  # as where its parcels were mapped one by one
    told, _ = export([seasons / "fall"], tmp_path / "out")
    assert "table: 6 lines" in told


def test_a_survey_without_products_is_refused(seasons, tmp_path):
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "survey.json").write_text("{}")
    with pytest.raises(InputError, match="no parcel of this survey"):
        export([tmp_path / "none"], tmp_path / "out")
    (seasons / "june" / "A" / "A.gpkg").write_bytes(b"no GeoPackage")
    with pytest.raises(InputError, match=r"A\.gpkg: can't be read"):
        export([seasons / "june"], tmp_path / "out")
