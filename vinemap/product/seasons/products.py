"""Products of a survey and of those flown before it: what lies in their folders, and which show the same place."""

from __future__ import annotations

import json
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyogrio
import shapely
from pyogrio.errors import DataLayerError, DataSourceError

from vinemap import naming, paths
from vinemap.errors import InputError
from vinemap.evaluate.changes import MEASURES
from vinemap.geo.main import origin_of
from vinemap.product.json_values import read_object

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    import geopandas as gpd
    import pandas as pd

COLUMNS = ("row_id", "label", "spacing_m", *MEASURES)
"""What is read of rows, beside what wasn't seen of them."""
GONE = "no longer a parcel"
"""State, in a survey's record, of a parcel that its boundaries have no more, though its product is still there."""
SHARED = 0.3
"""Share of the smaller of two outlines that both hold, from which on they are the same parcel's."""


class Product(NamedTuple):
    """What a survey's page wants to know of a parcel's product, without its layers."""

    folder: Path
    parcel: str
    survey: str | None
    flown: datetime
    outline: shapely.Geometry
    """In WGS 84, x east, or in local coordinates."""
    local: bool
    crs: str
    area: float
    """m²."""
    warnings: tuple[str, ...]
    files: dict[str, str]
    """Names of the files that the page leads to."""
    key: str
    """What tells this product from others."""
    told: str
    """What tells the seasons that its page shows from others; nothing while it shows none."""
    off: tuple[str, float, float] | None = None
    """Which known rows its rows lie off, and by how many metres to the east and north, where both are told."""


def read_products(folder: Path) -> Iterator[Product]:
    """Products of a survey's parcels, as far as their records can be read."""
    for place in places_of(folder):
        if product := read_product(place):
            yield product


def places_of(folder: Path) -> list[Path]:
    """Folders of the products of a survey's parcels, without those that are gone, as by another name."""
    try:
        record = read_object(paths.survey_record(folder))
        gone = {paths.parcel_folder(folder, str(one["parcel"])) for one in record["parcels"] if one["state"] == GONE}
    except (KeyError, TypeError):
        gone = set()
    try:
        return sorted(path.parent for path in folder.glob(f"*/{paths.RUN}") if path.parent not in gone)
    except OSError:
        return []


def products_of(given: Path) -> list[Path]:
    """The products that a path means: of a folder in which there are some, as of a survey, those; else the path itself.

    Raises
    ------
    InputError
        If there is none in the survey's folder.
    """
    if paths.run_record(given).is_file():
        return [given]
    products = places_of(given)
    if not products and paths.survey_record(given).is_file():
        raise InputError(f"{naming.shown(given)}: no parcel of this survey was mapped: see its {paths.INDEX}")
    return products or [given]


def read_record(product: Path) -> tuple[Path, dict[str, Any]]:
    """Folder of a product, given by its folder or its GeoPackage, and the record of its run.

    Raises
    ------
    InputError
        If it is no whole product.
    """
    folder = product if product.is_dir() else product.parent
    record = read_object(paths.run_record(folder))
    try:
        record["parcel"] = str(record["parcel"])
        origin_of(record["origin"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{naming.shown(product)}: no product of vinemap: give its folder, with {paths.RUN} in it, "
            "or its GeoPackage"
        ) from error
    path = naming.uncut(paths.geopackage(folder, record["parcel"]))
    if product not in (folder, path):
        raise InputError(f"{naming.shown(product)}: no product of vinemap: {naming.shown(path)} is one")
    return folder, record


def whose(place: Path) -> tuple[str, str] | None:
    """Parcel and survey of the product in a folder, as far as its record tells."""
    record = read_object(paths.run_record(place))
    return (str(record["parcel"]), str(record["survey"])) if {"parcel", "survey"} <= record.keys() else None


def read_product(place: Path) -> Product | None:
    """The product in a folder; None if its records can't be read, or tell of no place and time."""
    record = read_object(paths.run_record(place))
    try:
        parcel = str(record["parcel"])
        item = read_object(paths.stac_item(place, parcel))
        local = item["geometry"] is None
        outline = outline_in(place, parcel) if local else shapely.from_geojson(json.dumps(item["geometry"]))
        linked = {
            "report": paths.report(place, parcel),
            "layers": paths.geopackage(place, parcel),
            "project": paths.project(place, parcel),
        }
        product = Product(
            place,
            parcel,
            record["survey"],
            datetime.fromisoformat(record["flown"]),
            shapely.make_valid(outline),
            local,
            str(record["crs"]),
            float(item["properties"].get("vinemap:area_m2", np.nan)),
            tuple(map(str, record["warnings"])),
            {kind: path.name for kind, path in linked.items() if path.name in record["files"]},
            json.dumps(
                [record["key"], {name: n for name, n in record["files"].items() if name != linked["report"].name}]
            ),
            str(record.get("seasons", "")),
            _off(record.get("shift")),
        )
        west, south, east, north = shapely.bounds(outline)  # NaN of an empty one
        placed = local or (-180 <= west <= east <= 180 and -90 <= south <= north <= 90)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, shapely.errors.ShapelyError):
        return None
    return product if product.flown.tzinfo and placed else None


