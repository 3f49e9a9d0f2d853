"""Troubles of odometry: drives over ground that is known, spoilt by what fools cameras, and what becomes of them."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.measure.odometry.trials import FAILURE, template_error
from vinemap.odometry.field import MEMORY
from vinemap.odometry.frames import Frame
from vinemap.odometry.poses import moved
from vinemap.odometry.track import follow
from vinemap.simulate.camera import LOW, Ground, Weather, lay_ground, render, rough, wander
from vinemap.simulate.grounds import RESOLUTION
from vinemap.simulate.steps import HILLS, ROOM

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from vinemap.compute.arrays import Image, Values
    from vinemap.odometry.poses import Pose

    Lens = Callable[[Values, int], Values]
    """What becomes of a frame before its noise, by its number."""

NOISE = 3.0
"""Grey levels."""
LENGTH = 50
"""Steps of a drive."""
SHAPE = LOW.height, LOW.width
AGAIN = 0.15
"""Share of frames that a recorder repeats, or during which a robot stands still."""
LASTS = 25
"""Frames for which drops stay on the lens."""


class Outcome(NamedTuple):
    """What became of the steps of drives."""

    n_steps: int
    """Those that can be measured: frames but the first one and those repeated."""
    believed: int
    wrong: int
    """Believed, and off by more than :data:`vinemap.measure.odometry.trials.FAILURE`."""


class Trouble(NamedTuple):
    """What spoils a drive: its ground, its lens, or its order."""

    lens: Callable[[np.random.Generator], Lens] | None = None
    ground: Callable[[Ground, int], Ground] | None = None
    relief_mm: float = 0.0
    repeats: bool = False
    stands: bool = False


def drive(trouble: Trouble, ground: str | Path, n: int, *, seed: int = 0) -> tuple[list[Image], list[Pose], list[bool]]:
    """Frames, true poses, and which frames are repeated, of a robot that wanders over a ground."""
    rng = np.random.default_rng(seed)
    laid = lay_ground(ground, size_mm=ROOM, seed=seed)
    if trouble.ground:
        laid = trouble.ground(laid, seed)
    if trouble.relief_mm:
        laid = rough(laid, amplitude_mm=trouble.relief_mm, correlation_mm=HILLS, seed=seed)
    poses = wander(n, seed=seed)
    again = (rng.uniform(size=n) < AGAIN) & (np.arange(n) > 0)
    if trouble.stands:
        poses = [poses[k // 3] for k in range(n)]
    lens = trouble.lens(rng) if trouble.lens else None
    images: list[Image] = []
    repeated = [bool(flag) and trouble.repeats for flag in again]
    for k, pose in enumerate(poses):
        if repeated[k]:
            images.append(images[-1])
            continue
        values = render(laid, pose, weather=Weather(noise=0.0)).astype(np.float32)
        values = lens(values, k) if lens else values
        images.append(np.clip(np.rint(values + rng.normal(0, NOISE, SHAPE)), 0, 255).astype(np.uint8))
    return images, poses, repeated


def outcome(images: Sequence[Image], poses: Sequence[Pose], repeated: Sequence[bool]) -> Outcome:
    """Follow a drive, and hold every step that is believed against the truth."""
    track = list(follow((Frame(str(k), None, image) for k, image in enumerate(images)), camera=LOW, foresight=MEMORY))
    believed = wrong = 0
    for k, point in enumerate(track):
        if point.measured_from is None:
            continue
        step = moved(track[point.measured_from].pose, point.pose)
        off = template_error(step, moved(poses[point.measured_from], poses[k]), LOW)
        believed += not repeated[k]
        wrong += off > FAILURE
    return Outcome(len(images) - 1 - sum(repeated), believed, wrong)


def troubles(grounds: Sequence[str | Path], steps: int, *, seed: int = 0) -> dict[str, Outcome]:
    """What becomes of so many steps of each trouble, shared out among drives over the grounds."""
    found = {}
    for name, trouble in TROUBLES.items():
        drives = [
            drive(trouble, grounds[k % len(grounds)], LENGTH + 1, seed=seed + k) for k in range(-(-steps // LENGTH))
        ]
        found[name] = Outcome(*map(sum, zip(*(outcome(*driven) for driven in drives), strict=True)))
    return found


def _spots(rng: np.random.Generator, count: int, sizes: tuple[int, int]) -> Values:
    """Blurred spots (ny, nx) at random, 1 in their middles."""
    import cv2

    spots = np.zeros(SHAPE, np.float32)
    for _ in range(count):
        at = int(rng.integers(SHAPE[1])), int(rng.integers(SHAPE[0]))
        cv2.circle(spots, at, int(rng.integers(*sizes, endpoint=True)), 1.0, -1)
    return np.asarray(cv2.GaussianBlur(spots, (0, 0), 2.0))


def _clouds(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Values:
    """Smooth values from 0 to 1, half of them steeply between."""
    import cv2

    values = np.asarray(cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), sigma))
    return np.asarray(0.5 + 0.5 * np.tanh(2 * values / values.std()))


def dirt(rng: np.random.Generator, *, count: int) -> Lens:
    """Dark spots of 5 to 12 pixels, half as bright."""
    clear = 1 - 0.5 * _spots(rng, count, (5, 12))
    return lambda values, _: values * clear


def half_dirty(rng: np.random.Generator) -> Lens:
    """Mud on one half of the lens."""
    clear = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, 0.15 + 0.5 * _clouds(rng, SHAPE, 6.0), 1.0)
    return lambda values, _: values * clear


def vignette(rng: np.random.Generator, *, edge: float = 0.3) -> Lens:
    """Corners that have a share of the light."""
    del rng
    light = 1 - (1 - edge) * _from_middle() ** 2
    return lambda values, _: values * light


def headlight(rng: np.random.Generator) -> Lens:
    """A lamp at night that rides with the camera."""
    del rng
    light = 0.06 + 1.1 * np.exp(-((2.2 * _from_middle()) ** 2))
    return lambda values, _: values * light


def text(rng: np.random.Generator) -> Lens:
    """A name, and a time that runs, burnt into frames."""
    del rng
    import cv2

    def burnt(values: Values, k: int) -> Values:
        letters = np.zeros(SHAPE, np.uint8)
        for line, at in (("CAM 01  VINEYARD", (8, 24)), (f"2026-05-14 08:{k // 60:02d}:{k % 60:02d}", (8, 228))):
            cv2.putText(letters, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2)
        return np.maximum(values, letters)

    return burnt


def shadows(rng: np.random.Generator) -> Lens:
    """Leaves' shadows that move over the ground as they like."""
    shade = _clouds(rng, (SHAPE[0] + 400, SHAPE[1] + 400), 14.0)
    ways = rng.uniform(-25, 25, (4000, 2)).cumsum(axis=0)

    def fallen(values: Values, k: int) -> Values:
        i, j = np.abs((ways[k].astype(int) + 200) % 800 - 400)
        return values * (0.5 + 0.5 * shade[i : i + SHAPE[0], j : j + SHAPE[1]])

    return fallen


