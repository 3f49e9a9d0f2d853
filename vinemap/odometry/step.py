"""Visual odometry: how a robot moved between two frames of a camera that looks down, by cross-correlation.

Chapter 4 of the thesis, its print put right: Eq. 8 gives the ground's movement as the robot sees it, of which the
robot's own is the negative; the centroid of Eq. 10–12 divides by the sum of the weights, and sums angles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from vinemap.errors import InputError
from vinemap.odometry.correlation import (
    COARSE_STEP,
    Place,
    Search,
    climb,
    coarse_peaks,
    correlation,
    near,
    peak,
    place_at,
    search_of,
    warp,
)
from vinemap.odometry.poses import Pose, onward

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.config.camera import Camera
    from vinemap.odometry.correlation import Index

    Array = NDArray[np.floating]
    Image = NDArray[np.uint8]

Method = Literal["aligned", "quadratic", "centroid", "maximum"]
Strategy = Literal["coarse to fine", "exhaustive"]
ANGLES = (-9.0, 9.0)
"""Degrees that a robot turns by from one frame to the next (Section 4.4)."""

ANGLE_STEP = 1.15
"""Degrees between the angles of the search: what moves the edge of a template of 49 pixels by half a pixel."""
SMOOTHING, SMOOTHED_SIZE = 1.0, 240
"""Sigma in pixels of the Gaussian that both frames get, as interpolation blurs the turned template, and only that one;
it grows with frames whose shorter side has more pixels than that, so that all see the ground's relief alike."""
NEIGHBOURS, SHARE_OF_PEAK = 5, 0.95
"""n_Γ and m of Eq. 9."""
COARSE_SIZE = 60
"""Pixels along the shorter side of the coarse frames, or a little more or less."""
APART = 1.5
"""Pixels of the coarse frames between two places that aren't the same."""
BACKGROUND = 4.0
"""Sigma in pixels of the coarse frames of what is taken off as uneven light."""
TURNED = 1.2
"""Room that a square needs to turn by 9°, as a share of its half width."""
SMALLEST_TEMPLATE = 5
"""Half width of a template in pixels."""
LARGEST_SHARE = 0.8
"""p_T above which nothing is left to move in."""
LEAST_CONTRAST = 1.0
"""Standard deviation in grey levels below which a frame shows nothing."""
LEAST_OVERLAP = 0.1
"""Share of a frame that the next one must show too."""
LEAST_SHARPNESS = 0.5
"""Detail of the blurrier frame as a share of the other's."""
LEAST_SCORE, LEAST_AGREEMENT, MOST_RIVAL = 0.5, 0.35, 0.7
"""Of a step that is believed: correlation of the template, that of all that both frames show, and the share of the
latter that the next best place may reach."""


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
    """Correlation of all that both frames show, so moved, by signs; of a few peaks that with the highest is chosen."""
    rival: float
    """The same for the next best place."""
    overlap: float
    """Share of the frame that the next one shows too."""
    flag: str
    """Why the step isn't to be believed: "blank", "overlap", "score", "repeats", "step", "blur"; or empty."""

    @property
    def movement(self) -> Pose:
        """The next pose in the frame of the first."""
        return Pose(self.dx_mm, self.dy_mm, self.rotation_deg)


class View(NamedTuple):
    """A frame, ready to be compared with others."""

    image: Array
    """Smoothed, but for the standard algorithm."""
    coarse: Array
    detail: Array
    """The coarse one without uneven light."""
    contrast: float
    """Standard deviation in grey levels."""
    sharpness: float
    """Its fine detail over its contrast."""


