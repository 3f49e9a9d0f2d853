"""Coordinates that can't lie where their CRS says, and places that PROJ doesn't know well."""

import re
import warnings

import geopandas as gpd
import numpy as np
import pytest
import shapely
from formats import write_text
from pyproj import CRS, Transformer
from pyproj.transformer import AreaOfInterest, TransformerGroup

from vinemap.cloud.las import read_cloud
from vinemap.errors import GridError, InputError
from vinemap.geo.crs import LOCAL, from_wgs84, horizontal, metric_crs, parse_crs, stated, to_wgs84, vertical_name
from vinemap.geo.place import check_place, doubts_of, doubts_of_cloud

FOOT = 0.3048
SHIFT = "TOWGS84[590.5,69.5,411.6,-0.796,-0.052,-3.601,8.3]"
GAUSS_KRUEGER = CRS.from_epsg(31467).to_wkt("WKT1_GDAL")
SHIFTED = GAUSS_KRUEGER.replace('AUTHORITY["EPSG","6314"]', f'{SHIFT},AUTHORITY["EPSG","6314"]')


def nameless(text):
    """A CRS without codes, of a false easting that no other has."""
    bare = re.sub(r',AUTHORITY\["EPSG","\d+"\]', "", text)
    return bare.replace("3-degree Gauss-Kruger zone 3", "a grid of our own").replace("3500000", "3500100")


def on(crs, lon, lat):
    """A place in a CRS, x east."""
    return Transformer.from_crs(CRS.from_epsg(4326), horizontal(crs), always_xy=True).transform(lon, lat)


@pytest.mark.parametrize(
    ("code", "lon", "lat", "grid"),
    [
        (27700, 1.3107, 52.6276, "uk_os_OSTN15"),
        (31467, 8.13, 49.25, "de_adv_BETA2007"),
        (4314, 8.13, 49.25, "de_adv_BETA2007"),
        (26910, -122.3, 38.4, "us_noaa_"),
    ],
)
def test_a_place_that_lacks_its_grid(code, lon, lat, grid):
    crs = CRS.from_epsg(code)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if TransformerGroup(crs, 4326, area_of_interest=AreaOfInterest(lon, lat, lon, lat)).best_available:
            pytest.skip(f"PROJ has the grid {grid} here")
    (doubt,) = doubts_of(crs, *on(crs, lon, lat))
    assert re.match(r"positions in WGS 84 are good to [234] m only: PROJ lacks the grid ", doubt)
    assert grid in doubt


@pytest.mark.parametrize(
    ("text", "told"), [("EPSG:3003", "good to 4 m only"), ("+proj=utm +zone=32 +ellps=intl", "is not known: PROJ")]
)
def test_a_place_that_is_known_roughly(text, told):
    crs = parse_crs(text)
    (doubt,) = doubts_of(crs, *on(crs, 9.0, 44.6))
    assert told in doubt


@pytest.mark.parametrize(
    ("code", "lon", "lat"),
    [(32632, 7.9, 44.6), (25832, 7.9, 44.6), (2154, 4.8, 47.0), (2193, 174.0, -41.5), (2048, 18.86, -33.93)],
)
def test_a_place_that_is_known_well(code, lon, lat):
    crs = CRS.from_epsg(code)
    assert doubts_of(crs, *on(crs, lon, lat)) == []
    check_place(crs, *on(crs, lon, lat), "a.laz")


def test_another_shift_beside_a_crs_is_told():
    crs = CRS.from_wkt(SHIFTED)
    doubts = doubts_of(crs, *on(crs, 8.13, 49.25))
    assert any("the TOWGS84 beside EPSG:31467" in doubt and "leads 2.93 m elsewhere" in doubt for doubt in doubts)
    assert vertical_name(crs) is None


@pytest.mark.parametrize(
    ("crs", "lon", "lat", "kept"),
    [
        (CRS.from_wkt(SHIFTED), 8.13, 49.25, 31467),
        (CRS.from_wkt(f'COMPD_CS["both",{SHIFTED},{CRS.from_epsg(5783).to_wkt("WKT1_GDAL")}]'), 8.13, 49.25, 31467),
        (CRS.from_wkt(nameless(SHIFTED).replace("299.1528128]", f"299.1528128],{SHIFT}")), 8.13, 49.25, 32632),
        (CRS.from_wkt(nameless(GAUSS_KRUEGER)), 8.13, 49.25, 32632),
        (CRS.from_user_input("+proj=utm +zone=32 +ellps=intl"), 9.0, 44.6, 32632),
        (CRS.from_user_input("+proj=tmerc +lat_0=0 +lon_0=8 +k=1 +datum=WGS84"), 8.13, 49.25, None),
        (CRS.from_epsg(27700), 1.31, 52.63, 27700),
    ],
    ids=["shift", "compound", "shift of a grid", "grid", "ellipsoid", "own", "british"],
)
def test_a_place_is_one_in_files_and_in_wgs84(tmp_path, crs, lon, lat, kept):
    x, y = on(crs, lon, lat)
    target = metric_crs(crs, x, y)
    there = np.array([[*Transformer.from_crs(horizontal(crs), target, always_xy=True).transform(x, y), 467.0]])
    path = tmp_path / "rows.gpkg"
    gpd.GeoDataFrame(geometry=[shapely.Point(*there[0])], crs=target).to_file(path)
    read = gpd.read_file(path)
    assert read.crs.to_epsg() == kept
    seen = shapely.get_coordinates(read.to_crs(4326).geometry)[0]
    lat_lon = to_wgs84(there, target)[0, :2]
    assert np.abs((seen - lat_lon[::-1]) * 111_000).max() < 0.005
    assert np.allclose(from_wgs84([[*lat_lon, 467.0]], target), there, atol=0.001)


