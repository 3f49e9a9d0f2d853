"""Frames made ready to be compared with others."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.compute.extras import load
from vinemap.errors import InputError

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Image, Values
    from vinemap.config.camera import Camera
    from vinemap.odometry.refinement import Method

SMOOTHING, SMOOTHED_SIZE = 1.0, 240
"""Sigma in pixels of the Gaussian that both frames get, as interpolation blurs the turned template, and only that one;
it grows with frames whose shorter side has more pixels than that, so that all see the ground's relief alike."""
COARSE_SIZE = 60
"""Pixels along the shorter side of the coarse frames, or a little more or less."""
BACKGROUND = 4.0
"""Sigma in pixels of the coarse frames of what is taken off as uneven light."""
DARKEST = 0.3
"""Light of a pixel, as a share, below which it is not brightened to its full contrast, as that of noise is."""
GRAIN = 3.0
"""Sigma in pixels of some 320 × 240 of what is taken off from fine detail."""
LEAST_CONTRAST = 1.0
"""Standard deviation in grey levels below which a frame shows nothing."""


class Cleaner(NamedTuple):
    """What frames are divided by, and which pixels show no ground."""

    light: Values
    """As a share of the usual, (ny, nx)."""
    hidden: Flags | None = None


class View(NamedTuple):
    """A frame, ready to be compared with others."""

    image: Values
    """Smoothed, but for the standard algorithm."""
    coarse: Values
    detail: Values
    """The coarse one without uneven light."""
    fine: Values
    """Detail finer than uneven light and shadows, at some 320 × 240 pixels."""
    contrast: float
    """Standard deviation in grey levels."""
    sharpness: float
    """Its fine detail over its contrast."""
    hidden: Flags | None = None
    """Pixels that show no ground."""


def view_of(image: Image, *, camera: Camera, method: Method = "aligned", cleaner: Cleaner | None = None) -> View:
    """Make a frame ready for :func:`vinemap.odometry.step.motion_between`.

    Raises
    ------
    InputError
        If it isn't grey, of 8 bits and of the camera's size.
    DependencyError
        If OpenCV can't be loaded.
    """
    cv2 = load("cv2")

    if image.ndim != 2 or image.dtype != np.uint8:
        raise InputError(f"A frame has shape {image.shape} of {image.dtype}: give grey images of 8 bits")
    if image.shape != (camera.height, camera.width):
        size = f"{image.shape[1]} × {image.shape[0]}"
        raise InputError(f"A frame has {size} pixels, the camera {camera.width} × {camera.height}: give frames of one")
    values = cleaned(image, cleaner)
    sigma = SMOOTHING * max(1.0, min(image.shape) / SMOOTHED_SIZE)
    smooth = np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32)
    coarse = reduced(values)
    contrast = float(values.std())
    sharpness = float(cv2.Laplacian(smooth, cv2.CV_32F).std()) / max(contrast, LEAST_CONTRAST)
    kept = values if method == "maximum" else smooth
    n = fineness(values)
    less = smooth if n == 1 else cv2.resize(smooth, None, fx=1 / n, fy=1 / n, interpolation=cv2.INTER_AREA)
    fine = np.asarray(less - cv2.GaussianBlur(less, (0, 0), GRAIN), np.float32)
    return View(kept, coarse, detail_of(coarse), fine, contrast, sharpness, cleaner and cleaner.hidden)


def coarseness(image: Values) -> int:
    """Pixels along the side of one of the coarse search's."""
    shorter: int = min(image.shape)
    return max(1, round(shorter / COARSE_SIZE))


def fineness(image: Values) -> int:
    """Pixels along the side of one of the fine detail's."""
    shorter: int = min(image.shape)
    return max(1, round(shorter / SMOOTHED_SIZE))


def reduced(image: Values) -> Values:
    """A coarse frame: means of squares of pixels."""
    import cv2

    n = coarseness(image)
    height, width = (size // n for size in image.shape)
    whole = image[: height * n, : width * n]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def detail_of(coarse: Values) -> Values:
    """A coarse frame without uneven light."""
    import cv2

    return np.asarray(coarse - cv2.GaussianBlur(coarse, (0, 0), BACKGROUND))


def cleaned(image: Image, cleaner: Cleaner | None) -> Values:
    """A frame in grey levels without what stays; hidden pixels are filled from about them."""
    import cv2

    values = image.astype(np.float32)
    if cleaner is None:
        return values
    light = cleaner.light
    level = float(np.median(values[::4, ::4] / light[::4, ::4]))
    values = np.asarray(level + (values / light - level) * np.minimum(light / DARKEST, 1), np.float32)
    if cleaner.hidden is None:
        return values
    n = coarseness(values)
    seen = (~cleaner.hidden).astype(np.float32)
    weights, sums = (cv2.GaussianBlur(reduced(part), (0, 0), 2.0) for part in (seen, seen * values))
    filled = (np.asarray(sums) + 1e-3 * level) / (np.asarray(weights) + 1e-3)
    whole = cv2.resize(filled, values.shape[::-1], interpolation=cv2.INTER_LINEAR) if n > 1 else filled
    return np.where(cleaner.hidden, whole, values).astype(np.float32)