def estimate_motion(
    frame: Image,
    next_frame: Image,
    *,
    camera: Camera,
    template_share: float = 0.2,
    angles: tuple[float, float] = ANGLES,
    method: Method = "aligned",
    search: Strategy = "coarse to fine",
    expected: Pose | None = None,
) -> Motion:
    """Estimate how a robot moved between two frames.

    Parameters
    ----------
    frame, next_frame : ndarray
        Grey images (height, width) of 8 bits.
    camera : Camera
        Its images, its lens and where it is mounted; frames are taken to be free of distortion.
    template_share : float
        p_T, width of the template as a share of the image's shorter side, up to 0.8.
    angles : (float, float)
        Smallest and largest turn of the robot in degrees, beyond what is expected.
    method : {"aligned", "quadratic", "centroid", "maximum"}
        How the peak of the correlation is refined: by a quadratic through its 27 neighbours, from which on frames are
        aligned by the enhanced correlation coefficient, or by the quadratic alone; by the thesis's weighted centroid
        (Eq. 9–12); or not at all, on frames as they are: the standard algorithm.
    search : {"coarse to fine", "exhaustive"}
        Whether all places and angles are tried on coarse frames of some 80 × 60 pixels first, or at full resolution.
    expected : Pose, optional
        Movement by which the template is chosen from what both frames should show; without it, it is the middle of
        the first (Eq. 3). All places of the next are searched all the same.

    Raises
    ------
    InputError
        If a frame is not of the camera's size, or not grey and of 8 bits, or the template or the angles are nothing.

    References
    ----------
    Chapter 4 of the thesis; G. D. Evangelidis and E. Z. Psarakis, Parametric image alignment using enhanced
    correlation coefficient maximization, IEEE TPAMI 30 (2008).
    """
    a, b = (view_of(image, camera=camera, method=method) for image in (frame, next_frame))
    return motion_between(
        a,
        b,
        camera=camera,
        template_share=template_share,
        angles=angles,
        method=method,
        search=search,
        expected=expected,
    )


def view_of(image: Image, *, camera: Camera, method: Method = "aligned") -> View:
    """Make a frame ready for :func:`motion_between`; InputError as of :func:`estimate_motion`."""
    import cv2

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


def motion_between(
    view: View,
    next_view: View,
    *,
    camera: Camera,
    template_share: float = 0.2,
    angles: tuple[float, float] = ANGLES,
    method: Method = "aligned",
    search: Strategy = "coarse to fine",
    expected: Pose | None = None,
) -> Motion:
    """:func:`estimate_motion` for frames that are ready, so that each need be made so only once."""
    shorter = min(camera.width, camera.height)
    if not (2 * SMALLEST_TEMPLATE <= template_share * shorter <= LARGEST_SHARE * shorter):
        raise InputError(
            f"template_share = {template_share:g} of {shorter} pixels: give {LARGEST_SHARE:g} at most, and what makes "
            f"{2 * SMALLEST_TEMPLATE} pixels at least"
        )
    half = round(template_share * shorter / 2)
    if not (angles[0] < angles[1] <= angles[0] + 360 and max(map(abs, angles)) <= 360):
        raise InputError(f"angles from {angles[0]:g}° to {angles[1]:g}° hold nothing: give the smaller first, in ±360")
    centre = _template_centre(camera, half, expected)
    turned = expected.heading_deg if expected else 0.0
    fine = search_of(
        view.image,
        next_view.image,
        centre=centre,
        half=half,
        step=ANGLE_STEP,
        angles=(angles[0] + turned, angles[1] + turned),
        cubic=method != "maximum",
    )
    if min(view.contrast, next_view.contrast) < LEAST_CONTRAST:
        return _motion(camera, centre, Place(0.0, *centre), flag="blank")
    n = _coarseness(view.image)
    peaks = [climb(fine, place, n + 1) for place in _candidates(view, next_view, fine)]
    if search == "exhaustive":
        peaks.append(peak(fine, fine.whole))
    agreed = {index: _agreement(view, next_view, centre, place_at(fine, index))[0] for index, _ in peaks}
    top, score = max(peaks, key=lambda found: agreed[found[0]])
    others = [index for index in agreed if np.hypot(index[1] - top[1], index[2] - top[2]) > APART * n]
    rival = max((agreed[index] for index in others), default=0.0)
    place = _refined(fine, top, method)
    agreement, overlap = _agreement(view, next_view, centre, place)
    at_limit, *out = (not within[0] < value < within[-1] for value, within in zip(top, fine.whole, strict=True))
    doubts = {
        "overlap": any(out),
        "score": score < LEAST_SCORE or agreement < LEAST_AGREEMENT,
        "repeats": rival > MOST_RIVAL * agreement,
        "step": at_limit,
        "blur": min(view.sharpness, next_view.sharpness) < LEAST_SHARPNESS * max(view.sharpness, next_view.sharpness),
    }
    flag = next((reason for reason, doubted in doubts.items() if doubted), "")
    return _motion(camera, centre, place, score, agreement, rival, overlap, flag)


