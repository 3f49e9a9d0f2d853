"""Numbering and Table 2.1's attributes."""

from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from pyproj import CRS

from vinemap.geo.crs import from_wgs84
from vinemap.geo.main import Origin
from vinemap.rows.blocks import group_blocks
from vinemap.rows.numbers import describe_rows, number_rows

UTM = CRS.from_epsg(32632)
ORIGIN = Origin(44.611669149, 7.924423195, 428.735)
TABLE = pd.read_csv(Path(__file__).parents[2] / "data" / "table_2_1.csv")


def frame(lines, spacing=2.5):
    geometry = [shapely.LineString(np.column_stack([c, np.zeros(len(c))])) for c in lines]
    return group_blocks(gpd.GeoDataFrame({"spacing_m": [spacing] * len(lines)}, geometry=geometry, crs=UTM))


def no_gaps():
    columns = {c: np.empty(0) for c in ("row", "start_m", "end_m", "length_m")}
    return gpd.GeoDataFrame(columns, geometry=[], crs=UTM)


def parallel(n, azimuth, length=30, spacing=2.5, at=(0, 0)):
    angle = np.radians(azimuth)
    way, normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    return [np.array([at + k * spacing * normal, at + k * spacing * normal + length * way]) for k in range(n)]


@pytest.mark.parametrize("azimuth", [0, 20, 44, -30, 160, 200, -44])
def test_rows_are_numbered_from_south_to_north_starting_in_the_west(azimuth):
    lines = parallel(5, azimuth)
    order = np.random.default_rng(0).permutation(5)
    rows, _ = number_rows(frame([lines[k] for k in order]), no_gaps())
    assert list(rows["row_id"]) == [1, 2, 3, 4, 5]
    ends = np.array([shapely.get_coordinates(g)[[0, -1]] for g in rows.geometry])
    assert (ends[:, 0, 0] <= ends[:, 1, 0] + 1e-9).all()
    middle = ends.mean(axis=1)
    assert (np.diff(middle[:, 1]) > 0).all()


@pytest.mark.parametrize("azimuth", [90, 270, 46, 89, 91, 100, -80])
def test_rows_that_run_north_are_numbered_from_west_to_east(azimuth):
    rows, _ = number_rows(frame(parallel(4, azimuth)[::-1]), no_gaps())
    x = [g.centroid.x for g in rows.geometry]
    assert (np.diff(x) > 0).all()


def test_blocks_follow_each_other():
    lines = parallel(4, 10, at=np.array([0, 0])) + parallel(4, 80, at=np.array([60, 0]))
    rows, _ = number_rows(frame([lines[k] for k in (7, 0, 5, 2, 4, 3, 6, 1)]), no_gaps())
    x = np.array([g.centroid.x for g in rows.geometry])
    assert (x[:4] < 40).all()
    assert (x[4:] > 40).all()


def test_gaps_turn_with_their_row():
    line = np.array([[30.0, 0], [0, 0]])
    gap = gpd.GeoDataFrame(
        {"row": [0], "start_m": [5.0], "end_m": [8.0], "length_m": [3.0]},
        geometry=[shapely.LineString([[25, 0, 0], [22, 0, 0]])],
        crs=UTM,
    )
    _, gaps = number_rows(frame([line]), gap)
    assert (gaps["start_m"][0], gaps["end_m"][0], gaps["row_id"][0]) == (22.0, 25.0, 1)
    assert shapely.get_coordinates(gaps.geometry[0])[0, 0] == 22


def test_table_2_1_comes_back():
    """The table's own end points, described again: both frames, order, orientation and number of key points."""
    e1 = from_wgs84(TABLE[["lat1", "lon1", "alt1"]], UTM)
    en = from_wgs84(TABLE[["latn", "lonn", "altn"]], UTM)
    lines = [shapely.LineString([a, b]) for a, b in zip(e1, en, strict=True)]
    order = np.random.default_rng(0).permutation(16)
    scrambled = gpd.GeoDataFrame(
        {"spacing_m": [2.6] * 16}, geometry=[shapely.reverse(lines[k]) for k in order], crs=UTM
    )
    rows, ends, points = describe_rows(number_rows(group_blocks(scrambled), no_gaps())[0], parcel="F", origin=ORIGIN)
    assert list(rows["label"]) == [f"{k} F" for k in range(1, 17)]
    assert np.abs(rows[["e1_x", "e1_y"]].to_numpy() - TABLE[["x1", "y1"]].to_numpy()).max() < 0.005
    assert np.abs(rows[["en_x", "en_y"]].to_numpy() - TABLE[["xn_corrected", "yn_corrected"]].to_numpy()).max() < 0.005
    assert np.abs(rows[["e1_lat", "en_lat"]].to_numpy() - TABLE[["lat1", "latn"]].to_numpy()).max() < 1e-8
    assert np.abs(rows[["e1_lon", "en_lon"]].to_numpy() - TABLE[["lon1", "lonn"]].to_numpy()).max() < 1e-8
    assert np.abs(rows["length_m"] - TABLE["length_m"]).max() < 0.4
    assert np.abs(rows["n_key_points"] - TABLE["n_key_points"]).max() <= 2
    # The table prints whole degrees, and of row 14 more than its chord's, as it bends.
    off = rows["orientation_deg"] - TABLE["orientation_deg"]
    assert np.abs(off[TABLE["id"] != 14]).max() < 1.2
    assert len(ends) == 32
    assert ends.crs.to_epsg() == 4326
    assert list(points.groupby("row_id")["order"].max()) == list(rows["n_key_points"])
    step = points[points["row_id"] == 1]["position_m"].diff().dropna()
    assert step.between(1.95, 2.1).all()


@pytest.mark.parametrize(
    ("way", "expected"), [((1, 0), 0), ((1, 1), 45), ((0, 1), 90), ((1, -1), -45), ((1, -50), -88.854)]
)
def test_orientation(way, expected):
    """On the zone's central meridian, where grid and true east agree."""
    line = np.array([500000, 4940000]) + np.array([[0, 0], np.array(way) * 20.0])
    rows, _, _ = describe_rows(number_rows(frame([line]), no_gaps())[0], parcel="A", origin=Origin(44.6, 9.0, 0.0))
    assert rows["orientation_deg"][0] == pytest.approx(expected, abs=0.01)


def test_length_is_three_dimensional_and_elevation_a_mean_along_the_row():
    line = shapely.LineString([[0, 0, 100], [3, 0, 104], [30, 0, 104]])
    rows = gpd.GeoDataFrame({"row_id": [1], "spacing_m": [2.5]}, geometry=[line], crs=UTM)
    rows, _, _ = describe_rows(rows, parcel="A", origin=ORIGIN)
    assert rows["length_m"][0] == pytest.approx(32)
    assert rows["elevation_m"][0] == pytest.approx((102 * 3 + 104 * 27) / 30)
    assert rows["elevation_diff_m"][0] == 4


def test_no_rows():
    empty = gpd.GeoDataFrame({"spacing_m": np.empty(0)}, geometry=[], crs=UTM)
    rows, gaps = number_rows(group_blocks(empty), no_gaps())
    rows, ends, points = describe_rows(rows, parcel="A", origin=ORIGIN)
    assert len(rows) == len(gaps) == len(ends) == len(points) == 0
