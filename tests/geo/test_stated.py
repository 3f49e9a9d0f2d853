"""What files state of their coordinates: units and datums of heights, and steps in which they are stored."""

import struct

import laspy
import numpy as np
import pytest
from pyproj import CRS

from vinemap.cloud.las import read_cloud
from vinemap.errors import InputError
from vinemap.geo.crs import parse_crs

FOOT = 0.304800609601219
NAPA = np.array([561_100.0, 4_250_400.0, 0.0])
"""A place in UTM zone 10."""


@pytest.fixture
def points():
    """Points (n, 3) of 40 m by 30 m, 0.35 m apart, their z in metres above 100."""
    return np.random.default_rng(0).uniform([0, 0, 100], [40, 30, 103], (10_000, 3)).round(3)


def write(path, xyz, *, crs=None, keys=(), ascii_keys=(), scales=0.001, wkt=None):
    """Write a LAS 1.2 file with GeoTIFF keys, short ones and such of text, or LAS 1.4 with WKT."""
    header = laspy.LasHeader(point_format=6 if wkt else 3, version="1.4" if wkt else "1.2")
    header.scales = np.broadcast_to(scales, 3).astype(float)
    header.offsets = np.floor(xyz.min(axis=0))
    if crs is not None:
        header.add_crs(CRS.from_user_input(crs))
    if wkt:
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", wkt.encode() + b"\0"))
    if keys:
        words, entries = b"", [(key, 0, 1, value) for key, value in dict(keys).items()]
        for key, text in dict(ascii_keys).items():
            entries.append((key, 34737, len(text) + 1, len(words)))
            words += text.encode() + b"|"
        data = struct.pack("<4H", 1, 1, 0, len(entries)) + b"".join(struct.pack("<4H", *e) for e in sorted(entries))
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", data))
        if words:
            header.vlrs.append(laspy.VLR("LASF_Projection", 34737, "", words + b"\0"))
    las = laspy.LasData(header)
    las.xyz = xyz
    las.write(path)
    return path


UTM, STATE_PLANE = {1024: 1, 3072: 26910}, {1024: 1, 3072: 2226}


@pytest.mark.parametrize(
    ("keys", "unit", "vertical"),
    [
        (UTM, 1.0, None),
        (UTM | {4096: 5703}, 1.0, "NAVD88 height"),
        (UTM | {4096: 6360}, FOOT, "NAVD88 height"),
        (UTM | {4096: 8228}, 0.3048, "NAVD88 height"),
        (UTM | {4099: 9003}, FOOT, None),
        (UTM | {4099: 9002}, 0.3048, None),
        (UTM | {4096: 5703, 4099: 9003}, FOOT, "NAVD88 height"),
        (UTM | {4096: 5103, 4099: 9001}, 1.0, "NAVD88 height"),
        (UTM | {4096: 5030}, 1.0, "ellipsoidal height"),
        (UTM | {4096: 4979}, 1.0, "ellipsoidal height"),
        (UTM | {4096: 32767, 4098: 5171}, 1.0, "EGM96 geoid"),
        (UTM | {4096: 32767, 4099: 9003}, FOOT, None),
        (STATE_PLANE, FOOT, None),
        (STATE_PLANE | {4096: 5703}, 1.0, "NAVD88 height"),
        (STATE_PLANE | {4099: 9001}, 1.0, None),
        ({1024: 2, 2048: 4269, 4096: 6360}, FOOT, "NAVD88 height"),
    ],
)
def test_heights_by_geotiff_keys(tmp_path, points, keys, unit, vertical):
    scales, place = 0.001, NAPA
    xyz = points + place
    if 2226 in keys.values():
        xyz = (points - [20, 15, 0]) / [FOOT, FOOT, 1] + [6_466_000, 1_873_000, 0]
    if 2048 in keys:
        xyz, scales = points * [1.1e-5, 9e-6, 1] + [-122.3, 38.4, 0], (1e-8, 1e-8, 0.001)
    xyz[:, 2] = points[:, 2] / unit
    cloud = read_cloud(write(tmp_path / "a.laz", xyz, keys=keys, scales=scales))
    assert np.allclose(np.sort(cloud.xyz[:, 2]), np.sort(points[:, 2]), atol=0.002)
    assert cloud.vertical == vertical


def test_a_datum_in_words_is_kept(tmp_path, points):
    texts = {3073: "NAD83 / UTM 10N", 4097: "NAVD88 (Geoid18)"}
    keys = UTM | {4096: 32767, 4099: 9003}
    cloud = read_cloud(write(tmp_path / "a.laz", points / [1, 1, FOOT] + NAPA, keys=keys, ascii_keys=texts))
    assert cloud.vertical == "NAVD88 (Geoid18)"
    assert np.allclose(cloud.extent[1][2], points[:, 2].max(), atol=0.002)


