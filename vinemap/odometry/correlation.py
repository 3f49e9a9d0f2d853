"""Normalised cross-correlation of a turned template: where a piece of one image lies in another (Eq. 3–7).

J. P. Lewis, Fast normalized cross-correlation, Vision Interface 1995.
"""

from __future__ import annotations

from math import cos, radians, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Values

    Box = tuple[range, range, range]
    Index = tuple[int, int, int]
    Window = tuple[int, range, range]

COARSE_STEP, CANDIDATES = 3.0, 8
"""The coarse search: degrees between its angles, and peaks that are looked into."""

CLIMBS = 4
"""Times that a peak may lie on the edge of where it is looked for before it is left."""


class Place(NamedTuple):
    """Where a template is in another image."""

    angle: float
    """Degrees that its image must be turned by, anticlockwise, to look as it did: what the camera turned by."""
    row: float
    column: float
    """Of its centre, in pixels."""


class Search(NamedTuple):
    """Two images, and where a template of the first is looked for in the second."""

    a: Values
    b: Values
    centre: tuple[int, int]
    """Row and column of the template in the first."""
    half: int
    """Its half width w_T."""
    step: float
    """Degrees between angles δ_ϑ."""
    cubic: bool
    """Whether the template is turned by cubic instead of linear interpolation."""
    whole: Box
    """All angles, in steps, and all rows and columns."""
    turned: dict[int, Values]
    """The template turned by so many steps, where it was before."""
    planes: dict[Window, Values]
    """Correlations at so many steps in rows and columns, where they were asked for before."""


def search_of(
    a: Values, b: Values, *, centre: tuple[int, int], half: int, step: float, angles: tuple[float, float], cubic: bool
) -> Search:
    """Look for a template at all places of the second image and at angles between two, in degrees."""
    height, width = b.shape
    turns = range(int(np.floor(angles[0] / step)) - 1, int(np.ceil(angles[1] / step)) + 2)
    whole = turns, range(half, height - half), range(half, width - half)
    return Search(a, b, centre, half, step, cubic, whole, {}, {})


def place_at(search: Search, index: Sequence[float] | Values) -> Place:
    """The place of an index, which may lie between whole numbers."""
    return Place(float(index[0] * search.step), float(index[1]), float(index[2]))


def warp(angle: float, source: Sequence[float] | Values, target: Sequence[float] | Values) -> Values:
    """Matrix (2, 3) to pixels of an image from those of the next, (row, column) of a point in both given."""
    c, s = cos(radians(angle)), sin(radians(angle))
    (y, x), (next_y, next_x) = source, target
    return np.array([[c, s, x - c * next_x - s * next_y], [-s, c, y + s * next_x - c * next_y]])


def correlation(search: Search, box: Box) -> Values:
    """γ(u, v, ϑ) of Eq. 5 at the angles, rows and columns of a box, (n, rows, columns)."""
    turns, rows, columns = box
    return np.stack([_plane(search, (turn, rows, columns)) for turn in turns])


def _plane(search: Search, window: Window) -> Values:
    """The correlation at one angle."""
    import cv2

    if window not in search.planes:
        turn, rows, columns = window
        half = search.half
        part = search.b[rows[0] - half : rows[-1] + half + 1, columns[0] - half : columns[-1] + half + 1]
        search.planes[window] = np.asarray(cv2.matchTemplate(part, _template(search, turn), cv2.TM_CCOEFF_NORMED))
    return search.planes[window]


def _template(search: Search, turn: int) -> Values:
    """The template turned by so many steps."""
    import cv2

    if turn not in search.turned:
        half, size = search.half, 2 * search.half + 1
        flags = (cv2.INTER_CUBIC if search.cubic else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
        matrix = warp(turn * search.step, search.centre, (half, half))
        search.turned[turn] = np.asarray(
            cv2.warpAffine(search.a, matrix, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        )
    return search.turned[turn]


def near(search: Search, index: Sequence[int], reach: Sequence[int]) -> Box:
    """What is near a place; beyond the search's rows and columns there is nothing."""
    turns = range(index[0] - reach[0], index[0] + reach[0] + 1)
    rows, columns = (
        range(max(within[0], at - far), min(within[-1], at + far) + 1)
        for at, far, within in zip(index[1:], reach[1:], search.whole[1:], strict=True)
    )
    return turns, rows, columns


def peak(search: Search, box: Box) -> tuple[Index, float]:
    """Angle, row and column of the highest correlation in a box, and that."""
    values = correlation(search, box)
    k, i, j = np.unravel_index(np.argmax(values), values.shape)
    return (box[0][k], box[1][i], box[2][j]), float(values[k, i, j])


def coarse_peaks(search: Search) -> list[Place]:
    """The highest peaks of the correlation, each of them at a place of its own."""
    values = correlation(search, search.whole)
    highest, turn = values.max(axis=0), values.argmax(axis=0)
    places = []
    for _ in range(CANDIDATES):
        i, j = np.unravel_index(np.argmax(highest), highest.shape)
        places.append(place_at(search, (search.whole[0][turn[i, j]], search.whole[1][i], search.whole[2][j])))
        highest[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3] = -1.0
    return places


def climb(search: Search, start: Place, reach: int) -> tuple[Index, float]:
    """The peak near a place that is known to some pixels, and the correlation there."""
    sought = start.angle / search.step, start.row, start.column
    turn, row, column = (
        int(np.clip(round(value), within[0], within[-1])) for value, within in zip(sought, search.whole, strict=True)
    )
    box = near(search, (turn, row, column), (1, reach, reach))
    higher, score = peak(search, box)
    for _ in range(CLIMBS):
        beside = near(search, higher, (1, 1, 1))
        if _holds(box, beside):
            break
        about = near(search, higher, (1, reach, reach))
        box = about if not _holds(box[1:], beside[1:]) else (about[0], box[1], box[2])
        higher, score = peak(search, box)
    return higher, score


def _holds(box: Sequence[range], other: Sequence[range]) -> bool:
    return all(part[0] in whole and part[-1] in whole for whole, part in zip(box, other, strict=True))
