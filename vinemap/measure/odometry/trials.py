"""Trials of odometry on simulated frames whose movement is known: random steps, paths, and pairs without an answer."""

from __future__ import annotations

import time
from collections import deque
from functools import partial, reduce
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.odometry.frames import Frame
from vinemap.odometry.poses import STILL, Pose, moved, onward
from vinemap.odometry.step import estimate_motion
from vinemap.odometry.track import follow
from vinemap.simulate.camera import HIGH, LOW, lay_ground, render, sinusoid, wander
from vinemap.simulate.steps import ROOM, beyond, unrelated, walk

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from vinemap.compute.arrays import Flags, Image, Values
    from vinemap.config.camera import Camera
    from vinemap.odometry.refinement import Method
    from vinemap.odometry.step import Strategy
    from vinemap.simulate.steps import Step

    Follower = Callable[[Sequence[Image]], tuple[Pose, Values | None]]
    """Movement from the first frame of a path to its last, and its covariance (3, 3) in mm and degrees if told."""

    ByMethod = Mapping[Method, "Errors"]

METHODS: tuple[Method, ...] = ("maximum", "centroid", "quadratic", "aligned")
CAMERAS = {"320 × 240": LOW, "1280 × 720": HIGH}
SHARES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8)
LARGEST_SHARE = 0.35
"""Templates up to which a step of 70 mm is in the next frame."""
RELIEFS = ("8 mm, the truth", "25 mm, the truth", "25 mm, 1280 × 720")
"""From the lowest to the highest point, and what errors are measured against."""
TIMED = 12
"""Frames of which pairs are timed."""
FAILURE = 5.0
"""Millimetres from which on a step is wrong."""


class Errors(NamedTuple):
    """What is wrong with steps."""

    offset: Values
    """Error (n, 2) of the template's place in mm, forward and to the left."""
    turn: Values
    """|error| (n,) of the rotation in degrees (Eq. 14)."""
    flagged: Flags

    @property
    def place(self) -> Values:
        """|error| (n,) of the template's place in mm (Eq. 13)."""
        return np.asarray(np.hypot(*self.offset.T))

    @property
    def wrong(self) -> Flags:
        """Whether a step is lost (n,)."""
        return np.asarray(self.place > FAILURE)

    @property
    def cep(self) -> float:
        """Circular error probable in mm: half of the steps are better."""
        return float(np.median(self.place))


class Losses(NamedTuple):
    """What becomes of random steps on a ground, and of pairs of frames that show little or nothing of the same."""

    contrast: float
    """Standard deviation of its frames in grey levels, their mean."""
    steps: Errors
    unrelated: Flags
    """Whether two frames of different ground are flagged."""
    beyond: Errors


class Size(NamedTuple):
    """What becomes of pairs of frames with one size of the template."""

    share: float
    seconds: dict[str, float]
    """Of a pair, by resolution."""
    most_mm: float
    """How far the template may move before it leaves the next frame."""
    errors: ByMethod
    """None where the template is too large for steps of 70 mm."""

    def speed(self, seconds: float) -> float:
        """Highest speed in m/s if a pair takes so long."""
        return self.most_mm / 1000 / seconds


class Drift(NamedTuple):
    """Error at the end of paths."""

    place: Values
    """Millimetres a metre (n,) of their length."""
    turn: Values
    """Degrees a metre (n,)."""
    squared: Values
    """Squared error (n,) in what the covariance tells of it, 3 on the mean if that is right; NaN if none is told."""


