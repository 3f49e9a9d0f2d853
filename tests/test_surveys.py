"""Simulated surveys by another hand: rows, terrain and Table 2.1, by the bars that the product keeps."""

import json

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import rasterio

from vinemap import paths
from vinemap.crs import Origin
from vinemap.evaluate import evaluate_rows
from vinemap.parcel import map_parcel

ORIGIN = Origin(44.611669149, 7.924423195, 428.735)


@pytest.fixture(scope="module")
def product(shared, tmp_path_factory):
    """Map a shared survey, each one once."""
    done = {}

    def product(name):
        if name not in done:
            source = shared / "surveys" / name
            folder = tmp_path_factory.mktemp("products") / name
            origin = ORIGIN if name == "parcelF" else None
            map_parcel(source / f"{name}.laz", folder, parcel=name, boundary=source / "boundary.gpkg", origin=origin)
            done[name] = folder
        return done[name]

    return product


def rows_of(folder, name):
    return gpd.read_file(paths.geopackage(folder, name), layer="rows")


@pytest.mark.parametrize(("name", "n"), [("parcelF", 16), ("twoblocks", 26), ("riseholme", 10)])
def test_all_rows_and_no_other(product, shared, name, n):
    truth = gpd.read_file(shared / "surveys" / name / "truth.gpkg", layer="rows")
    found = evaluate_rows(rows_of(product(name), name), truth)
    assert (found.good, found.extra, found.missed) == (100, 0, 0)
    assert len(found.pairs) == n
    assert found.dep.mean <= 0.07
    assert found.dek.mean <= 0.015
    assert found.cof.mean <= 0.015
    assert found.pairs[["dek_m", "cof_m"]].to_numpy().max() <= 0.03
    assert abs(found.pairs[["e1_along_m", "en_along_m"]].to_numpy().mean()) <= 0.03


def test_no_vines_no_rows(product):
    folder = product("nothing")
    assert len(rows_of(folder, "nothing")) == 0
    assert json.loads((folder / "run.json").read_text())["counts"]["rows"] == 0


def test_terrain(product, shared):
    x, y, z = np.load(shared / "surveys" / "parcelF" / "dtm_truth.npy").T
    with rasterio.open(paths.raster(product("parcelF"), "parcelF", "dtm")) as src:
        error = np.abs(np.array([v[0] for v in src.sample(np.column_stack([x, y]))]) - z)
    assert np.median(error) <= 0.025
    assert np.quantile(error, 0.95) <= 0.06


def test_table_2_1(product, shared):
    table = pd.read_csv(shared / "thesis" / "table_2_1.csv")
    rows = rows_of(product("parcelF"), "parcelF")
    assert len(rows) == 16
    for end, columns in (("e1", ["x1", "y1", "z1"]), ("en", ["xn_corrected", "yn_corrected", "zn_corrected"])):
        off = rows[[f"{end}_{axis}" for axis in "xyz"]].to_numpy() - table[columns].to_numpy()
        assert np.linalg.norm(off, axis=1).max() <= 0.25
    for end, k in (("e1", "1"), ("en", "n")):
        degrees = rows[[f"{end}_lat", f"{end}_lon"]].to_numpy() - table[[f"lat{k}", f"lon{k}"]].to_numpy()
        off = degrees * [111_100, 111_300 * np.cos(np.radians(44.615))]
        up = rows[f"{end}_alt"] - table[f"alt{k}"]
        assert np.sqrt((off**2).sum(axis=1) + up**2).max() <= 0.25
    assert np.abs(rows["length_m"] - table["length_m"]).max() <= 0.4
    assert np.abs(rows["elevation_m"] - ORIGIN.alt - table["elevation_as_printed_m"]).max() <= 0.15
    assert np.abs(rows["n_key_points"] - table["n_key_points"]).max() <= 2
