"""Styles for QGIS: what stands in them is understood by QGIS itself in test_qgis.py."""

import itertools
import xml.etree.ElementTree as ET

import geopandas as gpd
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from vinemap.product.qgis.style import VIGOUR, alias, raster_style, vector_style
from vinemap.product.qgis.symbology import classes_of, rgba


@pytest.mark.parametrize(
    ("column", "words"),
    [
        ("length_m", "Length (m)"),
        ("orientation_deg", "Orientation (°)"),
        ("volume_m3", "Volume (m³)"),
        ("e1_lat", "e1 lat (°)"),
        ("en_z", "en z (m)"),
        ("row_id", "Row"),
    ],
)
def test_aliases_read_well_and_tell_units(column, words):
    assert alias(column) == words


@given(st.lists(st.floats(0, 1e4), min_size=1, max_size=40), st.sampled_from([0.05, 0.1, 1.0]))
def test_classes_hold_every_value_and_have_round_bounds(values, step):
    classes = classes_of(np.array(values), VIGOUR, step=step, unit="m")
    assert 1 <= len(classes) <= len(VIGOUR)
    for (_, high, *_), (low, *_) in itertools.pairwise(classes):
        assert high == low
        assert high / step == pytest.approx(round(high / step))
    assert classes[0][0] < min(values)
    assert classes[-1][1] > max(values)
    shades = [VIGOUR.index(shade) for *_, shade in classes]
    assert shades == sorted(set(shades))


def test_classes_of_wide_values_use_all_colours_and_say_their_bounds():
    classes = classes_of(np.linspace(0.2, 1.6, 50), VIGOUR, step=0.05, unit="m³/m")
    assert [label for _, _, label, _ in classes] == [
        "below 0.5 m³/m",
        "0.5 – 0.75 m³/m",
        "0.75 – 1 m³/m",
        "1 – 1.25 m³/m",
        "1.25 – 1.5 m³/m",
        "1.5 m³/m and more",
    ]
    assert [shade for *_, shade in classes] == list(VIGOUR)


@pytest.mark.parametrize("values", [[], [np.nan], [0.72, 0.72]])
def test_without_a_difference_there_is_one_class(values):
    assert len(classes_of(np.array(values), VIGOUR, step=0.05, unit="m")) == 1


def test_colours_as_qgis_writes_them():
    assert rgba("#1d2b24") == "29,43,36,255"
    assert rgba("#1d2b24c8") == "29,43,36,200"


def test_a_row_without_canopy_is_in_the_lowest_class():
    rows = gpd.GeoDataFrame(
        {"label": ["1", "2", "3"], "length_m": [100.0] * 3, "unseen_m": 0.0, "volume_m3": [90.0, np.nan, 30.0]},
        geometry=[shapely.LineString([(0, k), (100, k)]) for k in range(3)],
        crs=32632,
    )
    renderer = next(e for e in vector_style("rows", rows).body if e.tag == "renderer-v2")
    assert "coalesce" in renderer.get("attr")
    assert float(renderer.find("ranges/range").get("lower")) < 0


def test_rows_bear_their_numbers_on_the_map():
    rows = gpd.GeoDataFrame(
        {
            "row_id": [12],
            "label": ["12 Vigna di San Lorenzo"],
            "length_m": [100.0],
            "unseen_m": [0.0],
            "volume_m3": [90.0],
        },
        geometry=[shapely.LineString([(0, 0), (100, 0)])],
        crs=32632,
    )
    (text,) = ET.fromstring(vector_style("rows", rows).qml()).iter("text-style")
    assert text.get("fieldName") == "row_id"


@pytest.mark.parametrize("states", [["missing"], ["missing", "unseen"]])
def test_what_was_not_seen_of_rows_looks_unlike_gaps(states):
    gaps = gpd.GeoDataFrame({"row_id": 1, "state": states}, geometry=[shapely.Point(0, 0)] * len(states), crs=32632)
    style = ET.fromstring(vector_style("gaps", gaps).qml())
    assert [category.get("value") for category in style.iter("category")] == states
    looks = [{one.get("name"): one.get("value") for one in symbol.iter("Option")} for symbol in style.iter("symbol")]
    assert [look["line_color"] for look in looks] == [rgba("#d7263d"), rgba("#8b8f96")][: len(states)]


@pytest.mark.parametrize("kind", ["dtm", "chm", "row_direction", "row_spacing", "vineyard_likelihood"])
@pytest.mark.parametrize("values", [np.full((2, 2), np.nan), np.full((2, 2), 3.0), np.linspace(1, 4, 9).reshape(3, 3)])
def test_colours_of_rasters_rise(kind, values):
    style = ET.fromstring(raster_style(kind, values).qml())
    stops = [float(item.get("value")) for item in style.iter("item")]
    assert len(stops) > 2
    assert (np.diff(stops) > 0).all()