@pytest.mark.parametrize("text", ["NAD83 / UTM zone 10N", "ESRI PE String = " + CRS(26910).to_wkt("WKT1_ESRI")])
@pytest.mark.parametrize("keys", [{2048: 4269}, {}])
def test_a_projected_crs_in_words(tmp_path, points, text, keys):
    path = write(tmp_path / "a.laz", points + NAPA, keys={1024: 1, 3072: 32767} | keys, ascii_keys={3073: text})
    assert read_cloud(path).crs.to_epsg() == 26910


@pytest.mark.parametrize("text", ["a grid of our own", ""])
def test_a_projected_crs_in_words_that_nobody_knows(tmp_path, points, text):
    """Its geographic CRS isn't that of the coordinates."""
    keys, words = {1024: 1, 2048: 4269, 3072: 32767}, {3073: text} if text else {}
    with pytest.raises(InputError, match="states no CRS for its coordinates"):
        read_cloud(write(tmp_path / "a.laz", points + NAPA, keys=keys, ascii_keys=words))


@pytest.mark.parametrize(
    ("code", "metres"), [(26911, r"5\d\d,\d\d\d"), (26710, r"\d\d\d"), (6339, None), (32610, None)]
)
def test_two_crss_of_one_file_must_lead_to_one_place(tmp_path, points, code, metres):
    path = write(tmp_path / "a.laz", points + NAPA, keys=UTM, wkt=CRS(code).to_wkt("WKT1_GDAL"))
    if not metres:
        assert read_cloud(path).crs.to_epsg() == code
        return
    with pytest.raises(
        InputError, match=rf"a\.laz: states two CRSs that lie {metres} m apart, .* in WKT and NAD83 / UTM"
    ):
        read_cloud(path)
    assert read_cloud(path, crs=CRS(26910)).crs.to_epsg() == 26910


def test_another_crs_than_the_files_own_is_told(tmp_path, points):
    path = write(tmp_path / "a.laz", points + NAPA, crs=26910)
    for given, told in {"EPSG:26911": True, "EPSG:32610": False, "local": False}.items():
        remarks = [one for one in read_cloud(path, crs=parse_crs(given)).remarks if "states" in one]
        assert len(remarks) == told
        assert not told or remarks[0].startswith("a.laz states NAD83 / UTM zone 10N, which leads 5")


def test_a_local_crs_in_wkt_that_keys_know(tmp_path, points):
    """As programs write it that lost the rest."""
    wkt = 'LOCAL_CS["NAD83 / UTM zone 10N",UNIT["metre",1]]'
    assert read_cloud(write(tmp_path / "a.laz", points + NAPA, keys=UTM, wkt=wkt)).crs.to_epsg() == 26910


LOCAL_WKT = {
    "metres": 'LOCAL_CS["site",UNIT["metre",1]]',
    "with heights": 'ENGCRS["site",EDATUM["site"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],AXIS["z",up],'
    'LENGTHUNIT["metre",1]]',
    "feet": 'LOCAL_CS["site",UNIT["foot",0.3048]]',
    "depths": f'COMPD_CS["site",{CRS(26910).to_wkt("WKT1_GDAL")},VERT_CS["d",VERT_DATUM["d",2005],UNIT["m",1],'
    'AXIS["Depth",DOWN]]]',
}


@pytest.mark.parametrize("kind", LOCAL_WKT)
def test_local_coordinates_by_the_file(tmp_path, points, kind):
    path = write(tmp_path / "a.laz", points + NAPA * (kind == "depths"), wkt=LOCAL_WKT[kind])
    refused = {"feet": "site is local, and not in metres", "depths": "heights of site count downwards"}
    if kind in refused:
        with pytest.raises(InputError, match=rf"a\.laz: {refused[kind]}"):
            read_cloud(path)
        return
    cloud = read_cloud(path)
    assert np.allclose(cloud.xyz, points, atol=0.0006)
    assert cloud.vertical is None


def test_heights_are_the_files_where_the_given_crs_tells_of_none(tmp_path, points):
    path = write(tmp_path / "a.laz", points / [1, 1, FOOT] + NAPA, keys=UTM | {4096: 6360})
    given = read_cloud(path, crs=parse_crs("EPSG:32610"))
    assert (given.crs.to_epsg(), given.vertical) == (32610, "NAVD88 height")
    assert np.allclose(given.extent[1][2], points[:, 2].max(), atol=0.002)
    other = read_cloud(path, crs=parse_crs("EPSG:32610+5773"))
    assert other.vertical == "EGM96 height"
    assert np.allclose(other.extent[1][2], points[:, 2].max() / FOOT, atol=0.002)


