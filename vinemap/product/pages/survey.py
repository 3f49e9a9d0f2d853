"""The page of a survey: its parcels on one map and in one table, and what has changed since those before."""

from __future__ import annotations

import hashlib
import warnings
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from pyproj import CRS

from vinemap import __version__, paths
from vinemap.compute.threads import in_threads
from vinemap.errors import VinemapError
from vinemap.geo.crs import WGS84
from vinemap.product.json_values import read_object
from vinemap.product.pages.changes import TOLERANCE, outline_of, tell_parcel
from vinemap.product.pages.page import as_json, page, page_hash, rings, unpacked
from vinemap.product.pages.parcel import tell_seasons
from vinemap.product.seasons.products import find_earlier, read_products
from vinemap.product.store import write_whole

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from vinemap.product.seasons.products import Product


def write_index(folder: Path, survey: str) -> bool:
    """Write the page of a survey's products, if there is anything to write that isn't there; tell whether it did.

    Earlier surveys are looked for in the folders beside this one: for each parcel the products of earlier flights whose
    outlines overlap its own. What lies there that can't be read is passed over. Layers are read only of parcels of
    which something is new: what the page that is there tells of the others is kept. The parcels' own pages show their
    earlier flights, too.

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
    earlier = find_earlier(products, folder)
    crs = _crs(products)
    keys = {name: _key(product, earlier.get(name, []), crs) for name, product in products.items()}
    about = {name: [product.folder.name, product.warnings, product.files] for name, product in products.items()}
    key = _hash([__version__, survey, known, keys, about])
    target = paths.index(folder)
    fresh = _key_of(target) == key
    wanted = {name: keys[name] if name in earlier else "" for name in products}
    untold = [name for name, one in products.items() if "report" in one.files and one.told != wanted[name]]
    if fresh and not untold:
        return False
    told = _kept(_text_of(target), keys)
    new = [name for name in products if name not in told]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # GDAL's remarks on odd files
        read = in_threads(lambda name: tell_parcel(products[name], earlier.get(name, []), crs), new)
    told |= {name: {"key": keys[name]} | one for name, one in zip(new, read, strict=True)}
    if not fresh:
        write_whole(target, survey_page(survey, known, products, told, key=key))

    def tell(name: str) -> None:
        # It is no more, isn't ours to change, or another run is at work on it: then it is told another night.
        with suppress(VinemapError, OSError, ValueError, KeyError, TypeError):
            tell_seasons(products[name], told[name].get("history"), wanted[name])

    in_threads(tell, untold)
    return not fresh


def _crs(products: Mapping[str, Product]) -> CRS:
    return CRS.from_user_input(next(iter(products.values())).crs) if products else WGS84


def _key(product: Product, earlier: Sequence[Product], crs: CRS) -> str:
    """What tells all that is said of a parcel's rows from what was said before."""
    seen = [[one.survey, one.parcel, one.flown.isoformat(), one.key] for one in (product, *earlier)]
    return _hash([__version__, page_hash("index"), crs.to_string(), seen])


def _hash(made_of: Any) -> str:
    return hashlib.sha256(as_json(made_of).encode()).hexdigest()


def _kept(page: str, keys: Mapping[str, str]) -> dict[str, Any]:
    """What an earlier page tells of parcels of which nothing is new, and all could be read."""
    found = unpacked(page, "details")
    known = found.items() if isinstance(found, dict) else ()
    same = {name: one for name, one in known if isinstance(one, dict) and name in keys and one.get("key") == keys[name]}
    return {name: one for name, one in same.items() if not (one["remarks"] or "remark" in one["told"])}


def _outcomes(folder: Path) -> dict[str, dict[str, Any]]:
    """What the last job says became of each parcel."""
    try:
        parcels = read_object(paths.survey_record(folder))["parcels"]
        return {str(one["parcel"]): {"state": str(one["state"]), "reason": str(one["reason"])} for one in parcels}
    except (KeyError, TypeError):
        return {}


def _text_of(page: Path, most: int = -1) -> str:
    """A page, or so many of its first characters; nothing if it can't be read."""
    try:
        with page.open(encoding="utf-8") as stream:
            return stream.read(most)
    except (OSError, ValueError):
        return ""


def _key_of(page: Path) -> str | None:
    return _text_of(page, 4096).partition('<meta name="made-of" content="')[2].partition('"')[0] or None


def survey_page(
    survey: str,
    known: Mapping[str, Mapping[str, Any]],
    products: Mapping[str, Product],
    told: Mapping[str, Mapping[str, Any]],
    *,
    key: str,
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
    told : mapping of str to mapping
        What :func:`vinemap.product.pages.changes.tell_parcel` tells of each.
    key : str
        Stands in the page, to tell what it was made of.
    """
    crs = _crs(products)
    shapes = {name: outline_of(product, crs) for name, product in products.items()}
    bounds = shapely.total_bounds(list(shapes.values())) if shapes else np.zeros(4)
    zero = np.floor(bounds[:2])
    parcels = []
    for name in sorted({*known, *products}):
        one: dict[str, Any] = {"parcel": name, "state": "done", "reason": "", **known.get(name, {})}
        if name in products:
            one |= _described(products[name]) | dict(told[name]["told"])
            one["warnings"] = [*one["warnings"], *told[name]["remarks"]]
            one["outline"] = rings(shapes[name], zero, tolerance=TOLERANCE, digits=1)
        parcels.append(one)
    flown = sorted(product.flown for product in products.values())
    data = {
        "vinemap": __version__,
        "survey": survey,
        "flown": [flown[0].isoformat(), flown[-1].isoformat()] if flown else [],
        "parcels": parcels,
        "zero": zero,
        "bounds": [0.0, 0.0, *(bounds[2:] - zero)],
        "crs": crs.to_string(),
        "key": key,
    }
    title = f"{survey} · vine rows"
    return page("index", title, data, packed={"details": as_json(told).encode()}, scripts=[], key=key)


def _described(product: Product) -> dict[str, Any]:
    """What a parcel's records tell, and its links."""
    return {
        "folder": product.folder.name,
        "files": product.files,
        "flown": product.flown.isoformat(),
        "area_m2": product.area,
        "warnings": product.warnings,
    }
