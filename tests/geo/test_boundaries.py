"""Polygons of parcels, as people's files have them."""

import zipfile
from pathlib import Path

import geopandas as gpd
import pytest
import shapely
from pyproj import CRS

from vinemap.errors import InputError
from vinemap.geo.boundaries import NoAreaError, boundary_in, read_boundary, read_parcel, read_parcels
from vinemap.geo.crs import LOCAL


@pytest.mark.parametrize("suffix", ["gpkg", "geojson", "shp"])
def test_boundaries_of_any_format(tmp_path, suffix):
    polygon = shapely.box(7.9, 44.6, 7.91, 44.61)
    path = tmp_path / f"b.{suffix}"
    gpd.GeoDataFrame({"name": ["F"]}, geometry=[polygon], crs=4326).to_file(path)
    found, crs = read_boundary(path)
    assert found.equals(polygon)
    assert crs.to_epsg() == 4326


def test_boundary_of_the_named_parcel_or_of_all(tmp_path):
    path = tmp_path / "b.gpkg"
    squares = [shapely.box(k, 0, k + 0.9, 1) for k in range(3)]
    gpd.GeoDataFrame({"no": [1, 2, 3], "Vigna": ["A", "Ba", "C"]}, geometry=squares, crs=32632).to_file(path)
    assert read_boundary(path, parcel="Ba")[0].equals(squares[1])
    assert read_boundary(path)[0].area == pytest.approx(2.7)
    with pytest.raises(InputError, match="did you mean 'Ba'"):
        read_boundary(path, parcel="BAA")


def polygons(path, **columns):
    """Write squares side by side, a column of names for each."""
    n = len(next(iter(columns.values())))
    squares = [shapely.box(k, 0, k + 0.9, 1) for k in range(n)]
    gpd.GeoDataFrame(columns, geometry=squares, crs=32632).to_file(path)
    return path, squares


@pytest.mark.parametrize(
    ("columns", "names"),
    [
        ({"name": ["A", "B", "C"]}, ["A", "B", "C"]),
        ({"Vigna": ["A", "B", "C"]}, ["A", "B", "C"]),
        ({"no": [3, 1, 2], "Name": ["A", "B", "C"]}, ["A", "B", "C"]),
        ({"area": [0.5, 1.5, 2.5], "LABEL": ["b", "c", "a"], "vine": ["x", "y", "z"]}, ["b", "c", "a"]),
        ({"name": ["A", "B", "A"], "id": [7, 8, 9]}, ["7", "8", "9"]),
        ({"id": [1, 2, 3], "name": ["A", "B", "C"]}, ["A", "B", "C"]),
        ({"code": [1, 2, 3], "Label": ["A", "B", "C"]}, ["A", "B", "C"]),
        ({"name": ["A", None, None], "plot": ["P", "Q", "R"]}, ["P", "Q", "R"]),
        ({"name": ["123/4", "123/5", " 123/6  b"]}, ["123/4", "123/5", "123/6 b"]),
        ({"id": [7.0, 8.0, 9.0]}, ["7", "8", "9"]),
        ({"superficie": [364, 171, 169], "nombre": ["A", "B", "C"]}, ["A", "B", "C"]),
        (
            {"uuid": [f"{k}f2504e0-4f89-41d3-9a0c-0305e82c3301" for k in "123"], "Lage": ["A", "B", "C"]},
            ["A", "B", "C"],
        ),
        ({"ha": [0.5, 1.5, 2.25], "no": [7, 8, 9]}, ["7", "8", "9"]),
    ],
)
def test_names_of_parcels(tmp_path, columns, names):
    path, squares = polygons(tmp_path / "b.gpkg", **columns)
    assert list(read_parcels(path)) == names
    for name, square in zip(names, squares, strict=True):
        assert read_boundary(path, parcel=name)[0].equals(square)


