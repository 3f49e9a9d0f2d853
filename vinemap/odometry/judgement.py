"""Whether a step between two frames is to be believed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinemap.odometry.correlation import Place, warp
from vinemap.odometry.views import View, coarseness

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Values

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
CHANGED = 0.45
"""Change of the cleanest patches, as a share of their detail, from which on ground has moved."""
EVEN = 0.8
"""Sigma in pixels of what both coarse frames are blurred by, as turning blurs one of them."""
FAINT = 1.0
"""Grey levels of detail that count as none."""
NEAR_STILL = 3.0
"""Pixels of coarse frames within which what moves with the camera draws a step to where nothing moves."""


def agreement_at(view: View, next_view: View, centre: Sequence[float], place: Place) -> tuple[float, float]:
    """Correlation of all that two coarse frames both show, and its share of a frame.

    It is the quadrant correlation, as Pearson's for normal values, which a few dark or bright spots that move with the
    camera can't decide: N. Blomqvist, On a measure of dependence between two random variables, 1950.
    """
    import cv2

    a, b = view.detail, next_view.detail
    n = coarseness(view.image)
    source, target = ((np.asarray(at) + 0.5) / n - 0.5 for at in (centre, place[1:]))
    matrix = warp(place.angle, source, target)
    size, flags = b.shape[::-1], cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    moved = np.asarray(cv2.warpAffine(a, matrix, size, flags=flags), np.float32)
    shown = cv2.warpAffine(np.ones_like(a), matrix, size, flags=flags) > 0.999
    overlap = float(shown.mean())
    if overlap < LEAST_OVERLAP:
        return 0.0, overlap
    x, y = moved[shown], b[shown]
    quadrants = np.mean(np.sign(x - np.median(x)) * np.sign(y - np.median(y)))
    agreement = float(np.sin(np.pi / 2 * quadrants))
    if np.hypot(*(source - target)) < NEAR_STILL:
        inner = np.s_[3:-3, 3:-3]
        agreement = agreement if change(moved[inner], b[inner]) < CHANGED else 0.0
    return agreement, overlap


def doubt(
    view: View, next_view: View, at_limits: Sequence[bool], *, score: float, agreement: float, rival: float
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
    """
    turned, *out = at_limits
    doubts = {
        "blur": min(view.sharpness, next_view.sharpness) < LEAST_SHARPNESS * max(view.sharpness, next_view.sharpness),
        "overlap": any(out),
        "score": score < LEAST_SCORE or agreement < LEAST_AGREEMENT,
        "repeats": rival > MOST_RIVAL * agreement,
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
