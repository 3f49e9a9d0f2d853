"""The rows of a parcel over all dates on which it was flown, as pages plot them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap.evaluate.changes import follow_rows
from vinemap.evaluate.confidence import DOUBTFUL
from vinemap.product.pages.page import whole_numbers
from vinemap.product.seasons.products import seen_lengths, shift_between

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd

    from vinemap.evaluate.changes import Changes
    from vinemap.product.seasons.products import Product

UNITS = {"length_m": 0.1, "seen_m": 0.1, "height_m": 0.01, "width_m": 0.01, "volume_m3": 0.01, "gap_m": 0.1}
"""In how many of its column's units a number is told."""


def history(flights: Sequence[tuple[Product, gpd.GeoDataFrame]], *, latest: Changes | None = None) -> dict[str, Any]:
    """Numbers of rows by date.

    Parameters
    ----------
    flights : sequence of (Product, GeoDataFrame)
        Products of a parcel with their rows, the latest first.
    latest : Changes, optional
        Those between the first two, where they are known.

    Returns
    -------
    dict
        ``dates``, the oldest first, each with its ``survey``, ``parcel`` and ``flown``. For each row, those of the
        latest date in their order and then those that are there no more, a list by date, None where it isn't there:
        ``labels``, what ``units`` has, in these (``seen_m`` is the length that was seen), and ``doubtful``, whether its
        canopy's numbers are.
    """
    tables = [rows for _, rows in flights]
    shifts = [shift_between(flights[0][0], one) for one, _ in flights[1:]]
    numbers = follow_rows(tables, shifts=shifts, latest=latest)
    shape = int(max(found.max(initial=-1) for found in numbers)) + 1, len(flights)
    labels = np.full(shape, None, dtype=object)
    doubtful = np.zeros(shape, dtype=int)
    values = {name: np.full(shape, np.nan) for name in UNITS}
    for k, (table, found) in enumerate(zip(tables, numbers, strict=True)):
        date = shape[1] - 1 - k
        labels[found, date] = table["label"]
        if "canopy_confidence" in table:
            doubtful[found, date] = table["canopy_confidence"].to_numpy(dtype=float) < DOUBTFUL
        shown = table.assign(seen_m=seen_lengths(table))
        for name, column in values.items():
            column[found, date] = shown[name]
    return {
        "dates": [
            {"survey": one.survey, "parcel": one.parcel, "flown": one.flown.isoformat()} for one, _ in flights[::-1]
        ],
        "units": UNITS,
        "labels": labels.tolist(),
        "doubtful": doubtful.tolist(),
        **{name: whole_numbers(column, unit=UNITS[name]) for name, column in values.items()},
    }