@pytest.mark.parametrize(
    ("written", "stated"), [("UTF-8", None), ("UTF-8", "1252"), ("CP1252", None), ("CP1252", "UTF-8")]
)
def test_names_in_a_shapefile_whatever_it_states_of_its_encoding(tmp_path, written, stated):
    path = tmp_path / "b.shp"
    names = ["Höhe", "Süd"]
    gpd.GeoDataFrame({"name": names}, geometry=[shapely.box(k, 0, k + 0.9, 1) for k in (0, 1)], crs=32632).to_file(
        path, encoding=written
    )
    path.with_suffix(".cpg").unlink()
    if stated:
        path.with_suffix(".cpg").write_text(stated)
    assert list(read_parcels(path)) == names


def test_no_column_names_each_parcel(tmp_path):
    path, _ = polygons(tmp_path / "b.gpkg", name=["A", "A", "C"], plot=["P", None, "Q"])
    with pytest.raises(InputError, match=r"b\.gpkg: no column has a name of its own for each of its 3 polygons"):
        read_parcels(path)
    measured, _ = polygons(tmp_path / "m.gpkg", name=["A", "A", "C"], hectares=[0.5, 1.5, 2.5])
    with pytest.raises(InputError, match="no column has a name of its own"):
        read_parcels(measured)
    bare = tmp_path / "bare.geojson"
    gpd.GeoDataFrame(geometry=[shapely.box(0, 0, 1, 1)], crs=32632).to_file(bare)
    with pytest.raises(InputError, match="no column has a name"):
        read_parcels(bare)


def test_a_name_that_several_polygons_have_is_told(tmp_path):
    path, _ = polygons(tmp_path / "b.gpkg", name=["North", "South", "North"], id=[7, 8, 9])
    (remark,) = read_parcels(path)["8"].remarks
    assert remark == "it is called after column 'id', as 'North' stands more than once in 'name'"
    (remark,) = read_parcel(path, parcel="North").remarks
    assert remark == "2 polygons of b.gpkg are called 'North', and count as one parcel"
    (remark,) = read_parcel(path).remarks
    assert remark == "all 3 polygons of b.gpkg count as one parcel"


def test_a_parcels_name_in_another_column_is_another_thing(tmp_path):
    """Numbers of plots, say, that are those of other parcels in another column."""
    path, squares = polygons(tmp_path / "b.gpkg", block=["B", "A", "A"], name=["A", "B", "C"], code=[2, 1, 3])
    assert list(read_parcels(path)) == ["A", "B", "C"]
    for name, square in zip("ABC", squares, strict=True):
        assert read_boundary(path, parcel=name)[0].equals(square)
    assert read_boundary(path, parcel="1")[0].equals(squares[1])
    path, squares = polygons(tmp_path / "c.gpkg", name=["A", None, "1"], id=[1, 2, 3])
    assert read_boundary(path, parcel="1")[0].equals(squares[2])
    assert read_boundary(path, parcel="2")[0].equals(squares[1])


@pytest.mark.parametrize("columns", [{}, {"id": [1, 2, 3]}, {"variety": ["Nebbiolo", "Barbera", "Dolcetto"]}])
@pytest.mark.parametrize("nothing", [None, " "])
def test_a_polygon_without_a_name_costs_itself_alone(tmp_path, columns, nothing):
    path, squares = polygons(tmp_path / "b.gpkg", **columns, name=["A", "B", nothing])
    found = read_parcels(path)
    assert [found[name].boundary[0].equals(square) for name, square in zip("AB", squares, strict=False)] == [True, True]
    with pytest.raises(InputError, match=r"b\.gpkg: polygon 3 has no name in column 'name': give it one"):
        raise found["polygon 3"]
    assert len(found) == 3


