"""What is wrong with the rows of a map, by the truth of its survey."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import shapely

from vinemap.evaluate.rows import evaluate_rows
from vinemap.geo.raster import Raster, sample

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd
    from numpy.typing import ArrayLike, NDArray

    from vinemap.chain import RowMap
    from vinemap.compute.arrays import Flags, Floats
    from vinemap.simulate.survey import Survey
    from vinemap.surfaces.waves import RowField

NEAR = 0.8
"""Metres within which a gap and a dead vine belong together."""
PLACES = 4000
"""At which the terrain is asked for, those beside the parcels among them."""
LONG = 1.5
"""Metres from which a gap is one of missing vines: shorter ones may part bushes that stand apart."""


class Errors(NamedTuple):
    """What is wrong with one map, or with several."""

    rows: int
    """True rows."""
    found: int
    pairs: pd.DataFrame
    """The pairs of :func:`vinemap.evaluate.rows.evaluate_rows`."""
    terrain: Floats
    """|error| of the DTM (m) at random points of the parcels."""
    direction: Floats
    """|error| of the row direction (degrees) every metre of the true rows."""
    spacing: Floats
    """|error| of the inter-row spacing, as a share of it, every metre of the true rows that have a neighbour."""
    recalled: Flags
    """Whether a dead vine with a dead neighbour lies by a gap."""
    right: Flags
    """Whether a long gap lies by a dead vine."""
    gap_length: Floats
    """|error| of the length (m) of gaps of two vines or more."""


class Worst(NamedTuple):
    """The worst row of a map; ``badness`` is 1 where a bar is just met."""

    badness: float
    line: shapely.LineString
    what: str


def compare(survey: Survey, found: RowMap) -> tuple[Errors, Worst | None]:
    """Hold a map against the truth of its survey; the worst row is None if there is no row at all."""
    evaluation = evaluate_rows(found.rows[["geometry"]], survey.rows[["geometry"]])
    truth = shapely.force_2d(survey.rows.geometry.to_numpy())
    lines = shapely.force_2d(found.rows.geometry.to_numpy())
    direction, spacing = _field_errors(truth, found.field)
    errors = Errors(
        len(truth),
        len(lines),
        evaluation.pairs,
        _terrain_errors(survey, found.dtm),
        direction,
        spacing,
        *_gap_errors(survey, found.gaps),
    )
    pairs = evaluation.pairs.to_dict("records")
    worst = [
        Worst(
            max(p["dep_m"] / 0.2, p["dek_m"] / 0.03, p["cof_m"] / 0.03),
            truth[p["reference"] - 1],
            f"DEP {p['dep_m']:.3f}, DEK {p['dek_m']:.3f}, COF {p['cof_m']:.3f} m",
        )
        for p in pairs
    ]
    # A row that is wrong altogether is worse than any that isn't, the longest first.
    for rows, ids, what in ((truth, evaluation.missed_rows, "missed"), (lines, evaluation.extra_rows, "extra")):
        worst += [Worst(1000 + rows[int(str(i)) - 1].length, rows[int(str(i)) - 1], f"{what} row") for i in ids]
    return errors, max(worst, key=lambda row: row.badness, default=None)


def pool(errors: Sequence[Errors]) -> Errors:
    """Errors of several maps as those of one."""
    rows, found, pairs, *arrays = zip(*errors, strict=True)
    return Errors(sum(rows), sum(found), pd.concat(pairs), *(np.concatenate(values) for values in arrays))


def _terrain_errors(survey: Survey, dtm: Raster) -> Floats:
    """Errors (n,) of the terrain's elevation, m, at random places in the parcels."""
    inside = shapely.union_all(survey.parcels.geometry.to_numpy())
    west, south, east, north = inside.bounds
    x, y = np.random.default_rng(0).uniform([west, south], [east, north], (PLACES, 2)).T
    x, y = np.array([x, y])[:, shapely.contains_xy(inside, x, y)]
    return np.abs(sample(dtm, np.column_stack([x, y])) - survey.terrain(x, y))


def _field_errors(rows: NDArray[np.object_], field: RowField) -> tuple[Floats, Floats]:
    """Errors of direction (degrees) and spacing (shares) every metre of rows; where the field is unknown, the worst."""
    along = [np.arange(0.5, row.length, 1.0) for row in rows]
    row = np.repeat(np.arange(len(rows)), [len(a) for a in along])
    at = np.concatenate([*along, np.empty(0)])
    xy, back, ahead = (
        shapely.get_coordinates(shapely.line_interpolate_point(rows[row], np.maximum(at + step, 0)))
        for step in (0, -0.3, 0.3)
    )
    if len(xy) == 0:
        return np.empty(0), np.empty(0)
    way = ahead - back
    told, told_spacing, _ = field.at(xy)
    turn = told - np.degrees(np.arctan2(way[:, 1], way[:, 0]))
    direction = np.abs((turn + 90) % 180 - 90)
    wanted = _true_spacing(rows, row, xy, way / np.hypot(*way.T)[:, None])
    spacing = np.abs(told_spacing / wanted - 1)
    return np.nan_to_num(direction, nan=90.0), np.nan_to_num(spacing, nan=1.0)[np.isfinite(wanted)]


def _true_spacing(rows: NDArray[np.object_], row: NDArray[np.intp], xy: Floats, way: Floats) -> Floats:
    """Distance (m) across the rows to the neighbours, the mean of both sides; NaN where there is none."""
    normal = np.column_stack([-way[:, 1], way[:, 0]])
    others = np.array([shapely.MultiLineString(list(np.delete(rows, i))) for i in range(len(rows))], dtype=object)
    sides = []
    for side in (1, -1):
        rays = shapely.linestrings(np.stack([xy, xy + 6 * side * normal], axis=1))
        sides.append(shapely.distance(shapely.points(xy), shapely.intersection(rays, others[row])))
    distance = np.array(sides)
    # Past the end of its neighbour a row looks at the one beyond.
    usual = quantile(distance[np.isfinite(distance)], 0.5)
    known = distance < 1.5 * usual
    total = np.where(known, distance, 0).sum(axis=0)
    out: Floats = np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
    return out


def _gap_errors(survey: Survey, gaps: gpd.GeoDataFrame) -> tuple[Flags, Flags, Floats]:
    """Recall of dead vines in runs, precision of long gaps, errors of the runs' lengths (m)."""
    dead = survey.dead_vines
    runs = ((dead["vine"].diff() != 1) | (dead["row"].diff() != 0)).cumsum()
    spots = shapely.force_2d(dead.geometry[runs.map(runs.value_counts()) >= 2].to_numpy())
    pieces = shapely.force_2d(gaps.geometry.to_numpy())
    recalled = shapely.distance(spots, shapely.union_all(pieces)) < NEAR
    long = pieces[shapely.length(pieces) >= LONG]
    right = shapely.distance(long, shapely.union_all(shapely.force_2d(dead.geometry.to_numpy()))) < NEAR
    errors = []
    for true in shapely.force_2d(survey.gaps.geometry[survey.gaps["n_vines"] >= 2].to_numpy()):
        by = pieces[shapely.dwithin(pieces, true, NEAR / 2)]
        if len(by):
            errors.append(abs(shapely.length(by).max() - true.length))
    return recalled, right, np.array(errors)


def mean(values: ArrayLike) -> float:
    """Mean, NaN of nothing."""
    return float(np.mean(np.asarray(values, dtype=float))) if np.size(values) else np.nan


def quantile(values: ArrayLike, order: float) -> float:
    """Quantile, NaN of nothing."""
    return float(np.quantile(np.asarray(values, dtype=float), order)) if np.size(values) else np.nan
