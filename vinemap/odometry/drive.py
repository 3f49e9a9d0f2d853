"""A robot's drive: from the recording of its camera to a GeoPackage of its track."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import shapely

from vinemap.errors import InputError, OutputError
from vinemap.evaluate.reference import read_lines
from vinemap.geo.crs import WGS84, metric_crs
from vinemap.odometry.field import MEMORY
from vinemap.odometry.frames import read_recording
from vinemap.odometry.layers import NOWHERE, TRACK_LAYERS, beside_rows, track_layers
from vinemap.odometry.poses import STILL, moved
from vinemap.odometry.sensors.bridging import bridged, joined
from vinemap.odometry.sensors.files import check_times
from vinemap.odometry.sensors.fixes import read_fixes
from vinemap.odometry.sensors.wheels import Odometer, read_wheels
from vinemap.odometry.step import ANGLES
from vinemap.odometry.track import TrackPoint, follow
from vinemap.product.geopackage import check_replaced, write_geopackage
from vinemap.product.store import drafted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    import geopandas as gpd
    from pyproj import CRS

    from vinemap.config.camera import Camera
    from vinemap.config.drives import Start
    from vinemap.odometry.frames import Frame
    from vinemap.odometry.refinement import Method
    from vinemap.odometry.sensors.fixes import Fixes
    from vinemap.odometry.sensors.wheels import Wheels

STAGES = ("Following the robot", "Placing its track", "Writing")

LEAST_WAY, TOLD_OFF, MOST_OFF = 300.0, 0.05, 2.0
"""Millimetres from which on wheels are held against frames, and how far they may differ, as a share and a factor."""
MOST_SUNK = 0.02
"""Share of the camera's height by which it may change before that is said."""


class DriveSummary(NamedTuple):
    """What became of a recording."""

    out: Path
    n_frames: int
    n_missing: int
    """Frames that the recording announces and doesn't have."""
    flags: dict[str, int]
    """How many poses have each flag."""
    length_m: float
    n_stretches: int
    remarks: tuple[str, ...] = ()
    """What is to be known of other sensors."""
    sunk: float = 0.0
    """Share of its height by which the camera came closer to the ground than its file says, at most."""

    def line(self) -> str:
        """The same in one line."""
        said = [f"{self.out}: {self.length_m:.2f} m in {self.n_frames} frames"]
        if self.n_missing:
            said.append(f"the recording promises {self.n_missing} more")
        if self.flags:
            reasons = ", ".join(f"{count} {flag}" for flag, count in sorted(self.flags.items()))
            said.append(f"{sum(self.flags.values())} flagged ({reasons})")
        if self.n_stretches > 1:
            said.append(f"in {self.n_stretches} stretches that no frame joins")
        said += self.remarks
        if abs(self.sunk) > MOST_SUNK:
            said.append(f"ground came {100 * self.sunk:.0f}% closer than above_ground_mm: distances are as wrong there")
        return "; ".join(said)


