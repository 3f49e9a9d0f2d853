"""Simulated surveys by another hand: rows, terrain and Table 2.1, by the bars that the product keeps."""

import json
from functools import cache

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import rasterio
import shapely
from pyproj import CRS
from scipy.spatial import cKDTree

from vinemap import paths
from vinemap.canopy.mesh import section_meshes, volume
from vinemap.canopy.numbers import judge_canopies, modelling_indices, summarise_rows
from vinemap.chain import RowMap, map_rows, model_canopies
from vinemap.cloud.las import read_cloud
from vinemap.cloud.points import PointCloud
from vinemap.config.settings import Settings
from vinemap.evaluate.rows import evaluate_rows
from vinemap.geo.boundaries import read_boundary
from vinemap.geo.main import Origin
from vinemap.parcel import map_parcel
from vinemap.surfaces.ground import terrain_model

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


def true_outlines(profiles, canopy):
    """True foliage (m polygons) at sections, leaves' reach included, and its height and half width there."""
    names = sorted({key.split("_")[0] for key in profiles if key.startswith("row")})
    xy = np.concatenate([np.column_stack([profiles[f"{n}_x"], profiles[f"{n}_y"]]) for n in names])
    height, half = (np.concatenate([profiles[f"{n}_{key}"] for n in names]) for key in ("height", "half_width"))
    distance, at = cKDTree(xy).query(canopy.origin[:, :2])
    away, way = xy[at] - canopy.origin[:, :2], canopy.tangent
    off = way[:, 0] * away[:, 1] - way[:, 1] * away[:, 0]
    up = np.linspace(0, 1, 41)
    shape = np.interp(up, profiles["shape_height"], profiles["shape_half_width"])
    bottom, reach = float(profiles["foliage_bottom"]), float(profiles["leaf_reach"])
    z = bottom + up * (height[at] - bottom)[:, None]
    right, left = (np.stack([off[:, None] + s * shape * half[at][:, None], z], axis=2) for s in (1, -1))
    rings = np.concatenate([right, left[:, ::-1]], axis=1)
    return shapely.buffer(shapely.polygons(rings), reach), (half[at] > 0.02) & (distance < 0.3)


@pytest.fixture(scope="module")
def modelled(shared):
    """Canopies of a shared survey, of a share of its points, each once."""

    @cache
    def modelled(name, share=1.0):
        source = shared / "surveys" / name
        points = read_cloud(source / f"{name}.laz", boundary=read_boundary(source / "boundary.gpkg"))
        chosen = np.random.default_rng(0).random(len(points.xyz)) < share
        points = PointCloud(points.xyz[chosen], points.crs)
        found = map_rows(points, Settings())
        return found, model_canopies(found, Settings())

    return modelled


@pytest.mark.parametrize("name", ["parcelF", "twoblocks", "riseholme"])
def test_canopies_against_the_true_profile(modelled, shared, name):
    found, model = modelled(name)
    with np.load(shared / "surveys" / name / "profiles.npz") as profiles:
        true, living = true_outlines(profiles, model.at)
    shared_area = shapely.area(shapely.intersection(shapely.make_valid(shapely.polygons(model.polygons)), true))
    good, under, over = modelling_indices(
        shared_area[living], shapely.area(shapely.polygons(model.polygons))[living], shapely.area(true)[living]
    )
    assert good.mean() >= 0.93
    assert under.mean() <= 0.07
    assert over.mean() <= 0.18
    assert (good - under - over).mean() >= 0.70
    assert model.table["over"].mean() <= 0.09
    rows = summarise_rows(found.rows, model.table, step=0.25)
    assert rows["volume_m3"].sum() == pytest.approx(shapely.area(true)[living].sum() * 0.25, rel=0.06)
    truth = gpd.read_file(shared / "surveys" / name / "truth.gpkg", layer="rows")
    pairs = evaluate_rows(rows[["geometry"]], truth[["geometry"]]).pairs[["row_id", "reference"]].astype(int)
    for mine, theirs in (("height_m", "mean_height"), ("width_m", "mean_width")):
        off = rows[mine].to_numpy()[pairs["row_id"] - 1] - truth[theirs].to_numpy()[pairs["reference"] - 1]
        assert np.abs(off).max() <= 0.05
    assert judge_canopies(rows, model.table, step=0.25)["canopy_confidence"].min() > 0.5


def test_canopies_of_airborne_lidar(modelled, shared):
    """Ten points a square metre, eight of which stand for a metre of canopy."""
    found, model = modelled("als10")
    rows = summarise_rows(found.rows, model.table, step=0.25)
    truth = gpd.read_file(shared / "surveys" / "als10" / "truth.gpkg", layer="rows")
    pairs = evaluate_rows(rows[["geometry"]], truth[["geometry"]]).pairs[["row_id", "reference"]].astype(int)
    mine, true = rows.iloc[pairs["row_id"] - 1], truth.iloc[pairs["reference"] - 1]
    assert len(pairs) == len(truth)
    assert np.abs(mine["height_m"].to_numpy() - true["mean_height"].to_numpy()).max() < 0.06
    assert np.abs(mine["width_m"].to_numpy() - true["mean_width"].to_numpy()).max() < 0.08
    with np.load(shared / "surveys" / "als10" / "profiles.npz") as profiles:
        area, living = true_outlines(profiles, model.at)
    assert mine["volume_m3"].sum() == pytest.approx(shapely.area(area)[living].sum() * 0.25, rel=0.1)


