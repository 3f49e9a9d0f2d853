"""Visual odometry: how a robot moved between two frames of a camera that looks down, by cross-correlation.

Chapter 4 of the thesis, its print put right: Eq. 8 gives the ground's movement as the robot sees it, of which the
robot's own is the negative; the centroid of Eq. 10–12 divides by the sum of the weights, and sums angles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from vinemap.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.floating]
    Image = NDArray[np.uint8]
    Box = tuple[range, range, range]
    Index = tuple[int, int, int]

Method = Literal["aligned", "quadratic", "centroid", "maximum"]
Search = Literal["coarse to fine", "exhaustive"]

ANGLE_STEP = 1.15
"""Degrees between the angles of the search: what moves the edge of a template of 49 pixels by half a pixel."""
SMOOTHING = 1.0
"""Sigma in pixels of the Gaussian that both frames get: interpolation blurs the turned template, and only that one."""
NEIGHBOURS, SHARE_OF_PEAK = 5, 0.95
"""n_Γ and m of Eq. 9."""
COARSE, COARSE_STEP, CANDIDATES = 4, 3.0, 8
"""The coarse search: pixels in one of its own, degrees between its angles, and peaks that are looked into."""
CLIMBS = 8
"""Times that a peak may lie on the edge of where it is looked for before it is left."""
APART = 6
"""Pixels between two places that aren't the same."""
BACKGROUND = 4.0
"""Sigma in pixels of the coarse frames of what is taken off as uneven light."""
TURNED = 1.2
"""Room that a square needs to turn by 9°, as a share of its half width."""
LEAST_CONTRAST = 1.0
"""Standard deviation in grey levels below which a frame shows nothing."""
LEAST_OVERLAP = 0.1
"""Share of a frame that the next one must show too."""
LEAST_SHARPNESS = 0.5
"""Detail of the blurrier frame as a share of the other's."""
LEAST_SCORE, LEAST_AGREEMENT, MOST_RIVAL = 0.5, 0.35, 0.7
"""Of a step that is believed: correlation of the template, that of all that both frames show, and the share of the
latter that the next best place may reach."""


class Camera(NamedTuple):
    """A camera that looks straight down; the defaults are the low resolution of Table 4.1."""

    width: int = 320
    """Of its images, in pixels, along the robot's x axis."""
    height: int = 240
    fx: float = 299.4303
    """Focal length in pixels, along the width and along the height."""
    fy: float = 299.4122
    above_ground_mm: float = 245.0
    x_mm: float = 950.0
    """Place of its axis in the robot's frame: x forward, y to the left."""
    y_mm: float = 0.0

    def ground(self, column: float, row: float) -> Array:
        """Place (2,) in the robot's frame in mm of a point of the image (Eq. 2); whole numbers are pixels' centres."""
        right, down = column - (self.width - 1) / 2, row - (self.height - 1) / 2
        gx, gy = self.above_ground_mm / self.fx, self.above_ground_mm / self.fy
        return np.array([right * gx + self.x_mm, self.y_mm - down * gy])


class Motion(NamedTuple):
    """How the robot moved from one frame to the next, in the frame of where it was."""

    dx_mm: float
    """Forward."""
    dy_mm: float
    """To the left."""
    rotation_deg: float
    """Anticlockwise."""
    score: float
    """Normalised cross-correlation of the template at its best place, up to 1."""
    agreement: float
    """Correlation of all that both frames show, so moved; of a few peaks that with the highest is chosen."""
    rival: float
    """The same for the next best place."""
    overlap: float
    """Share of the frame that the next one shows too."""
    column: float
    """Where the template's centre lies in the next frame, in pixels."""
    row: float
    flag: str
    """Why the step isn't to be believed: "blank", "overlap", "score", "repeats", "step", "blur"; or empty."""


class _Place(NamedTuple):
    """Where the template is in the next frame: the robot's turn in degrees, row and column of the centre in pixels."""

    angle: float
    row: float
    column: float


class _Pair(NamedTuple):
    """Two frames, smoothed alike, and where the template of the first is looked for in the second."""

    a: Array
    b: Array
    centre: tuple[int, int]
    """Row and column of the template in the first."""
    half: int
    """Its half width w_T."""
    step: float
    """Degrees between angles."""
    cubic: bool
    """Whether the template is turned by cubic instead of linear interpolation."""
    whole: Box
    """All angles, in steps, rows and columns of the search."""


