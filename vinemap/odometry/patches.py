"""Pieces of two frames beside each other, and the movement, scale and slope that they tell together."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.compute.order import median
from vinemap.odometry.correlation import Place, warp
from vinemap.odometry.views import View, fineness

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Flags, Ints, Values

PATCH_PITCH, PATCH_HALF, PATCH_REACH = 36.0, 12, 6
"""Pixels of fine detail between patches of what both frames show, their half width, and how far from where they should
be they are looked for."""
PATCH_SCORE, PATCH_SPREAD = 0.6, 3.0
"""Correlation of a patch that agrees, and pixels of fine detail from the others' median that it may lie off."""
LEAST_PATCHES, FEWEST_PATCHES = 0.4, 3
"""Share and number of patches that must agree."""
SHORT = 12.0
"""Pixels of fine detail of movement below which parallax says nothing."""
ROUNDS = 4
"""Times that patches are weighed by how far they disagree."""
ALIKE, MOST_LIKE = 1.2, 0.6
"""How much more patches vary together, at least, than each for itself, as neighbours err alike; the largest correlation
of neighbours of which that is told."""
SINGULAR = 1e10
"""By how much variances are inflated, at least, by other unknowns that patches can't tell apart from theirs."""
LEAST_SPREAD = 0.01
"""Pixels by which patches disagree at least."""


class Patches(NamedTuple):
    """Pieces of fine detail of the next frame, and how they lie beside where a step puts them."""

    places: Values
    """Columns and rows (n, 2) in the next frame."""
    shifts: Values
    """Pixels (n, 2) from there to where they are."""
    scores: Values
    """Correlation there (n,)."""
    unit: int = 1
    """Pixels of a frame along the side of one of fine detail."""

    @property
    def agree(self) -> Flags:
        """Which of them (n,) show the same ground, and lie together."""
        same = self.scores > PATCH_SCORE
        if not same.any():
            return np.asarray(same)
        off = self.shifts - [median(shifts) for shifts in self.shifts[same].T]
        return np.asarray(same & (np.hypot(*off.T) < PATCH_SPREAD * self.unit))

    @property
    def mean(self) -> float:
        """Mean correlation."""
        return float(self.scores.mean()) if len(self.scores) else 0.0

    @property
    def fit(self) -> bool:
        """Whether enough of them agree; unknown counts as such."""
        n = len(self.scores)
        return n < FEWEST_PATCHES or int(self.agree.sum()) >= max(FEWEST_PATCHES, LEAST_PATCHES * n)


class Fit(NamedTuple):
    """How patches lie together beside where a step puts them."""

    shift: Values
    """Of the step's place, columns and rows (2,)."""
    turn: float
    """Radians, clockwise in the image."""
    covariance: Values
    """Of shift and turn (3, 3), by how much the patches disagree."""
    scale: float
    """How much larger the next frame shows the ground."""
    slope: Values | None
    """The ground's to the right and downward (2,), as what is higher moves further; none of short steps."""
    spread: float
    """Pixels, root mean square along an axis, by which they disagree with one movement."""
    rest: float
    """The same if the camera may sink and tilt."""
    apart: float
    """Across the movement, where relief moves nothing."""

    def corrected(self, place: Place) -> Place:
        """The place of the step that the patches tell."""
        column, row = self.shift
        return Place(place.angle + float(np.degrees(self.turn)), place.row + float(row), place.column + float(column))

    def turned(self, place: Place) -> tuple[Place, Fit]:
        """The place turned as the patches tell, and as unsure as they are and as far as they put it elsewhere."""
        covariance = self.covariance.copy()
        covariance[:2, :2] += np.outer(self.shift, self.shift)
        return place._replace(angle=self.corrected(place).angle), self._replace(covariance=covariance)


def fit_of(patches: Patches, place: Place, centre: Sequence[float], focal: float) -> Fit | None:
    """Fit a movement to patches that agree, and a plane of any tilt at another height; none if they are too few.

    What is higher moves further, but the same way (parallax): across the movement patches agree on any relief, and
    count as much more as they disagree less there than along it.

    Parameters
    ----------
    place, centre
        Where the template is in the next frame, and was in the first.
    focal : float
        Focal length in pixels.
    """
    agree = patches.agree
    n = int(agree.sum())
    if n < 2 * FEWEST_PATCHES:
        return None
    x, y = (patches.places[agree] - [place.column, place.row]).T
    way = np.array([place.column - centre[1], place.row - centre[0]])
    far = float(np.hypot(*way))
    parallax = far > SHORT * patches.unit
    c, s = way / far if parallax else (1.0, 0.0)
    along, across = np.array([[c, s], [-s, c]])
    shifts = np.array([along, across]) @ patches.shifts[agree].T
    rigid = np.stack([np.column_stack([np.tile(axis, (n, 1)), axis[1] * x - axis[0] * y]) for axis in (along, across)])
    orders = np.lexsort((x, y)), np.lexsort((y, x))
    sd = np.ones((2, 1))
    for _ in range(ROUNDS):
        moved, covariance = _least_squares(rigid, shifts, sd)
        left = shifts - rigid @ moved
        squares = np.maximum(np.sum(left**2, axis=1) / (n - 1.5), LEAST_SPREAD**2)
        sd[:, 0] = np.sqrt(squares * _alike(left, orders) if parallax else ALIKE * squares.mean())
    ahead, aside = along @ [x, y], across @ [x, y]
    leaning = far / focal * np.column_stack([x, y])
    bent = np.stack([np.column_stack([ahead, leaning]), np.column_stack([aside, 0 * leaning])])
    whole = np.concatenate([rigid, bent], axis=2)
    every, _ = _least_squares(whole, shifts, sd)
    beyond = np.sum((shifts - whole @ every) ** 2, axis=1)
    rest, apart = float(np.sqrt(beyond.sum() / max(2 * n - 6, 1))), float(np.sqrt(beyond[1] / max(n - 2, 1)))
    slope, spread = every[4:] if parallax else None, float(np.sqrt(squares.mean()))
    return Fit(moved[:2], float(moved[2]), covariance, float(every[3]), slope, spread, rest, apart)


