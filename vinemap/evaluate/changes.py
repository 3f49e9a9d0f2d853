"""What has changed between two surveys of a parcel, row by row.

Rows are the same where they stand in the same place, whatever they are called. As two flights may lie some decimetres
apart, the shift between them is found first, from all rows together, unless known rows have told it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd
import shapely

from vinemap.evaluate.rows import match_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd
    from numpy.typing import NDArray

    Lines = NDArray[np.object_]

MEASURES = ("length_m", "height_m", "width_m", "volume_m3", "gap_m", "n_missing")
"""Numbers of rows that are compared."""
SUMS = ("volume_m3", "gap_m", "n_missing")
"""Those that are less where less of a row was seen."""
SAME, NEW, GONE = "same", "new", "gone"
NONE = -1
"""Position of no row."""
TOLERANCE = 0.05
"""Metres by which rows are simplified."""
STEP = 4.0
"""Metres, at most, between the places where the shift is measured."""
TANGENT = 0.5
"""Metres to either side of a place between which a row's direction is taken there."""
SHORTEST = 0.02
"""Metres that measurements of the shift scatter, at least."""
WEAK = 0.2
"""Share of the best known direction's weight below which rows don't tell a shift in another direction."""
ASIDE, MANY, FEWEST = 0.12, 0.25, 3
"""Share of the spacing by which a row lies aside, share of such rows, and number of all, from which they are others."""
TURNS = 8
"""Rounds in which measurements that don't fit lose their weight."""


class Changes(NamedTuple):
    """Rows of two dates."""

    shift: tuple[float, float]
    """Metres to the east and north by which the later survey lies off the earlier one; 0 where other rows stand."""
    rows: pd.DataFrame
    """A line a row of the later date, then those that are gone: ``state`` ("same", "new", "gone"), ``label`` and
    ``earlier`` (its label at that date), ``place`` and ``earlier_place`` (positions in the tables, -1 for none),
    ``part_of`` (label of the other date's row that it was split from or joined to), its numbers, ``length_m`` and so
    on, and what one that is the same has gained, ``d_length_m`` and so on. What it has gained in volume, gaps and
    missing vines isn't known, NaN, where a part of it wasn't seen on either date."""


def compare_rows(
    later: gpd.GeoDataFrame,
    earlier: gpd.GeoDataFrame,
    *,
    shift: tuple[float, float] | None = None,
    overlap: float = 0.5,
    width: float = 0.6,
) -> Changes:
    """Match the rows of two dates one to one, and tell what has changed.

    None is the same where a parcel was planted anew at another spacing, and some rows stand where others did by chance.

    Parameters
    ----------
    later, earlier : GeoDataFrame
        Layer ``rows`` of the two products, each in any projected CRS in metres; without ``unseen_m`` all was seen.
    shift : (float, float), optional
        Metres to the east and north by which the later rows lie off the earlier ones; by default estimated.
    overlap : float
        Share of the longer row along which two must run beside each other to be the same.
    width : float
        How far apart, in metres, once the shift is taken away; never more than 0.3 of the spacing.
    """
    spacing = _spacing(later, earlier)
    near = min(width, 0.3 * spacing)
    lines, before = (
        shapely.simplify(shapely.force_2d(table.geometry.to_numpy()), TOLERANCE)
        for table in (later, earlier.to_crs(later.crs))
    )
    told = estimate_shift(lines, before, spacing=spacing, overlap=overlap, width=near) if shift is None else shift
    moved = _move(lines, -np.asarray(told))
    j, i = match_rows(moved, before, overlap=overlap, width=near).T
    if _interleaved(moved, before, j, i, spacing=spacing, near=near):
        j, i = j[:0], i[:0]
        told = shift or (0.0, 0.0)
    was = np.full(len(lines), NONE)
    was[j] = i
    lost = np.setdiff1d(np.arange(len(before)), i)
    is_now, was = np.append(np.arange(len(lines)), np.full(len(lost), NONE)), np.append(was, lost)
    state = np.select([is_now == NONE, was == NONE], [GONE, NEW], SAME)
    labels, labels_before = (
        np.append(table["label"].to_numpy(dtype=object), np.array([None], dtype=object)) for table in (later, earlier)
    )
    part_of = np.full(len(state), None, dtype=object)
    part_of[state == NEW] = labels_before[_part_of(moved[is_now[state == NEW]], before, near)]
    part_of[state == GONE] = labels[_part_of(before[lost], moved, near)]
    columns = {"state": state, "label": labels[is_now], "earlier": labels_before[was], "part_of": part_of}
    columns |= {"place": is_now, "earlier_place": was}
    pairs = (later, is_now), (earlier, was)
    hidden = np.any([_column(table, "unseen_m", places) > 0 for table, places in pairs if "unseen_m" in table], axis=0)
    for name in MEASURES:
        now, then = (_column(table, name, places) for table, places in pairs)
        gained = np.where(hidden, np.nan, now - then) if name in SUMS else now - then
        columns |= {name: np.where(state == GONE, then, now), f"d_{name}": gained}
    return Changes((round(float(told[0]), 3), round(float(told[1]), 3)), pd.DataFrame(columns))


