"""The page of a survey: its parcels on one map and in one table, and what has changed since the survey before."""

from __future__ import annotations

import hashlib
import json
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from pyproj import CRS

from vinemap import __version__, paths
from vinemap.compute.threads import in_threads
from vinemap.evaluate.changes import GONE, compare_rows, summarise
from vinemap.geo.crs import WGS84, project
from vinemap.product.pages.page import as_json, page, page_hash, polylines, rings
from vinemap.product.seasons.products import find_earlier, read_products, read_rows
from vinemap.product.store import write_whole

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import geopandas as gpd

    from vinemap.product.seasons.products import Product

TOLERANCE = 0.2
"""Metres by which lines on the map may leave rows and outlines."""
DIGITS = {"length_m": 1, "height_m": 3, "width_m": 3, "volume_m3": 2, "gap_m": 2, "n_missing": 0}


def write_index(folder: Path, survey: str) -> bool:
    """Write the page of a survey's products, if there is anything to write that isn't there; tell whether it did.

    The survey before is looked for in the folders beside this one: for each parcel the latest earlier product whose
    outline overlaps its own. What lies there that can't be read is passed over.

    Parameters
    ----------
    folder : Path
        Folder of the products' folders, with the record of the survey.
    survey : str
        Its name.

    Raises
    ------
    OSError
        If it can't be written.
    """
    known = _outcomes(folder)
    products = {product.parcel: product for product in read_products(folder) if product.survey == survey}
    if not products and not known:
        return False
    earlier = {name: before[0] for name, before in find_earlier(products, folder).items()}
    made_of: list[Any] = [
        __version__,
        page_hash("index"),
        survey,
        known,
        *(product.key for product in products.values()),
    ]
    made_of += [[name, product.survey, product.parcel, product.key] for name, product in earlier.items()]
    key = hashlib.sha256(as_json(made_of).encode()).hexdigest()
    target = paths.index(folder)
    if _key_of(target) == key:
        return False
    write_whole(target, survey_page(survey, known, products, earlier, key=key))
    return True


def _outcomes(folder: Path) -> dict[str, dict[str, Any]]:
    """What the last job says became of each parcel."""
    try:
        record = json.loads(paths.survey_record(folder).read_text(encoding="utf-8"))
        return {
            str(one["parcel"]): {"state": str(one["state"]), "reason": str(one["reason"])} for one in record["parcels"]
        }
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _key_of(path: Path) -> str | None:
    try:
        with path.open(encoding="utf-8") as page:
            head = page.read(4096)
    except (OSError, ValueError):
        return None
    return head.partition('<meta name="made-of" content="')[2].partition('"')[0] or None