OWN_GRID = "+proj=tmerc +lat_0=49 +lon_0=-2 +k=0.9 +x_0=400100 +y_0=0 +ellps=airy +nadgrids={}"
GRIDS_IN_WKT = 'EXTENSION["PROJ4_GRIDS","nowhere.gsb"],AUTHORITY["EPSG","6277"]'


def test_a_grid_that_a_crs_names_and_proj_lacks():
    may, must = (parse_crs(OWN_GRID.format(grid)) for grid in ("@nowhere.gsb,null", "nowhere.gsb"))
    (doubt,) = doubts_of(may, 400_000, 300_000)
    assert doubt.startswith("the accuracy of positions in WGS 84 is not known: PROJ lacks the grid nowhere.gsb for ")
    with pytest.raises(GridError, match=r"a\.laz: .* can't be brought to WGS 84 without the grid nowhere\.gsb: give"):
        check_place(must, 400_000, 300_000, "a.laz")


def test_a_grid_beside_a_crs_that_proj_knows_does_not_count():
    """As GDAL writes it."""
    text = CRS.from_epsg(27700).to_wkt("WKT1_GDAL").replace('AUTHORITY["EPSG","6277"]', GRIDS_IN_WKT)
    assert doubts_of(CRS.from_wkt(text), 651_410, 313_177) == doubts_of(CRS.from_epsg(27700), 651_410, 313_177)


@pytest.mark.parametrize("code", [32600, 3145, 2963])
def test_a_crs_from_which_no_way_leads(code):
    with pytest.raises(
        InputError, match=rf"a\.laz: EPSG:{code} .* can't be brought to WGS 84: give their CRS with --crs"
    ):
        check_place(CRS.from_epsg(code), 500_000, 4_900_000, "a.laz")


POTSDAM = "+towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7"
MONTE_MARIO = "+towgs84=-104.1,-49.1,-9.9,0.971,-2.917,0.714,-11.68"


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        (f"+proj=utm +zone=32 +ellps=intl {MONTE_MARIO}", None),
        (f"+proj=tmerc +lon_0=9 +k=1 +x_0=3500000 +ellps=bessel {POTSDAM}", "DHDN"),
        (f"+proj=tmerc +lon_0=9 +k=0.9996 +x_0=1500000 +ellps=intl {MONTE_MARIO}", "Monte Mario"),
        ("+proj=utm +zone=32 +ellps=GRS80 +towgs84=0,0,0", "ETRS89"),
    ],
    ids=["not ED50", "not DB_REF", "one alone", "no shift"],
)
def test_of_crss_with_the_same_numbers_the_shift_tells_which(text, kept):
    crs = CRS.from_wkt(parse_crs(text).to_wkt("WKT1_GDAL"))
    flat = horizontal(crs)
    assert flat.is_bound if kept is None else flat.name.startswith(kept)
    x, y = Transformer.from_crs(4326, crs, always_xy=True).transform(9.0, 46.0)
    assert not doubts_of(crs, x, y) or "elsewhere" not in doubts_of(crs, x, y)[-1]


SWAPPED, TURNED, LOCAL_ONES = "x and y seem to be swapped:", "their signs seem to be turned", "seem to be local metres"


@pytest.mark.parametrize(
    ("code", "x", "y", "reason"),
    [
        (32632, 4_940_780.0, 414_750.0, SWAPPED),
        (2154, 6_650_000.0, 840_000.0, SWAPPED),
        (4258, 52.6, 1.3, SWAPPED),
        (2048, -12_944.0, -3_755_906.0, TURNED),
        (5514, 600_000.0, 1_200_000.0, TURNED),
        (32734, -300_000.0, -6_243_000.0, TURNED),
        (32632, 15.0, 20.0, LOCAL_ONES),
        (27700, 150.0, 4000.0, LOCAL_ONES),
        (2154, 1000.0, 1000.0, LOCAL_ONES),
        (26910, 561_123 / FOOT, 4_250_429 / FOOT, "they seem to be in feet"),
        (2193, 1_677_000 / FOOT, 5_405_000 / FOOT, "they seem to be in feet"),
        (2226, 1_989_000.0, 568_000.0, "they seem to be in metres"),
        (4326, 12.0, 414.0, "perhaps they are swapped"),
        (32632, 1e12, 1e12, "perhaps they are swapped"),
    ],
)
def test_coordinates_outside_their_crs_are_refused(code, x, y, reason):
    with pytest.raises(
        InputError, match=rf"a\.laz: coordinates .* lie outside the area of EPSG:{code}.*{reason}.*--crs"
    ):
        check_place(CRS.from_epsg(code), x, y, "a.laz")