def follow_rows(
    dates: Sequence[gpd.GeoDataFrame],
    *,
    shifts: Sequence[tuple[float, float] | None] | None = None,
    latest: Changes | None = None,
) -> list[NDArray[np.intp]]:
    """Follow the rows of a parcel back through its dates.

    Each date is compared with all rows that are known of later ones, each of these where it stood last.

    Parameters
    ----------
    dates : sequence of GeoDataFrame
        Layer ``rows`` of the products, the latest first.
    shifts : sequence of (float, float) or None, optional
        By which the latest lies off each of the others, where it is known.
    latest : Changes, optional
        Those between the first two, where they are known.

    Returns
    -------
    list of array (n,)
        For each date a number for each of its rows, from 0, the same on all dates on which that row stands: its
        position at the latest date, and from there on what is there no more.
    """
    known, numbers = dates[0], [np.arange(len(dates[0]))]
    apart = shifts or [None] * (len(dates) - 1)
    for k, (table, told) in enumerate(zip(dates[1:], apart, strict=True)):
        shift, changes = latest if latest and k == 0 else compare_rows(known, table, shift=told)
        place, earlier = changes["place"].to_numpy(), changes["earlier_place"].to_numpy()
        found = np.full(len(table), NONE)
        there = (place != NONE) & (earlier != NONE)
        found[earlier[there]] = place[there]
        lost = np.flatnonzero(found == NONE)
        found[lost] = len(known) + np.arange(len(lost))
        if len(lost):
            gone = table.iloc[lost].to_crs(known.crs)
            known = pd.concat([known, gone.set_geometry(gone.translate(*shift))], ignore_index=True)
        numbers.append(found)
    return numbers


def estimate_shift(
    later: Lines, earlier: Lines, *, spacing: float, overlap: float = 0.5, width: float = 0.6
) -> NDArray[np.float64]:
    """Metres (2,), east and north, by which lines of a later date lie off those of an earlier one.

    Across the rows all their points tell it, along them the ends of those that are the same. What has changed itself,
    a row that is new, an end that was shortened, loses its weight (Tukey's biweight, Beaton & Tukey 1974). The shift
    must be less than half the spacing, beyond which rows can't be told from their neighbours.
    """
    if len(later) == 0 or len(earlier) == 0:
        return np.zeros(2)
    across = _across(later, earlier, reach=spacing / 2)
    shift = _solve(*across)
    for _ in range(2):
        moved = _move(later, -shift)
        j, i = match_rows(moved, earlier, overlap=overlap, width=width).T
        directions, offsets = _along(moved[j], earlier[i])
        near = _across(moved, earlier, reach=width)
        # Ends are few, and count as much as all points between them.
        weights = np.concatenate([np.ones(len(near[1])), np.full(len(offsets), _balance(near[1], offsets))])
        shift = shift + _solve(np.concatenate([near[0], directions]), np.concatenate([near[1], offsets]), weights)
    return shift


