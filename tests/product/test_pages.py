"""What the pages of parcels and surveys hold, and which earlier survey a survey is compared with."""

import base64
import hashlib
import json
import re
import shutil
import subprocess
import zlib
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
from rasterio.io import MemoryFile

from vinemap import paths
from vinemap.geo.raster import Grid, Raster
from vinemap.product.pages.page import page
from vinemap.product.pages.parcel import SHADES, canopy_picture, profiles
from vinemap.product.pages.survey import write_index
from vinemap.product.seasons.products import find_earlier, read_products
from vinemap.simulate.scenes import rows_of

WEB = Path(paths.__file__).parent / "product" / "pages" / "web"


class Page(HTMLParser):
    """The elements of a page with their attributes, and the texts of scripts, styles and the title."""

    def __init__(self, path):
        super().__init__()
        self.found, self.texts, self.within = [], [], None
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))
        self.within = self.found[-1] if tag in ("script", "style", "title") else None

    def handle_endtag(self, tag):
        self.within = None

    def handle_data(self, text):
        if self.within and self.texts and self.texts[-1][0] is self.within:
            text = self.texts.pop()[1] + text
        if self.within:
            self.texts.append((self.within, text))

    def text(self, **wanted):
        (text,) = [t for (_, known), t in self.texts if wanted.items() <= known.items()]
        return text

    def data(self):
        return json.loads(self.text(id="data"))

    def unpacked(self, name):
        return zlib.decompress(base64.b64decode(self.text(id=name)))


def report(flights, parcel, survey="september"):
    return Page(paths.report(flights / survey / parcel, parcel))


def survey_index(folder):
    return Page(paths.index(folder))


def by_parcel(page):
    return {parcel["parcel"]: parcel for parcel in page.data()["parcels"]}


def lines_of(folder, parcel):
    rows = gpd.read_file(paths.geopackage(folder, parcel), layer="rows")
    return dict(zip(rows["label"], shapely.force_2d(rows.geometry), strict=True))


@pytest.fixture
def copy(flights, tmp_path):
    """Products of both surveys, to be changed."""
    return Path(shutil.copytree(flights, tmp_path / "products"))


def test_a_report_holds_its_products_numbers(flights):
    folder = flights / "september" / "A"
    page = report(flights, "A")
    data = page.data()
    rows = gpd.read_file(paths.geopackage(folder, "A"), layer="rows")
    assert data["rows"]["label"] == rows["label"].tolist() == [f"{k} A" for k in range(1, 6)]
    for name in ("length_m", "en_y", "e1_lat", "volume_m3", "confidence"):
        assert data["rows"][name] == pytest.approx(rows[name].tolist(), abs=0.006)
    first = np.array(data["rows"]["line"][0]) + data["zero"]
    assert first[0] == pytest.approx(rows.geometry[0].coords[0][:2], abs=0.01)
    assert data["totals"]["length_m"] == pytest.approx(rows["length_m"].sum())
    assert data["totals"]["n_missing"] == rows["n_missing"].sum() >= 1
    assert page.unpacked("canopies") == paths.canopy_mesh(folder, "A").read_bytes()
    details = json.loads(page.unpacked("details"))
    sections = gpd.read_file(paths.geopackage(folder, "A"), layer="sections").query("row_id == 2")
    assert np.array(details["profiles"]["2"]["height"]) / 100 == pytest.approx(
        sections["height_m"].to_numpy(), abs=0.006
    )
    record = json.loads(paths.run_record(folder).read_text())
    assert data["settings"] == record["settings"]
    assert data["inputs"] == record["inputs"]
    assert not {"created", "seconds", "key"} & set(data)
    item = json.loads(paths.stac_item(folder, "A").read_text())
    about = {"href": "./A_report.html", "type": "text/html", "roles": ["overview"]}
    assert about.items() <= item["assets"]["report"].items()


@pytest.mark.parametrize("parcel", ["one", "meadow"])
def test_a_report_of_one_row_or_none(flights, parcel):
    data = report(flights, parcel).data()
    n = len(data["rows"]["label"])
    assert n == data["totals"]["rows"] == (parcel == "one")
    assert data["totals"]["area_m2"] > 100
    assert data["totals"]["spacing_m"] is None