@pytest.mark.parametrize(
    ("text", "lon", "lat"),
    [
        ("EPSG:32632", 12.4, 45.9),
        ("EPSG:32633", 11.8, 47.2),
        ("EPSG:3460", -179.9, -17.0),
        ("EPSG:3460", 179.2, -17.0),
        ("EPSG:2193", 177.9, -38.6),
        ("EPSG:3857", 7.9, 44.6),
        ("EPSG:4326", 7.9, 44.6),
        ("EPSG:3763", -8.13, 39.67),
        ("EPSG:25832+7837", 8.1, 49.2),
        ("+proj=tmerc +lat_0=0 +lon_0=19 +k=1 +ellps=WGS84", 18.9, -33.9),
    ],
)
def test_coordinates_within_or_beside_their_crs_pass(text, lon, lat):
    crs = parse_crs(text)
    check_place(crs, *on(crs, lon, lat), "a.laz")


def test_a_local_crs_that_a_file_states_is_told():
    (doubt,) = doubts_of(CRS.from_wkt('LOCAL_CS["Local Coordinates (m)",UNIT["metre",1]]'), 3.0, 4.0)
    assert doubt.startswith("'Local Coordinates (m)' has no place on the globe")
    assert metric_crs(CRS.from_wkt('LOCAL_CS["Local Coordinates (m)",UNIT["metre",1]]'), 3.0, 4.0) == LOCAL


def test_local_coordinates_have_no_place():
    assert parse_crs(" Local ") == LOCAL
    check_place(LOCAL, 3.0, 1e9, "a.laz")
    assert doubts_of(LOCAL, 3.0, 4.0) == []
    assert metric_crs(LOCAL, 3.0, 4.0) == LOCAL
    assert np.isnan(to_wgs84([[1.0, 2.0, 3.0]], LOCAL)).all()
    assert stated(LOCAL) == LOCAL


@pytest.mark.parametrize(("lon", "lat"), [(7.924, 44.612), (-8.0, 41.2), (19.0, -33.9), (-40.5, -9.4), (38.7, 7.9)])
def test_degrees_with_latitude_first_are_told(lon, lat):
    """As vines of the tropics are, for which nobody can know."""
    told = (
        "are taken for longitude and latitude: if they are the other way round, export the cloud with longitude first"
    )
    north = abs(lat) > 25
    (doubt,) = doubts_of_cloud(CRS.from_epsg(4326), *((lat, lon) if north else (lon, lat)))
    assert told in doubt
    assert not north or doubts_of_cloud(CRS.from_epsg(4326), lon, lat) == []


def test_degrees_at_the_poles_are_refused():
    with pytest.raises(InputError, match=r"a.laz: coordinates \(-33.0400, -68.8800\), taken .* with longitude first"):
        check_place(CRS.from_epsg(4326), -33.04, -68.88, "a.laz")
    check_place(CRS.from_epsg(4326), -68.88, -33.04, "a.laz")


def test_the_order_of_degrees_is_told_of_a_cloud(tmp_path):
    path = write_text(tmp_path / "a.xyz", np.array([[44.61, 7.92, 460], [44.611, 7.921, 461]]))
    (remark,) = read_cloud(path, crs=CRS.from_epsg(4326)).remarks
    assert "(44.6105, 7.9205) are taken for longitude and latitude" in remark


@pytest.mark.parametrize(
    ("text", "foreign"),
    [
        ("EPSG:32632+5703", "NAVD88 height"),
        ("EPSG:32632+6360", "NAVD88 height (ftUS)"),
        ("EPSG:32632+5711", "AHD height"),
        ("EPSG:32632+5773", ""),
        ("EPSG:25832+5214", ""),
        ("EPSG:4979", ""),
    ],
)
def test_heights_above_another_countrys_datum_are_told(text, foreign):
    crs = parse_crs(text)
    said = [doubt for doubt in doubts_of_cloud(crs, *on(crs, 8.7, 46.2)) if "isn't used there" in doubt]
    assert said == ([f"heights are said to be above {foreign}, which isn't used there: {MORE}"] if foreign else [])


MORE = "--crs EPSG:n+m tells what they are above"
