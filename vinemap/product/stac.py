"""STAC metadata: an item for the product of a parcel, and for a survey a collection of them and an item of its own.

References within a survey's folder are relative, so that it can be moved and served as it is. Of the characters in
names only those are encoded that mean something else in a reference: pystac opens local ones as they stand.
"""

from __future__ import annotations

import json
import math
import os
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import numpy as np
import pystac
import shapely
from pystac import Asset, Link, MediaType, RelType
from pystac.extensions.file import FileExtension
from pystac.extensions.projection import ProjectionExtension

from vinemap import __version__, naming, paths
from vinemap.cloud.files import CLOUDS
from vinemap.cloud.formats.kinds import kind_of
from vinemap.evaluate.unmapped import TALL
from vinemap.geo.crs import WGS84, is_local, project
from vinemap.product.json_values import read_object
from vinemap.product.seasons.products import places_of
from vinemap.product.store import write_whole

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import geopandas as gpd
    from pyproj import CRS

    from vinemap.product.recipe import Recipe

MEDIA_TYPES = {
    ".glb": "model/gltf-binary",
    ".gpkg": MediaType.GEOPACKAGE,
    ".html": MediaType.HTML,
    ".geojson": MediaType.GEOJSON,
    ".json": MediaType.JSON,
    ".las": "application/vnd.las",
    ".laz": "application/vnd.laszip",
    ".qgz": "application/zip",
    ".qml": MediaType.XML,
    ".tif": MediaType.COG,
}
RESERVED = re.compile(r"[%#?]")
FOOTPRINT = 0.1
"""Metres by which the outline in an item may differ from the parcel's."""
SHA256 = "1220"
"""What a multihash of 32 bytes of SHA-256 begins with."""


def parcel_item(
    folder: Path,
    parcel: str,
    *,
    flown: datetime,
    polygon: shapely.Geometry,
    crs: CRS,
    properties: Mapping[str, Any],
    survey: str | None,
) -> pystac.Item:
    """Describe the product of a parcel.

    Parameters
    ----------
    folder : Path
        Where its files lie, but for the record of the run, which is written last.
    parcel : str
        Its name.
    flown : datetime
        When the survey was flown, with a time zone.
    polygon : Polygon or MultiPolygon
        The parcel's, in ``crs``.
    crs : CRS
        The product's projected CRS, or a local one, which leaves the item without a place.
    properties : mapping
        Numbers and words to be found under ``vinemap:<name>``; those without a value (None, NaN) are left out.
    survey : str, optional
        Name of the survey whose collection lies in the folder above.

    Raises
    ------
    OSError
        If a raster can't be read.
    """
    outline = None if is_local(crs) else _outline(polygon, crs)
    known = {name: value.item() if isinstance(value, np.generic) else value for name, value in properties.items()}
    item = pystac.Item(
        id=f"{survey}-{parcel}" if survey else parcel,
        geometry=json.loads(shapely.to_geojson(outline)) if outline else None,
        bbox=shapely.bounds(outline).tolist() if outline else None,
        datetime=flown.astimezone(UTC),
        properties={"title": parcel} | {f"vinemap:{name}": value for name, value in known.items() if _has_value(value)},
    )
    authority = crs.to_authority()
    ProjectionExtension.ext(item, add_if_missing=True).apply(
        code=":".join(authority) if authority else None,
        wkt2=None if authority else crs.to_wkt(),
        bbox=np.round(shapely.bounds(polygon), 3).tolist(),
    )
    files = {
        "layers": (paths.geopackage(folder, parcel), "Rows and what belongs to them, in layers"),
        "canopy": (paths.canopy_mesh(folder, parcel), "Meshes of the canopies"),
        "project": (paths.project(folder, parcel), "Project for QGIS, which shows the layers and rasters"),
        "tileset": (paths.tileset(folder), "Meshes of the canopies on the globe, as 3D Tiles"),
        "classified": (paths.classified_cloud(folder, parcel), "Point cloud with a class and a row for every point"),
    }
    for key, (path, title) in files.items():
        if path.exists():
            item.add_asset(key, _asset(path, folder, title))
    if (page := paths.report(folder, parcel)).exists():
        item.add_asset("report", _asset(page, folder, "Map, table, plots and canopies in 3D", role="overview"))
    for path in sorted(folder.glob("*.tif")):
        kind = path.stem.removeprefix(f"{naming.safe(parcel)}_")
        _add_raster(item, kind, path)
        if (style := paths.raster_style(path)).exists():
            item.add_asset(f"{kind}_style", _asset(style, folder, "Its colours in QGIS", role="style"))
    item.add_asset("run", _asset(paths.run_record(folder), folder, "Inputs, settings and versions", role="metadata"))
    if survey:
        above = folder / ".."
        _collect(item, survey, _href(paths.stac_collection(above), folder))
        source = _href(paths.stac_item(above, survey), folder)
        item.add_link(Link(RelType.DERIVED_FROM, source, MediaType.GEOJSON, survey))
    return item