@pytest.mark.parametrize(
    ("columns", "asked", "right"),
    [
        ({"name": ["A"]}, "A", True),
        ({"name": ["A"]}, "North", False),
        ({"Name": ["North 3"], "id": [1]}, "North", False),
        ({"id": [1]}, "North", True),
        ({"id": [7]}, "8", False),
        ({"id": [7]}, "7", True),
        ({"code": ["N3"]}, "North", False),
        ({"hectares": [1.5]}, "North", True),
        ({"name": [None]}, "North", True),
    ],
)
def test_a_single_polygon_is_the_parcels_unless_it_has_another_name(tmp_path, columns, asked, right):
    path, (square,) = polygons(tmp_path / "b.gpkg", **columns)
    if right:
        assert read_boundary(path, parcel=asked)[0].equals(square)
        return
    with pytest.raises(InputError, match=f"none of its 1 polygons has '{asked}' in a column"):
        read_boundary(path, parcel=asked)


def collections(path):
    """Of three features with names one is a polygon, one a polygon with its label's point, and one a line."""
    a, b, c = (shapely.box(k, 0, k + 0.9, 1) for k in range(3))
    inner = shapely.GeometryCollection([shapely.MultiPolygon([b]), b.centroid])
    shapes = [a, shapely.GeometryCollection([inner, shapely.LineString([(1, 0), (2, 0)])]), c.exterior]
    gpd.GeoDataFrame({"name": ["A", "B", "C"]}, geometry=shapes, crs=4326).to_file(path)
    return a, b, c


@pytest.mark.parametrize("suffix", ["geojson", "gpkg"])
def test_collections_keep_their_polygons_and_the_rest_is_named(tmp_path, suffix):
    path = tmp_path / f"b.{suffix}"
    a, b, _ = collections(path)
    found = read_parcels(path)
    assert found["A"].boundary[0].equals(a)
    assert found["A"].remarks == ()
    assert found["B"].boundary[0].equals(b)
    beside = "of the boundary only polygons count, not what stands beside them (1 LineString, 1 Point)"
    assert found["B"].remarks == (beside,)
    assert isinstance(found["C"], NoAreaError)
    assert str(found["C"]) == "a LineString 'C' is no polygon"
    whole = read_parcel(path)
    assert whole.boundary[0].equals(shapely.union_all([a, b]))
    assert whole.remarks[1] == f"b.{suffix} holds what is no polygon, and is left out: a LineString 'C'"
    with pytest.raises(NoAreaError):
        read_boundary(path, parcel="C")


KML = """<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document>
<Folder><name>Home</name><Placemark><name>A</name><description>one</description><MultiGeometry>{}<Point><coordinates>
0.5,0.5</coordinates></Point></MultiGeometry></Placemark></Folder>
<Folder><name>Hill</name><Placemark><name>B</name><description>two</description>{}</Placemark>
<Placemark><name>Gate</name><Point><coordinates>1,1</coordinates></Point></Placemark></Folder></Document></kml>"""
RING = "<Polygon><outerBoundaryIs><LinearRing><coordinates>{}</coordinates></LinearRing></outerBoundaryIs></Polygon>"


@pytest.mark.parametrize("packed", [False, True])
def test_kml_with_folders(tmp_path, packed):
    squares = [shapely.box(k, 0, k + 0.9, 1) for k in range(2)]
    rings = [RING.format(" ".join(f"{x},{y},0" for x, y in s.exterior.coords)) for s in squares]
    path = tmp_path / ("b.kmz" if packed else "b.kml")
    if packed:
        with zipfile.ZipFile(path, "w") as target:
            target.writestr("doc.kml", KML.format(*rings))
    else:
        path.write_text(KML.format(*rings))
    found = read_parcels(path)
    for name, square in zip("AB", squares, strict=True):
        assert found[name].boundary[0].equals(square)
    assert str(found["Gate"]) == "a Point 'Gate' is no polygon"
    assert len(found) == 3


