"""Polygons of parcels, as people's files have them."""

import geopandas as gpd
import pytest
import shapely

from vinemap.errors import InputError
from vinemap.geo.boundaries import read_boundary, read_parcels


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
        read_boundary(path, parcel="Baa")


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
        ({"name": ["A", None, "C"], "plot": ["P", "Q", "R"]}, ["P", "Q", "R"]),
        ({"name": ["A", " ", "C"], "plot": ["P", "Q", "R"]}, ["P", "Q", "R"]),
    ],
)
def test_names_of_parcels(tmp_path, columns, names):
    path, squares = polygons(tmp_path / "b.gpkg", **columns)
    assert list(read_parcels(path)) == names
    for name, square in zip(names, squares, strict=True):
        assert read_boundary(path, parcel=name)[0].equals(square)


def test_no_column_names_each_parcel(tmp_path):
    path, _ = polygons(tmp_path / "b.gpkg", name=["A", "A", "C"], plot=["P", None, "Q"])
    with pytest.raises(InputError, match=r"b\.gpkg: no column has a name of its own for each of its 3 polygons"):
        read_parcels(path)
    bare = tmp_path / "bare.geojson"
    gpd.GeoDataFrame(geometry=[shapely.box(0, 0, 1, 1)], crs=32632).to_file(bare)
    with pytest.raises(InputError, match="no column has a name"):
        read_parcels(bare)


def test_a_parcels_name_in_another_column_is_another_thing(tmp_path):
    """Numbers of plots, say, that are those of other parcels in another column."""
    path, squares = polygons(tmp_path / "b.gpkg", block=["B", "A", "A"], name=["A", "B", "C"], code=[2, 1, 3])
    assert list(read_parcels(path)) == ["A", "B", "C"]
    for name, square in zip("ABC", squares, strict=True):
        assert read_boundary(path, parcel=name)[0].equals(square)
    assert read_boundary(path, parcel="1")[0].equals(squares[1])
    path, squares = polygons(tmp_path / "c.gpkg", name=["A", None, "1"], id=[1, 2, 3])
    for name, square in zip(read_parcels(path), squares, strict=True):
        assert read_boundary(path, parcel=name)[0].equals(square)


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


def test_boundaries_that_are_none(tmp_path):
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
