"""Wheel speeds and yaw rates: how a robot moves between frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.errors import InputError
from vinemap.odometry.poses import Pose
from vinemap.odometry.sensors.files import column, go_on, read_table
from vinemap.odometry.track import UNSURE_DEG, UNSURE_MM, UNSURE_SHARE

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.compute.arrays import Values

SPEEDS = {"speed_m_s": 1000.0, "speed_mm_s": 1.0, "speed_km_h": 1000 / 3.6}
"""Columns of speeds, and what makes mm/s of them."""
YAW_RATES = {"yaw_rate_deg_s": 1.0, "yaw_rate_rad_s": float(np.degrees(1))}
"""Columns of yaw rates, anticlockwise, and what makes °/s of them."""
FASTEST, QUICKEST = 15_000.0, 360.0
"""mm/s and °/s beyond which no robot of a vineyard moves."""
LONGEST_GAP = 1.0
"""Seconds between two samples beyond which nothing is known."""
SPEED_SHARE, SLIP_MM = 0.02, 1.0
"""Standard deviation of a way by wheels: a share of it, and millimetres."""
RATE_SHARE, RATE_DEG = 0.02, 0.1
"""Standard deviation of a turn by yaw rates: a share of it, and degrees."""
UNTOLD = Pose(np.nan, np.nan, np.nan)
"""What wheels are to tell themselves."""
FIRST_MM, FIRST_SECONDS = 300.0, 2.0
"""Way and time for which wheels are believed as they are."""


class Wheels(NamedTuple):
    """Speeds and yaw rates (n,) in mm/s and °/s at times in seconds; NaN where a file has none."""

    times: Values
    speeds: Values
    rates: Values
    left_out: int = 0
    """Lines of the file that tell nothing, or what can't be."""

    def between(self, start: float | None, end: float | None, usual: Pose) -> tuple[Pose, Values] | None:
        """Movement and covariance (3, 3) from a time to another, a guess as usual where untold; none of a gap.

        Of :data:`UNTOLD` as usual, NaN says what they don't tell.
        """
        if start is None or end is None or not self.times[0] <= start < end <= self.times[-1]:
            return None
        first, last = np.searchsorted(self.times, start, "right"), np.searchsorted(self.times, end, "left")
        if np.diff(self.times[first - 1 : last + 1]).max() > LONGEST_GAP:
            return None
        times = np.concatenate([[start], self.times[first:last], [end]])
        steps, middles = np.diff(times), (times[1:] + times[:-1]) / 2
        rates = np.interp(middles, self.times, self.rates)
        turned = not np.isnan(rates).any()
        turns = steps * rates if turned else steps * usual.heading_deg / (end - start)
        ways = steps * np.interp(middles, self.times, self.speeds)
        driven = not np.isnan(ways).any()
        if not driven:
            ways = steps * usual.x_mm / (end - start)
        headings = np.radians(np.nan_to_num(np.cumsum(turns) - turns / 2))
        turn, way = float(turns.sum()), float(np.abs(ways).sum())
        sd = np.hypot(SPEED_SHARE * way, SLIP_MM) if driven else UNSURE_MM + UNSURE_SHARE * way
        turn_sd = np.hypot(RATE_SHARE * turn, RATE_DEG) if turned else UNSURE_DEG
        movement = Pose(float(ways @ np.cos(headings)), float(ways @ np.sin(headings)), turn)
        return movement, np.diag([sd**2, sd**2, turn_sd**2])


class Odometer:
    """Wheels that are held against frames where both know: a scale of their speeds and a drift of their yaw rates."""

    def __init__(self, wheels: Wheels) -> None:
        self.wheels = wheels
        self._seen = self._driven = FIRST_MM
        self._off, self._seconds = 0.0, FIRST_SECONDS

    def between(self, start: float | None, end: float | None, usual: Pose) -> tuple[Pose, Values] | None:
        """As :meth:`Wheels.between`, put right by what was seen so far."""
        found = self.wheels.between(start, end, usual)
        if found is None or start is None or end is None:
            return None
        movement, covariance = found
        scale, drift = self._seen / self._driven, self._off / self._seconds
        turn = movement.heading_deg + drift * (end - start)
        return Pose(movement.x_mm * scale, movement.y_mm * scale, turn), covariance

    def learn(self, start: float | None, end: float | None, seen: Pose) -> None:
        """Take a movement that frames tell into account."""
        found = self.wheels.between(start, end, UNTOLD)
        if found is None or start is None or end is None:
            return
        way, _, turn = found[0]
        if not np.isnan(way):
            self._seen += abs(seen.x_mm)
            self._driven += abs(way)
        if not np.isnan(turn):
            self._off += seen.heading_deg - turn
            self._seconds += end - start


def read_wheels(path: Path) -> Wheels:
    """Read wheel speeds and yaw rates from a CSV.

    Raises
    ------
    InputError
        If it has no times, or neither speeds nor yaw rates of a known unit, or they are of no robot.
    """
    table, times = read_table(path)
    speeds, rates = (column(table, names) for names in (SPEEDS, YAW_RATES))
    if speeds is None and rates is None:
        raise InputError(
            f"{path}: has neither speeds nor yaw rates: name a column {' or '.join([*SPEEDS, *YAW_RATES])}"
        )
    none = np.full(len(times), np.nan)
    found = [none if values is None else values for values in (speeds, rates)]
    kept = np.isfinite(times) & ~np.all(np.isnan(found), axis=0)
    for values, most, what in zip(found, (FASTEST, QUICKEST), ("speeds", "yaw rates"), strict=True):
        typical = np.nanmedian(np.abs(values)) if np.isfinite(values).any() else 0.0
        if typical > most:
            raise InputError(
                f"{path}: {what} are such as no robot has: is the unit the one that the column's name says?"
            )
        kept &= ~(np.abs(values) > most)
    kept &= go_on(times, kept)
    if kept.sum() < 2:
        raise InputError(f"{path}: holds fewer than two lines with a time and a number: give more")
    speeds, rates = (values[kept] for values in found)
    return Wheels(times[kept], speeds, rates, int(len(times) - kept.sum()))
