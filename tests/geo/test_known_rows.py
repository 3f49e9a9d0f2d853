"""Known rows, as people's files have them."""

import warnings
import zipfile

import geopandas as gpd
import pandas as pd
import pyogrio
import pytest
import shapely
from pyproj import CRS

from vinemap.errors import InputError
from vinemap.geo.crs import LOCAL
from vinemap.geo.layers import read_points
from vinemap.geo.lines import as_rows, read_rows, rows_of

UTM = CRS.from_epsg(32632)
LINES = [shapely.LineString([(428000, 4940000 + 3 * k), (428030, 4940001 + 3 * k)]) for k in range(4)]


def write(path, lines=LINES, crs=UTM, *, layer=None, driver=None, **columns):
    """A file of lines with some columns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of files without CRS, and of columns' names
        frame = gpd.GeoDataFrame(columns, geometry=list(lines), crs=UTM if crs else None)
        frame = frame.to_crs(crs) if crs else frame
        frame.to_file(path, layer=layer, driver=driver)
    return path


def told(path, parcel="F", **how):
    """Numbers and labels of a parcel's rows."""
    rows = rows_of(read_rows(path, **how), {parcel: None})[0][parcel]
    return list(zip(rows.lines["row_id"], rows.lines["label"], strict=True)), rows.remarks


@pytest.mark.parametrize("kind", ["gpkg", "geojson", "shp", "kml", "zip"])
def test_any_format_in_any_crs(tmp_path, kind):
    name = "rows.shp" if kind == "zip" else f"rows.{kind}"
    crs, driver = CRS.from_epsg(4326 if kind in ("geojson", "kml") else 3003), "KML" if kind == "kml" else None
    path = write(tmp_path / name, crs=crs, driver=driver, Name=list("abcd"))
    if kind == "zip":
        with zipfile.ZipFile(tmp_path / "rows.zip", "w") as packed:
            for part in tmp_path.glob("rows.*"):
                if part.suffix != ".zip":
                    packed.write(part, part.name)
        path = tmp_path / "rows.zip"
    rows = read_rows(path)
    there = rows.lines.to_crs(UTM).geometry
    assert all(there.geom_equals_exact(gpd.GeoSeries(LINES, crs=UTM), 0.01))
    assert list(rows.lines["label"]) == list("abcd")
    assert told(path)[0] == [(1, "a"), (2, "b"), (3, "c"), (4, "d")]


def test_a_drawing_has_no_crs_and_several_layers(tmp_path):
    path = write(tmp_path / "plan.dxf", [*LINES, LINES[0]], driver="DXF", crs=None, Layer=["Rows"] * 4 + ["road"])
    with pytest.raises(
        InputError,
        match=r"plan\.dxf: has no geometry or no CRS: save it with its CRS, give it with --rows-crs, or say --crs",
    ):
        read_rows(path)
    rows = read_rows(path, crs=UTM)
    assert rows.lines.crs == UTM
    assert [line.equals(known) for line, known in zip(rows.lines.geometry, LINES, strict=True)] == [True] * 4
    assert rows.remarks == ()
    other = write(tmp_path / "other.dxf", LINES, driver="DXF", crs=None, Layer=list("aabb"))
    with pytest.raises(InputError, match=r"any of its layers may be meant \(a, b\): name that of the rows rows"):
        read_rows(other, crs=UTM)
    assert read_rows(path, local=True).lines.crs == LOCAL


def test_the_layer_of_a_product(tmp_path):
    path = write(tmp_path / "F.gpkg", layer="rows", row_id=[4, 3, 2, 9], label=["4 F", "3 F", "2 F", "new"])
    write(path, LINES[:1], layer="gaps", row_id=[4])
    assert told(path) == ([(4, "4 F"), (3, "3 F"), (2, "2 F"), (9, "new")], ())
    write(tmp_path / "two.gpkg", layer="a")
    write(tmp_path / "two.gpkg", layer="b")
    with pytest.raises(InputError, match=r"any of its layers may be meant \(a, b\)"):
        read_rows(tmp_path / "two.gpkg")


def test_points_of_vines(tmp_path):
    """Of the layer that is called so, else of the only one of points; each counts once."""
    points = [shapely.Point(1, 2), shapely.MultiPoint([(3, 4), (1, 2)]), shapely.Point(5, 6)]
    path = write(write(tmp_path / "F.gpkg", layer="rows"), points, layer="surveyed")
    found = read_points(path, "vines")
    assert found.crs == UTM
    assert found.get_coordinates().to_numpy().tolist() == [[1, 2], [3, 4], [5, 6]]
    write(path, points[:1], layer="posts")
    with pytest.raises(InputError, match=r"may be meant \(rows, surveyed, posts\): name that of the vines so"):
        read_points(path, "vines")
    write(path, points[2:], layer="vines")
    assert read_points(path, "vines").get_coordinates().to_numpy().tolist() == [[5, 6]]
    with pytest.raises(InputError, match="holds no point: vines are points, one each"):
        read_points(write(tmp_path / "lines.gpkg"), "vines")


@pytest.mark.parametrize(
    ("columns", "rows"),
    [
        ({}, [(1, "1 F"), (2, "2 F"), (3, "3 F"), (4, "4 F")]),
        ({"row": [7, 5, 6, 8]}, [(7, "7 F"), (5, "5 F"), (6, "6 F"), (8, "8 F")]),
        ({"row_id": [7.0, 5.0, 6.0, 8.0], "name": list("abcd")}, [(7, "a"), (5, "b"), (6, "c"), (8, "d")]),
        ({"name": ["12", "11", "10", "9"]}, [(12, "12"), (11, "11"), (10, "10"), (9, "9")]),
        ({"Row": ["N1", "N2", "S1", "S2"]}, [(1, "N1"), (2, "N2"), (3, "S1"), (4, "S2")]),
    ],
)
def test_numbers_and_names(tmp_path, columns, rows):
    assert told(write(tmp_path / "a.gpkg", **columns)) == (rows, ())


