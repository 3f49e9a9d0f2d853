"""Frames made ready to be compared with others."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.compute.extras import load
from vinemap.errors import InputError

if TYPE_CHECKING:
    from vinemap.compute.arrays import Image, Values
    from vinemap.config.camera import Camera
    from vinemap.odometry.refinement import Method

SMOOTHING, SMOOTHED_SIZE = 1.0, 240
"""Sigma in pixels of the Gaussian that both frames get, as interpolation blurs the turned template, and only that one;
it grows with frames whose shorter side has more pixels than that, so that all see the ground's relief alike."""
COARSE_SIZE = 60
"""Pixels along the shorter side of the coarse frames, or a little more or less."""
BACKGROUND = 4.0
"""Sigma in pixels of the coarse frames of what is taken off as uneven light."""
LEAST_CONTRAST = 1.0
"""Standard deviation in grey levels below which a frame shows nothing."""


class View(NamedTuple):
    """A frame, ready to be compared with others."""

    image: Values
    """Smoothed, but for the standard algorithm."""
    coarse: Values
    detail: Values
    """The coarse one without uneven light."""
    contrast: float
    """Standard deviation in grey levels."""
    sharpness: float
    """Its fine detail over its contrast."""


def view_of(image: Image, *, camera: Camera, method: Method = "aligned") -> View:
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
    values = image.astype(np.float32)
    sigma = SMOOTHING * max(1.0, min(image.shape) / SMOOTHED_SIZE)
    smooth = np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32)
    coarse = _reduced(values)
    contrast = float(values.std())
    sharpness = float(cv2.Laplacian(smooth, cv2.CV_32F).std()) / max(contrast, LEAST_CONTRAST)
    kept = values if method == "maximum" else smooth
    return View(kept, coarse, coarse - cv2.GaussianBlur(coarse, (0, 0), BACKGROUND), contrast, sharpness)


def coarseness(image: Values) -> int:
    """Pixels along the side of one of the coarse search's."""
    shorter: int = min(image.shape)
    return max(1, round(shorter / COARSE_SIZE))


def _reduced(image: Values) -> Values:
    """Means of squares of pixels."""
    import cv2

    n = coarseness(image)
    height, width = (size // n for size in image.shape)
    whole = image[: height * n, : width * n]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)
