"""{Main}, WGS84 and metric CRSs, against Table 2.1 and hand-made cases."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pyproj import CRS

from vinemap.errors import InputError
from vinemap.geo.crs import from_wgs84, metric_crs, parse_crs, to_wgs84, vertical_name, vertical_unit
from vinemap.geo.main import Origin, main_to_wgs84, to_main, wgs84_to_main

TABLE = pd.read_csv(Path(__file__).parents[2] / "data" / "table_2_1.csv")
ORIGIN = Origin(44.611669149, 7.924423195, 428.735)


@pytest.mark.parametrize("end", ["1", "n"])
def test_main_agrees_with_both_halves_of_table_2_1(end):
    suffix = "_corrected" if end == "n" else ""
    main = TABLE[[f"{axis}{end}{suffix}" for axis in "xyz"]].to_numpy()
    wgs84 = TABLE[[f"lat{end}", f"lon{end}", f"alt{end}"]].to_numpy()
    error = wgs84_to_main(wgs84, ORIGIN) - main
    assert np.abs(error[:, :2]).max() < 0.005
    # z and altitude are both printed to 1 cm, so they can disagree by as much beside the origin's own rounding.
    assert np.abs(error[:, 2] - error[:, 2].mean()).max() < 0.010
    there = to_utm(main_to_wgs84(main, ORIGIN)) - to_utm(wgs84)
    assert np.hypot(*there[:, :2].T).max() < 0.005


def to_utm(lat_lon_alt):
    return from_wgs84(lat_lon_alt, CRS.from_epsg(32632))


def test_main_and_back_is_exact():
    main = TABLE[["x1", "y1", "z1"]].to_numpy()
    assert np.allclose(wgs84_to_main(main_to_wgs84(main, ORIGIN), ORIGIN), main, atol=1e-6)


def test_utm_to_main_is_not_a_shift():
    """Grid north differs from true north by 0.75° here, and UTM's scale is 0.9996."""
    utm = from_wgs84(TABLE[["lat1", "lon1", "alt1"]], CRS.from_epsg(32632))
    main = to_main(utm, CRS.from_epsg(32632), ORIGIN)
    rotation = np.degrees(np.angle((main[-1] - main[0]) @ [1, 1j, 0]) - np.angle((utm[-1] - utm[0]) @ [1, 1j, 0]))
    assert rotation == pytest.approx(0.753, abs=0.01)
    assert np.allclose(to_wgs84(utm, CRS.from_epsg(32632))[:, 2], TABLE.alt1)


@pytest.mark.parametrize(
    ("code", "x", "y", "expected"),
    [
        ("EPSG:32632", 414700.0, 4940750.0, 32632),
        ("EPSG:4326", 7.925, 44.615, 32632),
        ("EPSG:4326", 174.0, -41.5, 32760),
        ("EPSG:3857", 882200.0, 5559000.0, 32632),
        ("EPSG:2227", 6000000.0, 2100000.0, 32610),
        ("EPSG:25832+7837", 414700.0, 4940750.0, 25832),
    ],
)
def test_metric_crs(code, x, y, expected):
    assert metric_crs(parse_crs(code), x, y).to_epsg() == expected


def test_units_and_datums_of_heights():
    assert vertical_unit(parse_crs("EPSG:2227")) == pytest.approx(0.3048006096)
    assert vertical_unit(parse_crs("EPSG:2227+5703")) == 1.0
    assert vertical_unit(parse_crs("EPSG:4979")) == 1.0
    assert vertical_name(parse_crs("EPSG:25832+7837")) == "DHHN2016 height"
    assert vertical_name(parse_crs("EPSG:32632")) is None
    assert vertical_name(parse_crs("EPSG:4979")) == "ellipsoidal height"
    assert vertical_name(parse_crs("EPSG:32632").to_3d()) == "ellipsoidal height"


def test_unknown_crs_is_named():
    with pytest.raises(InputError, match="EPSG:999999"):
        parse_crs("EPSG:999999")


def test_coordinates_outside_their_crs():
    with pytest.raises(InputError, match="--crs"):
        metric_crs(parse_crs("EPSG:32632"), 1e12, 1e12)
