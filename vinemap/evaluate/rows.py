"""How good the rows of a map are: the six indices of the thesis's Table 2.2.

Detected rows are compared with reference lines, drawn by hand or known, pair by pair. A *pair* is a detected row and
the reference line that it stands for. Everything but DEP is measured in plan.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from shapely.geometry import Point, Polygon
from shapely.ops import substring

from vinemap.errors import InputError
from vinemap.geo.crs import horizontal, metric_crs, vertical_unit
from vinemap.geo.lines import abreast_apart, joined

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pyproj import CRS
    from shapely.geometry import LineString
    from shapely.geometry.base import BaseGeometry

ID_COLUMNS = ("row_id", "row", "id")
DEK_STEP = 0.25
"""Spacing, in metres, of the points of the detected curve at which DEK is taken."""
TANGENT = 1.0
"""Length, in metres, of the reference's last piece that gives its direction at an end."""
ELSEWHERE = 100.0
"""Metres between all lines of two tables beyond which they are no one parcel's."""


class Spread(NamedTuple):
    """Mean and (population) standard deviation over the pairs, in metres; NaN without pairs."""

    mean: float
    std: float


class Evaluation(NamedTuple):
    """Table 2.2 for one map.

    The percentages are of the number of reference lines. Where there is none, good and missed are 0 and extra is 100
    times the number of detected rows.
    """

    pairs: pd.DataFrame
    """A line a pair, in the reference's order: ``reference``, ``row_id``, ``dep_m``, ``dek_m``, ``cof_m``, and the
    errors of the detected ends along the row, ``e1_along_m`` and ``en_along_m``, positive where it runs too far."""
    missed_rows: list[object]
    """Reference lines that no detected row stands for."""
    extra_rows: list[object]
    """Detected rows that stand for no reference line."""
    good: float
    extra: float
    missed: float
    dep: Spread
    """Distance between the ends (index 4)."""
    dek: Spread
    """Distance of the detected curve's points to the reference (index 5)."""
    cof: Spread
    """Area between the curves over the reference's length (index 6)."""


def match_rows(
    result: NDArray[np.object_], reference: NDArray[np.object_], *, overlap: float = 0.8, width: float = 0.6
) -> NDArray[np.intp]:
    """Pair detected rows with reference lines, one to one, so that as much as possible of their length agrees.

    Parameters
    ----------
    result, reference : ndarray of LineString, shape (n,) and (m,)
        Lines of some length in one CRS in metres; their direction doesn't matter.
    overlap : float
        A pair counts where the two run within ``width`` of each other over this share of the longer, or more.
    width : float
        In metres, on either side of a line. It should stay well below half the spacing of the rows.

    Returns
    -------
    ndarray of int, shape (n_pairs, 2)
        Positions in ``result`` and in ``reference``, ascending in the latter.
    """
    from scipy.optimize import linear_sum_assignment  # much to load for runs that hold rows against none

    found, truth = shapely.force_2d(result), shapely.force_2d(reference)
    share = np.zeros((len(truth), len(found)))
    near_found, near_truth = shapely.buffer(found, width), shapely.buffer(truth, width)
    i, j = shapely.STRtree(found).query(near_truth, predicate="intersects")
    # The lesser of the two lengths: a buffer's round end must not make up for a piece that is missing.
    agree = np.minimum(
        shapely.length(shapely.intersection(found[j], near_truth[i])),
        shapely.length(shapely.intersection(truth[i], near_found[j])),
    )
    longer = np.maximum(shapely.length(found[j]), shapely.length(truth[i]))
    share[i, j] = agree / longer
    share[share < overlap] = 0.0
    i, j = linear_sum_assignment(share, maximize=True)
    good = share[i, j] > 0
    return np.column_stack([j[good], i[good]])


