"""STAC metadata of a parcel: valid, complete, and of any CRS and name."""

import json

import numpy as np
import pystac
import pytest
import rasterio
import shapely
from catalogs import FIELD, ODD, PROJECTION, RASTERS, UTM, add_parcel, at, collect, describe, links, write_files
from pyproj import CRS
from pystac.errors import STACValidationError
from pystac.extensions.projection import ProjectionExtension

from vinemap import paths
from vinemap.geo.crs import WGS84, project
from vinemap.parcel import map_parcel
from vinemap.simulate.survey import write_survey

pytestmark = pytest.mark.usefixtures("no_network")
NOWHERE = CRS.from_proj4("+proj=tmerc +lat_0=44.6 +lon_0=7.9 +k=1 +x_0=1000 +y_0=2000 +ellps=WGS84 +units=m")


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
