"""Where a flight lies: how far its canopies are off the known rows, and how surely that is told.

Across rows their courses tell it, along them their ends. Canopy may end short of what is known for the row's end, its
post, or beyond it: that is the same at both ends of rows, and is found along with the shift.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import shapely

from vinemap.geo.curve import at, tangents, way_along

if TYPE_CHECKING:
    import geopandas as gpd

    from vinemap.compute.arrays import Flags, Ints, Values

STEP = 2.0
"""Metres between the stations at which a row's course is compared."""
LARGEST, INSET = 5.0, 0.3
"""Metres, standard deviations before anything is measured: of the shift, and of how far canopy ends off known ends."""
USUAL, DOUBT = (0.03, 0.15), 2.0
"""Metres by which courses and ends are usually off, and how many of them that counts for."""
COMMON = 0.01
"""Metres, a standard deviation, by which all canopies of a flight are off their rows: sun and wind have a side."""
TELLS = 0.25
"""Standard deviation, in spacings, beyond which nothing is told."""
ROUNDS = 10
"""Rounds in which what doesn't fit loses its weight: first those of least absolutes, then Tukey's."""
TUKEY, NORMAL = 4.685, 1.4826
"""Deviations at which his weights end, and a normal deviation in median absolute ones."""


class Shift(NamedTuple):
    """How far a flight lies off known rows."""

    metres: Values
    """(2,), to the east and north; none of it in a direction that isn't told."""
    axes: Values
    """Unit vectors (2, 2), a row each: the direction in which it is told best, and the other."""
    deviation: Values
    """(2,), a standard deviation in metres along these; infinite along the second where nothing tells it."""
    rows: int
    """Rows that tell it."""
    ends: int
    """Their ends that do."""

    @property
    def covariance(self) -> Values:
        """(2, 2), m², to the east and north; infinite where it isn't told."""
        with np.errstate(invalid="ignore"):
            parts = self.axes.T[:, None] * self.axes.T[None] * self.deviation**2
        out: Values = np.where(np.isnan(parts), 0.0, parts).sum(axis=2)
        return out

    def record(self) -> dict[str, Any]:
        """For ``run.json``: metres to the east and north and along its axes; None of what isn't told."""

        def told(value: float) -> float | None:
            return round(float(value), 4) if np.isfinite(value) else None

        angles = np.degrees(np.arctan2(self.axes[:, 1], self.axes[:, 0])) % 180
        axes = [
            {"deg": round(float(angle), 2), "m": told(part if np.isfinite(sd) else np.inf), "sd_m": told(sd)}
            for angle, part, sd in zip(angles, self.axes @ self.metres, self.deviation, strict=True)
        ]
        east, north = (round(float(one), 4) for one in self.metres)
        sd = dict(zip(("east_sd_m", "north_sd_m"), map(told, np.sqrt(np.diag(self.covariance))), strict=True))
        return {"east_m": east, "north_m": north, **sd, "axes": axes, "rows": self.rows, "ends": self.ends}


class _Told(NamedTuple):
    """What rows tell: along unit vectors (n, 2) the shift, and so many (n,) times the inset, are together (n,) metres.

    ``of`` (n,) is the course or the end of which it is told, and ``is_end`` (k,) which of both that is.
    """

    way: Values
    inset: Values
    metres: Values
    of: Ints
    is_end: Flags


def measure_shift(lines: gpd.GeoDataFrame, rows: gpd.GeoDataFrame, moves: Flags) -> Shift | None:
    """Measure how far rows lie off the lines that they are known by, in any direction.

    Courses and ends that don't fit lose their weight (Tukey's biweight, Beaton & Tukey 1974). The standard deviation is
    of what the others scatter, and of what is usual, as of a measurement or two; and of what canopies have in common.

    Parameters
    ----------
    lines : GeoDataFrame
        LineString in the rows' CRS, with ``spacing_m``.
    rows : GeoDataFrame
        In the lines' order, fitted to their canopy, with ``support``, ``start_told`` and ``end_told``.
    moves : array (n,)
        Whether canopy tells where a row runs.

    Returns
    -------
    Shift or None
        None where nothing tells it.
    """
    use = np.asarray(moves, dtype=bool) & (rows["support"].to_numpy() > 0)
    flat = (shapely.force_2d(table.geometry.to_numpy()) for table in (lines, rows))
    pairs = zip(*flat, rows["start_told"], rows["end_told"], strict=True)
    told = [_told_by(given, found, ends) for (given, found, *ends), used in zip(pairs, use, strict=True) if used]
    told = [one for one in told if len(one.metres)]
    if not told:
        return None
    first = np.cumsum([0, *(len(one.is_end) for one in told)])
    way, inset, metres, _, is_end = (np.concatenate(part) for part in zip(*told, strict=True))
    of = np.concatenate([one.of + k for one, k in zip(told, first[:-1], strict=True)])
    shift, covariance, trust = _solve(_Told(way, inset, metres, of, is_end))
    variance, axes = np.linalg.eigh(covariance)
    axes, deviation = _turned(axes.T), np.sqrt(variance + COMMON**2)
    known = deviation <= TELLS * float(lines["spacing_m"].median())
    if not known.any():
        return None
    metres = axes.T @ np.where(known, axes @ shift, 0.0)
    counted = trust > 0
    n = int((counted & ~is_end).sum()), int((counted & is_end).sum())
    return Shift(metres, axes, np.where(known, deviation, np.inf), *n)


