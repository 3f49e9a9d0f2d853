"""Table 2.1: rows numbered across the rows, each with its length, orientation, elevation, ends and missing vines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import shapely

from vinemap.geo.crs import WGS84, is_local, to_wgs84
from vinemap.geo.main import Corner, Origin, to_main
from vinemap.rows.standing.canopy import USUAL
from vinemap.rows.standing.gaps import UNSEEN

if TYPE_CHECKING:
    from pyproj import CRS

    from vinemap.compute.arrays import Floats, Ints


def number_rows(rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Give rows their direction and number, and gaps the number of their row.

    A curve starts at its western end e1 (its southern one where it runs due north). Rows are numbered from 1 across
    the rows, from south to north, from west to east where they run rather north–south, block by block.

    Parameters
    ----------
    rows : GeoDataFrame
        LineStringZ with ``block``.
    gaps : GeoDataFrame
        LineStringZ with ``row`` (position in rows), ``start_m``, ``end_m`` and ``length_m``.

    Returns
    -------
    rows, gaps : GeoDataFrame
        In order of ``row_id``; gaps without ``row``.
    """
    if len(rows) == 0:
        number = np.empty(0, dtype=np.int64)
        return rows.assign(row_id=number), gaps.drop(columns="row").assign(row_id=number)
    chords = [_chord(line) for line in rows.geometry]
    backwards = np.array([c[0] < 0 or (c[0] == 0 and c[1] < 0) for c in chords])
    lines = [shapely.reverse(g) if b else g for g, b in zip(rows.geometry, backwards, strict=True)]
    rows = rows.set_geometry(gpd.GeoSeries(lines, index=rows.index, crs=rows.crs))
    rank = np.empty(len(rows), dtype=np.int64)
    rank[order_across(rows)] = np.arange(1, len(rows) + 1)

    index = gaps["row"].to_numpy(dtype=np.int64)
    turned = backwards[index]
    length = shapely.length(shapely.force_2d(rows.geometry.to_numpy()))[index]
    start = np.where(turned, length - gaps["end_m"], gaps["start_m"])
    end = np.where(turned, length - gaps["start_m"], gaps["end_m"])
    pieces = [shapely.reverse(g) if t else g for g, t in zip(gaps.geometry, turned, strict=True)]
    gaps = gaps.assign(row_id=rank[index], start_m=start, end_m=end)
    gaps = gaps.set_geometry(gpd.GeoSeries(pieces, index=gaps.index, crs=rows.crs))
    return (
        rows.assign(row_id=rank).sort_values("row_id", ignore_index=True),
        gaps.drop(columns="row").sort_values(["row_id", "start_m"], ignore_index=True),
    )


def _chord(line: shapely.LineString) -> Floats:
    ends = shapely.get_coordinates(line)[[0, -1]]
    out: Floats = ends[1] - ends[0]
    return out


def order_across(rows: gpd.GeoDataFrame) -> Ints:
    """Positions of rows, or lanes, block by block and across each as :func:`number_rows` goes."""
    lines = rows.geometry.to_numpy()
    middle = shapely.get_coordinates(shapely.line_interpolate_point(lines, 0.5, normalized=True))
    angle = np.array([np.arctan2(*_chord(line)[::-1]) for line in lines])
    block = rows["block"].to_numpy()
    across = np.empty(len(rows))
    for b in np.unique(block):
        members = block == b
        half = np.angle(np.exp(2j * angle[members]).mean()) / 2
        normal = np.array([-np.sin(half), np.cos(half)])
        # Northwards across rows that run rather west–east, eastwards across those that run rather north–south.
        leading = normal[1] if abs(normal[1]) >= abs(normal[0]) else normal[0]
        across[members] = middle[members] @ (normal if leading > 0 else -normal)
    order: Ints = np.lexsort((across, block))
    return order


