"""What other sensors of a robot know: wheel speeds and yaw rates between frames, satellite fixes now and then.

Fixes pull the whole track by least squares, a pose graph solved by Gauss–Newton with sparse factors: G. Grisetti and
others, A tutorial on graph-based SLAM, IEEE Intelligent Transportation Systems Magazine 2, 2010.
"""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

from vinemap.errors import InputError
from vinemap.geo.main import Origin, wgs84_to_main
from vinemap.odometry.poses import Pose, moved

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from scipy.sparse import csc_matrix

    from vinemap.compute.arrays import Values
    from vinemap.config.drives import Start
    from vinemap.odometry.track import Fix

SPEEDS = {"speed_m_s": 1000.0, "speed_mm_s": 1.0, "speed_km_h": 1000 / 3.6}
"""Columns of speeds, and what makes mm/s of them."""
YAW_RATES = {"yaw_rate_deg_s": 1.0, "yaw_rate_rad_s": float(np.degrees(1))}
"""Columns of yaw rates, anticlockwise, and what makes °/s of them."""
PLACES = ("lat", "lon", "accuracy_m")
FASTEST, QUICKEST = 15_000.0, 360.0
"""mm/s and °/s beyond which no robot of a vineyard moves."""
LONGEST_GAP = 1.0
"""Seconds between two samples beyond which nothing is known."""
SPEED_SHARE, SLIP_MM = 0.02, 1.0
"""Standard deviation of a way by wheels: a share of it, and millimetres."""
RATE_SHARE, RATE_DEG, UNKNOWN_TURN_DEG = 0.02, 0.1, 3.0
"""Standard deviation of a turn by yaw rates: a share of it, and degrees; and of a turn that nothing tells."""
FIRST_MM, FIRST_SECONDS = 300.0, 2.0
"""Way and time for which wheels are believed as they are."""
START_MM, START_DEG = 1000.0, 10.0
"""Standard deviations of a start where fixes know better."""
FAR = 4.0
"""Standard deviations from the track from which on a fix is left out."""
BLOCK = 300
"""Columns of the inverse that are solved for at once."""


class Wheels(NamedTuple):
    """Speeds and yaw rates (n,) in mm/s and °/s at times in seconds; NaN where a file has none."""

    times: Values
    speeds: Values
    rates: Values

    def between(self, start: float | None, end: float | None, usual: Pose) -> tuple[Pose, Values] | None:
        """Movement and its covariance (3, 3) from a time to another, what isn't measured as usual; none of a gap."""
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
        if np.isnan(ways).any():
            ways = steps * usual.x_mm / (end - start)
        headings = np.radians(np.cumsum(turns) - turns / 2)
        turn, way = float(turns.sum()), float(np.abs(ways).sum())
        sd = np.hypot(SPEED_SHARE * way, SLIP_MM)
        turn_sd = np.hypot(RATE_SHARE * turn, RATE_DEG) if turned else UNKNOWN_TURN_DEG
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
        found = self.wheels.between(start, end, seen)
        if found is None or start is None or end is None:
            return
        self._seen += abs(seen.x_mm)
        self._driven += abs(found[0].x_mm)
        self._off += seen.heading_deg - found[0].heading_deg
        self._seconds += end - start


class Places(NamedTuple):
    """Where a robot's centre was at times, in mm in its frame at the start, (n, 2), and standard deviations (n,)."""

    times: Values
    xy: Values
    sd: Values


def read_wheels(path: Path) -> tuple[Wheels, int]:
    """Read wheel speeds and yaw rates from a CSV, and tell how many lines were left out.

    Raises
    ------
    InputError
        If it has no times, or neither speeds nor yaw rates of a known unit, or they are of no robot.
    """
    table, times = _read(path)
    speeds, rates = (_column(table, names) for names in (SPEEDS, YAW_RATES))
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
    kept &= _goes_on(times, kept)
    if kept.sum() < 2:
        raise InputError(f"{path}: holds fewer than two lines with a time and a number: give more")
    return Wheels(times[kept], *(values[kept] for values in found)), int(len(times) - kept.sum())