def test_canopies_whose_volumes_do_not_follow_truth_are_doubtful(modelled):
    found, model = modelled("stereo_straight_poor")
    rows = judge_canopies(summarise_rows(found.rows, model.table, step=0.25), model.table, step=0.25)
    assert len(rows) == 14
    assert rows["canopy_confidence"].median() < 0.4


def test_canopies_of_a_thinner_cloud(modelled):
    """A third of the points tells the same volume, height and width."""
    full, thin = (
        summarise_rows(f.rows, m.table, step=0.25) for f, m in (modelled("parcelF"), modelled("parcelF", 0.35))
    )
    assert np.abs(thin["volume_m3"] / full["volume_m3"] - 1).max() < 0.08
    assert np.abs(thin["height_m"] - full["height_m"]).max() < 0.05
    assert np.abs(thin["width_m"] - full["width_m"]).max() < 0.08


def test_the_real_row(shared):
    """One row scanned by a tractor's lidar: its package's examples have a canopy 0.426 m wide."""
    xyz = np.asarray(laspy.read(shared / "real" / "vine_row_1p9m.las").xyz)
    points = PointCloud(xyz, CRS.from_epsg(25831))
    dtm = terrain_model(points)
    middle = np.median(xyz[xyz[:, 2] > 0.5, 1])
    line = shapely.LineString([(0, middle, 0), (1.9, middle, 0)])
    rows = gpd.GeoDataFrame({"row_id": [1], "label": ["1"], "spacing_m": [2.5]}, geometry=[line], crs=points.crs)
    none = gpd.GeoDataFrame({key: np.empty(0) for key in ("row_id", "start_m", "end_m")}, geometry=[], crs=points.crs)
    found = RowMap(points.above(dtm), dtm, None, None, None, None, 0, rows, none)
    model = model_canopies(found, Settings())
    rows = summarise_rows(rows, model.table, step=0.25)
    assert len(model.table) == 9
    assert rows["height_m"].iloc[0] == pytest.approx(1.5, abs=0.15)
    assert rows["width_m"].iloc[0] == pytest.approx(0.43, abs=0.06)
    assert rows["bottom_m"].iloc[0] == pytest.approx(0.5, abs=0.1)
    (mesh,) = section_meshes(model.at, model.polygons, rows, step=0.25)
    assert volume(mesh) == pytest.approx(rows["volume_m3"].iloc[0], rel=0.1)


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


@pytest.mark.parametrize("name", ["parcelF", "twoblocks", "riseholme"])
def test_vines_one_by_one(product, shared, name):
    truth = shared / "surveys" / name / "truth.gpkg"
    planted = gpd.read_file(truth, layer="rows")["n_vines"].sum()
    dead = shapely.force_2d(gpd.read_file(truth, layer="dead_vines").geometry.to_numpy())
    vines = gpd.read_file(paths.geopackage(product(name), name), layer="vines")
    missing = shapely.force_2d(vines.geometry[vines["state"] == "missing"].to_numpy())
    apart = shapely.distance(missing[:, None], dead)
    spacing = rows_of(product(name), name)["length_m"].sum() / planted
    assert abs(len(vines) - planted) <= 0.02 * planted
    assert np.mean(apart.min(axis=0) < 0.3 * spacing) >= 0.97
    assert np.mean(apart.min(axis=1) < 0.3 * spacing) >= 0.97
    assert vines.groupby("row_id")["volume_m3"].sum().to_numpy() == pytest.approx(
        rows_of(product(name), name)["volume_m3"].to_numpy(), rel=0.01
    )


@pytest.mark.parametrize("name", ["parcelF", "twoblocks", "riseholme"])
def test_of_trees_and_a_hut_beside_the_rows_none_is_taken_for_vines(product, name):
    folder = product(name)
    unmapped = gpd.read_file(paths.geopackage(folder, name), layer="unmapped")
    assert set(unmapped["reason"]) <= {"too tall", "too wide"}
    assert json.loads((folder / "run.json").read_text())["warnings"] == []


def test_no_vines_no_rows(product):
    folder = product("nothing")
    assert len(rows_of(folder, "nothing")) == 0
    record = json.loads((folder / "run.json").read_text())
    assert record["counts"]["rows"] == 0
    why, unit = record["warnings"]
    assert why.startswith("no row was found in what stands on ")
    assert "too tall for vines" in why
    assert unit.endswith("are heights in metres? Their unit is told by --crs EPSG:n+m")


@pytest.mark.parametrize("name", ["parcelF", "twoblocks", "riseholme"])
def test_terrain(product, shared, name):
    x, y, z = np.load(shared / "surveys" / name / "dtm_truth.npy").T
    with rasterio.open(paths.raster(product(name), name, "dtm")) as src:
        error = np.array([v[0] for v in src.sample(np.column_stack([x, y]))]) - z
    assert abs(np.mean(error)) <= 0.003
    assert np.median(np.abs(error)) <= 0.012
    assert np.quantile(np.abs(error), 0.95) <= 0.04


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
