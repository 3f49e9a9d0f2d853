"""Table 2.2 on lines of known place and length."""

import json

import geopandas as gpd
import numpy as np
import pytest
import shapely
from shapely.geometry import LineString, MultiLineString, Point, Polygon

from vinemap.errors import InputError
from vinemap.evaluate.reference import read_lines
from vinemap.evaluate.rows import as_layer, evaluate_rows, format_table, match_rows

UTM = "EPSG:32632"
X, Y = 414_700.0, 4_940_700.0


def line(*points):
    return LineString([(X + x, Y + y, *z) for x, y, *z in points])


def frame(*lines, crs=UTM, **columns):
    return gpd.GeoDataFrame(columns, geometry=list(lines), crs=crs)


REFERENCE = frame(line((0, 0), (100, 0)))


def only(result, reference=REFERENCE):
    """Return the one pair that there must be."""
    evaluation = evaluate_rows(result, reference)
    assert len(evaluation.pairs) == 1
    return evaluation.pairs.iloc[0]


def test_the_same_line():
    evaluation = evaluate_rows(REFERENCE, REFERENCE)
    assert (evaluation.good, evaluation.extra, evaluation.missed) == (100, 0, 0)
    assert evaluation.pairs.iloc[0, 2:].tolist() == pytest.approx([0] * 5)


@pytest.mark.parametrize("vertices", [2, 101])
def test_parallel_line(vertices):
    pair = only(frame(line(*((x, 0.1) for x in np.linspace(0, 100, vertices)))))
    assert pair[["dep_m", "dek_m", "cof_m"]].tolist() == pytest.approx([0.1, 0.1, 0.1])
    assert pair[["e1_along_m", "en_along_m"]].tolist() == pytest.approx([0, 0])


@pytest.mark.parametrize("reverse_result", [False, True])
@pytest.mark.parametrize("reverse_reference", [False, True])
def test_shortened_end_in_any_direction(reverse_result, reverse_reference):
    result, reference = line((0, 0), (99.5, 0)), line((0, 0), (60, 0), (100, 0))
    pair = only(
        frame(result.reverse() if reverse_result else result),
        frame(reference.reverse() if reverse_reference else reference),
    )
    assert pair[["dep_m", "dek_m", "cof_m"]].tolist() == pytest.approx([0.25, 0, 0])
    # The ends are the result's own.
    along = [-0.5, 0] if reverse_result else [0, -0.5]
    assert pair[["e1_along_m", "en_along_m"]].tolist() == pytest.approx(along)


def test_an_end_too_far_is_positive_and_counts_in_dek_not_in_cof():
    pair = only(frame(line((-1, 0), (100, 0))))
    assert pair[["dep_m", "cof_m", "e1_along_m"]].tolist() == pytest.approx([0.5, 0, 1])
    # 405 points, the first four 1, 0.75, 0.5, 0.25 m before the reference.
    assert pair["dek_m"] == pytest.approx(2.5 / 405)


def test_curves_that_cross_add_up_their_lobes():
    # A zigzag of four triangles, 25 m long and 0.2 m high: 4 * 2.5 m² over 100 m.
    zigzag = line((0, 0), (12.5, 0.2), (25, 0), (37.5, -0.2), (50, 0), (62.5, 0.2), (75, 0), (87.5, -0.2), (100, 0))
    assert only(frame(zigzag))["cof_m"] == pytest.approx(0.1)


def test_concentric_arcs():
    angle = np.linspace(0, np.pi / 2, 2000)
    arcs = [line(*np.column_stack([r * np.cos(angle), r * np.sin(angle)])) for r in (60.1, 60.0)]
    pair = only(frame(arcs[0]), frame(arcs[1].reverse()))
    assert pair["dek_m"] == pytest.approx(0.1, abs=1e-4)
    assert pair["cof_m"] == pytest.approx(0.1 * 60.05 / 60, abs=1e-4)


def test_dep_is_3d_where_both_have_z():
    low, high = line((0, 0, 200), (100, 0, 210)), line((0, 0.3, 200.4), (100, 0.3, 210.4))
    assert only(frame(high), frame(low))["dep_m"] == pytest.approx(0.5)
    assert only(frame(high), REFERENCE)["dep_m"] == pytest.approx(0.3)
    assert only(frame(shapely.force_2d(high)), frame(low))["dep_m"] == pytest.approx(0.3)
    # One layer may hold both kinds.
    both = evaluate_rows(frame(high, line((0, 5), (100, 5))), frame(low, line((0, 5), (100, 5), (100, 5.0))))
    assert both.pairs["dep_m"].tolist() == pytest.approx([0.5, 0])