def read_places(path: Path, start: Start) -> tuple[Places, int]:
    """Read satellite fixes from a CSV, and tell how many lines were left out.

    Raises
    ------
    InputError
        If a column is missing, or no line can be used.
    """
    table, times = _read(path)
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
    return Places(times[kept], xy, 1000 * accuracy[kept]), int(len(times) - kept.sum())


def check_times(path: Path, times: Values, fixes: Sequence[Fix]) -> None:
    """Raise InputError if a file has nothing of the time of a recording."""
    known = [fix.time for fix in fixes if fix.time is not None]
    if len(known) < 2:
        raise InputError(f"{path}: can't be used, as the frames have no times: name images by them")
    if times.max() < min(known) or times.min() > max(known):
        raise InputError(f"{path}: its times lie beside those of the frames: is it of another day or in another clock?")


def pulled(fixes: Sequence[Fix], places: Places) -> tuple[list[Fix], int]:
    """A track with the poses and covariances that fit steps and places best, and how many places were left out.

    Places that lie far from where all others put the robot don't count, nor those beside the recording.
    """
    poses = np.array([fix.pose for fix in fixes])
    poses[:, 2] = np.radians(poses[:, 2])
    at, weight, used = _frames_at(places, fixes)
    unit = np.array([1, 1, np.radians(1)])
    start = np.arange(len(fixes)) - 1
    ends = [(start[k] if fix.measured_from is None else fix.measured_from, k) for k, fix in enumerate(fixes)][1:]
    links = np.array(ends, int).reshape(-1, 2)
    steps = [fixes[j].motion.movement if fixes[j].motion else moved(fixes[i].pose, fixes[j].pose) for i, j in links]
    sure = [np.linalg.cholesky(np.linalg.inv(unit[:, None] * fixes[j].of_step * unit)).T for _, j in links]
    graph = _Graph(links, np.array(steps).reshape(-1, 3) * unit, np.array(sure).reshape(-1, 3, 3), at, weight)
    way = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    kept = used & (np.hypot(*places.xy.T) < 2 * way + FAR * (START_MM + places.sd))
    at_first = poses
    for _ in range(int(used.sum()) + 1):
        poses, factors = _solved(at_first, graph, places, kept)
        off = np.hypot(*(_place_at(poses, at, weight) - places.xy).T) / places.sd
        worst = int(np.argmax(np.where(kept, off, 0)))
        if not kept[worst] or off[worst] <= FAR or kept.sum() <= 1:
            break
        kept[worst] = False
    covariances = factors.blocks() / unit[:, None] / unit
    poses[:, 2] = np.degrees(poses[:, 2])
    out = [
        fix._replace(pose=Pose(*map(float, pose)), covariance=covariance)
        for fix, pose, covariance in zip(fixes, poses, covariances, strict=True)
    ]
    return out, int(len(kept) - kept.sum())


class _Graph(NamedTuple):
    """Steps (n, 3) from poses to others (n, 2), square roots of their information; frames at places, and shares."""

    links: Values
    steps: Values
    sure: Values
    frames: Values
    weight: Values


def _frames_at(places: Places, fixes: Sequence[Fix]) -> tuple[Values, Values, Values]:
    """The frame before each place in time, how far it is on to the next, and whether there are both."""
    told = np.array([k for k, fix in enumerate(fixes) if fix.time is not None])
    times = np.maximum.accumulate([fixes[k].time for k in told])
    after = np.clip(np.searchsorted(times, places.times, "right"), 1, len(times) - 1)
    share = (places.times - times[after - 1]) / np.maximum(times[after] - times[after - 1], 1e-9)
    period = float(np.median(np.diff(times))) or 1.0
    near = (places.times >= times[0] - period) & (places.times <= times[-1] + period)
    return np.column_stack([told[after - 1], told[after]]), np.clip(share, 0, 1), near


def _place_at(poses: Values, at: Values, weight: Values) -> Values:
    return poses[at[:, 0], :2] * (1 - weight[:, None]) + poses[at[:, 1], :2] * weight[:, None]