def evaluate_rows(
    result: gpd.GeoDataFrame, reference: gpd.GeoDataFrame, *, overlap: float = 0.8, width: float = 0.6
) -> Evaluation:
    """Compare the rows of a map with reference lines (Table 2.2).

    Parameters
    ----------
    result, reference : GeoDataFrame
        A line a row, in any CRS, drawn in either direction, with or without z. A line in parts is one row where they
        follow each other, and several where they lie side by side. Rows are named by a column ``row_id``, ``row`` or
        ``id`` if it is complete and unique, else by their position from 1.
    overlap, width : float
        What counts as a pair, see :func:`match_rows`.

    Returns
    -------
    Evaluation
        DEP is 3D for the pairs in which both lines have z, else 2D. Vertical datums are taken to be the same.

    Raises
    ------
    InputError
        If lines have no CRS, or one that doesn't fit their coordinates, or lie elsewhere than those of the other table.
    """
    result, found_ids = _usable(result, "the result")
    reference, truth_ids = _usable(reference, "the reference")
    crs = next((metric_crs(some.crs, *some.total_bounds[:2]) for some in (result, reference) if len(some)), None)
    found, truth = _metric_lines(result, crs), _metric_lines(reference, crs)
    _check_beside(found, truth)
    j, i = match_rows(found, truth, overlap=overlap, width=width).T
    pairs = pd.DataFrame({"reference": truth_ids[i], "row_id": found_ids[j], **_errors(found[j], truth[i])})
    spreads = (Spread(float(pairs[c].mean()), float(pairs[c].std(ddof=0))) for c in ("dep_m", "dek_m", "cof_m"))
    percent = 100.0 / max(len(truth), 1)
    good, extra, missed = (n * percent for n in (len(pairs), len(found) - len(pairs), len(truth) - len(pairs)))
    missed_rows, extra_rows = np.delete(truth_ids, i).tolist(), np.delete(found_ids, j).tolist()
    return Evaluation(pairs, missed_rows, extra_rows, good, extra, missed, *spreads)


