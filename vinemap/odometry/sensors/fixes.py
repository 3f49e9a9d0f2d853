"""Satellite fixes: where a robot is now and then."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from vinemap.errors import InputError
from vinemap.geo.main import Origin, wgs84_to_main
from vinemap.odometry.sensors.files import read_table

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.compute.arrays import Values
    from vinemap.config.drives import Start

PLACES = ("lat", "lon", "accuracy_m")


class Fixes(NamedTuple):
    """Where a robot was: times (n,), places (n, 2) in mm in its frame at the start, sd along each axis (n,)."""

    times: Values
    xy: Values
    sd: Values
    left_out: int = 0
    """Lines of the file that tell no place."""


def read_fixes(path: Path, start: Start) -> Fixes:
    """Read satellite fixes from a CSV.

    Accuracies are horizontal, as receivers state them: the root of the mean square of distances from the true place
    (DRMS), √2 times the standard deviation along an axis where both axes have the same.

    Raises
    ------
    InputError
        If a column is missing, or no line can be used.
    """
    table, times = read_table(path)
    missing = [name for name in PLACES if name not in table]
    if missing:
        raise InputError(f"{path}: has no column {', '.join(missing)}: give time, {', '.join(PLACES)}")
    lat, lon, accuracy = (pd.to_numeric(table[name], errors="coerce").to_numpy(float) for name in PLACES)
    kept = np.isfinite(times) & (np.abs(lat) <= 90) & (np.abs(lon) <= 180) & (accuracy > 0) & np.isfinite(accuracy)
    if not kept.any():
        raise InputError(f"{path}: holds no line with a time, a place and an accuracy: give one at least")
    degrees = np.column_stack([lat, lon, np.zeros(len(lat))])[kept]
    east, north, _ = wgs84_to_main(degrees, Origin(start.lat, start.lon, 0.0)).T
    a = np.radians(start.heading_deg)
    xy = 1000 * np.column_stack([east * np.sin(a) + north * np.cos(a), north * np.sin(a) - east * np.cos(a)])
    return Fixes(times[kept], xy, 1000 * accuracy[kept] / np.sqrt(2), int(len(times) - kept.sum()))
