"""Steps of a virtual camera, each with the true movement: at random over ground after ground, and too long ones."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from vinemap.odometry.poses import Pose, moved
from vinemap.simulate.camera import LOW, above, lay_ground, render, rough, wander

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from vinemap.compute.arrays import Image
    from vinemap.config.camera import Camera
    from vinemap.simulate.camera import Ground

    Step = tuple[Image, Image, Pose]
    """Two frames and the movement between them."""

ROOM = (1000.0, 1000.0)
"""Millimetres of ground for robots that wander."""
PATCH = 60
"""Steps on one piece of ground; then another is laid."""
HILLS = 30.0
"""Millimetres at which the relief's correlation is 1/e."""
BEYOND = (0.3, 2.0)
"""Frame widths between cameras that see too little of the same."""


def steps_of(ground: Ground, poses: Sequence[Pose], *, camera: Camera = LOW, seed: int = 0) -> Iterator[Step]:
    """Frames of the poses of a path, pair by pair, each with the true movement."""
    frames = (render(ground, pose, camera=camera, seed=seed + k) for k, pose in enumerate(poses))
    for pair, step in zip(pairwise(frames), pairwise(poses), strict=True):
        yield *pair, moved(*step)


def walk(ground: str | Path, n: int, *, relief_mm: float = 0.0, camera: Camera = LOW, seed: int = 0) -> Iterator[Step]:
    """Random steps of up to 70 mm and 9°, from piece to piece of a ground."""
    for k, piece in _pieces(ground, n, relief_mm, seed):
        poses = wander(min(PATCH, n - PATCH * k) + 1, seed=seed + k)
        yield from steps_of(piece, poses, camera=camera, seed=1000 * (seed + k))


def unrelated(ground: str | Path, n: int, *, relief_mm: float = 0.0, seed: int = 0) -> Iterator[tuple[Image, Image]]:
    """Two frames of different pieces of a ground."""
    walks = (walk(ground, n, relief_mm=relief_mm, seed=s) for s in (seed, seed + 10_000))
    for (frame, *_), (other, *_) in zip(*walks, strict=True):
        yield frame, other


def beyond(ground: str | Path, n: int, *, relief_mm: float = 0.0, seed: int = 0) -> Iterator[Step]:
    """Steps as long as :data:`BEYOND`, any way, with turns of up to 9°."""
    rng = np.random.default_rng(seed)
    width = LOW.width * LOW.above_ground_mm / LOW.fx
    for k, piece in _pieces(ground, n, relief_mm, seed):
        for i in range(min(PATCH, n - PATCH * k)):
            far, away, turn = rng.uniform(*BEYOND) * width, rng.uniform(0, 2 * np.pi), rng.uniform(-9, 9)
            half = far / 2 * np.array([np.cos(away), np.sin(away)])
            middle = rng.uniform(-25, 25, 2)
            poses = above(middle - half, 0.0), above(middle + half, turn)
            yield from steps_of(piece, poses, seed=1000 * (seed + k) + 2 * i)


def _pieces(ground: str | Path, n: int, relief_mm: float, seed: int) -> Iterator[tuple[int, Ground]]:
    """Pieces of ground, one for each :data:`PATCH` of steps."""
    for k in range(-(-n // PATCH)):
        piece = lay_ground(ground, size_mm=ROOM, seed=seed + k)
        if relief_mm:
            piece = rough(piece, amplitude_mm=relief_mm, correlation_mm=HILLS, seed=seed + k)
        yield k, piece
