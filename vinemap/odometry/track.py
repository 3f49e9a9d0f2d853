"""The track of a robot: the poses of its frames, each measured from an earlier frame, or guessed and flagged."""

from __future__ import annotations

from collections import Counter
from itertools import chain, islice
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vinemap.odometry.field import cleaner_of, field_of, learned
from vinemap.odometry.frames import repeats
from vinemap.odometry.poses import STILL, Pose, moved, onward, onward_covariance
from vinemap.odometry.step import ANGLES, expected_overlap, motion_between
from vinemap.odometry.views import LEAST_CONTRAST, view_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from vinemap.compute.arrays import Values
    from vinemap.config.camera import Camera
    from vinemap.odometry.frames import Frame
    from vinemap.odometry.refinement import Method
    from vinemap.odometry.step import Motion
    from vinemap.odometry.views import View


UNSURE_MM, UNSURE_SHARE, UNSURE_DEG = 5.0, 0.5, 3.0
"""Standard deviation of a movement that is carried on: millimetres and a share of it along an axis, and degrees."""
TIE_MM = 5.0
"""Millimetres within which a place of a pattern is the one that wheels tell."""
KEY_OVERLAP = 0.4
"""Share of a frame that a keyframe must have in common with the frames that are measured from it."""


class Sensor(Protocol):
    """What else knows how a robot moves."""

    def between(self, start: float | None, end: float | None, usual: Pose) -> tuple[Pose, Values] | None:
        """Movement and covariance from a time to another, if it knows, given the last movement."""

    def learn(self, start: float | None, end: float | None, seen: Pose) -> None:
        """Be held against a movement that frames tell."""


class TrackPoint(NamedTuple):
    """Where the robot was when a frame was taken."""

    frame: str
    time: float | None
    """Seconds, as the recording tells them."""
    pose: Pose
    """In the robot's frame at the first frame that shows something."""
    covariance: Values
    """Of the pose (3, 3), in mm and degrees."""
    of_step: Values
    """Of the movement (3, 3) from the frame from which it was measured, or else from the frame before."""
    height_mm: float
    """Of the camera above the ground, by how large ground is from frame to frame, if it was the camera's at first."""
    flag: str = ""
    """Why it couldn't be measured; empty where it was. A flagged pose is carried on by the last movement, or is the
    likeliest of several; once a track is bridged, by what crosses its gap."""
    measured_from: int | None = None
    """Number of the frame, from 0 on, from which it was measured."""
    motion: Motion | None = None
    """From there."""


class _Anchor(NamedTuple):
    """A frame from which others are measured."""

    number: int
    view: View
    pose: Pose
    covariance: Values
    height_mm: float