def template_offset(movement: Pose, truth: Pose, camera: Camera) -> Values:
    """Millimetres (2,) in the next frame from where the middle of a frame is to where it is found."""
    x, y = camera.ground(camera.width // 2, camera.height // 2)
    found, true = (moved(step, Pose(x, y, 0.0)) for step in (movement, truth))
    return np.array([found.x_mm - true.x_mm, found.y_mm - true.y_mm])


def template_error(movement: Pose, truth: Pose, camera: Camera) -> float:
    """Length of :func:`template_offset`."""
    return float(np.hypot(*template_offset(movement, truth, camera)))


def referred(steps: Iterable[Step], fine: Iterable[Step]) -> Iterator[Step]:
    """Steps whose truth is what is measured in the high resolution: the thesis's reference."""
    for (frame, next_frame, _), (*pair, _) in zip(steps, fine, strict=True):
        yield frame, next_frame, estimate_motion(*pair, camera=HIGH).movement


def measure(
    steps: Iterable[Step], methods: Sequence[Method] = METHODS, *, template_share: float = 0.2
) -> dict[Method, Errors]:
    """Errors of methods on the same steps."""
    found: dict[Method, list[tuple[Values, float, bool]]] = {method: [] for method in methods}
    for frame, next_frame, truth in steps:
        for method, errors in found.items():
            motion = estimate_motion(frame, next_frame, camera=LOW, method=method, template_share=template_share)
            offset = template_offset(motion.movement, truth, LOW)
            errors.append((offset, abs(motion.rotation_deg - truth.heading_deg), motion.flag != ""))
    return {method: Errors(*map(np.array, zip(*errors, strict=True))) for method, errors in found.items()}


def pool(errors: Sequence[ByMethod]) -> ByMethod:
    """Errors of several grounds as those of one."""
    return {m: Errors(*map(np.concatenate, zip(*(e[m] for e in errors), strict=True))) for m in errors[0]}


def relief_errors(steps: int, *, seed: int = 0) -> dict[str, ByMethod]:
    """Errors on grass with relief, of each of :data:`RELIEFS`."""
    rough = partial(walk, "grass", steps, seed=seed)
    on_high = referred(rough(relief_mm=25.0), rough(relief_mm=25.0, camera=HIGH))
    walks = rough(relief_mm=8.0), rough(relief_mm=25.0), on_high
    return {name: measure(taken) for name, taken in zip(RELIEFS, walks, strict=True)}


def size_of(
    share: float, frames: Mapping[str, Sequence[Image]], grounds: Sequence[str | Path], steps: int, *, seed: int = 0
) -> Size:
    """Time pairs of frames of each of :data:`CAMERAS`, and measure errors on grounds."""
    seconds = {name: seconds_of(frames[name], camera=camera, template_share=share) for name, camera in CAMERAS.items()}
    most = (1 - share) / 2 * LOW.height * LOW.above_ground_mm / LOW.fy
    if share > LARGEST_SHARE:
        return Size(share, seconds, most, {})
    walks = (walk(ground, steps, seed=seed + 1000 * k) for k, ground in enumerate(grounds))
    errors = [measure(taken, ["maximum", "aligned"], template_share=share) for taken in walks]
    return Size(share, seconds, most, pool(errors))


def frames_to_time() -> dict[str, list[Image]]:
    """Frames of each of :data:`CAMERAS` over the same gravel."""
    ground = lay_ground("gravel", size_mm=ROOM, seed=1)
    poses = wander(TIMED, seed=3)
    return {
        name: [render(ground, pose, camera=camera, seed=k) for k, pose in enumerate(poses)]
        for name, camera in CAMERAS.items()
    }


def losses(ground: str | Path, n: int, *, relief_mm: float = 0.0, seed: int = 0) -> Losses:
    """Take so many random steps, and a fifth as many pairs of the other kinds."""
    fewer = max(n // 5, 1)
    contrast = []

    def seen() -> Iterator[Step]:
        for step in walk(ground, n, relief_mm=relief_mm, seed=seed):
            contrast.append(step[0].std())
            yield step

    steps = measure(seen(), ["aligned"])["aligned"]
    strangers = unrelated(ground, fewer, relief_mm=relief_mm, seed=seed + 20_000)
    flagged = np.array([estimate_motion(*pair, camera=LOW).flag != "" for pair in strangers])
    far = measure(beyond(ground, fewer, relief_mm=relief_mm, seed=seed + 40_000), ["aligned"])["aligned"]
    return Losses(float(np.mean(contrast)), steps, flagged, far)


def seconds_of(
    frames: Sequence[Image], *, camera: Camera, template_share: float = 0.2, search: Strategy = "coarse to fine"
) -> float:
    """Seconds of a pair of frames, the median of all that follow each other; the first is done once before."""
    took = []
    for frame, next_frame in [*pairwise(frames[:2]), *pairwise(frames)]:
        began = time.perf_counter()
        estimate_motion(frame, next_frame, camera=camera, template_share=template_share, search=search)
        took.append(time.perf_counter() - began)
    return float(np.median(took[1:]))


def step_by_step(frames: Sequence[Image], *, method: Method) -> tuple[Pose, None]:
    """Movement from the first frame to the last, by those from each to the next."""
    steps = (estimate_motion(*pair, camera=LOW, method=method).movement for pair in pairwise(frames))
    return reduce(onward, steps, STILL), None


def by_keyframes(frames: Sequence[Image]) -> tuple[Pose, Values]:
    """The same by :func:`vinemap.odometry.track.follow`."""
    named = (Frame(str(k), None, image) for k, image in enumerate(frames))
    (last,) = deque(follow(named, camera=LOW), maxlen=1)
    return last.pose, last.covariance


FOLLOWERS: dict[str, Follower] = {
    **{method: partial(step_by_step, method=method) for method in METHODS},
    "keyframes": by_keyframes,
}


def drifts(
    grounds: Sequence[str | Path],
    count: int,
    *,
    followers: Mapping[str, Follower] = FOLLOWERS,
    length_mm: float = 9600.0,
    seed: int = 0,
) -> dict[str, Drift]:
    """Errors that ways to follow frames gather along the thesis's sinusoidal path, on ground after ground."""
    poses, length = path(length_mm)
    gathered: dict[str, list[tuple[float, float, float]]] = {name: [] for name in followers}
    for k in range(count):
        frames = views(poses, grounds[k % len(grounds)], length_mm, seed=seed + k)
        for name, followed in followers.items():
            pose, covariance = followed(frames)
            off = moved(moved(poses[0], poses[-1]), pose)
            squared = np.nan if covariance is None else _squared(moved(poses[0], poses[-1]), pose, covariance)
            gathered[name].append((float(np.hypot(*off[:2])) / length, abs(off.heading_deg) / length, squared))
    return {name: Drift(*np.transpose(errors)) for name, errors in gathered.items()}


def path(length_mm: float) -> tuple[list[Pose], float]:
    """Poses along the thesis's sinusoidal path of so many millimetres ahead, and metres of the way along it."""
    poses = [pose._replace(x_mm=pose.x_mm - length_mm / 2 - LOW.x_mm) for pose in sinusoid(length_mm=length_mm)]
    return poses, sum(float(np.hypot(*moved(*step)[:2])) for step in pairwise(poses)) / 1000


def views(poses: Sequence[Pose], ground: str | Path, length_mm: float, *, seed: int) -> list[Image]:
    """What a camera sees of ground at poses along such a path."""
    laid = lay_ground(ground, size_mm=(length_mm + 700.0, 1100.0), seed=seed)
    return [render(laid, pose, seed=1000 * seed + i) for i, pose in enumerate(poses)]


def _squared(truth: Pose, pose: Pose, covariance: Values) -> float:
    """Squared error of a pose, normalised by its covariance."""
    turn = (pose.heading_deg - truth.heading_deg + 180) % 360 - 180
    off = np.array([pose.x_mm - truth.x_mm, pose.y_mm - truth.y_mm, turn])
    return float(off @ np.linalg.solve(covariance, off))
