"""Whether a step between two frames is to be believed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.compute.order import median
from vinemap.odometry.correlation import warp
from vinemap.odometry.views import coarseness

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Flags, Values
    from vinemap.odometry.correlation import Place
    from vinemap.odometry.patches import Fit, Patches
    from vinemap.odometry.views import View

LEAST_OVERLAP = 0.1
"""Share of a frame that the next one must show too."""
LEAST_SHARPNESS = 0.5
"""Detail of the blurrier frame as a share of the other's."""
LEAST_SCORE, LEAST_AGREEMENT, MOST_RIVAL = 0.5, 0.35, 0.7
"""Of a step that is believed: correlation of the template, that of all that both frames show, and the share of the
latter that the next best place may reach."""

PATCH = 4
"""Pixels of coarse frames along the side of a patch."""
CLEANEST = 90.0
"""Percentile of patches, by how much of them changed, that is neither covered nor blank."""
CHANGED, CHANGED_ROUGHLY = 0.45, 0.6
"""Change of the cleanest patches, as a share of their detail, from which on ground has moved; and if frames lie on each
other to half a step of the search only."""
EVEN = 0.8
"""Sigma in pixels of what both coarse frames are blurred by, as turning blurs one of them."""
FAINT = 1.0
"""Grey levels of detail that count as none."""
NEAR_STILL = 3.0
"""Pixels of coarse frames within which what moves with the camera draws a step to where nothing moves."""

MOST_APART = 0.65
"""Pixels of fine detail, root mean square, over the mean correlation of patches, from which on they disagree across the
movement as no ground's do: what they share are shadows that move over it."""

MOST_UNSURE = 1.3, np.radians(0.35)
"""Standard deviations in pixels of fine detail and radians of a step from which on the ground isn't flat enough."""
PLANE = 0.5
"""Share of the patches' disagreement that is left if it is that of a plane that is tilted."""


def agreement_at(
    view: View, next_view: View, centre: Sequence[float], place: Place, *, most_change: float = CHANGED
) -> tuple[float, float]:
    """Correlation of all that two coarse frames both show, and its share of a frame.

    It is none where nothing moves, but for the cleanest patches, by so much change.

    It is the quadrant correlation, as Pearson's for normal values, which a few dark or bright spots that move with the
    camera can't decide: N. Blomqvist, On a measure of dependence between two random variables, 1950.
    """
    import cv2

    a, b = view.detail, next_view.detail
    n = coarseness(view.image)
    source, target = ((np.asarray(at) + 0.5) / n - 0.5 for at in (centre, place[1:]))
    matrix = warp(place.angle, source, target)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    moved = np.asarray(cv2.warpAffine(a, matrix, b.shape[::-1], flags=flags), np.float32)
    shown = _within(a.shape, matrix, b.shape)
    overlap = float(shown.mean())
    if overlap < LEAST_OVERLAP:
        return 0.0, overlap
    x, y = moved[shown], b[shown]
    alike = np.count_nonzero((x > median(x)) == (y > median(y))) / len(x)
    agreement = float(np.sin(np.pi * (alike - 0.5)))
    if np.hypot(*(source - target)) < NEAR_STILL:
        inner = np.s_[3:-3, 3:-3]
        agreement = agreement if change(moved[inner], b[inner]) < most_change else 0.0
    return agreement, overlap


def _within(shape: tuple[int, ...], matrix: Values, next_shape: tuple[int, ...]) -> Flags:
    """Which pixels (ny, nx) of the next image lie where the first has pixels all about."""
    rows, columns = (np.arange(size) for size in next_shape)
    within = np.ones(next_shape, bool)
    for size, (by_column, by_row, offset) in zip(shape[::-1], matrix, strict=True):
        middle = (size - 1) / 2
        within &= np.abs(by_column * columns + (by_row * rows + offset - middle)[:, None]) <= middle - 1
    return within


def doubt(
    view: View,
    next_view: View,
    at_limits: Sequence[bool],
    *,
    score: float,
    agreement: float,
    rival: float,
    patches: Patches,
    fit: Fit | None,
) -> str:
    """Why a step isn't to be believed, in a word; empty if it is.

    Parameters
    ----------
    view, next_view : View
        The frames.
    at_limits : sequence of bool
        Whether its turn, row and column lie where the search ends.
    score, agreement, rival : float
        Correlation of the template, of all that both frames show, and of the next best place.
    patches, fit : Patches, Fit
        What pieces of the frames say, one by one and together.
    """
    turned, *out = at_limits
    *place_sd, turn_sd = np.sqrt(np.diag(fit.covariance)) if fit else (0.0, 0.0)
    crooked = max(place_sd) > MOST_UNSURE[0] * patches.unit or turn_sd > MOST_UNSURE[1]
    sliding = fit is not None and fit.apart > MOST_APART * patches.mean * patches.unit
    doubts = {
        "blur": min(view.sharpness, next_view.sharpness) < LEAST_SHARPNESS * max(view.sharpness, next_view.sharpness),
        "overlap": any(out),
        "score": score < LEAST_SCORE or agreement < LEAST_AGREEMENT or not patches.fit or sliding,
        "ambiguous": rival > MOST_RIVAL * agreement,
        "tilt": crooked and fit is not None and fit.rest < PLANE * fit.spread,
        "relief": crooked,
        "step": turned,
    }
    return next((reason for reason, doubted in doubts.items() if doubted), "")


def change(detail: Values, next_detail: Values) -> float:
    """Change from a coarse frame to the next at the same place, as a share of their detail, where it is clearest."""
    import cv2

    a, b = (np.asarray(cv2.GaussianBlur(part, (0, 0), EVEN)) for part in (detail, next_detail))
    ratios = np.sqrt(_means((b - a) ** 2)) / (np.sqrt(_means((a * a + b * b) / 2)) + FAINT)
    return float(np.percentile(ratios, CLEANEST))


def _means(values: Values) -> Values:
    import cv2

    height, width = (size // PATCH for size in values.shape)
    return np.asarray(
        cv2.resize(values[: height * PATCH, : width * PATCH], (width, height), interpolation=cv2.INTER_AREA)
    )