def _least_squares(slopes: Values, values: Values, sd: Values) -> tuple[Values, Values]:
    """Unknowns (k,) and covariance (k, k) of slopes (2, n, k) and values (2, n) of standard deviations (2, 1)."""
    weighted = (slopes / sd[..., None]).reshape(-1, slopes.shape[-1])
    normal = weighted.T @ weighted
    try:
        covariance: Values = np.linalg.inv(normal)
        inflated = np.diag(covariance) * np.diag(normal)
    except np.linalg.LinAlgError:
        inflated = np.array(np.inf)
    if not ((inflated > 0) & (inflated < SINGULAR)).all():  # patches in a line
        covariance = np.linalg.pinv(normal, rcond=1 / SINGULAR, hermitian=True)
    return np.asarray(covariance @ (weighted.T @ (values / sd).ravel())), covariance


def _alike(left: Values, orders: Sequence[Ints]) -> Values:
    """How much more what is left (2, n) varies together than each for itself, by neighbours in orders of the patches.

    It is the sum of a correlation that falls off as a Gaussian's over the nodes of a lattice.
    """
    power = np.maximum(np.sum(left**2, axis=1), 1e-12)
    beside = [np.sum(left[:, order[1:]] * left[:, order[:-1]], axis=1) / power for order in orders]
    like = np.clip(np.mean(beside, axis=0), 0, MOST_LIKE)
    return np.asarray(np.maximum(ALIKE, (1 + 2 * like + 2 * like**4) ** 2))


def patches_at(view: View, next_view: View, centre: Sequence[float], place: Place) -> Patches:
    """Where patches of what two frames both show lie, by a movement.

    Between pixels, linear interpolation puts detail too near to the nearer one, by up to some hundredths of a pixel
    that a spread of patches doesn't tell; between those of a frame twice as large it is an eighth of that.
    """
    import cv2

    a, b = view.fine, next_view.fine
    n = fineness(view.image)
    matrix = warp(place.angle, *((np.asarray(at) + 0.5) / n - 0.5 for at in (centre, place[1:])))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = np.asarray(cv2.warpAffine(cv2.pyrUp(a), 2 * matrix, b.shape[::-1], flags=flags))
    half, far = PATCH_HALF, PATCH_HALF + PATCH_REACH
    size = np.array(b.shape[::-1])
    corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (size - 1) - matrix[:, 2]) @ matrix[:, :2]
    low = np.maximum(corners.min(axis=0) + half, far)
    high = np.minimum(corners.max(axis=0) - half, size - 1 - far)
    if np.any(high < low):
        return Patches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), n)
    grid = np.rint(np.stack(np.meshgrid(*map(_spaced, low, high)), axis=-1).reshape(-1, 2))
    there = grid @ matrix[:, :2].T + matrix[:, 2]
    grid = grid[np.all((there > half + 2) & (there < size - 3 - half), axis=1)].astype(int)
    shifts, scores = np.zeros((len(grid), 2)), np.zeros(len(grid))
    for k, (x, y) in enumerate(grid):
        part = b[y - far : y + far + 1, x - far : x + far + 1]
        own = moved[y - half : y + half + 1, x - half : x + half + 1]
        found = np.asarray(cv2.matchTemplate(part, own, cv2.TM_CCOEFF_NORMED), np.float32)
        _, scores[k], _, (j, i) = cv2.minMaxLoc(found)
        shifts[k] = [_vertex(found[i, :], j) - PATCH_REACH, _vertex(found[:, j], i) - PATCH_REACH]
    return Patches((grid + 0.5) * n - 0.5, shifts * n, scores, n)


def _spaced(low: float, high: float) -> Values:
    return np.linspace(low, high, max(2, round((high - low) / PATCH_PITCH) + 1))


def _vertex(values: Values, at: int) -> float:
    """Place of the highest point of the parabola through a peak and its neighbours."""
    if not 0 < at < len(values) - 1:
        return float(at)
    left, top, right = map(float, values[at - 1 : at + 2])
    return at + (left - right) / (2 * (left - 2 * top + right)) if left + right < 2 * top else float(at)