def _turned(axes: Values) -> Values:
    """Axes (2, 2), each in the sense that is counted from east to west, anticlockwise."""
    backwards = (axes[:, 1] < 0) | ((axes[:, 1] == 0) & (axes[:, 0] < 0))
    out: Values = np.where(backwards[:, None], -axes, axes)
    return out


def _told_by(given: shapely.LineString, found: shapely.LineString, ends: list[bool]) -> _Told:
    """What a row tells that was found for a given line: its course, and those of its two ends that are told."""
    curve = shapely.get_coordinates(given)
    length = float(way_along(curve)[-1])
    n = max(2, round(length / STEP))
    position = (np.arange(n) + 0.5) * length / n
    along, place = tangents(curve, np.array([0.0, *position, length])), at(curve, position)
    there = shapely.line_locate_point(found, shapely.points(place))
    beside = (there > 0) & (there < found.length)
    foot = shapely.get_coordinates(shapely.line_interpolate_point(found, there))
    left = np.column_stack([-along[1:-1, 1], along[1:-1, 0]])
    across = ((foot - place) * left).sum(axis=1)[beside]
    outward = along[[0, -1]] * [[-1], [1]]
    beyond = ((shapely.get_coordinates(found)[[0, -1]] - curve[[0, -1]]) * outward).sum(axis=1)[ends]
    return _Told(
        np.concatenate([left[beside], outward[ends]]),
        np.append(np.zeros(len(across)), np.ones(len(beyond))),
        np.append(across, beyond),
        np.append(np.zeros(len(across), dtype=np.int64), 1 + np.arange(len(beyond))),
        np.arange(1 + len(beyond)) > 0,
    )


def _solve(told: _Told) -> tuple[Values, Values, Values]:
    """The shift (2,), its covariance (2, 2), and the trust (k,), 0 to 1, in each course and end."""
    design = np.column_stack([told.way, told.inset])
    size = np.bincount(told.of, minlength=len(told.is_end))
    usual = np.where(told.is_end, *USUAL[::-1])
    before = np.diag([LARGEST**-2, LARGEST**-2, INSET**-2])
    scale, trust = usual, np.ones(len(usual))
    for k in range(2 * ROUNDS):
        weight = (trust / scale**2 / np.maximum(size, 1))[told.of]
        normal = design.T @ (weight[:, None] * design) + before
        answer = np.linalg.solve(normal, design.T @ (weight * told.metres))
        off = np.bincount(told.of, told.metres - design @ answer, minlength=len(size)) / np.maximum(size, 1)
        if k < ROUNDS:
            trust = np.minimum(1.0, scale / np.maximum(np.abs(off), 1e-6))
            continue
        scale = _scales(off, trust, told.is_end, usual)
        trust = np.clip(1 - (off / scale / TUKEY) ** 2, 0, None) ** 2
    scale = _scales(off, trust, told.is_end, usual)
    weight = (trust / scale**2 / np.maximum(size, 1))[told.of]
    covariance = np.linalg.inv(design.T @ (weight[:, None] * design) + before)
    return answer[:2], covariance[:2, :2], trust


def _scales(off: Values, trust: Values, is_end: Flags, usual: Values) -> Values:
    """Standard deviations (k,) of courses and of ends, by what those are off that are trusted, and by what is usual."""
    out = usual.copy()
    for kind in (is_end, ~is_end):
        if kind.any():
            spread = NORMAL * float(np.median(np.abs(off[kind])))
            n = max(float(trust[kind].sum()) - 1, 0.0)
            out[kind] = np.sqrt((DOUBT * usual[kind] ** 2 + n * spread**2) / (DOUBT + n))
    return out