def test_parts_are_joined_where_they_follow_each_other():
    parts = [line((0, 0), (30, 0)), line((100, 0), (30, 0))]
    assert only(frame(MultiLineString(parts)))["dep_m"] == pytest.approx(0)
    broken = frame(MultiLineString([line((100, 0, 2), (60, 0, 2)), line((0, 0, 1), (45, 0, 2))]))
    for pair in (only(broken), only(REFERENCE, broken)):
        assert pair[["dep_m", "e1_along_m", "en_along_m"]].tolist() == pytest.approx([0, 0, 0])
    assert only(broken, frame(line((0, 0, 1.5), (100, 0, 2))))["dep_m"] == pytest.approx(0.25)
    assert only(REFERENCE, frame(MultiLineString(parts)))["dep_m"] == pytest.approx(0)


def test_parts_side_by_side_are_rows_of_their_own():
    rows = [line((0, 2.5 * k), (100, 2.5 * k)) for k in range(3)]
    evaluation = evaluate_rows(frame(*rows), frame(MultiLineString(rows), row=[7]))
    assert evaluation.pairs["reference"].tolist() == [1, 2, 3]
    assert len(as_layer(evaluation, frame(*rows), frame(MultiLineString(rows), row=[7]))) == 3


def test_lines_elsewhere_are_refused():
    with pytest.raises(InputError, match="lie 400 m away from the result's: check the parcel"):
        evaluate_rows(frame(line((500, 0), (600, 0))), REFERENCE)


def test_good_extra_missed():
    rows = [line((0, 2.5 * k), (100, 2.5 * k)) for k in range(5)]
    half = line((0, 10), (70, 10))
    astray = line((0, 40), (100, 40))
    evaluation = evaluate_rows(
        frame(rows[2], rows[0], half, astray, rows[1], row_id=[7, 8, 9, 10, 11]),
        frame(*rows, id=["a", "b", "c", "d", "e"]),
    )
    assert evaluation.pairs[["reference", "row_id"]].to_numpy().tolist() == [["a", 8], ["b", 11], ["c", 7]]
    assert evaluation.missed_rows == ["d", "e"]
    assert evaluation.extra_rows == [9, 10]
    assert (evaluation.good, evaluation.extra, evaluation.missed) == pytest.approx((60, 40, 40))
    table = format_table(evaluation)
    assert "good 60.0%, extra 40.0%, missed 40.0% (3, 2, 2; 5 reference rows)" in table
    assert "missed: d, e" in table
    assert "extra: 9, 10" in table


def test_one_line_stands_for_one_row():
    # A doubled row is good once and extra once; the nearer in length is the good one.
    evaluation = evaluate_rows(frame(line((0, 0.1), (90, 0.1)), line((0, -0.1), (100, -0.1))), REFERENCE)
    assert evaluation.pairs["row_id"].tolist() == [2]
    assert evaluation.extra_rows == [1]


@pytest.mark.parametrize(("length", "pairs"), [(80.5, 1), (79.5, 0), (124.5, 1), (125.5, 0)])
def test_overlap_is_of_the_longer_line(length, pairs):
    result = np.array([line((0, 0.2), (length, 0.2))])
    assert len(match_rows(result, REFERENCE.geometry.to_numpy())) == pairs


@pytest.mark.parametrize(("offset", "pairs"), [(0.59, 1), (0.61, 0)])
def test_width_is_on_either_side(offset, pairs):
    result = np.array([line((0, offset), (100, offset))])
    assert len(match_rows(result, REFERENCE.geometry.to_numpy())) == pairs