def _off(told: dict[str, Any] | None) -> tuple[str, float, float] | None:
    """What a record tells of the shift of a product's rows, if it does in all directions."""
    if not told or None in (told["east_sd_m"], told["north_sd_m"]):
        return None
    east, north = (float(told[name]) if told["in_rows"] else 0.0 for name in ("east_m", "north_m"))
    return str(told["known_rows"]), east, north


def shift_between(later: Product, earlier: Product) -> tuple[float, float] | None:
    """Metres to the east and north by which a product's rows lie off an earlier one's, if both state the same rows."""
    if not later.off or not earlier.off or (later.off[0], later.crs) != (earlier.off[0], earlier.crs):
        return None
    return later.off[1] - earlier.off[1], later.off[2] - earlier.off[2]


def outline_in(folder: Path, parcel: str) -> shapely.Geometry:
    """The polygon of a product's parcel, in its own CRS; ValueError if it can't be read."""
    try:
        outline: shapely.Geometry = pyogrio.read_dataframe(paths.geopackage(folder, parcel), layer="parcel").union_all()
    except (DataSourceError, DataLayerError) as error:
        raise ValueError(str(error)) from error
    return outline


def find_earlier(products: Mapping[str, Product], folder: Path) -> dict[str, list[Product]]:
    """For each parcel its products of earlier flights, the latest first: one of each survey beside a folder.

    Which of a survey's is the same parcel its place tells, not its name; parcels that have no earlier one aren't there.
    """
    placed = {name: product for name, product in products.items() if not product.local}
    found: dict[str, list[Product]] = {}
    if not placed:
        return found
    latest = max(product.flown for product in placed.values())
    for beside in _surveys_beside(folder.resolve(), latest):
        others = [product for product in read_products(beside) if product.flown < latest and not product.local]
        outlines = np.array([product.outline for product in others], dtype=object)
        tree = shapely.STRtree(outlines)
        for name, product in placed.items():
            near = [k for k in tree.query(product.outline).tolist() if others[k].flown < product.flown]
            shares = {k: _shared(product.outline, outlines[k]) for k in near}
            best = max(near, key=lambda k: (others[k].flown, shares[k]), default=None)
            if best is not None and shares[best] < SHARED:
                best = max(near, key=lambda k: shares[k])
            if best is not None and shares[best] >= SHARED:
                found.setdefault(name, []).append(others[best])
    return {name: sorted(known, key=lambda one: one.flown, reverse=True) for name, known in found.items()}


def same_places(products: Sequence[Product]) -> list[list[int]]:
    """Positions of products that show the same parcel, the latest first; every product is in one of the lists.

    A list has one product of a survey. Of local coordinates nothing tells whether their place is the same.
    """
    outlines = np.array([product.outline for product in products], dtype=object)
    tree = shapely.STRtree(outlines)
    at: dict[int, int] = {}
    places: list[list[int]] = []
    for k in sorted(range(len(products)), key=lambda k: products[k].flown, reverse=True):
        one = products[k]
        near = [] if one.local else [j for j in tree.query(one.outline).tolist() if j in at and not products[j].local]
        shares = {at[j]: _shared(one.outline, outlines[j]) for j in sorted(near, key=lambda j: products[j].flown)}
        open_ = [place for place in shares if all(_survey(products[j]) != _survey(one) for j in places[place])]
        best = max(open_, key=lambda place: shares[place], default=None)
        if best is None or shares[best] < SHARED:
            best = len(places)
            places.append([])
        places[best].append(k)
        at[k] = best
    return places


def _survey(product: Product) -> tuple[str | None, datetime]:
    return product.survey, product.flown


def _surveys_beside(folder: Path, latest: datetime) -> Iterator[Path]:
    """Folders of other surveys beside one that were flown before a time."""
    try:
        places = sorted(folder.parent.iterdir())
    except OSError:
        return
    for place in places:
        try:
            if place == folder or not paths.survey_record(place).is_file():
                continue
            collection = read_object(paths.stac_collection(place))
            if datetime.fromisoformat(collection["extent"]["temporal"]["interval"][0][0]) < latest:
                yield place
        except (OSError, ValueError, KeyError, TypeError, IndexError):
            continue


def _shared(one: shapely.Geometry, other: shapely.Geometry) -> float:
    smaller = min(shapely.area(one), shapely.area(other))
    return float(shapely.area(shapely.intersection(one, other)) / smaller) if smaller > 0 else 0.0


def seen_lengths(rows: gpd.GeoDataFrame) -> pd.Series:
    """Metres of each row that were seen: all where nothing is said of it."""
    unseen = rows["unseen_m"].fillna(0.0) if "unseen_m" in rows else 0.0
    seen: pd.Series = rows["length_m"] - unseen
    return seen


def read_rows(folder: Path, parcel: str) -> gpd.GeoDataFrame | None:
    """Rows of a product, or None if they can't be read."""
    path = paths.geopackage(folder, parcel)
    try:
        rows = pyogrio.read_dataframe(path, layer="rows", columns=[*COLUMNS, "canopy_confidence", "unseen_m"])
        rows = rows.astype(dict.fromkeys(("spacing_m", *MEASURES), float))
        usable = set(COLUMNS) <= set(rows.columns) and rows.crs is not None
        lines = rows[(rows.geom_type == "LineString") & (rows.length > 0)] if usable else None
    except Exception:  # noqa: BLE001 - whatever GDAL makes of a file that isn't ours
        return None
    return lines