def as_layer(evaluation: Evaluation, result: gpd.GeoDataFrame, reference: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Lines to look at in QGIS: matched and extra rows of the result, and rows of the reference that it misses.

    Returns
    -------
    GeoDataFrame
        LineString or MultiLineString with ``state`` ("matched", "extra" or "missed"), ``row_id``, ``reference`` and
        the indices of matched pairs, as in ``evaluation.pairs``.
    """
    found, drawn = (
        dict(zip(ids, frame.to_crs(result.crs).geometry, strict=True))
        for frame, ids in (_usable(result, "the result"), _usable(reference, "the reference"))
    )
    pairs = evaluation.pairs
    records = [{"state": "matched"} | record for record in pairs.to_dict("records")]
    records += [{"state": "extra", "row_id": row} for row in evaluation.extra_rows]
    records += [{"state": "missed", "reference": row} for row in evaluation.missed_rows]
    lines = [drawn[r["reference"]] if r["state"] == "missed" else found[r["row_id"]] for r in records]
    return gpd.GeoDataFrame(records, columns=["state", *pairs.columns], geometry=lines, crs=result.crs)


def format_table(evaluation: Evaluation) -> str:
    """Lay out an evaluation as plain text: a line a pair, the rows without one, Table 2.2 over all."""
    pairs, missed, extra = evaluation.pairs, evaluation.missed_rows, evaluation.extra_rows
    counts = f"{len(pairs)}, {len(extra)}, {len(missed)}; {len(pairs) + len(missed)} reference rows"
    shares = f"good {evaluation.good:.1f}%, extra {evaluation.extra:.1f}%, missed {evaluation.missed:.1f}%"
    text = [f"{shares} ({counts})"]
    text += [f"{name}: {', '.join(map(str, rows))}" for name, rows in (("extra", extra), ("missed", missed)) if rows]
    if len(pairs):
        overall = pd.DataFrame([*evaluation[-3:]], index=["DEP", "DEK", "COF"]).add_suffix("_m")
        tables = [table.to_string(index=table is overall, float_format="%.3f") for table in (pairs, overall)]
        text = [tables[0], "", tables[1], "", *text]
    return "\n".join(text)


def _usable(frame: gpd.GeoDataFrame, what: str) -> tuple[gpd.GeoDataFrame, NDArray[np.object_]]:
    """Drop what has no length, and name the rest."""
    frame = abreast_apart(frame)
    kept = shapely.length(frame.geometry.to_numpy()) > 0
    complete = (name for name in ID_COLUMNS if name in frame and frame[name].notna().all() and frame[name].is_unique)
    column = next(complete, None)
    ids = np.array(range(1, len(frame) + 1) if column is None else frame[column].tolist(), dtype=object)
    if kept.any() and frame.crs is None:
        raise InputError(f"{what} has no CRS: set it in QGIS (Layer > Set CRS) or with ogr2ogr -a_srs EPSG:n")
    return frame[kept], ids[kept]


def _metric_lines(frame: gpd.GeoDataFrame, crs: CRS | None) -> NDArray[np.object_]:
    """LineStrings of a frame in ``crs``, z in metres; a ``crs`` of None goes with an empty frame."""
    if crs is None or frame.empty:
        return np.empty(0, dtype=object)
    flat = horizontal(frame.crs)
    lines = frame.geometry.set_crs(flat, allow_override=True).to_crs(crs).to_numpy()
    if not np.isfinite(shapely.bounds(lines)).all():
        raise InputError(f"lines don't lie in their CRS, {flat.name}: set the right one in QGIS (Layer > Set CRS)")
    whole = np.array([joined(shapely.get_parts(shapely.line_merge(line)).tolist()) for line in lines], dtype=object)
    to_metres = np.array([1.0, 1.0, vertical_unit(frame.crs)])
    return np.asarray(shapely.transform(whole, lambda xyz: xyz * to_metres, include_z=True))


def _check_beside(found: NDArray[np.object_], truth: NDArray[np.object_]) -> None:
    """Refuse lines that are another place's; InputError tells how far off they are."""
    areas = [shapely.box(*shapely.total_bounds(lines)) for lines in (found, truth) if len(lines)]
    if len(areas) == 2 and (off := float(shapely.distance(*areas))) > ELSEWHERE:
        raise InputError(
            f"the reference's lines lie {off:,.0f} m away from the result's: check the parcel, the reference's CRS, "
            "and whether its coordinates are swapped"
        )


def _errors(found: NDArray[np.object_], truth: NDArray[np.object_]) -> dict[str, NDArray[np.float64]]:
    """Indices 4-6 and the errors along the row for lines paired element by element."""
    ends, true_ends = _ends(found), _ends(truth)
    straight, crossed = (
        np.linalg.norm((ends - other)[:, :, :2], axis=2).sum(axis=1) for other in (true_ends, true_ends[:, ::-1])
    )
    truth = np.where(crossed < straight, shapely.reverse(truth), truth)
    offset = ends - _ends(truth)
    offset[np.isnan(offset).any(axis=(1, 2)), :, 2] = 0.0  # no z: DEP in plan

    found, truth = shapely.force_2d(found), shapely.force_2d(truth)
    along = _along(offset[:, :, :2], truth)
    xy, row = shapely.get_coordinates(shapely.segmentize(found, DEK_STEP), return_index=True)
    distance = shapely.distance(shapely.points(xy), truth[row])
    area = np.array([_area_between(*pair) for pair in zip(truth, found, strict=True)], dtype=float)
    return {
        "dep_m": np.linalg.norm(offset, axis=2).mean(axis=1),
        "dek_m": np.bincount(row, distance, len(found)) / np.bincount(row, minlength=len(found)),
        "cof_m": area / shapely.length(truth),
        "e1_along_m": along[:, 0],
        "en_along_m": along[:, 1],
    }


def _ends(lines: NDArray[np.object_]) -> NDArray[np.float64]:
    """First and last point of each line, (n, 2, 3), NaN for a z that isn't there."""
    points = [shapely.get_coordinates(shapely.get_point(lines, k), include_z=True) for k in (0, -1)]
    return np.stack(points, axis=1)


def _along(offset: NDArray[np.float64], truth: NDArray[np.object_]) -> NDArray[np.float64]:
    """Part of the ends' offsets (n, 2, 2) that lies along the reference and outward, (n, 2), in metres."""
    inside = np.minimum(TANGENT, shapely.length(truth) / 2)
    inner = [shapely.get_coordinates(shapely.line_interpolate_point(truth, at)) for at in (inside, -inside)]
    outward = _ends(truth)[:, :, :2] - np.stack(inner, axis=1)
    return np.asarray((offset * outward).sum(axis=2) / np.linalg.norm(outward, axis=2))


def _area_between(truth: LineString, found: LineString) -> float:
    """Area, in m², between two curves of one direction, from where both have begun to where one ends.

    The curves and the lines that join their ends make a ring. Where they cross it crosses itself, and its lobes,
    taken by the even-odd rule, add up. NaN if the curves have no span in common.
    """
    near = _span(truth, found)
    far = _span(found, near)
    if near.geom_type != "LineString" or far.geom_type != "LineString":
        return float("nan")
    return float(shapely.make_valid(Polygon([*near.coords, *reversed(far.coords)])).area)


def _span(line: LineString, other: BaseGeometry) -> BaseGeometry:
    """Piece of a line between the feet of another's ends; a point where that is no piece."""
    start, stop = sorted(line.project(Point(other.coords[k])) for k in (0, -1))
    return substring(line, start, stop)