def test_means_and_standard_deviations():
    rows = [line((0, 5 * k), (100, 5 * k)) for k in range(2)]
    shifted = [line((0, 0.1), (100, 0.1)), line((0, 5.3), (100, 5.3))]
    evaluation = evaluate_rows(frame(*shifted), frame(*rows))
    for spread in (evaluation.dep, evaluation.dek, evaluation.cof):
        assert spread == pytest.approx((0.2, 0.1))


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857", "EPSG:3003"])
@pytest.mark.parametrize("other", ["result", "reference"])
def test_any_crs(crs, other):
    # Other CRSs bend a straight row: give it vertices.
    x = np.linspace(0, 100, 11)
    pair = {"result": frame(line(*((a, 0.1) for a in x))), "reference": frame(line(*((a, 0) for a in x)))}
    pair[other] = pair[other].to_crs(crs)
    got = only(pair["result"], pair["reference"])
    # UTM's scale here is 0.9997; PROJ's datum shift of Monte Mario comes back.
    assert got[["dep_m", "dek_m", "cof_m"]].tolist() == pytest.approx([0.1, 0.1, 0.1], abs=1e-3)


def test_heights_in_feet_are_compared_in_metres():
    metres = frame(line((0, 0, 200), (100, 0, 210)))
    feet = metres.set_geometry(shapely.transform(metres.geometry.array, lambda p: p / [1, 1, 0.3048], include_z=True))
    assert only(feet.set_crs("EPSG:32632+8228", allow_override=True), metres)["dep_m"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("what", ["result", "reference"])
def test_no_crs(what):
    frames = {"result": REFERENCE, "reference": REFERENCE} | {what: REFERENCE.set_crs(None, allow_override=True)}
    with pytest.raises(InputError, match=f"the {what} has no CRS: set it"):
        evaluate_rows(**frames)


def test_coordinates_that_do_not_fit_their_crs():
    with pytest.raises(InputError, match="set the right one"):
        evaluate_rows(REFERENCE, REFERENCE.set_crs("EPSG:4326", allow_override=True))


def test_nothing_detected_nothing_there():
    nothing = frame(crs=None)
    empty_line = frame(LineString(), None)
    for empty in (nothing, empty_line):
        missed = evaluate_rows(empty, REFERENCE)
        assert (missed.good, missed.extra, missed.missed) == (0, 0, 100)
        extra = evaluate_rows(frame(line((0, 0), (9, 0)), line((0, 5), (9, 5))), empty)
        assert (extra.good, extra.extra, extra.missed) == (0, 200, 0)
        assert extra.extra_rows == [1, 2]
    both = evaluate_rows(nothing, nothing)
    assert (both.good, both.extra, both.missed) == (0, 0, 0)
    assert np.isnan([both.dep, both.dek, both.cof]).all()
    assert format_table(both) == "good 0.0%, extra 0.0%, missed 0.0% (0, 0, 0; 0 reference rows)"
    assert both.pairs.columns.tolist() == evaluate_rows(REFERENCE, REFERENCE).pairs.columns.tolist()


def test_a_line_of_no_length_is_left_out():
    evaluation = evaluate_rows(frame(line((0, 0), (0, 0)), line((0, 0), (100, 0))), REFERENCE)
    assert evaluation.pairs["row_id"].tolist() == [2]
    assert evaluation.extra == 0


def test_table_has_a_line_a_pair():
    table = format_table(evaluate_rows(frame(line((0, 0.2), (99.5, 0.2)), row_id=[12]), REFERENCE)).splitlines()
    assert table[0].split() == ["reference", "row_id", "dep_m", "dek_m", "cof_m", "e1_along_m", "en_along_m"]
    assert table[1].split() == ["1", "12", "0.369", "0.200", "0.199", "0.000", "-0.500"]
    assert [row.split() for row in table[3:7]] == [
        ["mean_m", "std_m"],
        ["DEP", "0.369", "0.000"],
        ["DEK", "0.200", "0.000"],
        ["COF", "0.199", "0.000"],
    ]


def test_layer_of_pairs_to_look_at():
    lines = [LineString([(500_000, 4_940_000 + y), (500_040, 4_940_000 + y)]) for y in (0, 2.5, 5, 60)]
    reference = gpd.GeoDataFrame({"row": [1, 2, 3]}, geometry=lines[:3], crs=32632)
    result = gpd.GeoDataFrame({"row_id": [7, 8, 9]}, geometry=[lines[1], lines[2], lines[3]], crs=32632)
    layer = as_layer(evaluate_rows(result, reference), result, reference.to_crs(4326))
    assert list(zip(layer["state"], layer["reference"], layer["row_id"].fillna(0), strict=True)) == [
        ("matched", 2, 7),
        ("matched", 3, 8),
        ("extra", pytest.approx(np.nan, nan_ok=True), 9),
        ("missed", 1, 0),
    ]
    assert layer.crs == result.crs
    assert layer.geometry.iloc[3].equals_exact(lines[0], 1e-5)
    assert layer["dep_m"].iloc[:2].max() < 1e-6


def test_read_lines_finds_the_layer(tmp_path):
    path = tmp_path / "map.gpkg"
    REFERENCE.to_file(path, layer="drawn")
    frame(Point(X, Y)).to_file(path, layer="ends")
    assert read_lines(path).geometry.iloc[0].equals(REFERENCE.geometry.iloc[0])
    frame(line((0, 9), (9, 9))).to_file(path, layer="gaps")
    with pytest.raises(InputError, match=r"map.gpkg: several layers of lines among drawn, ends, gaps"):
        read_lines(path)
    assert len(read_lines(path, "drawn")) == 1
    with pytest.raises(InputError, match="no layer curves; it has drawn, ends, gaps"):
        read_lines(path, "curves")
    frame(line((0, 0), (5, 0)), line((0, 3), (5, 3))).to_file(path, layer="rows")
    assert len(read_lines(str(path))) == 2


def test_read_lines_of_one_parcel(tmp_path):
    path = tmp_path / "lines.gpkg"
    REFERENCE.assign(parcel=["G", *["H"] * (len(REFERENCE) - 1)]).to_file(path, layer="rows")
    assert len(read_lines(path, parcel="G")) == 1
    with pytest.raises(InputError, match="'X'"):
        read_lines(path, parcel="X")


def test_read_lines_of_a_shapefile_that_misstates_its_encoding(tmp_path):
    path = tmp_path / "rows.shp"
    REFERENCE.assign(parcel="Süd").to_file(path, encoding="CP1252")
    path.with_suffix(".cpg").write_text("UTF-8")
    assert len(read_lines(path, parcel="Süd")) == len(REFERENCE)


COMPOSED, APART = "Vigna L\u00e0", "Vigna La\u0300"


@pytest.mark.parametrize(
    ("told", "asked"),
    [(7.0, "7"), ("North  3 ", "North 3"), ("North 3", " North  3"), (APART, COMPOSED), (COMPOSED, APART)],
)
def test_names_of_parcels_are_found_as_they_are_meant(tmp_path, told, asked):
    frame(line((0, 0), (9, 0)), line((0, 2), (9, 2)), parcel=[told, None]).to_file(tmp_path / "lines.gpkg")
    assert len(read_lines(tmp_path / "lines.gpkg", parcel=asked)) == 1


def test_read_lines_without_columns(tmp_path):
    REFERENCE.to_file(tmp_path / "lines.geojson")
    with pytest.raises(InputError, match="has 'G' in a column"):
        read_lines(tmp_path / "lines.geojson", parcel="G")


def test_read_lines_of_an_empty_layer(tmp_path):
    path = tmp_path / "nothing.gpkg"
    frame().to_file(path, layer="drawn", geometry_type="Unknown")
    assert read_lines(path).empty


def test_read_lines_refuses_what_is_no_line(tmp_path):
    path = tmp_path / "parcels.gpkg"
    frame(Polygon([(0, 0), (1, 0), (1, 1)])).to_file(path, layer="parcels")
    with pytest.raises(InputError, match="no layer of lines among parcels"):
        read_lines(path)
    with pytest.raises(InputError, match="layer parcels holds Polygon"):
        read_lines(path, "parcels")


@pytest.mark.parametrize("content", [None, b"", b"hello", b"SQLite format 3\x00" + bytes(200)])
def test_read_lines_names_a_bad_file(tmp_path, content):
    path = tmp_path / "rows.gpkg"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"rows.gpkg: (no such file|can't be read).*GeoPackage") as caught:
        read_lines(path)
    assert "\n" not in str(caught.value)


def test_read_lines_of_truncated_files(tmp_path):
    good = tmp_path / "good.gpkg"
    frame(*[line((0, k), (9, k)) for k in range(2000)]).to_file(good, layer="rows")
    half = tmp_path / "half.gpkg"
    half.write_bytes(good.read_bytes()[: good.stat().st_size // 2])
    with pytest.raises(InputError, match=r"half\.gpkg: can't be read"):
        read_lines(half)
    broken = tmp_path / "broken.geojson"
    broken.write_text(json.dumps({"type": "FeatureCollection", "features": []})[:-2])
    with pytest.raises(InputError, match=r"broken\.geojson: can't be read"):
        read_lines(broken)
