"""What a survey's page tells of a parcel's rows: where they are, what has changed, and their numbers on all dates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from vinemap.compute.threads import in_threads
from vinemap.errors import own_fault
from vinemap.evaluate.changes import GONE, compare_rows, summarise
from vinemap.geo.crs import WGS84, project
from vinemap.product.pages.page import mean_of, polylines
from vinemap.product.seasons.history import history
from vinemap.product.seasons.products import read_rows, seen_lengths, shift_between

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd
    from pyproj import CRS

    from vinemap.product.seasons.products import Product

TOLERANCE = 0.2
"""Metres by which lines on the map may leave rows and outlines."""
DIGITS = {"length_m": 1, "height_m": 3, "width_m": 3, "volume_m3": 2, "gap_m": 2, "n_missing": 0}


def outline_of(product: Product, crs: CRS) -> shapely.Geometry:
    """A parcel's outline in the CRS of a page; local coordinates as they are."""
    return product.outline if product.local else project(product.outline, WGS84, crs)


def tell_parcel(product: Product, earlier: Sequence[Product], crs: CRS) -> dict[str, Any]:
    """What is told of a parcel: ``lines`` of its rows about ``zero``, ``told`` (numbers), and ``remarks``.

    With earlier products also ``changes`` since the latest of them and the ``history`` of all, as far as can be told.

    Parameters
    ----------
    product : Product
        The parcel's.
    earlier : sequence of Product
        Those of earlier flights, the latest first.
    crs : CRS
        That of the page.
    """
    rows, *before = in_threads(lambda one: read_rows(one.folder, one.parcel), (product, *earlier))
    zero = np.floor(np.nan_to_num(shapely.bounds(outline_of(product, crs))[:2]))

    def drawn(lines: gpd.GeoSeries) -> list[list[list[float]]]:
        return polylines(lines.to_crs(crs), zero, tolerance=TOLERANCE, digits=1)

    compared = _compare(rows, before[0], product, earlier[0]) if earlier else {}
    found: dict[str, Any] = {
        "zero": zero,
        "told": _numbers(rows)
        | {one: compared[one] for one in ("since", "shift", "summary", "remark") if one in compared},
        "remarks": [] if rows is not None else ["its GeoPackage can't be read"],
        "lines": [] if rows is None else drawn(rows.geometry),
    }
    unread = [one.survey or one.parcel for one, table in zip(earlier[1:], before[1:], strict=True) if table is None]
    found["remarks"] += [f"its rows of {survey} can't be read" for survey in unread]
    if "rows" in compared:
        found["changes"] = compared["rows"] | {"gone": drawn(compared["gone"])}
    flights = [
        (one, table) for one, table in zip((product, *earlier), (rows, *before), strict=True) if table is not None
    ]
    if rows is not None and len(flights) > 1:
        try:
            found["history"] = history(flights, latest=compared.get("all"))
        except Exception as error:  # noqa: BLE001 - one parcel's odd rows cost no other its place on the page
            found["told"].setdefault("remark", f"can't be followed: {own_fault(error)}")
    return found


def _numbers(rows: gpd.GeoDataFrame | None) -> dict[str, Any]:
    """A parcel's numbers."""
    if rows is None:
        return {}
    length = rows["length_m"].to_numpy(dtype=float)
    told: dict[str, Any] = {name: float(rows[name].sum()) for name in ("length_m", "volume_m3", "gap_m", "n_missing")}
    told["seen_m"] = float(seen_lengths(rows).sum())
    return told | {"rows": len(rows), "height_m": mean_of(rows["height_m"], length)}


def _compare(
    rows: gpd.GeoDataFrame | None, earlier: gpd.GeoDataFrame | None, product: Product, before: Product
) -> dict[str, Any]:
    """What has changed in a parcel since a product, or why nothing can be said."""
    told: dict[str, Any] = {
        "since": {"survey": before.survey, "parcel": before.parcel, "flown": before.flown.isoformat()}
    }
    if rows is None or earlier is None:
        return told | {"remark": f"rows of {'this' if rows is None else 'the earlier'} survey can't be read"}
    try:
        changes = compare_rows(rows, earlier, shift=shift_between(product, before))
    except Exception as error:  # noqa: BLE001 - one parcel's odd rows cost no other its place on the page
        return told | {"remark": f"can't be compared: {own_fault(error)}"}
    table = changes.rows
    columns: dict[str, Any] = {name: table[name].tolist() for name in ("state", "label", "earlier", "part_of")}
    for name, digits in DIGITS.items():
        columns |= {part: np.round(table[part], digits).tolist() for part in (name, f"d_{name}")}
    share = table["d_volume_m3"] / (table["volume_m3"] - table["d_volume_m3"])
    columns["d_volume"] = np.round(share, 4).tolist()
    gone = earlier.geometry.iloc[table.loc[table["state"] == GONE, "earlier_place"]].to_crs(rows.crs)
    return told | {
        "shift": changes.shift,
        "summary": summarise(changes),
        "rows": columns,
        "gone": gone.translate(*changes.shift),
        "all": changes,
    }
