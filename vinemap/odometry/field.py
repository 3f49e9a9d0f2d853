"""What stays in frames while the ground moves: dirt, a vignette, burnt-in text, the robot's shadow and its own parts.

Frames are divided by it, as astronomers' are by flat fields. Standing still must be shown by ground that stays.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.odometry.judgement import CHANGED, change
from vinemap.odometry.views import DARKEST, Cleaner, detail_of, reduced

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vinemap.compute.arrays import Flags, Image, Values
    from vinemap.config.camera import Camera

MEMORY = 40
"""Frames over which a field is averaged; it follows what changes more slowly."""
FEWEST = 6
"""Frames of different ground without which nothing is known."""
SOME = 4
"""Every so many pixels of which the likeness of frames is told."""
MOST_ALIKE = 0.9
"""The most that frames of different ground are alike."""
CERTAIN = 4.0
"""Standard errors of a mean that are ground, which happens to be as bright; what is beyond stays."""
OPAQUE = 0.35
"""Contrast that a pixel has in time, as a share of others', below which it shows no ground."""


class Field(NamedTuple):
    """Mean and variance (ny, nx) of frames of different ground, each over its mean."""

    n: int
    mean: Values
    variance: Values
    last: Values
    """Detail of the coarse frame that was learned last."""
    off: Values
    """Deviation of that frame from the mean, at a few pixels."""
    alike: float = 0.0
    """Correlation of such deviations from one frame to the next, as large grains are in several frames."""

    @property
    def n_apart(self) -> float:
        """How many frames that have nothing in common would tell as much."""
        return min(self.n, MEMORY) * (1 - self.alike) / (1 + self.alike)


def learned(field: Field | None, image: Image) -> Field:
    """A field with one frame more, if that shows other ground than the last one learned."""
    values = image.astype(np.float32)
    detail = detail_of(reduced(values))
    values /= max(float(values.mean()), 1.0)
    if field is None:
        return Field(1, values, np.zeros_like(values), detail, np.zeros_like(values[::SOME, ::SOME]))
    if change(field.last, detail) < CHANGED:
        return field
    weight = 1 / min(field.n + 1, MEMORY)
    off = values - field.mean
    variance = (1 - weight) * (field.variance + weight * off * off)
    some = off[::SOME, ::SOME]
    power = float(np.sqrt(np.mean(some**2) * np.mean(field.off**2)))
    alike = float(np.mean(some * field.off)) / power if power else 0.0
    alike = float(np.clip(field.alike + weight * (alike - field.alike), 0, MOST_ALIKE))
    return Field(field.n + 1, field.mean + weight * off, variance, detail, some, alike)


def field_of(images: Iterable[Image]) -> Field | None:
    """The field of some frames in order."""
    field = None
    for image in images:
        field = learned(field, image)
    return field


def cleaner_of(field: Field | None, camera: Camera) -> Cleaner | None:
    """What frames are to be divided by; none while nothing is known to stay.

    A deviation of the mean counts as much as it is beyond chance, so that clean frames are left as they are: the
    non-negative garrote of L. Breiman, Better subset regression using the nonnegative garrote, 1995.
    """
    import cv2

    masked = mask_of(camera)
    if field is None or field.n_apart < FEWEST:
        return None if masked is None else Cleaner(np.ones(masked.shape, np.float32), masked)
    usual = float(np.median(field.mean))
    off = field.mean / usual - 1
    variance = np.maximum(cv2.blur(field.variance, (3, 3)), 0)
    chance = CERTAIN**2 * variance / field.n_apart / usual**2
    light = 1 + off * np.maximum(1 - chance / np.maximum(off * off, 1e-12), 0)
    light = np.maximum(light, 0.01).astype(np.float32)
    contrast = np.sqrt(variance) / np.maximum(light, DARKEST)
    hidden = contrast < OPAQUE * float(np.median(contrast))
    if masked is not None:
        hidden |= masked
    if not hidden.any():
        return None if np.all(light == 1) else Cleaner(light)
    return Cleaner(light, hidden)


@lru_cache(maxsize=4)
def mask_of(camera: Camera) -> Flags | None:
    """Pixels (ny, nx) of frames that are free of distortion which show no ground, by the camera's file."""
    import cv2

    if not camera.mask:
        return None
    drawn = np.zeros((camera.height, camera.width), np.uint8)
    for corners in camera.mask:
        cv2.fillPoly(drawn, [np.rint(corners).astype(np.int32)], 1)
    if not camera.distortion:
        return np.asarray(drawn > 0)
    return np.asarray(cv2.undistort(drawn, camera.matrix, np.array(camera.distortion)) > 0)
