"""Lost stretches, and what bridges them: wheels, satellite fixes at both ends of a path, or both."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.measure.odometry.trials import path, views
from vinemap.odometry.frames import Frame
from vinemap.odometry.poses import moved
from vinemap.odometry.sensors.bridging import bridged, joined
from vinemap.odometry.sensors.fixes import Fixes
from vinemap.odometry.sensors.wheels import Odometer, Wheels
from vinemap.odometry.track import follow
from vinemap.simulate.camera import LOW

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vinemap.compute.arrays import Flags, Values
    from vinemap.odometry.poses import Pose
    from vinemap.odometry.track import TrackPoint

LOST, STRETCHES = 0.2, 4
"""Share of a path's frames that show nothing, and in how many stretches they are."""
PERIOD = 0.2
"""Seconds from a frame to the next."""
SCALE, SLIP = 0.05, 0.02
"""Standard deviations of wheel speeds: of all of a path, and of each sample, as shares."""
DRIFT, JITTER = 0.5, 0.2
"""The same of yaw rates in °/s."""
ACCURACY = 20.0
"""Of satellite fixes in mm, in the horizontal: the root of the mean square of their distances (DRMS)."""


class Bridge(NamedTuple):
    """What is wrong with paths of which stretches are lost."""

    worst: Values
    """Millimetres (n,) by which a pose is off at most."""
    end: Values
    """Millimetres (n,) by which the last one is."""
    length: float
    """Of a path in metres."""


def bridges(
    grounds: Sequence[str | Path], count: int, *, length_mm: float = 9600.0, seed: int = 0
) -> dict[str, Bridge]:
    """Errors of tracks along the thesis's sinusoidal path, on ground after ground, by what bridges lost stretches."""
    poses, length = path(length_mm)
    true = [moved(poses[0], pose) for pose in poses]
    times = PERIOD * np.arange(len(poses))
    found: dict[str, list[Values]] = {}
    for k in range(count):
        rng = np.random.default_rng(seed + k)
        seen = views(poses, grounds[k % len(grounds)], length_mm, seed=seed + k)
        lost = lost_frames(len(poses), rng)
        frames = [Frame(str(i), float(times[i]), None if lost[i] else image) for i, image in enumerate(seen)]
        odometer = Odometer(wheels_of(true, rng))
        sd = np.full(2, ACCURACY / np.sqrt(2))
        ends = np.array([true[0][:2], true[-1][:2]]) + rng.normal(0, sd, (2, 2))
        fixes = Fixes(times[[0, -1]], ends, sd)
        alone, driven = (list(follow(iter(frames), camera=LOW, sensor=sensor)) for sensor in (None, odometer))
        tracks = {
            "the last movement": alone,
            "steps beside them": bridged(alone),
            "wheels": bridged(driven, odometer),
            "fixes at both ends": joined(alone, fixes).track,
            "wheels, fixes at both ends": joined(driven, fixes, odometer).track,
        }
        for name, track in tracks.items():
            found.setdefault(name, []).append(_off(track, true))
    return {
        name: Bridge(np.array([off.max() for off in errors]), np.array([off[-1] for off in errors]), length)
        for name, errors in found.items()
    }


def lost_frames(n: int, rng: np.random.Generator) -> Flags:
    """Which of so many frames are lost (n,): stretches alike, one in each part of the path, not at its ends."""
    lost = np.zeros(n, dtype=bool)
    long = round(LOST * n / STRETCHES)
    for part in np.array_split(np.arange(5, n - 5), STRETCHES):
        begin = part[0] + rng.integers(len(part) - long)
        lost[begin : begin + long] = True
    return lost


def wheels_of(poses: Sequence[Pose], rng: np.random.Generator) -> Wheels:
    """What wheels and a gyroscope would tell of a path, at its frames."""
    steps = np.array([moved(*step) for step in pairwise(poses)])
    n = len(poses)
    speeds, rates = (np.interp(np.arange(n), np.arange(n - 1) + 0.5, steps[:, c]) / PERIOD for c in (0, 2))
    speeds = speeds * (1 + SCALE * rng.normal()) * (1 + SLIP * rng.normal(size=n))
    rates = rates + DRIFT * rng.normal() + JITTER * rng.normal(size=n)
    return Wheels(PERIOD * np.arange(n), speeds, rates)


def _off(track: Sequence[TrackPoint], true: Sequence[Pose]) -> Values:
    """Millimetres (n,) by which poses are off."""
    return np.array([np.hypot(*np.subtract(point.pose[:2], pose[:2])) for point, pose in zip(track, true, strict=True)])