def lie_aside(lines: Lines, before: Lines, *, spacing: float) -> NDArray[np.float64]:
    """Metres (n,) by which rows lie off lines (n,) that they may be, but for a shift of all."""
    if len(lines) == 0:
        return np.zeros(0)
    lines, before = shapely.force_2d(lines), shapely.force_2d(before)
    return _off(_move(lines, -estimate_shift(lines, before, spacing=spacing, width=spacing / 2)), before)


def are_others(off: NDArray[np.float64], *, spacing: float) -> bool:
    """Whether rows that lie so many metres (n,) aside, each another way, are of another planting."""
    return len(off) >= FEWEST and float(np.mean(off > ASIDE * spacing)) >= MANY


def _interleaved(
    lines: Lines,
    before: Lines,
    j: NDArray[np.intp],
    i: NDArray[np.intp],
    *,
    spacing: float,
    near: float,
) -> bool:
    """Whether rows stand among earlier ones at another spacing: many pairs lie aside, and many rows between two."""
    aside = _off(lines[j], before[i]) > ASIDE * spacing
    if len(aside) == 0 or np.mean(aside) < MANY:
        return False
    for rows, others, paired in ((lines, before, j), (before, lines, i)):
        off = np.delete(_off(rows, np.array([shapely.multilinestrings(others)])), paired)
        between = np.count_nonzero((off > near) & (off < spacing / 2))
        if len(paired) + between >= FEWEST and between >= MANY * (len(paired) + between):
            return True
    return False


def _off(lines: Lines, others: Lines) -> NDArray[np.float64]:
    """Metres (n,) by which lines (n,) lie off others (n,), or off one of any."""
    places = shapely.line_interpolate_point(lines[:, None], [[0.25, 0.5, 0.75]], normalized=True)
    off: NDArray[np.float64] = np.median(shapely.distance(places, others[:, None]), axis=1)
    return off


def summarise(changes: Changes) -> dict[str, float]:
    """Changes of a parcel: of the rows that are the same, mean height and width by length, sums of the rest.

    Returns
    -------
    dict
        ``same``, ``new`` and ``gone`` (numbers of rows), ``d_height_m``, ``d_width_m``, ``d_volume_m3``,
        ``d_volume`` (share of what was), ``d_gap_m`` and ``d_n_missing``; NaN where no row is the same, or none of
        which it is known.
    """
    state = changes.rows["state"].to_numpy()
    found: dict[str, float] = {one: int((state == one).sum()) for one in (SAME, NEW, GONE)}
    columns = [*MEASURES, *(f"d_{name}" for name in MEASURES)]
    same = {name: changes.rows[name].to_numpy(dtype=float)[state == SAME] for name in columns}
    for name in ("d_height_m", "d_width_m"):
        known = np.isfinite(same[name])
        found[name] = float(np.average(same[name][known], weights=same["length_m"][known])) if known.any() else np.nan
    for name in (f"d_{one}" for one in SUMS):
        found[name] = float(np.nansum(same[name])) if np.isfinite(same[name]).any() else np.nan
    before = np.nansum(same["volume_m3"] - same["d_volume_m3"])
    return found | {"d_volume": found["d_volume_m3"] / before if before > 0 else np.nan}


def _column(table: gpd.GeoDataFrame, name: str, places: NDArray[np.intp]) -> NDArray[np.float64]:
    """Numbers of a table's rows in some places, NaN where that is none."""
    out: NDArray[np.float64] = np.append(table[name].to_numpy(dtype=float), np.nan)[places]
    return out


