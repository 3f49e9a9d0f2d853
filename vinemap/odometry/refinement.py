"""Peaks of a correlation, refined between the steps of the search.

The thesis's print is put right: the centroid of Eq. 10–12 divides by the sum of the weights, and sums angles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from vinemap.odometry.correlation import Place, Search, correlation, near, place_at, warp

if TYPE_CHECKING:
    from vinemap.compute.arrays import Values
    from vinemap.odometry.correlation import Index

Method = Literal["aligned", "quadratic", "centroid", "maximum"]
NEIGHBOURS, SHARE_OF_PEAK = 5, 0.95
"""n_Γ and m of Eq. 9."""
TURNED = 1.2
"""Room that a square needs to turn by 9°, as a share of its half width."""


def refine(search: Search, top: Index, method: Method) -> Place:
    """The peak between the steps of the search."""
    match method:
        case "maximum":
            return place_at(search, top)
        case "centroid":
            return _centroid(search, top)
        case "quadratic":
            return _vertex(search, top)
        case "aligned":
            return _aligned(search, _vertex(search, top))


def _around(search: Search, top: Index, reach: int) -> tuple[Values, Values]:
    """Steps from a peak (n, 3), and the correlations there."""
    box = near(search, top, (reach, reach, reach))
    steps = np.stack(np.meshgrid(*box, indexing="ij"), axis=-1) - top
    return steps.reshape(-1, 3), correlation(search, box).ravel()


def _centroid(search: Search, top: Index) -> Place:
    """Weighted centroid of Γ (Eq. 9–12)."""
    steps, values = _around(search, top, NEIGHBOURS)
    within = np.linalg.norm(steps, axis=1) <= NEIGHBOURS
    chosen = within & (values >= SHARE_OF_PEAK * values[within].max())
    return place_at(search, top + np.average(steps[chosen], axis=0, weights=values[chosen]))


def _vertex(search: Search, top: Index) -> Place:
    """Highest point of the quadratic that fits a peak's neighbours best."""
    steps, values = _around(search, top, 1)
    k, i, j = steps.T.astype(float)
    terms = np.column_stack([np.ones_like(k), k, i, j, k * k, i * i, j * j, k * i, k * j, i * j])
    _, *slope, kk, ii, jj, ki, kj, ij = np.linalg.lstsq(terms, values.astype(float))[0]
    bend = np.array([[2 * kk, ki, kj], [ki, 2 * ii, ij], [kj, ij, 2 * jj]])
    if np.any(np.linalg.eigvalsh(bend) >= 0):
        return place_at(search, top)
    return place_at(search, top - np.clip(np.linalg.solve(bend, slope), -1, 1))


def _aligned(search: Search, place: Place) -> Place:
    """The place at which the enhanced correlation coefficient is highest, near one; that one where there is none.

    What is aligned is twice as wide as the template where both frames show so much.
    """
    import cv2

    (row, column), (height, width) = search.centre, search.b.shape
    room = min(
        row,
        column,
        height - 1 - row,
        width - 1 - column,
        *(side / TURNED for side in (place.row, place.column, height - 1 - place.row, width - 1 - place.column)),
    )
    half = max(search.half, min(2 * search.half, int(room)))
    far = int(np.ceil(half * TURNED)) + 2
    template = search.a[row - half : row + half + 1, column - half : column + half + 1]
    top, left = (max(0, round(value) - far) for value in place[1:])
    part = search.b[top : round(place.row) + far + 1, left : round(place.column) + far + 1]
    matrix = warp(-place.angle, (place.row - top, place.column - left), (half, half)).astype(np.float32)
    whole = np.full(part.shape, 255, np.uint8)
    enough = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-5)
    try:
        _, found = cv2.findTransformECC(template, part, matrix, cv2.MOTION_EUCLIDEAN, enough, whole, 1)
    except cv2.error:  # it doesn't converge
        return place
    matrix = np.asarray(found)
    x, y = matrix @ (half, half, 1)
    aligned = Place(float(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0]))), float(y) + top, float(x) + left)
    near_by = np.hypot(aligned.row - place.row, aligned.column - place.column) < 1
    return aligned if near_by and abs(aligned.angle - place.angle) < search.step else place
