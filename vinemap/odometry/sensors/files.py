"""Tables of sensors: CSV with times."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from vinemap.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from vinemap.compute.arrays import Flags, Values
    from vinemap.odometry.track import TrackPoint


def read_table(path: Path) -> tuple[pd.DataFrame, Values]:
    """The table of a CSV, and its times in seconds since 1970, or as they are."""
    try:
        table = pd.read_csv(path, sep=None, engine="python", encoding="utf-8-sig")
    except (OSError, ValueError, csv.Error, pd.errors.ParserError) as error:
        said = error.strerror if isinstance(error, OSError) else "it is no table"
        raise InputError(f"{path}: can't be read ({said}): give a CSV with a line of names") from error
    table.columns = [str(name).strip().lower() for name in table.columns]
    if "time" not in table:
        raise InputError(f"{path}: has no column time: give seconds since 1970, or dates and times in UTC")
    times = pd.to_numeric(table["time"], errors="coerce").to_numpy(float)
    if np.isnan(times).all():
        dates = pd.to_datetime(table["time"], errors="coerce", utc=True, format="ISO8601")
        times = (dates - pd.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy(float)
    if np.isnan(times).all():
        raise InputError(f"{path}: its times can't be read: give seconds since 1970, or dates and times in UTC")
    return table, times


def column(table: pd.DataFrame, names: Mapping[str, float]) -> Values | None:
    """What the first column of some names holds, times what is given for it."""
    name = next((name for name in names if name in table), None)
    return None if name is None else pd.to_numeric(table[name], errors="coerce").to_numpy(float) * names[name]


def go_on(times: Values, kept: Values) -> Flags:
    """Whether each time is later than all that are kept before it."""
    before = np.concatenate([[-np.inf], np.maximum.accumulate(np.where(kept, times, -np.inf))[:-1]])
    return np.asarray(times > before)


def check_times(path: Path, times: Values, track: Sequence[TrackPoint]) -> None:
    """Raise InputError if a file has nothing of the time of a recording."""
    known = [point.time for point in track if point.time is not None]
    if len(known) < 2:
        raise InputError(f"{path}: can't be used, as the frames have no times: name images by them")
    if times.max() < min(known) or times.min() > max(known):
        raise InputError(f"{path}: its times lie beside those of the frames: is it of another day or in another clock?")
