"""Known lines in a cloud: which of them it shows, and how far apart their rows are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from vinemap.errors import InputError
from vinemap.geo.crs import project
from vinemap.geo.curve import cross, resample, unit
from vinemap.geo.layers import some_of

if TYPE_CHECKING:
    from pyproj import CRS

    from vinemap.compute.arrays import Values
    from vinemap.surfaces.seen import Seen
    from vinemap.surfaces.waves import RowField

STEP = 0.5
"""Metres between the stations at which lines are looked at."""
FAR, USUAL = 15.0, 2.5
"""Metres within which a line has others beside it, and between rows where none has."""
CLOSEST = 0.3
"""Metres across, less than which lines lie on one row."""
CLOSER = 0.75
"""Share of the lines' distance that rows are apart of which only some are known."""
SLANT, TRACK = 0.35, 1.75
"""Metres along a line to a metre across up to which another is beside it, and ratio of their distance to the usual one
from which there is a track between."""
PARALLEL = np.cos(np.radians(20))
"""Cosine of the angle up to which lines, or rows and a line, run alike."""
SHORTEST = 2.0
"""Metres of a line, or it is none of a row."""
SEEN, WHOLE = 0.5, 0.9
"""Share of a line that was seen, or it is left out, and from which it lies in the cloud as a whole."""


def lines_here(known: gpd.GeoDataFrame, seen: Seen, crs: CRS) -> tuple[gpd.GeoDataFrame, list[str]]:
    """Bring known lines to a cloud's CRS, and leave out those where it shows nothing.

    Parameters
    ----------
    known : GeoDataFrame
        LineString with ``row_id`` and ``label``.
    seen : Seen
        What the cloud shows.
    crs : CRS
        The cloud's.

    Returns
    -------
    lines : GeoDataFrame
        With ``spacing_m``, the mean distance of lines about each.
    remarks : list of str
        What is to be known of lines that lie outside, a sentence each.

    Raises
    ------
    InputError
        If that are all.
    """
    lines = known.set_geometry(gpd.GeoSeries(project(known.geometry.to_numpy(), known.crs, crs), crs=crs))
    shapes = lines.geometry.to_numpy()
    placed = np.isfinite(shapely.bounds(shapes)).all(axis=1)
    points, line = shapely.get_coordinates(shapely.segmentize(shapes[placed], STEP), return_index=True)
    share = np.zeros(len(lines))
    share[placed] = np.bincount(line, seen.at(points)) / np.bincount(line)
    short = placed & (shapely.length(shapes) < SHORTEST)
    shown = (share >= SEEN) & ~short
    if not shown.any():
        raise InputError(
            f"none of the {len(known)} known rows lies in the cloud: do both show the same place, in the right CRS?"
        )
    kinds = share < SEEN, short & (share >= SEEN), shown & (share < WHOLE)
    outside, small, partly = (lines["label"][rows].tolist() for rows in kinds)
    n = len(known)
    remarks = {
        f"{len(outside)} of {n} known rows lie outside of the cloud, and are left out: {some_of(outside)}": outside,
        f"{len(small)} of {n} known rows are shorter than {SHORTEST:g} m, and are left out: {some_of(small)}": small,
        f"{len(partly)} of {n} known rows reach out of the cloud: {some_of(partly)}": partly,
    }
    return space_lines(lines[shown].reset_index(drop=True)), [remark for remark, holds in remarks.items() if holds]


def space_lines(lines: gpd.GeoDataFrame, field: RowField | None = None) -> gpd.GeoDataFrame:
    """Give lines their ``spacing_m``: the mean distance of those thereabouts, or else that of all others.

    Where a row field tells of rows along a line that are far closer, only some of them are known, and that counts.
    """
    shapes = shapely.force_2d(lines.geometry.to_numpy())
    share = np.array([[0.25, 0.5, 0.75]])
    back, points, ahead = (
        shapely.line_interpolate_point(shapes[:, None], share + step, normalized=True).ravel()
        for step in (-0.05, 0.0, 0.05)
    )
    way = unit(shapely.get_coordinates(ahead) - shapely.get_coordinates(back))
    point, other = shapely.STRtree(shapes).query(points, predicate="dwithin", distance=FAR)
    foot = shapely.get_coordinates(shapely.shortest_line(points[point], shapes[other])).reshape(-1, 2, 2)
    there = foot[:, 1] - foot[:, 0]
    along = (way[point] * there).sum(axis=1)
    left = cross(way[point], there)
    abreast = np.abs(along) <= SLANT * np.abs(left) + 1e-6
    places = pd.Series(left[abreast]).groupby(point[abreast])
    steps = places.apply(lambda one: _usual_step(one.to_numpy())).reindex(range(len(points)))
    spacing = steps.groupby(np.arange(len(points)) // 3).median().to_numpy()
    usual = float(np.nanmedian(spacing)) if np.isfinite(spacing).any() else USUAL
    spacing = np.where(np.isfinite(spacing), spacing, usual)
    if field:
        told = np.array([_told_by(field, shape) for shape in shapes])
        spacing = np.where(told < CLOSER * spacing, told, spacing)
    return lines.assign(spacing_m=spacing)


def _told_by(field: RowField, line: shapely.LineString) -> float:
    """Spacing in metres that a row field tells along a line; NaN where there are no rows along it."""
    curve = resample(shapely.get_coordinates(line), STEP)
    way = np.gradient(curve, axis=0)
    direction, spacing, _ = field.at(curve)
    turn = np.abs(np.cos(np.radians(direction) - np.arctan2(way[:, 1], way[:, 0])))
    along = (turn >= PARALLEL) & np.isfinite(spacing)
    return float(np.median(spacing[along])) if along.mean() > 0.5 else np.nan


def _usual_step(places: Values) -> float:
    """Mean distance in metres of places that follow each other, but for tracks between; NaN of one place."""
    steps = np.diff(np.sort(places))
    steps = steps[steps > CLOSEST]
    return float(steps[steps <= TRACK * np.median(steps)].mean()) if len(steps) else np.nan
