"""A product is there if it is whole."""

import json

import pytest

from vinemap.product.recipe import product_in

RECORD = {
    "key": "k",
    "parcel": "A",
    "counts": {"rows": 3},
    "length_m": 12.5,
    "warnings": ["few points"],
    "files": {"A.gpkg": 4, "A_dtm.tif": 0},
}


def write_product(folder, record):
    folder.mkdir()
    (folder / "A.gpkg").write_bytes(b"1234")
    (folder / "A_dtm.tif").touch()
    (folder / "run.json").write_text(record if isinstance(record, str) else json.dumps(record), encoding="utf-8")
    return folder


def test_a_whole_product(tmp_path):
    assert product_in(write_product(tmp_path / "A", RECORD)) == ("k", "A", 3, 12.5, ("few points",))


@pytest.mark.parametrize("file", ["A.gpkg", "A_dtm.tif", "run.json"])
def test_a_product_that_lacks_a_file(tmp_path, file):
    folder = write_product(tmp_path / "A", RECORD)
    (folder / file).unlink()
    assert product_in(folder) is None


@pytest.mark.parametrize("content", [b"123", b"12345", b""])
def test_a_product_with_a_file_of_another_size(tmp_path, content):
    folder = write_product(tmp_path / "A", RECORD)
    (folder / "A.gpkg").write_bytes(content)
    assert product_in(folder) is None


@pytest.mark.parametrize("name", list(RECORD))
@pytest.mark.parametrize("value", [None, 5, [1]])
def test_a_record_of_something_else(tmp_path, name, value):
    record = {key: known for key, known in RECORD.items() if key != name}
    assert product_in(write_product(tmp_path / "A", record)) is None
    if name in ("counts", "files") or (name == "warnings" and value != [1]):
        (tmp_path / "A" / "run.json").write_text(json.dumps(RECORD | {name: value}))
        assert product_in(tmp_path / "A") is None


def test_a_torn_record(tmp_path):
    text = json.dumps(RECORD)
    folder = write_product(tmp_path / "A", text)
    assert product_in(folder)
    for n in range(len(text)):
        (folder / "run.json").write_text(text[:n])
        assert product_in(folder) is None
    for other in (b"[]", b"null", b"\xff\xfe", bytes(10)):
        (folder / "run.json").write_bytes(other)
        assert product_in(folder) is None


def test_no_product(tmp_path):
    assert product_in(tmp_path / "none") is None
    (tmp_path / "A").touch()
    assert product_in(tmp_path / "A") is None