def estimate_motion(
    frame: Image,
    next_frame: Image,
    *,
    camera: Camera,
    template_share: float = 0.2,
    angles: tuple[float, float] = (-9.0, 9.0),
    method: Method = "aligned",
    search: Search = "coarse to fine",
) -> Motion:
    """Estimate how a robot moved between two frames.

    Parameters
    ----------
    frame, next_frame : ndarray
        Grey images (height, width) of 8 bits.
    template_share : float
        p_T, width of the template as a share of the image's shorter side, above 0 and below 1.
    angles : (float, float)
        Smallest and largest turn of the robot in degrees.
    method : {"aligned", "quadratic", "centroid", "maximum"}
        How the peak of the correlation is refined: by a quadratic through its 27 neighbours, from which on frames are
        aligned by the enhanced correlation coefficient, or by the quadratic alone; by the thesis's weighted centroid
        (Eq. 9–12); or not at all, on frames as they are: the standard algorithm.
    search : {"coarse to fine", "exhaustive"}
        Whether all places and angles are tried at a quarter of the resolution first, or at the full one.

    Raises
    ------
    InputError
        If a frame is not of the camera's size, or not grey and of 8 bits.

    References
    ----------
    Chapter 4 of the thesis; J. P. Lewis, Fast normalized cross-correlation, Vision Interface 1995; G. D. Evangelidis
    and E. Z. Psarakis, Parametric image alignment using enhanced correlation coefficient maximization, IEEE TPAMI 30
    (2008).
    """
    for image in (frame, next_frame):
        _check(image, camera)
    half = max(2, round(template_share * min(frame.shape) / 2))
    standard = method == "maximum"
    a, b = (_smoothed(image, 0.0 if standard else SMOOTHING) for image in (frame, next_frame))
    pair = _pair(a, b, half, ANGLE_STEP, angles, cubic=not standard)
    if min(frame.std(), next_frame.std()) < LEAST_CONTRAST:
        return _motion(camera, pair, _Place(0.0, *pair.centre), flag="blank")
    coarse = _reduced(frame), _reduced(next_frame)
    details = _detail(coarse[0]), _detail(coarse[1])
    peaks = [_climb(pair, place) for place in _candidates(*coarse, half, angles)]
    if search == "exhaustive":
        peaks.append(_peak(pair, pair.whole))
    agreed = {index: _agreement(*details, pair.centre, _at(pair, index))[0] for index, _ in peaks}
    top, score = max(peaks, key=lambda peak: agreed[peak[0]])
    others = [index for index in agreed if np.hypot(index[1] - top[1], index[2] - top[2]) > APART]
    rival = max((agreed[index] for index in others), default=0.0)
    place = _refined(pair, top, method)
    agreement, overlap = _agreement(*details, pair.centre, place)
    at_limit, *out = (not within[0] < value < within[-1] for value, within in zip(top, pair.whole, strict=True))
    doubts = {
        "overlap": any(out),
        "score": score < LEAST_SCORE or agreement < LEAST_AGREEMENT,
        "repeats": rival > MOST_RIVAL * agreement,
        "step": at_limit,
        "blur": _sharpness(pair.a, pair.b) < LEAST_SHARPNESS,
    }
    flag = next((reason for reason, doubted in doubts.items() if doubted), "")
    return _motion(camera, pair, place, score, agreement, rival, overlap, flag)


def _check(image: Image, camera: Camera) -> None:
    if image.ndim != 2 or image.dtype != np.uint8:
        raise InputError(f"A frame has shape {image.shape} of {image.dtype}: give grey images of 8 bits")
    if image.shape != (camera.height, camera.width):
        size = f"{image.shape[1]} × {image.shape[0]}"
        raise InputError(f"A frame has {size} pixels, the camera {camera.width} × {camera.height}: give frames of one")


def _motion(
    camera: Camera,
    pair: _Pair,
    place: _Place,
    score: float = 0.0,
    agreement: float = 0.0,
    rival: float = 0.0,
    overlap: float = 0.0,
    flag: str = "",
) -> Motion:
    """Movement of the robot by that of the template (Eq. 8)."""
    c, s = np.cos(np.radians(place.angle)), np.sin(np.radians(place.angle))
    row, column = pair.centre
    dx, dy = camera.ground(column, row) - np.array([[c, -s], [s, c]]) @ camera.ground(place.column, place.row)
    return Motion(float(dx), float(dy), place.angle, score, agreement, rival, overlap, place.column, place.row, flag)


def _smoothed(image: Image, sigma: float) -> Array:
    import cv2

    values = image.astype(np.float32)
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32) if sigma else values