def map_drive(
    recording: Sequence[Path],
    out: Path,
    *,
    camera: Camera,
    start: Start | None = None,
    rows: Path | None = None,
    motion: Path | None = None,
    fixes: Path | None = None,
    template_share: float = 0.2,
    angles: tuple[float, float] = ANGLES,
    method: Method = "aligned",
    show: Callable[[Iterable[Frame], int | None], Iterable[Frame]] = lambda frames, _: frames,
    step: Callable[..., Any] = lambda _, function, *args: function(*args),
) -> DriveSummary:
    """Follow a robot through a recording and write its track.

    Parameters
    ----------
    recording : sequence of Path
        Images, folders of images, and videos: see :func:`vinemap.odometry.frames.read_recording`.
    out : Path
        GeoPackage to write, in place of an earlier track.
    camera, template_share, angles, method
        As for :func:`vinemap.odometry.step.estimate_motion`.
    start : Start, optional
        Where the first frame was taken; without it the track has no place on the map.
    rows : Path, optional
        Vine rows, for the distance to the nearest one; the track is in their CRS if that is metric. Wants a start.
    motion : Path, optional
        CSV of wheel speeds and yaw rates, which bridge what frames don't tell.
    fixes : Path, optional
        CSV of satellite fixes, which pull the track. Wants a start.
    show : callable
        Is given the frames and their number, where that is known, and gives them on: progress.
    step : callable
        Is given each stage's name of ``STAGES``, its function and that one's arguments, and calls it.

    Raises
    ------
    InputError
        If a path holds no frames, or nothing can be measured, or the rows can't be used.
    OutputError
        If the GeoPackage can't be written, or the file there holds something else.
    """
    _check_out(out, rows)
    if rows and not start:
        raise InputError(f"{rows}: distances from rows need a start: give --start lat,lon,heading")
    lines = _rows_of(rows) if rows else None
    sensors = _read_sensors(motion, fixes, start)
    odometer = Odometer(sensors.wheels) if sensors.wheels else None
    source = read_recording(recording, camera=camera)

    def followed() -> list[TrackPoint]:
        frames = show(source.frames, source.n_frames)
        told = follow(
            frames,
            camera=camera,
            template_share=template_share,
            angles=angles,
            method=method,
            foresight=MEMORY,
            sensor=odometer,
        )
        return list(told)

    placed = partial(_placed, start=start, rows=lines)
    if lines is not None:  # whether start and rows go together
        placed([TrackPoint("", None, STILL, np.zeros((3, 3)), np.zeros((3, 3)), camera.above_ground_mm)])
    track = step(STAGES[0], followed)
    _check_track(track, recording, camera)
    track, remarks = step(STAGES[1], _held_against, sensors, odometer, track)
    layers = step(STAGES[1], placed, track)
    step(STAGES[2], _write, layers, out)
    flags = [point.flag for point in track if point.flag]
    return DriveSummary(
        out,
        n_frames=len(track),
        n_missing=max(0, (source.n_frames or 0) - len(track)),
        flags={flag: flags.count(flag) for flag in set(flags)},
        length_m=float(layers["track"]["length_m"].sum()),
        n_stretches=len(layers["track"]),
        remarks=remarks,
        sunk=max((1 - point.height_mm / camera.above_ground_mm for point in track), key=abs),
    )


class _Sensors(NamedTuple):
    """What goes with a camera, and from which files."""

    motion: Path | None
    wheels: Wheels | None
    fixes: Path | None
    known: Fixes | None


def _read_sensors(motion: Path | None, fixes: Path | None, start: Start | None) -> _Sensors:
    if fixes and not start:
        raise InputError(f"{fixes}: fixes need a start: give --start lat,lon,heading, roughly")
    known = read_fixes(fixes, start) if fixes and start else None
    return _Sensors(motion, read_wheels(motion) if motion else None, fixes, known)


def _held_against(
    sensors: _Sensors, odometer: Odometer | None, track: list[TrackPoint]
) -> tuple[list[TrackPoint], tuple[str, ...]]:
    """A track whose gaps are crossed and which is pulled to fixes, and what is to be said of the sensors."""
    motion, wheels, fixes, known = sensors
    remarks: list[str] = []
    if motion and wheels:
        check_times(motion, wheels.times, track)
        if wheels.left_out:
            remarks.append(f"{wheels.left_out} lines of {motion} left out")
        remarks += _against_wheels(motion, wheels, track)
    if not (fixes and known):
        return bridged(track, odometer), tuple(remarks)
    check_times(fixes, known.times, track)
    track, far, fit = joined(track, known, odometer)
    if odd := known.left_out + far:
        remarks.append(f"{odd} of {known.left_out + len(known.sd)} fixes left out")
    if not fit:
        remarks.append("fixes contradict the track by more than both err")
    return track, tuple(remarks)


def _placed(
    track: Sequence[TrackPoint], *, start: Start | None, rows: gpd.GeoDataFrame | None
) -> dict[str, gpd.GeoDataFrame]:
    """A track's layers on the map."""
    layers = track_layers(track, start=start, crs=_crs_of(start, rows))
    return layers if rows is None else layers | {"poses": beside_rows(layers["poses"], rows)}