def _outline(polygon: shapely.Geometry, crs: CRS) -> shapely.Geometry:
    """A polygon in WGS 84: normal is clockwise, RFC 7946 wants the opposite; its eighth decimal is a millimetre."""
    outline = shapely.reverse(shapely.normalize(project(shapely.simplify(polygon, FOOTPRINT), crs, WGS84)))
    return shapely.transform(outline, lambda lon_lat: np.round(lon_lat, 8))


def _has_value(value: object) -> bool:
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


def _asset(path: Path, folder: Path, title: str | None, *, role: str = "data") -> Asset:
    """A file as those see it that lie in ``folder``."""
    return Asset(_href(path, folder), title, media_type=MEDIA_TYPES.get(path.suffix.lower()), roles=[role])


def _href(path: Path, folder: Path) -> str:
    if url := naming.url_of(path):
        return url
    try:
        relative = RESERVED.sub(lambda found: quote(found[0]), Path(os.path.relpath(path, folder)).as_posix())
    except ValueError:  # on another drive
        return path.absolute().as_uri()
    return relative if relative.startswith("../") else f"./{relative}"


def _add_raster(item: pystac.Item, kind: str, path: Path) -> None:
    import rasterio  # half a second of start-up, needed only here

    with rasterio.open(path) as source:
        asset = _asset(path, path.parent, source.descriptions[0])
        band = {"data_type": source.dtypes[0], "nodata": source.nodata, "unit": source.units[0]}
        asset.extra_fields |= {name: value for name, value in band.items() if value is not None}
        item.add_asset(kind, asset)
        grid = ProjectionExtension.ext(asset)
        grid.shape = list(source.shape)
        grid.transform = list(source.transform)[:6]


def _collect(item: pystac.Item, survey: str, href: str) -> None:
    """Make an item one of a survey's collection."""
    item.collection_id = survey
    item.add_links([Link(rel, href, MediaType.JSON) for rel in (RelType.ROOT, RelType.PARENT, RelType.COLLECTION)])