def _reduced(image: Image) -> Array:
    """Means of squares of pixels."""
    import cv2

    height, width = (size // COARSE for size in image.shape)
    whole = image[: height * COARSE, : width * COARSE].astype(np.float32)
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _detail(image: Array) -> Array:
    import cv2

    return image - cv2.GaussianBlur(image, (0, 0), BACKGROUND)


def _pair(a: Array, b: Array, half: int, step: float, angles: tuple[float, float], *, cubic: bool = False) -> _Pair:
    height, width = a.shape
    turns = range(int(np.floor(angles[0] / step)) - 1, int(np.ceil(angles[1] / step)) + 2)
    whole = turns, range(half, height - half), range(half, width - half)
    return _Pair(a, b, (height // 2, width // 2), half, step, cubic, whole)


def _at(pair: _Pair, index: Sequence[float] | Array) -> _Place:
    return _Place(float(index[0] * pair.step), float(index[1]), float(index[2]))


def _warp(angle: float, source: Sequence[float] | Array, target: Sequence[float] | Array) -> Array:
    """Matrix (2, 3) to pixels of a frame from those of the next, (row, column) of a point in both given."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.array([[c, s], [-s, c]])
    return np.column_stack([turn, np.array(source)[::-1] - turn @ np.array(target)[::-1]])


def _correlation(pair: _Pair, box: Box) -> Array:
    """γ(u, v, ϑ) of Eq. 5 at the angles, rows and columns of a box, (n, rows, columns)."""
    import cv2

    turns, rows, columns = box
    half, size = pair.half, 2 * pair.half + 1
    flags = (cv2.INTER_CUBIC if pair.cubic else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
    part = pair.b[rows[0] - half : rows[-1] + half + 1, columns[0] - half : columns[-1] + half + 1]
    out = np.empty((len(turns), len(rows), len(columns)), np.float32)
    for turn, plane in zip(turns, out, strict=True):
        matrix = _warp(turn * pair.step, pair.centre, (half, half))
        template = cv2.warpAffine(pair.a, matrix, (size, size), flags=flags)
        plane[:] = cv2.matchTemplate(part, template, cv2.TM_CCOEFF_NORMED)
    return out


def _around(pair: _Pair, index: Sequence[int], reach: Sequence[int]) -> Box:
    """What is near a place; beyond the search's rows and columns there is nothing."""
    turns = range(index[0] - reach[0], index[0] + reach[0] + 1)
    rows, columns = (
        range(max(within[0], at - far), min(within[-1], at + far) + 1)
        for at, far, within in zip(index[1:], reach[1:], pair.whole[1:], strict=True)
    )
    return turns, rows, columns


def _peak(pair: _Pair, box: Box) -> tuple[Index, float]:
    """Angle, row and column of the highest correlation in a box, and that."""
    values = _correlation(pair, box)
    k, i, j = np.unravel_index(np.argmax(values), values.shape)
    return (box[0][k], box[1][i], box[2][j]), float(values[k, i, j])


def _candidates(a: Array, b: Array, half: int, angles: tuple[float, float]) -> list[_Place]:
    """Highest peaks of the correlation of coarse frames: turns, and how far the template moved, in pixels of these."""
    pair = _pair(a, b, max(2, round(half / COARSE)), COARSE_STEP, angles)
    values = _correlation(pair, pair.whole)
    highest, turn = values.max(axis=0), values.argmax(axis=0)
    places = []
    for _ in range(CANDIDATES):
        i, j = np.unravel_index(np.argmax(highest), highest.shape)
        index = pair.whole[0][turn[i, j]], pair.whole[1][i] - pair.centre[0], pair.whole[2][j] - pair.centre[1]
        places.append(_at(pair, index))
        highest[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3] = -1.0
    return places


def _climb(pair: _Pair, start: _Place) -> tuple[Index, float]:
    """The peak near what the coarse search found, and the correlation there."""
    moved = start.angle / pair.step, pair.centre[0] + COARSE * start.row, pair.centre[1] + COARSE * start.column
    turn, row, column = (
        int(np.clip(round(value), within[0], within[-1])) for value, within in zip(moved, pair.whole, strict=True)
    )
    index, reach = (turn, row, column), (1, COARSE + 1, COARSE + 1)
    higher, score = _peak(pair, _around(pair, index, reach))
    for _ in range(CLIMBS):
        if higher == index:
            break
        index, reach = higher, (1, 1, 1)
        higher, score = _peak(pair, _around(pair, index, reach))
    return higher, score


def _refined(pair: _Pair, top: Index, method: Method) -> _Place:
    """The peak between the steps of the search."""
    match method:
        case "maximum":
            return _at(pair, top)
        case "centroid":
            return _centroid(pair, top)
        case "quadratic":
            return _vertex(pair, top)
        case "aligned":
            return _aligned(pair, _vertex(pair, top))


def _near(pair: _Pair, top: Index, reach: int) -> tuple[Array, Array]:
    """Steps from a peak (n, 3), and the correlations there."""
    box = _around(pair, top, (reach, reach, reach))
    steps = np.stack(np.meshgrid(*box, indexing="ij"), axis=-1) - top
    return steps.reshape(-1, 3), _correlation(pair, box).ravel()


def _centroid(pair: _Pair, top: Index) -> _Place:
    """Weighted centroid of Γ (Eq. 9–12)."""
    steps, values = _near(pair, top, NEIGHBOURS)
    chosen = (np.linalg.norm(steps, axis=1) <= NEIGHBOURS) & (values >= SHARE_OF_PEAK * values.max())
    return _at(pair, top + np.average(steps[chosen], axis=0, weights=values[chosen]))


def _vertex(pair: _Pair, top: Index) -> _Place:
    """Highest point of the quadratic that fits a peak's neighbours best."""
    steps, values = _near(pair, top, 1)
    k, i, j = steps.T.astype(float)
    terms = np.column_stack([np.ones_like(k), k, i, j, k * k, i * i, j * j, k * i, k * j, i * j])
    _, *slope, kk, ii, jj, ki, kj, ij = np.linalg.lstsq(terms, values.astype(float))[0]
    bend = np.array([[2 * kk, ki, kj], [ki, 2 * ii, ij], [kj, ij, 2 * jj]])
    if np.any(np.linalg.eigvalsh(bend) >= 0):
        return _at(pair, top)
    return _at(pair, top - np.clip(np.linalg.solve(bend, slope), -1, 1))


def _aligned(pair: _Pair, place: _Place) -> _Place:
    """The place at which the enhanced correlation coefficient is highest, near one; that one where there is none.

    What is aligned is twice as wide as the template where both frames show so much.
    """
    import cv2

    height, width = pair.b.shape
    room = min(place.row, place.column, height - 1 - place.row, width - 1 - place.column)
    half = max(pair.half, min(2 * pair.half, int(room / TURNED)))
    far, (row, column) = int(np.ceil(half * TURNED)) + 2, pair.centre
    template = pair.a[row - half : row + half + 1, column - half : column + half + 1]
    top, left = (max(0, round(value) - far) for value in place[1:])
    part = pair.b[top : round(place.row) + far + 1, left : round(place.column) + far + 1]
    matrix = _warp(-place.angle, (place.row - top, place.column - left), (half, half)).astype(np.float32)
    whole = np.full(part.shape, 255, np.uint8)
    enough = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-5)
    try:
        _, found = cv2.findTransformECC(template, part, matrix, cv2.MOTION_EUCLIDEAN, enough, whole, 1)
    except cv2.error:  # it doesn't converge
        return place
    matrix = np.asarray(found)
    x, y = matrix @ (half, half, 1)
    near = _Place(float(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0]))), float(y) + top, float(x) + left)
    return near if np.hypot(near.row - place.row, near.column - place.column) < 1 else place


def _agreement(a: Array, b: Array, centre: Sequence[float], place: _Place) -> tuple[float, float]:
    """Correlation of all that two coarse frames both show, and its share of a frame."""
    import cv2

    source, target = ((np.asarray(at) + 0.5) / COARSE - 0.5 for at in (centre, place[1:]))
    matrix = _warp(place.angle, source, target)
    size, flags = b.shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(a, matrix, size, flags=flags)
    shown = cv2.warpAffine(np.ones_like(a), matrix, size, flags=flags) > 0.999
    overlap = float(shown.mean())
    if overlap < LEAST_OVERLAP:
        return 0.0, overlap
    x, y = moved[shown] - moved[shown].mean(), b[shown] - b[shown].mean()
    return float(x @ y / np.sqrt((x @ x) * (y @ y) + 1e-9)), overlap


def _sharpness(a: Array, b: Array) -> float:
    """Detail of the blurrier frame as a share of that of the other."""
    import cv2

    one, other = (float(cv2.Laplacian(image, cv2.CV_32F).std() / image.std()) for image in (a, b))
    return min(one, other) / max(one, other)