def survey_page(
    survey: str,
    known: Mapping[str, Mapping[str, Any]],
    products: Mapping[str, Product],
    earlier: Mapping[str, Product],
    *,
    key: str = "",
) -> str:
    """Page of a survey as one HTML file, which leads to its parcels' files by their relative paths.

    Parameters
    ----------
    survey : str
        Its name.
    known : mapping of str to mapping
        ``state`` and ``reason`` of each parcel, as in ``survey.json``.
    products : mapping of str to Product
        By the parcel's name.
    earlier : mapping of str to Product
        What each is compared with.
    key : str
        Stands in the page, to tell what it was made of.
    """
    crs = CRS.from_user_input(next(iter(products.values())).crs) if products else WGS84
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # GDAL's remarks on odd files
        tables = in_threads(lambda product: read_rows(product.folder, product.parcel), products.values())
        rows = dict(zip(products, tables, strict=True))
        pairs = [(rows[name], product) for name, product in earlier.items()]
        compared = dict(zip(earlier, in_threads(lambda pair: _compare(*pair), pairs), strict=True))
    shapes = {
        name: product.outline if product.local else project(product.outline, WGS84, crs)
        for name, product in products.items()
    }
    bounds = shapely.total_bounds(list(shapes.values())) if shapes else np.zeros(4)
    zero = np.floor(bounds[:2])
    parcels = []
    for name in sorted({*known, *products}):
        one: dict[str, Any] = {"parcel": name, "state": "done", "reason": "", **known.get(name, {})}
        if name in products:
            one |= _described(products[name], rows[name], compared.get(name, {}))
            one["outline"] = rings(shapes[name], zero, tolerance=TOLERANCE, digits=1)
        parcels.append(one)

    def drawn(lines: gpd.GeoSeries) -> list[list[list[float]]]:
        return polylines(lines.to_crs(crs), zero, tolerance=TOLERANCE, digits=1)

    details = {
        "lines": {name: drawn(table.geometry) for name, table in rows.items() if table is not None},
        "changes": {
            name: one["rows"] | {"gone": drawn(one["gone"])} for name, one in compared.items() if "rows" in one
        },
    }
    flown = sorted(product.flown for product in products.values())
    data = {
        "vinemap": __version__,
        "survey": survey,
        "flown": [flown[0].isoformat(), flown[-1].isoformat()] if flown else [],
        "parcels": parcels,
        "bounds": [0.0, 0.0, *(bounds[2:] - zero)],
        "crs": crs.to_string(),
        "key": key,
    }
    title = f"{survey} · vine rows"
    return page("index", title, data, packed={"details": as_json(details).encode()}, scripts=[], key=key)


def _compare(rows: gpd.GeoDataFrame | None, before: Product) -> dict[str, Any]:
    """What has changed in a parcel since a product, or why nothing can be said."""
    told: dict[str, Any] = {
        "since": {"survey": before.survey, "parcel": before.parcel, "flown": before.flown.isoformat()}
    }
    earlier = read_rows(before.folder, before.parcel)
    if rows is None or earlier is None:
        return told | {"remark": f"rows of {'this' if rows is None else 'the earlier'} survey can't be read"}
    try:
        changes = compare_rows(rows, earlier)
    except Exception as error:  # noqa: BLE001 - one parcel's odd rows cost no other its place on the page
        return told | {"remark": f"can't be compared ({type(error).__name__})"}
    table = changes.rows
    columns: dict[str, Any] = {name: table[name].tolist() for name in ("state", "label", "earlier", "part_of")}
    for name, digits in DIGITS.items():
        columns |= {part: np.round(table[part], digits).tolist() for part in (name, f"d_{name}")}
    share = table["d_volume_m3"] / (table["volume_m3"] - table["d_volume_m3"])
    columns["d_volume"] = np.round(share, 4).tolist()
    gone = earlier.geometry[earlier["label"].isin(table.loc[table["state"] == GONE, "earlier"])].to_crs(rows.crs)
    return told | {
        "shift": changes.shift,
        "summary": summarise(changes),
        "rows": columns,
        "gone": gone.translate(*changes.shift),
    }


def _described(product: Product, rows: gpd.GeoDataFrame | None, compared: Mapping[str, Any]) -> dict[str, Any]:
    """A parcel's numbers, links and changes."""
    told: dict[str, Any] = {
        "folder": product.folder.name,
        "files": product.files,
        "flown": product.flown.isoformat(),
        "area_m2": product.area,
        "warnings": product.warnings,
        **{name: compared[name] for name in ("since", "shift", "summary", "remark") if name in compared},
    }
    if rows is None:
        return told | {"warnings": [*product.warnings, "its GeoPackage can't be read"]}
    length = rows["length_m"].to_numpy(dtype=float)
    height = rows["height_m"].to_numpy(dtype=float)
    known = np.isfinite(height)
    told |= {name: float(rows[name].sum()) for name in ("length_m", "volume_m3", "gap_m", "n_missing")}
    mean = float(np.average(height[known], weights=length[known])) if known.any() else None
    return told | {"rows": len(rows), "height_m": mean}