def _against_wheels(path: Path, wheels: Wheels, track: Sequence[TrackPoint]) -> list[str]:
    """What wheels say otherwise than frames, in a line; InputError if it is so much that their unit must be wrong."""
    seen = by_wheels = 0.0
    for before, point in pairwise(track):
        driven = wheels.between(before.time, point.time, STILL)
        if driven and not before.flag and not point.flag:
            seen += float(np.hypot(*moved(before.pose, point.pose)[:2]))
            by_wheels += float(np.hypot(*driven[0][:2]))
    if not (seen > LEAST_WAY and np.isfinite(wheels.speeds).all()):
        return []
    ratio = by_wheels / seen
    if not 1 / MOST_OFF < ratio < MOST_OFF:
        raise InputError(f"{path}: speeds make {ratio:.2g} of the way that frames show: is the unit the column's?")
    return [f"wheels say {100 * (ratio - 1):+.0f}% of the way"] if abs(ratio - 1) > TOLD_OFF else []


def _rows_of(path: Path) -> gpd.GeoDataFrame:
    """The lines of a file that aren't empty."""
    rows = read_lines(path)
    shapes = rows.geometry.to_numpy()
    rows = rows[~(shapely.is_missing(shapes) | shapely.is_empty(shapes))]
    if len(rows) == 0:
        raise InputError(f"{path}: holds no row: give a GeoPackage with vine rows")
    if rows.crs is None:
        raise InputError(f"{path}: has no CRS: save the rows with it, in QGIS say")
    return rows


def _crs_of(start: Start | None, rows: gpd.GeoDataFrame | None) -> CRS:
    """CRS of a track: the rows' if it is metric, else the UTM zone of the start."""
    if start is None:
        return NOWHERE
    if rows is None:
        return metric_crs(WGS84, start.lon, start.lat)
    west, south, east, north = rows.total_bounds
    return metric_crs(rows.crs, (west + east) / 2, (south + north) / 2)


def _check_track(track: Sequence[TrackPoint], recording: Sequence[Path], camera: Camera) -> None:
    """Raise InputError if nothing was measured."""
    name = recording[0]
    if any(point.measured_from is not None for point in track):
        return
    used = [point for point in track if point.flag not in ("unreadable", "size")]
    if len(used) > 1:
        flags = ", ".join(sorted({point.flag for point in used} - {""}))
        raise InputError(f"{name}: none of {len(track)} frames could be measured from another ({flags})")
    if len(track) == 1:
        raise InputError(f"{name}: one frame alone shows no movement: give two at least")
    wrong = sum(point.flag == "size" for point in track)
    if wrong:
        raise InputError(
            f"{name}: {wrong} of {len(track)} frames don't have the camera's {camera.width} × {camera.height} pixels: "
            "give the camera file of these frames"
        )
    raise InputError(f"{name}: {len(track) - len(used)} of {len(track)} frames can't be read: give two at least")


def _check_out(out: Path, rows: Path | None) -> None:
    """Raise OutputError where a track would be written over something else, or can't be written."""
    if out.suffix.lower() != ".gpkg" or "!" in str(out):
        raise OutputError(f"{out}: a track is a GeoPackage: give a name that ends in .gpkg, without '!'")
    if not out.parent.is_dir():
        raise OutputError(f"{out}: its folder isn't there: make it first")
    if rows and out.exists() and rows.exists() and out.samefile(rows):
        raise OutputError(f"{out}: holds the rows: choose another file for the track")
    check_replaced(out, "a track", known=TRACK_LAYERS, needed=["track", "poses"])


def _write(layers: dict[str, gpd.GeoDataFrame], out: Path) -> None:
    try:
        with drafted(out.resolve(), ".gpkg") as draft:
            write_geopackage(layers, draft, contract=TRACK_LAYERS)
    except OSError as error:
        raise OutputError(f"{out}: can't be written ({error.strerror or error}): choose another file") from error
