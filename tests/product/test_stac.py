"""STAC metadata: valid, complete, whole, and still true when the products are moved."""

import json
import os
import shutil
import socket
from datetime import datetime, timedelta, timezone
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pystac
import pytest
import rasterio
import shapely
from pyproj import CRS
from pystac.errors import STACValidationError
from pystac.extensions.projection import ProjectionExtension
from pystac.validation import JsonSchemaSTACValidator

from vinemap import paths
from vinemap.geo.crs import WGS84, project
from vinemap.geo.raster import Grid, Raster
from vinemap.parcel import map_parcel
from vinemap.product.rasters import write_cog
from vinemap.product.recipe import read_source
from vinemap.product.stac import parcel_item, save, write_collection
from vinemap.simulate.survey import write_survey

RASTERS = ("dtm", "chm", "row_direction", "row_spacing", "vineyard_likelihood")
UTM = CRS.from_epsg(32632)
NOWHERE = CRS.from_proj4("+proj=tmerc +lat_0=44.6 +lon_0=7.9 +k=1 +x_0=1000 +y_0=2000 +ellps=WGS84 +units=m")
FLOWN = datetime(2024, 6, 3, 11, 30, tzinfo=timezone(timedelta(hours=2)))
FIELD = shapely.box(415000, 4940000, 415060, 4940040)
ODD = ["Nord 3", "Größe ä", "a#b", "50% x", "100%25", "葡萄", "+&'=;,@ (1)"]

PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
FILE = "https://stac-extensions.github.io/file/v2.1.0/schema.json"


def array(kind, *lengths):
    return {"type": "array", "items": {"type": kind}, "anyOf": [{"minItems": n, "maxItems": n} for n in lengths]}


def extension(uri, prefix, **fields):
    """What the tables of an extension's README say of its fields, in properties of items and in assets."""
    known = {f"{prefix}:{name}": schema for name, schema in fields.items()}
    holder = {
        "type": "object",
        "properties": known,
        "patternProperties": {f"^(?!{prefix}:)": True},
        "additionalProperties": False,
    }
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "$id": uri,
        "required": ["stac_extensions", "properties", "assets"],
        "properties": {
            "stac_extensions": {"contains": {"const": uri}},
            "properties": holder,
            "assets": {"additionalProperties": holder},
        },
    }


SCHEMAS = {
    PROJECTION: extension(
        PROJECTION,
        "proj",
        code={"type": ["string", "null"], "pattern": "^[A-Za-z0-9_]+:[A-Za-z0-9_]+$"},
        wkt2={"type": ["string", "null"]},
        bbox=array("number", 4, 6),
        shape=array("integer", 2),
        transform=array("number", 6, 9),
    ),
    FILE: extension(
        FILE,
        "file",
        checksum={"type": "string", "pattern": "^1220[0-9a-f]{64}$"},
        size={"type": "integer", "minimum": 0},
    ),
}