def write_collection(
    folder: Path, *, survey: str, flown: datetime, sources: Sequence[tuple[Path, Mapping[str, Any]]]
) -> list[Path]:
    """Write a survey's collection of all parcels' items that are in a folder, and the item of the survey.

    The survey's item tells what its parcels were mapped from. Cloud and boundaries may be anywhere and stay behind when
    the products are copied, so their references hold only where they lie; their names, sizes and SHA-256 always do.

    Parameters
    ----------
    folder : Path
        Folder of the products' folders. A folder without a whole product or with one of another survey is none.
        Without any product there will be no collection.
    survey : str
        Its name.
    flown : datetime
        When it was flown, with a time zone.
    sources : sequence of (Path, mapping)
        Clouds, and boundaries if there are any, each with its size in ``bytes`` and its ``sha256``.

    Returns
    -------
    list of Path
        Folders of the products in it.

    Raises
    ------
    OSError
        If the folder can't be read or written.
    """
    parcels = list(_parcels(folder, survey))
    own, whole = paths.stac_item(folder, survey), paths.stac_collection(folder)
    if not parcels:
        whole.unlink(missing_ok=True)
        own.unlink(missing_ok=True)
        return []
    boxes = np.array([parcel.bbox for parcel in parcels])
    bbox = [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]
    flown = flown.astimezone(UTC)
    times = [flown, *(parcel.flown for parcel in parcels)]

    extent = json.loads(shapely.to_geojson(shapely.box(*bbox)))
    item = pystac.Item(survey, extent, bbox, flown, {"title": f"Survey {survey}"})
    _collect(item, survey, _href(whole, folder))
    clouds = [path for path, _ in sources if path.suffix.lower() in CLOUDS or kind_of(path)]
    for path, known in sources:
        at = clouds.index(path) if path in clouds else -1
        key = "boundaries" if at < 0 else f"cloud_{at + 1}" if at else "cloud"
        item.add_asset(key, _asset(path, folder, path.name))
        about = FileExtension.ext(item.assets[key], add_if_missing=True)
        about.apply(checksum=SHA256 + known["sha256"], size=known["bytes"])

    collection = pystac.Collection(
        survey,
        "Vine rows, canopies and terrain, parcel by parcel, mapped by vinemap from a UAV point cloud.",
        pystac.Extent(pystac.SpatialExtent([bbox]), pystac.TemporalExtent([[min(times), max(times)]])),
        title=survey,
        license="other",
    )
    collection.clear_links()
    collection.add_link(Link(RelType.ROOT, _href(whole, folder), MediaType.JSON, survey))
    items = [(f"Survey {survey}", own), *((parcel.name, parcel.path) for parcel in parcels)]
    collection.add_links([Link(RelType.ITEM, _href(path, folder), MediaType.GEOJSON, title) for title, path in items])
    save(item, own)
    save(collection, whole)
    return [parcel.path.parent for parcel in parcels]


class _Parcel(NamedTuple):
    """What a survey's collection wants to know of a parcel's item."""

    name: str
    path: Path
    bbox: tuple[float, ...]
    flown: datetime


def _parcels(folder: Path, survey: str) -> Iterator[_Parcel]:
    for product in places_of(folder):
        path = paths.stac_item(product, product.name)
        item = read_object(path)
        try:
            if item["collection"] != survey:
                continue
            west, south, east, north = map(float, item["bbox"])
            flown = datetime.fromisoformat(item["properties"]["datetime"]).astimezone(UTC)
        except (ValueError, KeyError, TypeError):
            continue
        yield _Parcel(item["properties"]["title"], path, (west, south, east, north), flown)


def save(described: pystac.Item | pystac.Collection, path: Path) -> None:
    """Write an item or a collection, whole or not at all.

    Raises
    ------
    OSError
        If it can't be written.
    """
    known = described.to_dict(include_self_link=False, transform_hrefs=False)
    write_whole(path, json.dumps(known, indent=2, ensure_ascii=False, allow_nan=False))


def write_item(folder: Path, recipe: Recipe, record: dict[str, Any], polygons: gpd.GeoDataFrame) -> None:
    """Write the STAC item of a product, by its recipe, record and polygons; it lists the files that are there.

    Raises
    ------
    OSError
        If it can't be written.
    """
    properties = {
        "version": __version__,
        "points": record["counts"]["points"],
        "rows": record["counts"]["rows"],
        "rows_length_m": record["length_m"],
        "unmapped_m2": round(sum(area for reason, area in record["unmapped_m2"].items() if reason != TALL), 1),
        "area_m2": round(float(polygons.area.sum()), 1),
    }
    item = parcel_item(
        folder,
        recipe.parcel,
        flown=recipe.flown,
        properties=properties,
        polygon=polygons.union_all(),
        crs=polygons.crs,
        survey=recipe.survey,
    )
    save(item, paths.stac_item(folder, recipe.parcel))
