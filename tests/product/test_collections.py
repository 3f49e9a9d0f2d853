"""STAC metadata of a survey: valid, complete, whole, and still true when the products are moved."""

import json
import os
import shutil
from datetime import timedelta
from pathlib import Path

import numpy as np
import pystac
import pytest
import rasterio
import shapely
from catalogs import FIELD, FILE, FLOWN, ODD, add_parcel, at, collect, describe, links
from pystac.extensions.projection import ProjectionExtension

from vinemap import paths

pytestmark = pytest.mark.usefixtures("no_network")


def test_collection_of_a_survey(tmp_path, source, validate):
    products = tmp_path / "surveys" / "barolo"
    moved = shapely.transform(FIELD, lambda xy: xy + [500, 900])
    late = FLOWN + timedelta(days=3)
    add_parcel(products, "b", polygon=moved)
    add_parcel(products, "F", flown=late)
    add_parcel(products, "a-b")
    whole = collect(products, source)
    known = validate(whole)
    assert (known["id"], known["license"]) == ("barolo", "other")
    assert links(known, "root") == ["./collection.json"]
    assert links(known, "item") == ["./barolo_stac.json", "./F/F_stac.json", "./a-b/a-b_stac.json", "./b/b_stac.json"]
    assert known["extent"]["temporal"]["interval"] == [["2024-06-03T09:30:00Z", "2024-06-06T09:30:00Z"]]
    items = [json.loads(at(href, whole).read_text()) for href in links(known, "item")]
    boxes = shapely.box(*np.transpose([item["bbox"] for item in items]))
    assert known["extent"]["spatial"]["bbox"] == [list(shapely.union_all(boxes).bounds)]
    assert len({item["id"] for item in items}) == 4
    assert {item["collection"] for item in items} == {"barolo"}
    assert not list(products.glob(".*"))


def test_item_of_a_survey_tells_its_sources(tmp_path, source, validate):
    add_parcel(tmp_path, "F")
    collect(tmp_path, source)
    path = paths.stac_item(tmp_path, "barolo")
    item = validate(path, FILE)
    assert (item["id"], item["properties"]["datetime"]) == ("barolo", "2024-06-03T09:30:00Z")
    assert shapely.geometry.shape(item["geometry"]).exterior.is_ccw
    cloud = item["assets"]["cloud"]
    assert at(cloud["href"], path) == source[0][0]
    assert (cloud["title"], cloud["type"]) == ("barolo #1.laz", "application/vnd.laszip")
    assert cloud["file:checksum"] == "1220" + source[0][1]["sha256"]
    assert cloud["file:size"] == source[0][0].stat().st_size
    assert at(item["assets"]["boundaries"]["href"], path) == source[1][0]


def test_sources_may_lie_on_another_drive(tmp_path, source, monkeypatch):
    add_parcel(tmp_path, "F")
    relpath = os.path.relpath

    def of_windows(path, start):
        if Path(path) in dict(source):
            raise ValueError("path is on mount 'D:', start on mount 'C:'")
        return relpath(path, start)

    monkeypatch.setattr(os.path, "relpath", of_windows)
    collect(tmp_path, source)
    item = json.loads(paths.stac_item(tmp_path, "barolo").read_text())
    assert item["assets"]["cloud"]["href"] == source[0][0].as_uri()


def test_the_same_again_is_the_same(tmp_path, source):
    files = [*(add_parcel(tmp_path, parcel) for parcel in ODD), collect(tmp_path, source)]
    files.append(paths.stac_item(tmp_path, "barolo"))
    before = [path.read_bytes() for path in files]
    for parcel in ODD:
        describe(tmp_path / parcel, parcel)
    collect(tmp_path, source)
    assert [path.read_bytes() for path in files] == before


def test_pystac_reads_a_collection_that_was_moved(tmp_path, source):
    for parcel in ("F", "Größe 3", "葡萄"):
        add_parcel(tmp_path / "before", parcel)
    collect(tmp_path / "before", source)
    shutil.move(tmp_path / "before", tmp_path / "after")
    collection = pystac.Collection.from_file(paths.stac_collection(tmp_path / "after"))
    survey, *items = collection.get_items(recursive=True)
    assert [item.id for item in (survey, *items)] == ["barolo", "barolo-F", "barolo-Größe 3", "barolo-葡萄"]
    for item in items:
        assert item.get_collection() is item.get_parent() is item.get_root() is collection
        assert [origin.id for origin in item.get_derived_from()] == [survey.id]
        with rasterio.open(item.assets["dtm"].get_absolute_href()) as raster:
            assert list(raster.shape) == ProjectionExtension.ext(item.assets["dtm"]).shape


def test_what_is_no_product_is_left_out(tmp_path, source, validate):
    add_parcel(tmp_path, "F")
    shutil.copytree(tmp_path / "F", tmp_path / ".F.1234.part")
    paths.run_record(add_parcel(tmp_path, "half").parent).unlink()
    add_parcel(tmp_path, "theirs", survey="asti")
    add_parcel(tmp_path, "alone", survey=None)
    for name, content in {"torn": b'{"id": ', "list": b"[]", "binary": b"\xff\xfe", "empty": b"{}"}.items():
        add_parcel(tmp_path, name).write_bytes(content)
    for name, change in {"boxless": {"bbox": [1, 2]}, "timeless": {"properties": {}}}.items():
        path = add_parcel(tmp_path, name)
        path.write_text(json.dumps(json.loads(path.read_text()) | change))
    folder = add_parcel(tmp_path, "folder")
    folder.unlink()
    folder.mkdir()
    (tmp_path / "dangling").symlink_to("nowhere")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "bare").mkdir()
    locked = add_parcel(tmp_path, "locked").parent
    locked.chmod(0)
    try:
        known = validate(collect(tmp_path, source))
    finally:
        locked.chmod(0o755)
    may_read_all = os.geteuid() == 0
    expected = ["./barolo_stac.json", "./F/F_stac.json"] + ["./locked/locked_stac.json"] * may_read_all
    assert links(known, "item") == expected


def test_without_products_there_is_no_collection(tmp_path, source):
    path = add_parcel(tmp_path, "F")
    collect(tmp_path, source)
    shutil.rmtree(path.parent)
    collect(tmp_path, source)
    assert list(tmp_path.iterdir()) == []


def test_a_reader_never_sees_half_a_file(tmp_path, source, monkeypatch):
    add_parcel(tmp_path, "F")
    files = [collect(tmp_path, source), paths.stac_item(tmp_path, "barolo")]
    before = [path.read_bytes() for path in files]
    add_parcel(tmp_path, "G")
    write_text = Path.write_text

    def full_disk(path, text, **how):
        write_text(path, text[:100], **how)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full_disk)
    with pytest.raises(OSError, match="No space"):
        collect(tmp_path, source)
    assert [path.read_bytes() for path in files] == before
    assert not list(tmp_path.glob(".*"))