def follow(
    frames: Iterable[Frame],
    *,
    camera: Camera,
    template_share: float = 0.2,
    angles: tuple[float, float] = ANGLES,
    method: Method = "aligned",
    keyframes: bool = True,
    foresight: int = 0,
    sensor: Sensor | None = None,
) -> Iterator[TrackPoint]:
    """Follow a robot frame by frame, each pose told as soon as its frame is there.

    A frame is measured from a keyframe as long as both show enough of the same ground, as each measured step adds its
    error (Section 4.4); then the frame before becomes the keyframe. Where a step isn't to be believed, the frame is
    tried from the frame before as well; the pose is flagged if that doesn't help, and the next frames are tried from
    the last good frames first, which mends a single bad one, and else from the flagged one.

    Parameters
    ----------
    frames : iterable of Frame
        Each looked at once, and no more than four of them are kept, and those foreseen.
    camera, template_share, angles, method
        As for :func:`vinemap.odometry.step.estimate_motion`.
    keyframes : bool
        Whether frames are measured from keyframes, or each from the one before.
    foresight : int
        Frames that are looked at before the first pose is told, for what stays in them: dirt, text, shadows. Without
        it, that is known after the first :data:`vinemap.odometry.field.FEWEST` of different ground.
    sensor : Sensor, optional
        By it a pose is carried on, where it knows, and a pattern's places are told apart:
        :class:`vinemap.odometry.sensors.wheels.Odometer`.

    Raises
    ------
    InputError
        As for :func:`vinemap.odometry.step.estimate_motion`.
    """

    def measure(anchor: _Anchor, view: View, expected: Pose | None) -> Motion:
        return motion_between(
            anchor.view,
            view,
            camera=camera,
            template_share=template_share,
            angles=angles,
            method=method,
            expected=expected,
        )

    ahead = list(islice(frames := iter(frames), foresight))
    field = field_of(frame.image for frame in ahead if frame.image is not None)
    key = last = lost = None
    pose, velocity = STILL, STILL
    covariance: Values = np.zeros((3, 3))
    height = camera.above_ground_mm
    time: float | None = None
    shown: Frame | None = None
    for number, frame in enumerate(chain(ahead, frames)):
        driven = sensor.between(time, frame.time, velocity) if sensor else None
        step, of_step = driven or (velocity, _of_a_guess(velocity))
        covariance = onward_covariance(pose, covariance, step, of_step)
        pose = onward(pose, step)
        taken, time = time, frame.time
        guess = TrackPoint(frame.name, frame.time, pose, covariance, of_step, height)
        if frame.image is None or (shown is not None and repeats(shown, frame)):
            yield guess._replace(flag=frame.flaw or "repeated")
            continue
        shown = frame
        field = learned(field, frame.image)
        view = view_of(frame.image, camera=camera, method=method, cleaner=cleaner_of(field, camera))
        if view.contrast < LEAST_CONTRAST:
            yield guess._replace(flag="blank")
            continue
        if key is None or last is None:
            covariance = np.zeros((3, 3))
            key = last = _Anchor(number, view, pose, covariance, height)
            yield guess._replace(covariance=covariance)
            continue
        if not keyframes or expected_overlap(camera, moved(key.pose, pose)) < KEY_OVERLAP:
            key = last
        attempts = [(key, moved(key.pose, pose)), (last, moved(last.pose, pose)), (last, None)]
        attempts = attempts[key is last :] + ([(lost, None)] if lost else [])
        anchor, motion = _best(((anchor, measure(anchor, view, expected)) for anchor, expected in attempts))
        if motion.flag and not (driven and _tells_apart(motion, moved(anchor.pose, pose), number - anchor.number)):
            pose = onward(anchor.pose, motion.movement) if motion.flag == "ambiguous" else pose
            lost = _Anchor(number, view, pose, covariance, height)
            yield guess._replace(pose=pose, flag=motion.flag)
            continue
        pose = onward(anchor.pose, motion.movement)
        covariance = onward_covariance(anchor.pose, anchor.covariance, motion.movement, motion.covariance)
        height = anchor.height_mm / motion.scale
        before = anchor if anchor is lost else last
        if sensor and number == last.number + 1:
            sensor.learn(taken, frame.time, moved(last.pose, pose))
        velocity = _per_frame(moved(before.pose, pose), number - before.number)
        last, key, lost = _Anchor(number, view, pose, covariance, height), anchor, None
        yield TrackPoint(frame.name, frame.time, pose, covariance, motion.covariance, height, "", anchor.number, motion)


def stretches(track: Iterable[TrackPoint]) -> list[int]:
    """Number, from 1 on, of the unbroken stretch of the track that each pose belongs to; 0 for poses that are alone."""
    roots: list[int] = []
    for number, point in enumerate(track):
        roots.append(number if point.measured_from is None else roots[point.measured_from])
    counts = Counter(roots)
    known = {root: k for k, root in enumerate((r for r in counts if counts[r] > 1), start=1)}
    return [known.get(root, 0) for root in roots]


def _best(attempts: Iterable[tuple[_Anchor, Motion]]) -> tuple[_Anchor, Motion]:
    """The first step that is to be believed, else the first of several likely ones, else the first."""
    tried = []
    for anchor, motion in attempts:
        if not motion.flag:
            return anchor, motion
        tried.append((anchor, motion))
    return next((pair for pair in tried if pair[1].flag == "ambiguous"), tried[0])


def _tells_apart(motion: Motion, driven: Pose, frames: int) -> bool:
    """Whether wheels tell which of several places of a pattern is right."""
    off = moved(driven, motion.movement)
    return motion.flag == "ambiguous" and frames == 1 and float(np.hypot(off.x_mm, off.y_mm)) < TIE_MM


def _of_a_guess(velocity: Pose) -> Values:
    """Covariance (3, 3) of a movement that is taken to be the last one again."""
    place = UNSURE_MM + UNSURE_SHARE * float(np.hypot(velocity.x_mm, velocity.y_mm))
    return np.diag([place**2, place**2, UNSURE_DEG**2])


def _per_frame(movement: Pose, frames: int) -> Pose:
    return Pose(*(value / frames for value in movement))