def count_missing(
    rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame, *, vine_spacing: float | None = None
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Count the vines missing in every gap, but for those of which nothing was seen.

    Parameters
    ----------
    rows, gaps : GeoDataFrame
        With ``row_id``; gaps with ``start_m``, ``end_m``, ``length_m`` and ``state``.
    vine_spacing : float, optional
        Metres between vines in a row; by default 1 m, until it is known where they stand.

    Returns
    -------
    rows, gaps : GeoDataFrame
        With ``n_missing``; rows with ``vine_spacing_m`` too.
    """
    spacing = vine_spacing or USUAL
    n = np.maximum(1, np.rint(gaps["length_m"].to_numpy(dtype=float) / spacing)).astype(np.int64)
    gaps = gaps.assign(n_missing=np.where(gaps["state"] == UNSEEN, 0, n))
    missing = gaps.groupby("row_id")["n_missing"].sum().reindex(rows["row_id"], fill_value=0)
    return rows.assign(n_missing=missing.to_numpy(), vine_spacing_m=spacing), gaps


def describe_rows(
    rows: gpd.GeoDataFrame, *, parcel: str, origin: Origin | Corner, threshold: float = 2.0
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Describe numbered rows as Table 2.1 does.

    Parameters
    ----------
    rows : GeoDataFrame
        LineStringZ in a projected or local CRS with ``row_id``, and ``label`` where they are known by one.
    parcel : str
        Name that follows the number in a row's label ("1 F").
    origin : Origin or Corner
        Origin of {Main}.
    threshold : float
        Metres t between enhanced key points, which stand at equal distances of about that along γ.

    Returns
    -------
    rows : GeoDataFrame
        With ``label``, ``length_m`` (3-D), ``orientation_deg`` (mean, anticlockwise from {Main}'s west–east
        axis, which is true and not the grid's, in (-90, 90]), ``elevation_m`` (mean along the row),
        ``elevation_diff_m`` (en − e1), ``n_key_points``, and both ends as ``e1_x`` … ``en_z`` in
        {Main} and ``e1_lat`` … ``en_alt`` in WGS84, NaN where coordinates are local.
    row_ends : GeoDataFrame
        PointZ in EPSG:4326, or the local CRS, with ``row_id``, ``label``, ``end`` ("e1" or "en").
    key_points : GeoDataFrame
        PointZ with ``row_id``, ``label``, ``order`` (1 … n) and ``position_m`` along γ.
    """
    labels = list(rows["label"]) if "label" in rows else [f"{i} {parcel}" for i in rows["row_id"]]
    lines = [shapely.get_coordinates(line, include_z=True) for line in rows.geometry]
    n_points = np.array([max(2, round(_length(xyz) / threshold) + 1) for xyz in lines], dtype=np.int64)
    ends = np.array([xyz[[0, -1]] for xyz in lines]).reshape(-1, 3)
    main = to_main(ends, rows.crs, origin).reshape(-1, 2, 3)
    wgs84 = to_wgs84(ends, rows.crs)
    table = {
        "label": labels,
        "length_m": [_length(xyz) for xyz in lines],
        "orientation_deg": [_orientation(xyz) for xyz in _in_main(lines, rows.crs, origin)],
        "elevation_m": [_mean_elevation(xyz) for xyz in lines],
        "elevation_diff_m": [float(xyz[-1, 2] - xyz[0, 2]) for xyz in lines],
        "n_key_points": n_points,
    }
    for e, end in enumerate(("e1", "en")):
        table |= {f"{end}_{axis}": main[:, e, k] for k, axis in enumerate("xyz")}
    for e, end in enumerate(("e1", "en")):
        table |= {f"{end}_{name}": wgs84[e::2, k] for k, name in enumerate(("lat", "lon", "alt"))}
    row_ends = gpd.GeoDataFrame(
        {
            "row_id": np.repeat(rows["row_id"].to_numpy(), 2),
            "label": np.repeat(np.array(labels, dtype=object), 2),
            "end": ["e1", "en"] * len(rows),
        },
        geometry=gpd.points_from_xy(*(ends if is_local(rows.crs) else wgs84[:, [1, 0, 2]]).T),
        crs=rows.crs if is_local(rows.crs) else WGS84,
    )
    return rows.assign(**table), row_ends, _key_points(rows, labels, n_points)


def _key_points(rows: gpd.GeoDataFrame, labels: list[str], n_points: Ints) -> gpd.GeoDataFrame:
    order = np.arange(n_points.sum()) - np.repeat(np.cumsum(n_points) - n_points, n_points)
    row = np.repeat(np.arange(len(rows)), n_points)
    lines = rows.geometry.to_numpy()
    position = order * (shapely.length(lines) / (n_points - 1))[row]
    return gpd.GeoDataFrame(
        {
            "row_id": rows["row_id"].to_numpy()[row],
            "label": np.array(labels, dtype=object)[row],
            "order": order + 1,
            "position_m": position,
        },
        geometry=shapely.line_interpolate_point(lines[row], position),
        crs=rows.crs,
    )


def _in_main(lines: list[Floats], crs: CRS, origin: Origin | Corner) -> list[Floats]:
    """Lines (n, 3), as many as there are, in {Main}."""
    if not lines:
        return []
    return np.split(to_main(np.concatenate(lines), crs, origin), np.cumsum([len(xyz) for xyz in lines])[:-1])


def _length(xyz: Floats) -> float:
    return float(np.linalg.norm(np.diff(xyz, axis=0), axis=1).sum())


def _orientation(xyz: Floats) -> float:
    """Mean direction in degrees of a curve that runs eastwards, in (-90, 90]."""
    way = np.diff(xyz[:, :2], axis=0)
    chord = np.arctan2(*(xyz[-1, :2] - xyz[0, :2])[::-1])
    turn = np.angle(np.exp(1j * (np.arctan2(way[:, 1], way[:, 0]) - chord)))
    mean = np.degrees(chord + np.average(turn, weights=np.hypot(*way.T)))
    return float(90 - (90 - mean) % 180)


def _mean_elevation(xyz: Floats) -> float:
    step = np.hypot(*np.diff(xyz[:, :2], axis=0).T)
    return float(np.average((xyz[1:, 2] + xyz[:-1, 2]) / 2, weights=step))