@pytest.fixture(autouse=True)
def _no_network(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("the network was asked for")

    monkeypatch.setattr(socket, "create_connection", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


@pytest.fixture(scope="module")
def validator():
    found = JsonSchemaSTACValidator()
    found.schema_cache |= SCHEMAS
    return found


@pytest.fixture
def validate(validator):
    """Check a file of STAC, and give it; the schemas it was held against must be those of its kind."""

    def check(path, *extensions):
        known = json.loads(path.read_text(encoding="utf-8"))
        kind = "item" if known["type"] == "Feature" else "collection"
        against = pystac.validation.validate_dict(known, validator=validator)
        assert against == [f"https://schemas.stacspec.org/v1.1.0/{kind}-spec/json-schema/{kind}.json", *extensions]
        assert "NaN" not in path.read_text(encoding="utf-8")
        return known

    return check


def write_files(folder, parcel, crs=UTM):
    """A product of tiny files."""
    folder.mkdir(parents=True)
    for path in (paths.geopackage(folder, parcel), paths.canopy_mesh(folder, parcel)):
        path.write_bytes(b"x")
    grid = Grid(415000.0, 4940040.0, 10.0, 4, 6)
    for kind in RASTERS:
        path = paths.raster(folder, parcel, kind)
        write_cog(Raster(np.zeros(grid.shape), grid, crs), path, description=kind.title(), unit="m")


def describe(folder, parcel="F", *, survey="barolo", polygon=FIELD, crs=UTM, flown=FLOWN, **properties):
    item = parcel_item(
        folder, parcel, survey=survey, flown=flown, polygon=polygon, crs=crs, properties={"rows": 6, **properties}
    )
    path = paths.stac_item(folder, parcel)
    save(item, path)
    return path


def add_parcel(products, parcel, **how):
    folder = products / parcel
    write_files(folder, parcel)
    paths.run_record(folder).write_text("{}")
    return describe(folder, parcel, **how)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A cloud and boundaries, as far as a survey's item wants to know of them."""
    folder = tmp_path_factory.mktemp("surveys") / "barolo 2024"
    folder.mkdir()
    files = folder / "barolo #1.laz", folder / "parcels.gpkg"
    for path in files:
        path.write_bytes(path.name.encode())
    return [(path, read_source(path).record()) for path in files]


def collect(products, source, *, survey="barolo", flown=FLOWN):
    write_collection(products, survey=survey, flown=flown, sources=source)
    return paths.stac_collection(products)


def links(known, rel):
    return [link["href"] for link in known["links"] if link["rel"] == rel]


def at(href, path):
    """Where a reference in a file leads."""
    assert not href.startswith(("/", "file:", "http"))
    return Path(os.path.normpath(path.parent / unquote(href)))


def test_the_schemas_see_what_is_wrong(tmp_path, validator):
    write_files(tmp_path / "F", "F")
    good = json.loads(describe(tmp_path / "F").read_text())
    pystac.validation.validate_dict(good, validator=validator)
    for place, name, value in [
        ("properties", "proj:code", 32632),
        ("properties", "proj:code", "32632"),
        ("properties", "proj:bbox", [1, 2, 3]),
        ("properties", "proj:epsg", 32632),
        ("properties", "datetime", 2024),
        ("dtm", "proj:shape", [1.5, 2]),
        ("dtm", "proj:shape", [1, 2, 3]),
        ("dtm", "proj:transform", [1, 0, 0, 0, 1]),
        ("dtm", "href", ""),
    ]:
        bad = json.loads(json.dumps(good))
        (bad["properties"] if place == "properties" else bad["assets"][place])[name] = value
        with pytest.raises(STACValidationError):
            pystac.validation.validate_dict(bad, validator=validator)


def test_item_of_a_parcel(tmp_path, validate):
    write_files(tmp_path / "F", "F")
    item = validate(
        describe(tmp_path / "F", rows_length_m=np.float32(2.5), n_missing=np.int64(3), spacing_m=np.nan, datum=None),
        PROJECTION,
    )
    assert item["id"] == "barolo-F"
    assert item["properties"] == {
        "title": "F",
        "datetime": "2024-06-03T09:30:00Z",
        "vinemap:rows": 6,
        "vinemap:rows_length_m": 2.5,
        "vinemap:n_missing": 3,
        "proj:code": "EPSG:32632",
        "proj:bbox": [415000, 4940000, 415060, 4940040],
    }
    assert item["collection"] == "barolo"
    for rel in ("root", "parent", "collection"):
        assert links(item, rel) == ["../collection.json"]
    assert links(item, "derived_from") == ["../barolo_stac.json"]
    assert links(item, "self") == []
    assert set(item["assets"]) == {"layers", "canopy", "run", *RASTERS}
    assert item["assets"]["layers"]["type"] == "application/geopackage+sqlite3"
    assert item["assets"]["canopy"]["type"] == "model/gltf-binary"
    assert item["assets"]["run"] == {
        "href": "./run.json",
        "type": "application/json",
        "title": "Inputs, settings and versions",
        "roles": ["metadata"],
    }
    assert item["assets"]["dtm"] == {
        "href": "./F_dtm.tif",
        "type": "image/tiff; application=geotiff; profile=cloud-optimized",
        "title": "Dtm",
        "data_type": "float32",
        "nodata": -9999,
        "unit": "m",
        "proj:shape": [4, 6],
        "proj:transform": [10, 0, 415000, 0, -10, 4940040],
        "roles": ["data"],
    }


def test_a_classified_cloud_is_an_asset(tmp_path, validate):
    write_files(tmp_path / "F", "F")
    paths.classified_cloud(tmp_path / "F", "F").write_bytes(b"x")
    asset = validate(describe(tmp_path / "F"), PROJECTION)["assets"]["classified"]
    assert (asset["href"], asset["type"]) == ("./F_classified.laz", "application/vnd.laszip")


def test_a_parcel_of_no_survey_belongs_to_no_collection(tmp_path, validate):
    write_files(tmp_path / "F", "F")
    item = validate(describe(tmp_path / "F", survey=None), PROJECTION)
    assert (item["id"], item["links"], item.get("collection")) == ("F", [], None)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("several", [False, True])
def test_geometry_is_the_parcels(tmp_path, validate, turned, several):
    hole = shapely.box(415010, 4940010, 415020, 4940020).exterior.coords
    polygon = shapely.Polygon(FIELD.exterior.coords, [hole])
    if turned:
        polygon = shapely.reverse(polygon)
    if several:
        polygon = shapely.MultiPolygon([polygon, shapely.box(415100, 4940000, 415120, 4940040)])
    write_files(tmp_path / "F", "F")
    item = validate(describe(tmp_path / "F", polygon=shapely.force_3d(polygon, 250)), PROJECTION)
    outline = shapely.geometry.shape(item["geometry"])
    assert outline.geom_type == polygon.geom_type
    assert shapely.hausdorff_distance(project(outline, WGS84, UTM), polygon) < 0.002
    assert item["bbox"] == list(outline.bounds)
    assert 7 < item["bbox"][0] < 9  # longitude comes first
    for part in shapely.get_parts(outline):
        assert part.exterior.is_ccw
        assert not any(ring.is_ccw for ring in part.interiors)
        assert not part.has_z


def test_a_crs_without_a_code_is_written_out(tmp_path, validate):
    polygon = shapely.box(1000, 2000, 1060, 2040)
    write_files(tmp_path / "F", "F", crs=NOWHERE)
    path = describe(tmp_path / "F", polygon=polygon, crs=NOWHERE)
    item = validate(path, PROJECTION)
    assert item["properties"]["proj:code"] is None
    assert CRS.from_wkt(item["properties"]["proj:wkt2"]) == NOWHERE
    assert item["bbox"][:2] == pytest.approx([7.9, 44.6])
    assert CRS(ProjectionExtension.ext(pystac.Item.from_file(path)).crs_string) == NOWHERE


def test_other_authorities_have_codes_too(tmp_path, validate):
    write_files(tmp_path / "F", "F")
    crs = CRS.from_authority("ESRI", 102092)  # Monte Mario / Italy 2
    polygon = project(FIELD, UTM, crs)
    item = validate(describe(tmp_path / "F", polygon=polygon, crs=crs), PROJECTION)
    assert item["properties"]["proj:code"] == "ESRI:102092"


@pytest.mark.parametrize("parcel", ODD)
def test_references_of_odd_names_lead_to_files(tmp_path, source, validate, parcel):
    path = add_parcel(tmp_path / parcel, parcel, survey=parcel)
    item = validate(path, PROJECTION)
    files = {at(asset["href"], path) for asset in item["assets"].values()}
    assert files | {path} == set(path.parent.iterdir())
    whole = collect(tmp_path / parcel, source, survey=parcel)
    own = paths.stac_item(tmp_path / parcel, parcel)
    assert [at(href, whole) for href in links(validate(whole), "item")] == [own, path]
    assert [at(href, path) for href in links(item, "collection")] == [whole]
    assert [at(href, path) for href in links(item, "derived_from")] == [own]
    text = "".join([known["href"] for known in [*item["links"], *item["assets"].values()]])
    assert not set(text) & set("#?")


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


def test_item_of_a_real_product(vineyard, tmp_path, source, validate):
    cloud = write_survey(vineyard, tmp_path / "in")
    products = tmp_path / "products"
    map_parcel(cloud, products / "A", parcel="A", boundary=cloud.with_name("parcels.gpkg"))
    path = paths.stac_item(products / "A", "A")
    item = validate(path, PROJECTION)
    files = {at(asset["href"], path) for asset in item["assets"].values()}
    assert files == set(path.parent.iterdir()) - {path}
    assert item["assets"]["dtm"]["title"] == "Terrain elevation"
    assert {item["assets"][kind]["unit"] for kind in RASTERS} == {"m", "degree", "1"}
    with rasterio.open(at(item["assets"]["dtm"]["href"], path)) as raster:
        height, width = item["assets"]["dtm"]["proj:shape"]
        transform = rasterio.Affine(*item["assets"]["dtm"]["proj:transform"])
        assert rasterio.transform.array_bounds(height, width, transform) == tuple(raster.bounds)
        assert raster.crs.to_string() == item["properties"]["proj:code"]
    assert item["id"] == "A"
    assert "collection" not in item