def _spacing(*tables: gpd.GeoDataFrame) -> float:
    values = np.concatenate([table["spacing_m"].to_numpy(dtype=float) for table in tables])
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 2.5


def _move(lines: Lines, by: NDArray[np.float64]) -> Lines:
    return np.asarray(shapely.transform(lines, lambda xy: xy + by), dtype=object)


def _across(lines: Lines, others: Lines, *, reach: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors (n, 2) across the nearest of other lines, and how far (n,) points of lines lie off it that way."""
    points = np.asarray(shapely.points(shapely.get_coordinates(shapely.segmentize(lines, STEP))))
    nearest = others[shapely.STRtree(others).nearest(points)]
    position = shapely.line_locate_point(nearest, points)
    inside = (position > 0) & (position < shapely.length(nearest)) & (shapely.distance(nearest, points) < reach)
    points, nearest, position = points[inside], nearest[inside], position[inside]
    back = shapely.get_coordinates(shapely.line_interpolate_point(nearest, np.maximum(position - TANGENT, 0)))
    ahead = shapely.get_coordinates(shapely.line_interpolate_point(nearest, position + TANGENT))
    along = (ahead - back) / np.linalg.norm(ahead - back, axis=1, keepdims=True)
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    foot = shapely.get_coordinates(shapely.line_interpolate_point(nearest, position))
    return normals, ((shapely.get_coordinates(points) - foot) * normals).sum(axis=1)


def _along(lines: Lines, others: Lines) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors (2 n, 2) along paired rows, and how far (2 n,) their ends lie off each other that way."""
    ends, ends_before = (
        np.stack([shapely.get_coordinates(shapely.get_point(row, k)) for k in (0, -1)], axis=1)
        for row in (lines, others)
    )
    chord, chord_before = (pair[:, 1] - pair[:, 0] for pair in (ends, ends_before))
    turned = (chord * chord_before).sum(axis=1) < 0
    ends[turned] = ends[turned, ::-1]
    along = chord_before / np.maximum(np.linalg.norm(chord_before, axis=1, keepdims=True), 1e-9)
    offsets = ((ends - ends_before) * along[:, None]).sum(axis=2)
    return np.repeat(along, 2, axis=0), offsets.ravel()


def _balance(many: NDArray[np.float64], few: NDArray[np.float64]) -> float:
    return float(np.sqrt(len(many) / len(few))) if len(many) and len(few) else 1.0


def _solve(
    directions: NDArray[np.float64], offsets: NDArray[np.float64], weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """The shift (2,) whose parts in some directions (n, 2) are the offsets (n,), whatever some of them say."""
    shift: NDArray[np.float64] = np.zeros(2)
    if len(offsets) == 0:
        return shift
    given = np.ones(len(offsets)) if weights is None else weights
    trust = np.ones(len(offsets))
    for _ in range(TURNS):
        scaled = given * np.sqrt(trust)
        shift = np.asarray(np.linalg.lstsq(directions * scaled[:, None], offsets * scaled, rcond=WEAK)[0])
        residuals = offsets - directions @ shift
        scale = max(1.4826 * float(np.median(np.abs(residuals))), SHORTEST)
        trust = np.clip(1 - (residuals / (4.685 * scale)) ** 2, 0, None) ** 2
    return shift


def _part_of(lines: Lines, others: Lines, width: float) -> NDArray[np.intp]:
    """Which other line most of each line (n,) runs along, if it does for half of it; else none."""
    if len(lines) == 0 or len(others) == 0:
        return np.full(len(lines), NONE)
    i, j = shapely.STRtree(others).query(shapely.buffer(lines, width), predicate="intersects")
    share = np.zeros((len(lines), len(others)))
    beside = shapely.intersection(lines[i], shapely.buffer(others[j], width))
    share[i, j] = shapely.length(beside) / shapely.length(lines[i])
    return np.where(share.max(axis=1) >= 0.5, share.argmax(axis=1), NONE)