def test_heights_with_a_grid_beside_their_datum(tmp_path, points):
    """As GDAL writes them."""
    up = (
        'VERT_CS["NAVD88 height (ftUS)",VERT_DATUM["North American Vertical Datum 1988",2005,'
        'EXTENSION["PROJ4_GRIDS","g2012a_conus.gtx"]],UNIT["US survey foot",0.3048006096012192],AXIS["Up",UP]]'
    )
    wkt = f'COMPD_CS["both",{CRS.from_epsg(26910).to_wkt("WKT1_GDAL")},{up}]'
    cloud = read_cloud(write(tmp_path / "a.laz", points / [1, 1, FOOT] + NAPA, wkt=wkt))
    assert cloud.vertical == "NAVD88 height"
    assert np.allclose(cloud.extent[1][2], points[:, 2].max(), atol=0.002)


def test_local_metres_are_read_as_they_are(tmp_path, points):
    path = write(tmp_path / "a.laz", points)
    with pytest.raises(InputError, match="states no CRS for its coordinates: give it with --crs EPSG:n, or local"):
        read_cloud(path)
    cloud = read_cloud(path, crs=parse_crs("local"))
    assert np.allclose(cloud.xyz, points, atol=0.0006)
    assert cloud.remarks == ()


@pytest.mark.parametrize(("keys", "told"), [(STATE_PLANE, True), (STATE_PLANE | {4099: 9003}, False), (UTM, False)])
def test_feet_that_nothing_states_are_told(tmp_path, points, keys, told):
    place = NAPA if keys == UTM else np.array([6_475_700, 1_907_700, 0])
    remarks = read_cloud(write(tmp_path / "a.laz", points + place, keys=keys)).remarks
    assert any("heights are taken to be in US survey foot" in one for one in remarks) == told


def test_remarks_stay_with_the_points(tmp_path, points):
    cloud = read_cloud(write(tmp_path / "a.laz", points + [1_600_000, 4_940_000, 0], crs=3003))
    assert len(cloud.remarks) == 1
    assert "good to 4 m only" in cloud.remarks[0]


def single(xyz):
    """In single precision, in which a northing has steps of half a metre."""
    return xyz.astype(np.float32).astype(float)


@pytest.mark.parametrize(
    ("scales", "crs", "stored", "told"),
    [
        (1.0, 32610, lambda xyz: xyz, r"x is stored in steps of 1 \(scale 1\), 1 m"),
        (0.001, 32610, np.rint, r"x is stored in steps of 1 \(scale 0.001\)"),
        (0.001, 32610, single, r"y is stored in steps of 0.5 \(scale 0.001\)"),
        (0.001 / FOOT, 32610, single, r"y is stored in steps of 0.498687 \(scale 0.00328083\)"),
        ((0.01, 0.01, 0.001), 4326, lambda xyz: xyz, r"x is stored in steps of 0.01 \(scale 0.01\), 870 m"),
        ((0.001, 0.001, 1.0), 32610, lambda xyz: xyz, r"z is stored in steps of 1 \(scale 1\)"),
    ],
    ids=["metres", "rounded before", "single precision", "in other steps since", "degrees", "heights"],
)
def test_coordinates_stored_too_coarsely_are_refused(tmp_path, points, scales, crs, stored, told):
    xyz = points + NAPA if crs == 32610 else points * [1.1e-5, 9e-6, 1] + [-122.304, 38.404, 0]
    with pytest.raises(InputError, match=rf"a\.laz: its {told}.* points (lie 0\.\d+ m apart|all lie in one)"):
        read_cloud(write(tmp_path / "a.laz", stored(xyz), crs=crs, scales=scales))


@pytest.mark.parametrize("step", [0.01, 0.05, 0.2])
def test_steps_that_do_no_harm(tmp_path, points, step):
    """Points of 0.35 m apart."""
    assert read_cloud(write(tmp_path / "a.laz", points + NAPA, crs=32610, scales=(step, step, 0.01))).size == 10_000


def test_profiles_of_a_scanner_that_drives_along_an_axis_are_no_rounding(tmp_path, points):
    profiles = points.copy()
    profiles[:, 0] = 0.67 * np.rint(points[:, 0] / 0.67)
    assert read_cloud(write(tmp_path / "a.laz", profiles + NAPA, crs=32610)).size == 10_000


def test_two_fields_far_apart_are_no_coarse_steps(tmp_path, points):
    far = np.concatenate([points[::2], points[1::2] + [5000, 0, 0]]) + NAPA
    assert read_cloud(write(tmp_path / "a.laz", far, crs=32610, scales=0.01)).size == 10_000