def _solved(poses: Values, graph: _Graph, places: Places, kept: Values) -> tuple[Values, _Factors]:
    """Poses by Gauss–Newton, and the factors there."""
    poses = poses.copy()
    first = poses[0].copy()
    prior = np.array([1 / START_MM, 1 / START_MM, 1 / np.radians(START_DEG)])
    i, j = graph.links.T
    for _ in range(10):
        c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        d = poses[j] - poses[i]
        ahead, left = d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s
        off = np.column_stack([ahead, left, d[:, 2]]) - graph.steps
        of_j, of_i = np.zeros((2, len(i), 3, 3))
        of_j[:, 0, 0], of_j[:, 0, 1], of_j[:, 1, 0], of_j[:, 1, 1], of_j[:, 2, 2] = c, s, -s, c, 1
        of_i[:] = -of_j
        of_i[:, 0, 2], of_i[:, 1, 2] = left, -ahead
        n = len(i)
        rows = np.repeat(np.arange(3 * n).reshape(n, 3), 3, axis=1).reshape(-1)
        entries = [
            (rows, np.tile(3 * ends[:, None] + np.arange(3), 3).reshape(-1), (graph.sure @ part).reshape(-1))
            for ends, part in ((i, of_i), (j, of_j))
        ]
        entries.append((3 * n + np.arange(3), np.arange(3), prior))
        at, weight = graph.frames[kept], graph.weight[kept]
        under = 3 * n + 3 + np.arange(2 * len(at))
        entries += [
            (under, (3 * at[:, [end]] + np.arange(2)).reshape(-1), np.repeat(part / places.sd[kept], 2))
            for end, part in ((0, 1 - weight), (1, weight))
        ]
        row, column, value = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        slopes = coo_matrix((value, (row, column)), shape=(3 * n + 3 + 2 * len(at), poses.size)).tocsc()
        misses = (_place_at(poses, at, weight) - places.xy[kept]) / places.sd[kept, None]
        residuals = [
            np.einsum("nij,nj->ni", graph.sure, off).reshape(-1),
            prior * (poses[0] - first),
            misses.reshape(-1),
        ]
        factors = _Factors((slopes.T @ slopes).tocsc())
        step = factors.solve((slopes.T @ np.concatenate(residuals))[:, None])
        poses -= step.reshape(-1, 3)
        if np.abs(step).max() < 1e-6:
            break
    return poses, factors


class _Factors:
    """Factors of a normal matrix, its unknowns scaled alike."""

    def __init__(self, normal: csc_matrix) -> None:
        self.scale = 1 / np.sqrt(normal.diagonal())
        self.factors = splu((diags(self.scale) @ normal @ diags(self.scale)).tocsc())

    def solve(self, right: Values) -> Values:
        """Unknowns (n, m) of right sides (n, m)."""
        return np.asarray(self.scale[:, None] * self.factors.solve(self.scale[:, None] * right))

    def blocks(self) -> Values:
        """The (3, 3) on the diagonal of the inverse, for each pose."""
        size = len(self.scale)
        out = []
        for begin in range(0, size, BLOCK):
            width = min(BLOCK, size - begin)
            columns = np.zeros((size, width))
            columns[begin + np.arange(width), np.arange(width)] = 1
            part = self.solve(columns)[begin : begin + width].reshape(width // 3, 3, width // 3, 3)
            out.append(np.einsum("kikj->kij", part))
        return np.concatenate(out)


def _read(path: Path) -> tuple[pd.DataFrame, Values]:
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


def _column(table: pd.DataFrame, names: Mapping[str, float]) -> Values | None:
    name = next((name for name in names if name in table), None)
    return None if name is None else pd.to_numeric(table[name], errors="coerce").to_numpy(float) * names[name]


def _goes_on(times: Values, kept: Values) -> Values:
    """Whether each time is later than all that are kept before it."""
    before = np.concatenate([[-np.inf], np.maximum.accumulate(np.where(kept, times, -np.inf))[:-1]])
    return np.asarray(times > before)