def test_all_files_in_a_kmz_count(tmp_path):
    """GDAL reads the first of them alone."""
    rings = [RING.format(f"{k},0,0 {k}.9,0,0 {k}.9,1,0 {k},1,0 {k},0,0") for k in range(2)]
    with zipfile.ZipFile(tmp_path / "b.kmz", "w") as target:
        target.writestr("files\\nothing.kml", '<kml xmlns="http://www.opengis.net/kml/2.2"><Document/></kml>')
        for name, ring in zip(("doc", "files/more"), rings, strict=True):
            place = f"<Placemark><name>{name}</name>{ring}</Placemark>"
            target.writestr(
                f"{name}.kml", f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{place}</Document></kml>'
            )
    found = read_parcels(tmp_path / "b.kmz")
    assert {name: one.boundary[0].bounds[0] for name, one in found.items()} == {"doc": 0.0, "files/more": 1.0}


@pytest.mark.parametrize("kind", ["Unknown", "GeometryCollection"])
def test_a_layer_that_may_hold_polygons_is_not_passed_over(tmp_path, kind):
    """Beside one that does by its kind."""
    path = tmp_path / "b.gpkg"
    tables = {"fields": shapely.box(0, 0, 1, 1), "houses": shapely.box(2, 0, 3, 1)}
    for layer, square in tables.items():
        one = gpd.GeoDataFrame({"name": [layer]}, geometry=[shapely.GeometryCollection([square])], crs=32632)
        one = one if layer == "fields" else one.set_geometry([square], crs=32632)
        one.to_file(path, layer=layer, geometry_type=kind if layer == "fields" else None)
    with pytest.raises(InputError, match=r"several layers of polygons \(houses, fields\): save the parcels' alone"):
        read_boundary(path)


@pytest.mark.parametrize("folder", ["", "Parcels 2026/", "Parcels\\"])
def test_a_zipped_shapefile(tmp_path, folder):
    _, squares = polygons(tmp_path / "b.shp", name=["A", "B"])
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as packed:
        for part in tmp_path.glob("b.*"):
            if part.suffix != ".zip":
                packed.write(part, f"{folder}{part.name}")
        packed.writestr("__MACOSX/._b.shp", "")
    assert read_boundary(tmp_path / "b.zip", parcel="B")[0].equals(squares[1])
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as packed:
        packed.writestr("flight.laz", "")
    with pytest.raises(InputError, match=r"c\.zip: holds 0 files of polygons .*: unpack it"):
        read_boundary(tmp_path / "c.zip")


def test_local_polygons_need_no_crs(tmp_path):
    square = shapely.box(0, 0, 1, 1)
    path = tmp_path / "b.gpkg"
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        gpd.GeoDataFrame({"name": ["A"]}, geometry=[square]).to_file(path)
    assert read_parcel(path, parcel="A", local=True).boundary == (square, LOCAL)
    with pytest.raises(InputError, match="no CRS"):
        read_parcel(path, parcel="A")


def test_polygons_of_one_name_are_one_parcel(tmp_path):
    path, squares = polygons(tmp_path / "b.gpkg", name=["A", "B", "A"], id=[1, 2, 3])
    assert read_boundary(path, parcel="A")[0].equals(shapely.union_all([squares[0], squares[2]]))


@pytest.mark.parametrize("n", [1, 2])
def test_spikes_of_boundaries_are_no_part_of_them(tmp_path, n):
    path = tmp_path / "b.gpkg"
    spiked = shapely.Polygon([(0, 0), (1, 0), (1, 1), (5, 5), (1, 1), (0, 1)])
    apart = [shapely.transform(spiked, lambda xy, k=k: xy + 10 * k) for k in range(n)]
    gpd.GeoDataFrame({"name": ["A"] * n}, geometry=apart, crs=32632).to_file(path)
    found = read_boundary(path, parcel="A")[0]
    assert found.geom_type == ("Polygon" if n == 1 else "MultiPolygon")
    assert found.equals(shapely.union_all([shapely.box(10 * k, 10 * k, 10 * k + 1, 10 * k + 1) for k in range(n)]))


LOOP = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 1), (3, 1), (3, 3), (-1, 3), (-1, -1), (0, -1)]
BOW, EIGHT = [(0, 0), (1, 1), (1, 0), (0, 1)], [(0, 0), (1, 1), (2, 0), (2, 2), (1, 1), (0, 2)]