def test_rows_of_one_number_or_name_are_told_apart(tmp_path):
    path = write(tmp_path / "a.gpkg", row_id=[3, 3, None, 70_000], label=["a", "a", None, "d"])
    rows, remarks = told(path)
    assert rows == [(3, "a"), (4, "a (2)"), (5, "5 F"), (6, "d")]
    assert remarks == (
        "3 known rows have no number of their own, and get the next ones: a (2), 5 F, d",
        "2 known rows have no name of their own, and are called a (2), 5 F",
    )


def test_what_is_no_row_is_left_out_and_told(tmp_path):
    (x, y), _ = LINES[3].coords
    parts = shapely.MultiLineString([[(x, y), (x + 10, y)], [(x + 20, y), (x + 12, y)]])
    odd = {
        "good": LINES[0],
        "again": LINES[0].reverse(),
        "post": shapely.Point(x, y),
        "none": shapely.LineString(),
        "click": shapely.LineString([(x, y), (x, y)]),
        "loop": shapely.LineString([(x, y), (x + 5, y), (x + 5, y + 5), (x + 2, y - 5)]),
        "parts": parts,
    }
    known = read_rows(write(tmp_path / "a.gpkg", odd.values(), name=list(odd)))
    assert list(known.lines["label"]) == ["good", "parts"]
    assert known.lines.geometry.iloc[1].equals(shapely.LineString([(x, y), (x + 20, y)]))
    (remark,) = known.remarks
    assert remark == (
        "a.gpkg holds what is no row, and is left out: a line that is there twice 'again', a Point 'post', an empty "
        "geometry 'none', a line of no length 'click', a line that crosses itself 'loop'"
    )
    with pytest.raises(InputError, match="holds no line, and no two points of one name, but a Point: give"):
        read_rows(write(tmp_path / "b.gpkg", [odd["post"]], name=["post"]))


def test_parts_of_a_line_are_one_row_or_several(tmp_path):
    """One after the other, in whatever order and sense, they are one; side by side, as in dissolved layers, several."""
    (x, y), _ = LINES[0].coords
    parts = [[(x + 20, y), (x + 30, y)], [(x + 8, y), (x, y)], [(x + 10, y), (x + 18, y)]]
    known = read_rows(write(tmp_path / "parts.gpkg", [shapely.MultiLineString(parts)], name=["a"]))
    assert known.lines.geometry.iloc[0].equals(shapely.LineString([(x, y), (x + 30, y)]))
    assert known.lines.geometry.iloc[0].coords[0] == (x, y)
    dissolved = shapely.MultiLineString([LINES[0], LINES[1].reverse(), LINES[2]])
    path = write(tmp_path / "dissolved.gpkg", [LINES[3], dissolved], row=[9, 4])
    assert told(path)[0] == [(9, "9 F"), (4, "4 F"), (10, "10 F"), (11, "11 F")]
    assert [*read_rows(path).lines.length.round()] == [30] * 4
    assert as_rows([dissolved]) == ["a line of parts side by side"]


def test_numbers_of_any_script_and_length(tmp_path):
    rows = told(write(tmp_path / "a.gpkg", row=["٣", "9" * 5000, "07", "²"]))[0]
    assert [number for number, _ in rows] == [3, 8, 7, 9]


def test_posts_of_one_name_are_a_row(tmp_path):
    """From the end at which the first one was surveyed, whatever the order of those between."""
    ends = [line.interpolate(share, normalized=True) for line in LINES[:2] for share in (1, 0.4, 0.7, 0)]
    path = write(tmp_path / "rtk.geojson", [*ends, ends[0]], CRS.from_epsg(4326), row=["b"] * 4 + ["a"] * 4 + ["c"])
    rows = read_rows(path)
    assert rows.remarks == ("rtk.geojson holds what is no row, and is left out: a single post 'c'",)
    assert list(rows.lines["label"]) == ["b", "a"]
    for line, known in zip(rows.lines.to_crs(UTM).geometry, LINES[:2], strict=True):
        assert shapely.hausdorff_distance(line, known) < 0.02
        assert len(line.coords) == 4
        assert shapely.Point(line.coords[0]).distance(shapely.Point(known.coords[-1])) < 0.02


def test_lines_belong_to_the_parcel_that_holds_half_of_them(tmp_path):
    rows = read_rows(write(tmp_path / "a.gpkg", row_id=[1, 2, 1, 4]))
    low, high = shapely.box(427990, 4939999, 428025, 4940005), shapely.box(427990, 4940005, 428040, 4940009)
    wgs84 = gpd.GeoSeries([low, high], crs=UTM).to_crs(4326)
    parcels = {"low": (wgs84[0], wgs84.crs), "high": (high, UTM), "elsewhere": (shapely.box(0, 0, 1, 1), UTM)}
    found, homeless = rows_of(rows, parcels)
    assert {name: list(known.lines["label"]) for name, known in found.items()} == {
        "low": ["1 low", "2 low"],
        "high": ["1 high"],
    }
    assert homeless == ["4"]


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_rows(tmp_path / "none.gpkg")
    (tmp_path / "a.dxf").write_text("no drawing")
    with pytest.raises(InputError, match=r"KML, KMZ, DXF or Shapefile \(.*file format\)$"):
        read_rows(tmp_path / "a.dxf")
    pyogrio.write_dataframe(pd.DataFrame({"row": [1]}), tmp_path / "table.gpkg")
    with pytest.raises(InputError, match="has no geometry or no CRS"):
        read_rows(tmp_path / "table.gpkg")