@pytest.mark.parametrize("name", ["A/A_report.html", "index.html"])
def test_a_page_asks_for_nothing_and_runs_its_own_scripts_alone(flights, name):
    page = Page(flights / "september" / name)
    known = {tag for tag, _ in page.found}
    assert not known & {"img", "iframe", "object", "embed", "form", "base"}
    assert all("src" not in attributes for _, attributes in page.found)
    links = [attributes["href"] for tag, attributes in page.found if "href" in attributes]
    assert all(href.startswith(("#", "data:")) for href in links)
    (policy,) = [a["content"] for _, a in page.found if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    allowed = set(re.findall(r"'sha256-([^']+)'", policy))
    run = [text for (tag, attributes), text in page.texts if tag == "style" or attributes.get("id", "").endswith("-js")]
    run += [text for (tag, attributes), text in page.texts if tag == "script" and not attributes]
    hashes = {base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in run}
    assert hashes == allowed


def test_words_of_others_stay_words(tmp_path):
    odd = "</script><script>alert(1)</script><!-- \u2028 & $data ${x} é 🍇"
    path = tmp_path / "page.html"
    path.write_text(page("index", odd, {"parcel": odd}, packed={"details": b"{}"}), encoding="utf-8")
    made = Page(path)
    assert made.data() == {"parcel": odd}
    assert [text for ((tag, _), text) in made.texts if tag == "title"] == [odd]
    assert sum(tag == "script" for tag, _ in made.found) == 4


@pytest.mark.parametrize("name", ["A/A_report.html", "index.html"])
def test_a_page_holds_the_licences_of_what_is_bundled_in_it(flights, name):
    text = Page(flights / "september" / name).text(id="licences")
    assert text.strip() == (WEB / "dist" / "LICENSES.txt").read_text().strip()


def test_the_picture_tells_heights():
    values = np.array([[0.0, 1.5, 3.0, 9.0], [np.nan, 0.0, 0.0, 0.0]])
    png, across, down = canopy_picture(Raster(values, Grid(0.0, 0.0, 0.25, 2, 4), None))
    assert (across, down) == (1.0, 0.5)
    unplaced = pytest.warns(rasterio.errors.NotGeoreferencedWarning)
    with rasterio.Env(GDAL_PAM_ENABLED=False), MemoryFile(png) as file, unplaced, file.open() as picture:
        levels, inks = picture.read(1), picture.colormap(1)
    assert levels.tolist()[0] == [1, 1 + round(0.5 * (SHADES - 1)), SHADES, SHADES]
    opacity = [inks[level][3] for level in levels.ravel()]
    assert opacity[4] == 0 < opacity[0] < opacity[1] < opacity[2]


def test_a_large_parcel_is_drawn_coarser():
    png, across, down = canopy_picture(Raster(np.ones((100, 4001)), Grid(0.0, 0.0, 0.5, 100, 4001), None))
    assert across == pytest.approx(2001)
    assert down == 51
    assert len(png) < 5000
    n = 2000
    sections = {"row_id": np.repeat([1, 2], n), "position_m": np.tile(np.arange(n) * 0.25, 2)}
    sections |= dict.fromkeys(("height_m", "bottom_m", "width_m", "area_m2"), np.tile(np.linspace(1, 2, n), 2))
    found = profiles(gpd.GeoDataFrame(sections))
    assert len(found["2"]["height"]) == 667
    assert np.mean(found["2"]["height"]) == pytest.approx(150, abs=0.5)


def test_a_survey_tells_what_became_of_each_parcel(flights):
    page = survey_index(flights / "september")
    parcels = by_parcel(page)
    assert sorted(parcels) == ["A", "meadow", "nobody's", "one"]
    assert parcels["nobody's"]["state"] == "failed"
    assert "nobody's" in parcels["nobody's"]["reason"]
    assert (parcels["A"]["state"], parcels["A"]["rows"], parcels["meadow"]["rows"]) == ("done", 5, 0)
    assert parcels["A"]["files"] == {"report": "A_report.html", "layers": "A.gpkg", "project": "A.qgz"}
    assert page.data()["flown"][0][:10] == "2026-09-14"
    assert [len(told["lines"]) for told in json.loads(page.unpacked("details")).values()] == [5, 0, 1]


def test_a_survey_tells_what_has_changed_since_the_one_before(flights):
    parcels = by_parcel(survey_index(flights / "september"))
    rows = json.loads(survey_index(flights / "september").unpacked("details"))["A"]["changes"]
    known = parcels["A"]
    assert known["since"]["survey"] == "june"
    assert known["since"]["flown"][:10] == "2026-06-18"
    assert known["shift"] == pytest.approx([-0.4, 0.3], abs=0.06)
    told = known["summary"]
    assert (told["same"], told["new"], told["gone"]) == (4, 1, 1)
    assert told["d_height_m"] == pytest.approx(0.2, abs=0.04)
    assert told["d_volume"] == pytest.approx(0.13, abs=0.08)
    then, now = (lines_of(flights / survey / "A", "A") for survey in ("june", "september"))
    places = [shapely.LineString(line) for line in rows_of(6, length=22, azimuth=33)]
    for state, label, earlier in zip(rows["state"], rows["label"], rows["earlier"], strict=True):
        if state == "same":
            moved = shapely.transform(then[earlier], lambda xy: xy + known["shift"])
            assert shapely.hausdorff_distance(moved, now[label]) < 0.25
        elif state == "new":
            assert shapely.hausdorff_distance(now[label], places[4]) < 0.5
        else:
            moved = shapely.transform(then[earlier], lambda xy: xy + known["shift"])
            assert shapely.hausdorff_distance(moved, places[1]) < 0.5
    assert rows["label"][:5] == list(now)
    assert rows["d_height_m"][rows["state"].index("same")] == pytest.approx(0.2, abs=0.05)
    assert rows["d_height_m"][rows["state"].index("new")] is None
    assert rows["height_m"][rows["state"].index("gone")] == pytest.approx(1.8, abs=0.05)
    assert len(rows["gone"]) == 1
    assert (parcels["one"]["summary"]["same"], parcels["meadow"]["summary"]["same"]) == (1, 0)
    assert "since" not in by_parcel(survey_index(flights / "june"))["A"]


def test_the_same_products_give_the_same_page_which_is_not_written_again(copy):
    folder = copy / "september"
    before = paths.index(folder).read_bytes()
    assert not write_index(folder, "september")
    paths.index(folder).unlink()
    assert write_index(folder, "september")
    assert paths.index(folder).read_bytes() == before


def test_the_page_follows_what_lies_beside_it(copy):
    folder = copy / "september"
    shutil.rmtree(copy / "june" / "one")
    assert write_index(folder, "september")
    parcels = by_parcel(survey_index(folder))
    assert "since" in parcels["A"]
    assert "since" not in parcels["one"]


def test_a_parcel_is_known_again_by_its_place(copy):
    june = copy / "june"
    (june / "A").rename(june / "Z")
    for name in ("A.gpkg", "A_stac.json"):
        (june / "Z" / name).rename(june / "Z" / name.replace("A", "Z"))
    record = json.loads(paths.run_record(june / "Z").read_text())
    paths.run_record(june / "Z").write_text(json.dumps(record | {"parcel": "Z"}))
    assert write_index(copy / "september", "september")
    since = by_parcel(survey_index(copy / "september"))["A"]["since"]
    assert (since["survey"], since["parcel"]) == ("june", "Z")


def test_earlier_flights_are_found_the_latest_first(copy):
    shutil.copytree(copy / "june", copy / "july")
    for path in (copy / "july").glob("*/run.json"):
        path.write_text(path.read_text().replace('"2026-06-18', '"2026-07-18').replace('"june"', '"july"'))
    collection = paths.stac_collection(copy / "july")
    collection.write_text(collection.read_text().replace("2026-06-18", "2026-07-18"))
    products = {product.parcel: product for product in read_products(copy / "september")}
    found = find_earlier(products, copy / "september")
    surveys = {name: [one.survey for one in earlier] for name, earlier in found.items()}
    assert surveys == {name: ["july", "june"] for name in ("A", "one", "meadow")}
    assert {earlier[0].flown for earlier in found.values()} == {datetime(2026, 7, 18, tzinfo=UTC)}


def test_junk_beside_a_survey_costs_nothing(copy):
    (copy / "file").write_text("x")
    (copy / "empty").mkdir()
    for k, (record, collection) in enumerate(
        [("x", "x"), ("{}", "[]"), ("{}", '{"extent": {"temporal": {"interval": [[null, null]]}}}')]
    ):
        (copy / f"junk {k}").mkdir()
        paths.survey_record(copy / f"junk {k}").write_text(record)
        paths.stac_collection(copy / f"junk {k}").write_text(collection)
    (copy / "loop").symlink_to(copy / "loop")
    paths.geopackage(copy / "june" / "A", "A").write_bytes(b"SQLite format 3\0" + b"x" * 2000)
    paths.run_record(copy / "june" / "one").write_text("[]")
    paths.geopackage(copy / "september" / "meadow", "meadow").unlink()
    paths.index(copy / "september").unlink()
    assert write_index(copy / "september", "september")
    parcels = by_parcel(survey_index(copy / "september"))
    assert parcels["A"]["remark"] == "rows of the earlier survey can't be read"
    assert "since" not in parcels["one"]
    assert parcels["meadow"]["warnings"][-1] == "its GeoPackage can't be read"


def test_odd_products_of_its_own_cost_a_survey_no_page(copy):
    folder = copy / "september"
    layers = paths.geopackage(folder / "A", "A")
    rows = gpd.read_file(layers, layer="rows").assign(height_m="tall")
    layers.unlink()
    rows.to_file(layers, layer="rows")
    item = paths.stac_item(folder / "one", "one")
    shape = {"type": "Polygon", "coordinates": [[[1e6, 4e6], [2e6, 4e6], [2e6, 5e6], [1e6, 4e6]]]}
    item.write_text(json.dumps(json.loads(item.read_text()) | {"geometry": shape}))
    paths.index(folder).unlink()
    assert write_index(folder, "september")
    parcels = by_parcel(survey_index(folder))
    assert parcels["A"]["warnings"][-1] == "its GeoPackage can't be read"
    assert "outline" not in parcels["one"]
    assert parcels["meadow"]["rows"] == 0


def test_a_survey_without_any_product_has_a_page_of_what_failed(tmp_path):
    assert not write_index(tmp_path, "s")
    record = {"parcels": [{"parcel": "<b>", "state": "failed", "reason": "no </script>"}]}
    paths.survey_record(tmp_path).write_text(json.dumps(record))
    assert write_index(tmp_path, "s")
    assert survey_index(tmp_path).data()["parcels"] == [{"parcel": "<b>", "state": "failed", "reason": "no </script>"}]


def test_a_page_of_many_parcels_stays_small(copy):
    folder = copy / "many"
    folder.mkdir()
    n = 60
    for k in range(n):
        shutil.copytree(copy / "september" / "A", folder / f"{k}")
        for path in (folder / f"{k}").iterdir():
            path.rename(path.with_name(re.sub(r"^A(?=[_.])", str(k), path.name)))
        path = paths.run_record(folder / f"{k}")
        path.write_text(json.dumps(json.loads(path.read_text()) | {"parcel": str(k), "survey": "many"}))
    assert write_index(folder, "many")
    parcels = by_parcel(survey_index(folder))
    assert len(parcels) == n
    assert all(parcel["summary"]["same"] == 4 for parcel in parcels.values())
    bundle = sum((WEB / "dist" / name).stat().st_size for name in ("index.js", "style.css"))
    assert (paths.index(folder).stat().st_size - bundle) / n < 3000


def test_the_bundle_is_of_the_versions_that_package_json_names():
    wanted = json.loads((WEB / "package.json").read_text())["dependencies"]
    licences = (WEB / "dist" / "LICENSES.txt").read_text()
    for name, version in wanted.items():
        assert f"\n{name} {version}\n" in licences
    locked = json.loads((WEB / "package-lock.json").read_text())["packages"]
    assert {name: locked[f"node_modules/{name}"]["version"] for name in wanted} == wanted
    assert not any("resolved" in known for known in locked.values())


@pytest.mark.skipif(not (WEB / "node_modules").is_dir(), reason="needs what `make web` installs")
def test_the_bundle_is_that_of_its_sources(tmp_path):
    made = shutil.copytree(WEB, tmp_path / "web", symlinks=True, ignore=shutil.ignore_patterns("node_modules", "dist"))
    (made / "dist").mkdir()
    (made / "node_modules").symlink_to(WEB / "node_modules")
    subprocess.run(["node", "build.mjs"], cwd=made, check=True, timeout=60)
    for path in sorted((WEB / "dist").iterdir()):
        assert (made / "dist" / path.name).read_bytes() == path.read_bytes(), path.name