@pytest.mark.parametrize(("ring", "area", "told"), [(LOOP, 20.0, True), (BOW, 0.5, True), (EIGHT, 2.0, False)])
def test_an_outline_that_crosses_itself_loses_nothing_and_is_told(tmp_path, ring, area, told):
    """What it goes round twice isn't outside of it."""
    gpd.GeoDataFrame({"name": ["A"]}, geometry=[shapely.Polygon(ring)], crs=32632).to_file(tmp_path / "b.gpkg")
    found = read_parcel(tmp_path / "b.gpkg")
    assert found.boundary[0].area == pytest.approx(area)
    assert found.remarks == ("the boundary's outline crosses itself: is all of the parcel within it?",) * told


def test_overlapping_parts_of_a_parcel_are_one_area(tmp_path):
    parts = shapely.MultiPolygon([shapely.box(0, 0, 2, 1), shapely.box(1, 0, 3, 1)])
    gpd.GeoDataFrame({"name": ["A"]}, geometry=[parts], crs=32632).to_file(tmp_path / "b.gpkg")
    assert read_boundary(tmp_path / "b.gpkg")[0].area == pytest.approx(3.0)


def test_coordinates_that_are_no_numbers_cost_their_parcel_alone(tmp_path):
    squares = [shapely.box(0, 0, 7, 8), shapely.box(0, 0, 1, 1)]
    path = tmp_path / "b.geojson"
    gpd.GeoDataFrame({"name": ["A", "B"]}, geometry=squares, crs=4326).to_file(path)
    path.write_text(path.read_text().replace("7.0, 8.0", "NaN, 8.0"))
    found = read_parcels(path)
    assert "has coordinates that are no numbers" in str(found["A"])
    assert found["B"].boundary[0].area == 1.0


def test_numbers_too_large_to_count_are_names(tmp_path):
    path, squares = polygons(tmp_path / "b.gpkg", id=[1e20, 2e20])
    assert [
        one.boundary[0].equals(square) for one, square in zip(read_parcels(path).values(), squares, strict=True)
    ] == [
        True,
        True,
    ]


@pytest.mark.parametrize(
    ("polygon", "crs", "told"),
    [
        (shapely.box(414_735, 4_940_765, 414_765, 4_940_795), 4326, "lie outside the area of EPSG:4326"),
        (shapely.box(7.92, 44.61, 7.93, 44.62), 32600, "can't be brought to"),
    ],
)
def test_a_boundary_of_another_crs_than_it_says(polygon, crs, told):
    with pytest.raises(InputError, match=told) as error:
        boundary_in((polygon, CRS(crs)), CRS(32632), Path("a.laz"))
    assert "\n" not in str(error.value)


def test_boundaries_that_are_none(tmp_path):
    with pytest.raises(InputError, match="is a folder: name the file of polygons in it"):
        read_boundary(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_boundary(tmp_path / "none.gpkg")
    text = tmp_path / "b.gpkg"
    text.write_text("no polygons")
    with pytest.raises(InputError, match="can't be read"):
        read_boundary(text)
    flat = tmp_path / "flat.geojson"
    gpd.GeoDataFrame(geometry=[shapely.Polygon([(0, 0), (1, 1), (0, 0)])], crs=32632).to_file(flat)
    with pytest.raises(InputError, match="is empty"):
        read_boundary(flat)
    lines = tmp_path / "lines.gpkg"
    gpd.GeoDataFrame(geometry=[shapely.LineString([[0, 0], [1, 1]])], crs=32632).to_file(lines)
    with pytest.raises(InputError, match="holds no polygon"):
        read_boundary(lines)
    bare = tmp_path / "bare.shp"
    gpd.GeoDataFrame({"a": [1]}, geometry=[shapely.box(0, 0, 1, 1)], crs=32632).to_file(bare)
    bare.with_suffix(".prj").unlink()
    with pytest.raises(InputError, match="no CRS"):
        read_boundary(bare)
