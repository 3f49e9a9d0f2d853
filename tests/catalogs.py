"""Products of tiny files with STAC metadata, and the schemas these are held against."""

import os
from datetime import datetime, timedelta, timezone
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import shapely
from pyproj import CRS

from vinemap import paths
from vinemap.geo.raster import Grid, Raster
from vinemap.product.rasters import write_cog
from vinemap.product.stac import parcel_item, save, write_collection

RASTERS = ("dtm", "chm", "row_direction", "row_spacing", "vineyard_likelihood")
UTM = CRS.from_epsg(32632)
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


def collect(products, source, *, survey="barolo", flown=FLOWN):
    write_collection(products, survey=survey, flown=flown, sources=source)
    return paths.stac_collection(products)


def links(known, rel):
    return [link["href"] for link in known["links"] if link["rel"] == rel]


def at(href, path):
    """Where a reference in a file leads."""
    assert not href.startswith(("/", "file:", "http"))
    return Path(os.path.normpath(path.parent / unquote(href)))
