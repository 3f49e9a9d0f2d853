"""Rows over several flights: on a survey's page, on the parcels' own, and what is read again when something is new."""

import base64
import json
import shutil
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from products import place_product

from vinemap import paths
from vinemap.product import store
from vinemap.product.pages import changes
from vinemap.product.pages import survey as surveys
from vinemap.product.pages.page import LEVEL, page, repacked, unpacked
from vinemap.product.pages.survey import write_index
from vinemap.product.recipe import product_in
from vinemap.product.seasons.history import history
from vinemap.product.seasons.products import read_products, read_rows, shift_between

FLOWN = {"april": "2026-04-20", "june": "2026-06-18", "fall": "2026-09-14"}


def lines(kept, shift):
    """Rows 2.5 m apart, of so many places those that are kept."""
    x, y = np.add([400_000.0, 5_000_000.0], shift)
    return [shapely.LineString([(x, y + 2.5 * k, 100), (x + 40, y + 2.5 * k, 101)]) for k in kept]


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Three flights of A, whose second row is grubbed up by the last, and of B, which the second leaves out."""
    folder = tmp_path_factory.mktemp("products")
    for k, (survey, day) in enumerate(FLOWN.items()):
        how = {"survey": survey, "flown": day, "height_m": 1.2 + 0.3 * k, "canopy_confidence": 0.4 if k == 1 else 0.9}
        shift = 0.2 * np.array([k, -k])
        place_product(folder / survey, "A", lines((0, 2, 3) if survey == "fall" else (0, 1, 2, 3), shift), **how)
        if survey != "june":
            place_product(folder / survey, "B", lines((0, 1), shift + [0, 90]), **how)
        interval = [[f"{day}T00:00:00+00:00", f"{day}T23:00:00+00:00"]]
        paths.stac_collection(folder / survey).write_text(json.dumps({"extent": {"temporal": {"interval": interval}}}))
        paths.survey_record(folder / survey).write_text('{"parcels": []}')
        assert write_index(folder / survey, survey)
    return folder


@pytest.fixture
def estate(flown, tmp_path):
    return Path(shutil.copytree(flown, tmp_path / "products"))


@pytest.fixture
def read(monkeypatch):
    """Products whose rows are read, as (survey, parcel)."""
    seen, read_rows = [], changes.read_rows

    def noted(folder, parcel):
        seen.append((folder.parent.name, parcel))
        return read_rows(folder, parcel)

    monkeypatch.setattr(changes, "read_rows", noted)
    return seen


def test_shifts_against_the_same_known_rows_tell_that_between_flights(estate):
    """Half a metre more than the rows themselves show; but not where either isn't told whole."""
    told = {"east_m": 0.3, "north_m": -0.1, "east_sd_m": 0.01, "north_sd_m": 0.02, "in_rows": True, "known_rows": "k"}

    def stated(**fall):
        for survey, shift in (("june", told), ("fall", told | fall)):
            path = paths.run_record(estate / survey / "A")
            path.write_text(json.dumps(json.loads(path.read_text()) | {"shift": shift}))
        (later,), (earlier,) = (
            [one for one in read_products(estate / survey) if one.parcel == "A"] for survey in ("fall", "june")
        )
        return later, earlier

    assert shift_between(*stated(north_m=0.4)) == pytest.approx((0, 0.5))
    assert shift_between(*stated(in_rows=False)) == pytest.approx((-0.3, 0.1))
    assert shift_between(*stated(known_rows="others")) is None
    assert shift_between(*stated(north_sd_m=None)) is None
    later, earlier = stated(north_m=0.4)
    assert changes.tell_parcel(later, [earlier], "EPSG:32632")["told"]["shift"] == pytest.approx((0, 0.5))


def test_a_fault_of_ours_in_comparing_rows_is_told_with_what_it_says(estate, monkeypatch):
    def faulty(*args, **options):
        raise KeyError("d_gap_m")

    later, earlier = (
        next(one for one in read_products(estate / survey) if one.parcel == "A") for survey in ("fall", "june")
    )
    for name in ("history", "compare_rows"):
        monkeypatch.setattr(changes, name, faulty)
        remark = changes.tell_parcel(later, [earlier], "EPSG:32632")["told"]["remark"]
        what = "followed" if name == "history" else "compared"
        assert remark == f"can't be {what}: a fault of vinemap's own (KeyError: 'd_gap_m')"


def details(folder):
    return unpacked(paths.index(folder).read_text(encoding="utf-8"), "details")


def test_a_surveys_page_holds_all_flights_of_each_row(flown):
    told = details(flown / "fall")
    seasons = told["A"]["history"]
    assert [date["survey"] for date in seasons["dates"]] == ["april", "june", "fall"]
    assert seasons["labels"] == [["1 A"] * 3, ["3 A", "3 A", "2 A"], ["4 A", "4 A", "3 A"], ["2 A", "2 A", None]]
    height = np.array(seasons["height_m"], dtype=float) * seasons["units"]["height_m"]
    assert height[:3] == pytest.approx(np.tile([1.2, 1.5, 1.8], (3, 1)))
    assert height[3] == pytest.approx([1.2, 1.5, np.nan], nan_ok=True)
    assert seasons["doubtful"] == [[0, 1, 0]] * 4
    assert [date["survey"] for date in told["B"]["history"]["dates"]] == ["april", "fall"]
    assert told["A"]["told"]["since"]["survey"] == "june"
    assert len(told["A"]["changes"]["gone"]) == 1
    assert "history" not in details(flown / "april")["A"]