def expected_overlap(camera: Camera, movement: Pose) -> float:
    """Share of a frame that the next one should show too after a movement, turns left aside."""
    middle, then = _middle(camera), _next_middle(camera, movement)
    right, down = np.clip(1 - np.abs(then - middle) / [camera.width, camera.height], 0, 1)
    return float(right * down)


def _middle(camera: Camera) -> Array:
    """Column and row of the middle of a frame."""
    return np.array([camera.width // 2, camera.height // 2])


def _next_middle(camera: Camera, movement: Pose) -> Array:
    """Column and row in a frame of the middle of the next."""
    x, y = camera.ground(*_middle(camera))
    there = onward(movement, Pose(x, y, 0.0))
    return camera.pixel(there.x_mm, there.y_mm)


def _template_centre(camera: Camera, half: int, expected: Pose | None) -> tuple[int, int]:
    """Row and column of the template: the image's middle, or that of what both frames should show."""
    middle = _middle(camera)
    then = _next_middle(camera, expected) if expected else middle
    room = np.array([camera.width, camera.height]) - 1 - half
    column, row = np.clip(np.rint((middle + then) / 2), half, room).astype(int)
    return int(row), int(column)


def _motion(
    camera: Camera,
    centre: tuple[int, int],
    place: Place,
    score: float = 0.0,
    agreement: float = 0.0,
    rival: float = 0.0,
    overlap: float = 0.0,
    flag: str = "",
) -> Motion:
    """Movement of the robot by that of the template (Eq. 8)."""
    c, s = np.cos(np.radians(place.angle)), np.sin(np.radians(place.angle))
    dx, dy = camera.ground(centre[1], centre[0]) - np.array([[c, -s], [s, c]]) @ camera.ground(place.column, place.row)
    return Motion(float(dx), float(dy), place.angle, score, agreement, rival, overlap, flag)


def _coarseness(image: Array) -> int:
    """Pixels along the side of one of the coarse search's."""
    shorter: int = min(image.shape)
    return max(1, round(shorter / COARSE_SIZE))


def _reduced(image: Array) -> Array:
    """Means of squares of pixels."""
    import cv2

    n = _coarseness(image)
    height, width = (size // n for size in image.shape)
    whole = image[: height * n, : width * n]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _candidates(view: View, next_view: View, fine: Search) -> list[Place]:
    """Where the template may be, by the coarse frames."""
    n = _coarseness(view.image)
    row, column = (round((at + 0.5) / n - 0.5) for at in fine.centre)
    half = max(2, round(fine.half / n))
    angles = fine.whole[0][1] * fine.step, fine.whole[0][-2] * fine.step
    coarse = search_of(
        view.coarse,
        next_view.coarse,
        centre=(row, column),
        half=half,
        step=COARSE_STEP,
        angles=angles,
        cubic=False,
    )
    return [
        Place(angle, fine.centre[0] + n * (i - row), fine.centre[1] + n * (j - column))
        for angle, i, j in coarse_peaks(coarse)
    ]


def _refined(search: Search, top: Index, method: Method) -> Place:
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


def _around(search: Search, top: Index, reach: int) -> tuple[Array, Array]:
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


def _agreement(view: View, next_view: View, centre: Sequence[float], place: Place) -> tuple[float, float]:
    """Correlation of all that two coarse frames both show, and its share of a frame.

    It is the quadrant correlation, as Pearson's for normal values, which a few dark or bright spots that move with the
    camera can't decide: N. Blomqvist, On a measure of dependence between two random variables, 1950.
    """
    import cv2

    a, b = view.detail, next_view.detail
    n = _coarseness(view.image)
    source, target = ((np.asarray(at) + 0.5) / n - 0.5 for at in (centre, place[1:]))
    matrix = warp(place.angle, source, target)
    size, flags = b.shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(a, matrix, size, flags=flags)
    shown = cv2.warpAffine(np.ones_like(a), matrix, size, flags=flags) > 0.999
    overlap = float(shown.mean())
    if overlap < LEAST_OVERLAP:
        return 0.0, overlap
    x, y = moved[shown], b[shown]
    quadrants = np.mean(np.sign(x - np.median(x)) * np.sign(y - np.median(y)))
    return float(np.sin(np.pi / 2 * quadrants)), overlap