def own_shadow(rng: np.random.Generator) -> Lens:
    """The robot's own shadow, that rides with it."""
    del rng
    x, y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    light = 1 - 0.6 / (1 + np.exp(-(0.6 * x + y - 220) / 2.0))
    return lambda values, _: values * light


def drops(rng: np.random.Generator) -> Lens:
    """Rain drops on the lens, others after a while: ground is smeared in them."""
    import cv2

    seeds = rng.integers(1 << 30, size=1000)

    def wet(values: Values, k: int) -> Values:
        share = _spots(np.random.default_rng(seeds[k // LASTS]), 25, (6, 16))
        return values * (1 - share) + share * (0.9 * cv2.GaussianBlur(values, (0, 0), 12.0) + 25)

    return wet


def grate(ground: Ground, seed: int, *, own: float) -> Ground:
    """Bars every 30 to 60 mm both ways, with a share of the ground's own contrast in between."""
    rng = np.random.default_rng(seed)
    period = rng.uniform(30, 60) / RESOLUTION
    ny, nx = ground.image.shape
    bars = np.maximum(np.cos(2 * np.pi * np.arange(nx) / period), np.cos(2 * np.pi * np.arange(ny) / period)[:, None])
    values = ground.image.astype(np.float32)
    values = values.mean() + own * (values - values.mean()) + 50 * np.tanh(4 * (bars - 0.7))
    return ground._replace(image=np.clip(values, 0, 255).astype(np.uint8))


def _from_middle() -> Values:
    """Distance (ny, nx) from the middle of a frame, 1 in its corners."""
    x, y = np.linspace(-1, 1, SHAPE[1]), np.linspace(-1, 1, SHAPE[0])[:, None]
    return np.asarray(np.hypot(x * SHAPE[1], y * SHAPE[0]) / np.hypot(*SHAPE))


LENSES: dict[str, Callable[[np.random.Generator], Lens]] = {
    **{f"{count} spots of dirt": partial(dirt, count=count) for count in (5, 20, 60)},
    "mud on half of the lens": half_dirty,
    "vignette": vignette,
    "headlight at night": headlight,
    "text": text,
    "the robot's shadow": own_shadow,
    "shadows that move": shadows,
    "rain drops": drops,
}
TROUBLES = {
    "none": Trouble(),
    "standing still now and then": Trouble(stands=True),
    **{name: Trouble(lens) for name, lens in LENSES.items()},
    "20 spots, standing still now and then": Trouble(partial(dirt, count=20), stands=True),
    "repeated frames": Trouble(repeats=True),
    "20 spots, repeated frames": Trouble(partial(dirt, count=20), repeats=True),
    "grate": Trouble(ground=partial(grate, own=1.0)),
    "grate on faint ground": Trouble(ground=partial(grate, own=0.25)),
    **{f"relief of {relief} mm": Trouble(relief_mm=relief) for relief in (8, 20, 40, 60)},
}