def test_one_changed_parcel_does_not_have_all_others_read_again(estate, read):
    folder = estate / "fall"
    before = details(folder)
    assert not write_index(folder, "fall")
    assert read == []
    shutil.rmtree(folder / "B")
    place_product(folder, "B", lines((0, 1), (0.4, 89.6)), survey="fall", flown=FLOWN["fall"], height_m=2.5, key="new")
    assert write_index(folder, "fall")
    assert sorted(read) == [("april", "B"), ("fall", "B")]
    after = details(folder)
    assert after["A"] == before["A"]
    assert after["B"]["told"]["height_m"] == pytest.approx(2.5)
    written = paths.index(folder).read_bytes()
    paths.index(folder).unlink()
    assert write_index(folder, "fall")
    assert paths.index(folder).read_bytes() == written


def test_a_new_earlier_flight_concerns_the_parcels_that_it_shows(estate, read):
    shutil.rmtree(estate / "june" / "A")
    assert write_index(estate / "fall", "fall")
    assert {parcel for _, parcel in read} == {"A"}
    assert len(details(estate / "fall")["A"]["history"]["dates"]) == 2


@pytest.mark.parametrize("damage", ["cut", "other"])
def test_a_damaged_page_is_written_anew(estate, damage):
    path = paths.index(estate / "fall")
    whole = path.read_text()
    broken = {"cut": whole[: len(whole) // 2], "other": repacked(whole, "details", b"[1]")}[damage]
    path.write_text(broken.replace('name="made-of" content="', 'name="made-of" content="x'))
    assert write_index(estate / "fall", "fall")
    assert path.read_text() == whole


def test_what_is_packed_in_a_page_can_be_exchanged():
    made = page("index", "t", {}, packed={"details": b"[1]", "more": b"2"})
    assert (unpacked(made, "details"), unpacked(made, "more"), unpacked(made, "nothing")) == ([1], 2, None)
    other = repacked(made, "details", b'{"a": "</script>"}')
    assert (unpacked(other, "details"), unpacked(other, "more")) == ({"a": "</script>"}, 2)
    assert repacked(other, "details", b"[1]") == made
    assert repacked(made, "nothing", b"1") == made
    assert unpacked(made.replace(base64.b64encode(zlib.compress(b"[1]", LEVEL)).decode(), "???"), "details") is None


def test_a_parcels_page_shows_its_earlier_flights(flights, tmp_path):
    products = Path(shutil.copytree(flights, tmp_path / "products"))
    folder = products / "september"
    path = paths.report(folder / "A", "A")
    seasons = unpacked(path.read_text(encoding="utf-8"), "history")
    assert seasons == details(folder)["A"]["history"]
    assert [date["survey"] for date in seasons["dates"]] == ["june", "september"]
    assert unpacked(paths.report(products / "june" / "A", "A").read_text(encoding="utf-8"), "history") is None
    assert product_in(folder / "A")
    before = path.read_bytes()
    assert not write_index(folder, "september")
    assert path.read_bytes() == before
    shutil.rmtree(products / "june")
    assert write_index(folder, "september")
    assert unpacked(path.read_text(encoding="utf-8"), "history") is None
    assert product_in(folder / "A")


@pytest.fixture
def reported(estate):
    """The last flight of A with a page that shows no other."""
    folder = estate / "fall" / "A"
    report, run = paths.report(folder, "A"), paths.run_record(folder)
    report.write_text(page("index", "t", {}, packed={"history": b"null"}), encoding="utf-8")
    record = json.loads(run.read_text())
    run.write_text(json.dumps(record | {"files": record["files"] | {report.name: report.stat().st_size}}))
    return folder


def shown(folder):
    return unpacked(paths.report(folder, "A").read_text(encoding="utf-8"), "history")


def test_a_page_at_which_another_run_works_is_told_another_night(reported):
    with ThreadPoolExecutor(1) as threads, store.product(reported, within=reported.parent) as draft:
        shutil.copytree(reported, draft, dirs_exist_ok=True)
        threads.submit(write_index, reported.parent, "fall").result()
        assert shown(reported) is None
    write_index(reported.parent, "fall")
    assert len(shown(reported)["dates"]) == 3


def test_a_product_that_another_run_has_put_there_meanwhile_stays_as_it_is(reported, monkeypatch):
    run = paths.run_record(reported)
    new = run.read_text().replace('"fall A"', '"new"')
    tell = surveys.tell_parcel

    def late(*given):
        run.write_text(new)
        return tell(*given)

    paths.index(reported.parent).unlink()
    monkeypatch.setattr(surveys, "tell_parcel", late)
    write_index(reported.parent, "fall")
    assert run.read_text() == new
    assert shown(reported) is None


def test_what_was_not_seen_of_a_row_is_told_beside_its_numbers(estate):
    path = paths.geopackage(estate / "june" / "A", "A")
    rows = gpd.read_file(path, layer="rows")
    rows.assign(unseen_m=[0.0, 12.5, np.nan, 0.0]).to_file(path, layer="rows")
    products = {one.survey: one for folder in estate.iterdir() for one in read_products(folder) if one.parcel == "A"}
    told = history([(products[survey], read_rows(products[survey].folder, "A")) for survey in ("fall", "june")])
    length, seen = (np.array(told[name], dtype=float) * told["units"][name] for name in ("length_m", "seen_m"))
    assert length - seen == pytest.approx(np.array([[0, 0], [0, 0], [0, 0], [12.5, np.nan]]), abs=0.11, nan_ok=True)
    whole = changes.tell_parcel(products["june"], [], "EPSG:32632")["told"]
    assert whole["length_m"] - whole["seen_m"] == pytest.approx(12.5)
