"""Poses of a robot as layers: where they lie on the map, the lines of the track, and the vine row beside each."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from pyproj import CRS

from vinemap.errors import InputError
from vinemap.geo.crs import from_wgs84, project
from vinemap.geo.main import Origin, main_to_wgs84
from vinemap.odometry.poses import Pose, onward
from vinemap.odometry.track import stretches
from vinemap.product.layers import REAL, TEXT, TIME, WHOLE, Layer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.config.drives import Start
    from vinemap.odometry.track import TrackPoint

NOWHERE = CRS.from_wkt(
    'ENGCRS["Track: metres to the right of its start and ahead",EDATUM["start of the track"],CS[Cartesian,2],'
    'AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'
)
"""CRS of a track whose start isn't known."""
DATED = 1e8
"""Seconds from which on a time counts from 1970."""
FARTHEST = 2000.0
"""Metres between a start and the nearest row from which on one of them must be wrong."""
LEAST_SD = 1e-4
"""Metres that a band is drawn for at least."""
TRACK_LAYERS: dict[str, Layer] = {
    "track": Layer(
        "LineString",
        {"stretch": WHOLE, "n_poses": WHOLE} | dict.fromkeys(("length_m", "seconds", "score"), REAL),
        "The robot's track: a line for each stretch within which every pose was measured",
    ),
    "poses": Layer(
        "Point",
        {"pose": WHOLE, "frame": TEXT, "time": TIME, "seconds": REAL}
        | dict.fromkeys(
            ("x_m", "y_m", "heading_deg", "lat", "lon", "score", "agreement", "overlap", "height_mm", "tilt_deg"), REAL
        )
        | {"flag": TEXT, "measured_from": WHOLE, "stretch": WHOLE}
        | {"sd_m": REAL, "sd_heading_deg": REAL}
        | {"row": TEXT, "row_distance_m": REAL, "row_position_m": REAL},
        "Poses of the robot, one a frame",
    ),
    "band": Layer(
        "Polygon",
        {"stretch": WHOLE, "width_m": REAL},
        "Where the robot was: two standard deviations about each stretch of its track",
    ),
}
"""What the GeoPackage of a robot's track holds."""


def track_layers(track: Sequence[TrackPoint], *, start: Start | None, crs: CRS) -> dict[str, gpd.GeoDataFrame]:
    """Layers of the contract :data:`vinemap.odometry.layers.TRACK_LAYERS`, without rows.

    Parameters
    ----------
    track : sequence of TrackPoint
        In order, the first measured one at the start.
    start : Start, optional
        Without it the track starts northward at the origin of :data:`NOWHERE`.
    crs : CRS
        Projected CRS of the layers.
    """
    first = Pose(0.0, 0.0, 90.0 - (start.heading_deg if start else 0.0))
    east, north, heading = np.array([onward(first, point.pose) for point in track]).T
    east, north = east / 1000, north / 1000
    xy, lat, lon = _on_the_map(east, north, start, crs)
    seconds = np.array([np.nan if point.time is None else point.time for point in track])
    dated = np.where(seconds > DATED, seconds, np.nan)
    seconds = dated if np.isfinite(dated).any() else seconds
    known = seconds[np.isfinite(seconds)]
    poses = gpd.GeoDataFrame(
        {
            "pose": np.arange(1, len(track) + 1),
            "frame": [point.frame for point in track],
            "time": pd.to_datetime(pd.Series(dated), unit="s", utc=True),
            "seconds": seconds - (known[0] if len(known) else 0.0),
            "x_m": east,
            "y_m": north,
            "heading_deg": (90.0 - heading) % 360,
            "lat": lat,
            "lon": lon,
            "score": [point.motion.score if point.motion else 0.0 for point in track],
            "agreement": [point.motion.agreement if point.motion else 0.0 for point in track],
            "overlap": [point.motion.overlap if point.motion else 0.0 for point in track],
            "height_mm": [point.height_mm for point in track],
            "tilt_deg": [point.motion.tilt_deg if point.motion else np.nan for point in track],
            "flag": [point.flag for point in track],
            "measured_from": [0 if point.measured_from is None else point.measured_from + 1 for point in track],
            "stretch": stretches(track),
            "sd_m": [np.sqrt(np.linalg.eigvalsh(point.covariance[:2, :2])[-1]) / 1000 for point in track],
            "sd_heading_deg": [np.sqrt(point.covariance[2, 2]) for point in track],
            "row": "",
            "row_distance_m": np.nan,
            "row_position_m": np.nan,
        },
        geometry=shapely.points(xy),
        crs=crs,
    )
    return {"track": _lines(poses), "poses": poses, "band": _bands(poses)}


def beside_rows(poses: gpd.GeoDataFrame, rows: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Poses with the nearest row, their distance from it, and how far along it they are, in metres and in plan.

    Parameters
    ----------
    poses : GeoDataFrame
        Points in a projected CRS in metres.
    rows : GeoDataFrame
        Lines, one at least, in any CRS, named by ``label`` or ``row_id``, else by their order.

    Raises
    ------
    InputError
        If the first pose lies kilometres from all rows.
    """
    lines = np.atleast_1d(np.asarray(project(rows.geometry.to_numpy(), rows.crs, poses.crs)))
    points = poses.geometry.to_numpy()
    nearest = shapely.STRtree(lines).query_nearest(points, all_matches=False)[1]
    distance = np.asarray(shapely.distance(points, lines[nearest]))
    if distance[0] > FARTHEST:
        raise InputError(
            f"The start lies {distance[0] / 1000:.0f} km from the nearest row: give it as latitude, longitude, heading"
        )
    column = next((name for name in ("label", "row_id") if name in rows), None)
    names = np.arange(1, len(rows) + 1).astype(str)
    if column:
        names = np.where(rows[column].isna(), names, rows[column].astype(str))
    along = shapely.line_locate_point(shapely.line_merge(lines[nearest]), points)
    return poses.assign(row=names[nearest], row_distance_m=distance, row_position_m=along)


def _on_the_map(
    east: NDArray[np.float64], north: NDArray[np.float64], start: Start | None, crs: CRS
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates (n, 2) in the CRS, latitudes and longitudes (n,) of places about the start."""
    if start is None:
        nothing = np.full(len(east), np.nan)
        return np.column_stack([east, north]), nothing, nothing
    places = np.column_stack([east, north, np.zeros(len(east))])
    geographic = main_to_wgs84(places, Origin(start.lat, start.lon, 0.0))
    return from_wgs84(geographic, crs)[:, :2], geographic[:, 0], geographic[:, 1]


def _lines(poses: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """A line for each unbroken stretch of measured poses."""
    records = []
    for number, group in poses[poses["stretch"] > 0].groupby("stretch"):
        spread = group["seconds"].max() - group["seconds"].min()
        steps = group["score"][group["measured_from"] > 0]
        course = np.hypot(*np.diff(group[["x_m", "y_m"]].to_numpy(), axis=0).T)
        records.append((number, len(group), course.sum(), spread, steps.mean(), shapely.linestrings(_xy(group))))
    columns = ["stretch", "n_poses", "length_m", "seconds", "score", "geometry"]
    return gpd.GeoDataFrame(pd.DataFrame(records, columns=columns), geometry="geometry", crs=poses.crs)


def _bands(poses: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """A polygon for each stretch: circles of two standard deviations about its poses, and what lies between them."""
    records = []
    for number, group in poses[poses["stretch"] > 0].groupby("stretch"):
        sd = np.maximum(group["sd_m"].to_numpy(), LEAST_SD)
        circles = shapely.buffer(group.geometry.to_numpy(), 2 * sd, quad_segs=4)
        joined = shapely.convex_hull(shapely.union(circles[:-1], circles[1:]))
        records.append((number, 4 * sd.max(), shapely.make_valid(shapely.union_all(joined))))
    columns = ["stretch", "width_m", "geometry"]
    return gpd.GeoDataFrame(pd.DataFrame(records, columns=columns), geometry="geometry", crs=poses.crs)


def _xy(poses: gpd.GeoDataFrame) -> NDArray[np.float64]:
    """Places (n, 2), two at least, without those at which the robot stood still."""
    xy = shapely.get_coordinates(poses.geometry.to_numpy())
    kept = [next(group) for _, group in groupby(range(len(xy)), key=lambda k: tuple(xy[k]))]
    return xy[kept] if len(kept) > 1 else xy[:2]
