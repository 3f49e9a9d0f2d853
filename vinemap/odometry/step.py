"""Visual odometry: how a robot moved between two frames of a camera that looks down, by cross-correlation.

Chapter 4 of the thesis, its print put right: Eq. 8 gives the ground's movement as the robot sees it, of which the
robot's own is the negative.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from vinemap.errors import InputError
from vinemap.odometry.correlation import COARSE_STEP, Place, Search, climb, coarse_peaks, peak, place_at, search_of
from vinemap.odometry.field import cleaner_of
from vinemap.odometry.judgement import CHANGED, CHANGED_ROUGHLY, MOST_RIVAL, agreement_at, doubt
from vinemap.odometry.patches import fit_of, patches_at
from vinemap.odometry.poses import Pose, moved, onward
from vinemap.odometry.refinement import Method, refine
from vinemap.odometry.views import LEAST_CONTRAST, View, coarseness, view_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from vinemap.compute.arrays import Flags, Image, Values
    from vinemap.config.camera import Camera
    from vinemap.odometry.correlation import Index
    from vinemap.odometry.patches import Fit

Strategy = Literal["coarse to fine", "exhaustive"]
ANGLES = (-9.0, 9.0)
"""Degrees that a robot turns by from one frame to the next (Section 4.4)."""
ANGLE_STEP = 1.15
"""Degrees between the angles of the search: what moves the edge of a template of 49 pixels by half a pixel."""
APART = 1.5
"""Pixels of the coarse frames between two places that aren't the same."""
SMALLEST_TEMPLATE = 5
"""Half width of a template in pixels."""
ASIDE = 3
"""Quarters of a template that it is put aside by at most, either way, where its place shows no ground."""
CLEAR_LEAD, LACKS = 0.5, 0.02
"""Of what patches lack of a full correlation at the next best place, the most that they lack at a better one; and what
they lack anyway."""
FINE_SPREAD = 0.2
"""Pixels by which patches disagree from which on they know better where frames lie that they see more coarsely."""
SURE, LIKELY = 0.6, 0.25
"""What agrees at a place that is hardly a wrong one; and the share of what agreed there, when it was known to some
pixels only, which others so known must reach to be as good."""
LITTLE = 0.05
"""Share of a template that may show no ground."""
UNSURE = (1.0, 1.0, 1e-4)
"""Variances in pixels² and radians² of a step that too few patches tell about."""
LARGEST_SHARE = 0.8
"""p_T above which nothing is left to move in."""


class Motion(NamedTuple):
    """How the robot moved from one frame to the next, in the frame of where it was."""

    dx_mm: float
    """Forward."""
    dy_mm: float
    """To the left."""
    rotation_deg: float
    """Anticlockwise."""
    covariance: Values
    """Of the three (3, 3), in mm and degrees, by how much patches disagree."""
    score: float = 0.0
    """Normalised cross-correlation of the template at its best place, up to 1."""
    agreement: float = 0.0
    """Correlation of all that both frames show, so moved, by signs; of a few peaks that with the highest is chosen."""
    rival: float = 0.0
    """The same for the next best place that fine detail doesn't tell from it."""
    overlap: float = 0.0
    """Share of the frame that the next one shows too."""
    flag: str = ""
    """Why the step isn't to be believed: "blank", "blur", "overlap", "score", "ambiguous", "relief", "tilt", "step"; or
    empty."""
    scale: float = 1.0
    """How much larger the next frame shows the ground: how much lower the camera is there."""
    tilt_deg: float = np.nan
    """Between the ground and the image's plane; unknown of short steps."""

    @property
    def movement(self) -> Pose:
        """The next pose in the frame of the first."""
        return Pose(self.dx_mm, self.dy_mm, self.rotation_deg)


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
    cleaner = cleaner_of(None, camera)
    a, b = (view_of(image, camera=camera, method=method, cleaner=cleaner) for image in (frame, next_frame))
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
    centre = _template_centre(camera, half, expected, view.hidden)
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
        return _motion(camera, centre, Place(0.0, *centre), None)._replace(flag="blank")
    agree = partial(agreement_at, view, next_view, centre)
    places, guess = _candidates(view, next_view, fine), expected and _place_of(camera, centre, expected)
    peaks = peaks_near(fine, [guess, *places[:-1]] if guess else places, agree, coarseness(view.image) + 1)
    if search == "exhaustive":
        index, score = peak(fine, fine.whole)
        peaks[index] = score, agree(place_at(fine, index), most_change=CHANGED_ROUGHLY)[0]
    top, rival = _chosen(view, next_view, fine, {index: agreed for index, (_, agreed) in peaks.items()}, guess)
    place = refine(fine, top, method)
    patches = patches_at(view, next_view, centre, place)
    fit = fit_of(patches, place, centre, camera.fx)
    if fit and method == "aligned":
        finer = patches.unit > 1 and fit.spread <= FINE_SPREAD
        place, fit = fit.turned(place) if finer else (fit.corrected(place), fit)
    agreement, overlap = agree(place, most_change=CHANGED if method == "aligned" else CHANGED_ROUGHLY)
    score, _ = peaks[top]
    at_limits = [not within[0] < value < within[-1] for value, within in zip(top, fine.whole, strict=True)]
    flag = doubt(view, next_view, at_limits, score=score, agreement=agreement, rival=rival, patches=patches, fit=fit)
    motion = _motion(camera, centre, place, fit)
    return motion._replace(score=score, agreement=agreement, rival=rival, overlap=overlap, flag=flag)


def peaks_near(
    fine: Search, places: Sequence[Place], agree: Callable[..., tuple[float, float]], reach: int
) -> dict[Index, tuple[float, float]]:
    """Peaks near places known to some pixels, the template's correlation and what agrees there.

    Once there is a sure one, places where much less agrees, however roughly they are known, are left out.
    """
    peaks: dict[Index, tuple[float, float]] = {}
    roughly = {place: agree(place, most_change=np.inf)[0] for place in places}
    most = -np.inf
    for place in sorted(roughly, key=lambda place: -roughly[place]):
        if roughly[place] < LIKELY * most:
            break
        index, score = climb(fine, place, reach)
        agreed, _ = agree(place_at(fine, index), most_change=CHANGED_ROUGHLY)
        peaks[index] = score, agreed
        if agreed > SURE:
            most = max(most, roughly[place])
    return peaks


def _chosen(
    view: View, next_view: View, fine: Search, agreed: Mapping[Index, float], expected: Place | None
) -> tuple[Index, float]:
    """The place at which most agrees, and what agrees at the next best one.

    Of places at which nearly as much does, as on a pattern, patches of fine detail choose, else what is expected.
    """
    apart: list[Index] = []
    for index in sorted(agreed, key=lambda index: -agreed[index]):
        if all(np.hypot(index[1] - at[1], index[2] - at[2]) > APART * coarseness(view.image) for at in apart):
            apart.append(index)
    most = agreed[apart[0]]
    equals = [index for index in apart if agreed[index] >= min(MOST_RIVAL * most, most)]
    if len(equals) > 1:
        patches = {index: patches_at(view, next_view, fine.centre, place_at(fine, index)) for index in equals}
        lacks = {index: LACKS + 1 - found.mean for index, found in patches.items()}
        equals = [index for index in equals if lacks[index] * CLEAR_LEAD <= min(lacks.values())]
    if len(equals) > 1 and expected:
        equals.sort(key=lambda index: float(np.hypot(index[1] - expected.row, index[2] - expected.column)))
    others = equals[1:] or [index for index in apart if agreed[index] < MOST_RIVAL * most]
    return equals[0], max((agreed[index] for index in others), default=0.0)


def expected_overlap(camera: Camera, movement: Pose) -> float:
    """Share of a frame that the next one should show too after a movement, turns left aside."""
    middle, then = _middle(camera), _next_middle(camera, movement)
    right, down = np.clip(1 - np.abs(then - middle) / [camera.width, camera.height], 0, 1)
    return float(right * down)


def _middle(camera: Camera) -> Values:
    """Column and row of the middle of a frame."""
    return np.array([camera.width // 2, camera.height // 2])


def _next_middle(camera: Camera, movement: Pose) -> Values:
    """Column and row in a frame of the middle of the next."""
    x, y = camera.ground(*_middle(camera))
    there = onward(movement, Pose(x, y, 0.0))
    return camera.pixel(there.x_mm, there.y_mm)


def _template_centre(camera: Camera, half: int, expected: Pose | None, hidden: Flags | None) -> tuple[int, int]:
    """Row and column of the template: the image's middle, or that of what both frames should show, or ground beside."""
    middle = _middle(camera)
    then = _next_middle(camera, expected) if expected else middle
    room = np.array([camera.width, camera.height]) - 1 - half
    centre = np.clip(np.rint((middle + then) / 2), half, room).astype(int)
    if hidden is None:
        return int(centre[1]), int(centre[0])
    aside = np.stack(np.meshgrid(*[np.arange(-ASIDE, ASIDE + 1) * half // 2] * 2), axis=-1).reshape(-1, 2)
    places = np.clip(centre + aside, half, room)
    covered = [hidden[r - half : r + half + 1 : 2, c - half : c + half + 1 : 2].mean() for c, r in places]
    far = np.hypot(*(places - centre).T) / (half * ASIDE)
    column, row = places[np.argmin(np.maximum(covered, LITTLE) + LITTLE * far)]
    return int(row), int(column)


def _place_of(camera: Camera, centre: tuple[int, int], movement: Pose) -> Place:
    """Where the template of a movement is: the inverse of :func:`_motion`."""
    x, y = camera.ground(centre[1], centre[0])
    there = moved(movement, Pose(float(x), float(y), 0.0))
    column, row = camera.pixel(there.x_mm, there.y_mm)
    return Place(movement.heading_deg, float(row), float(column))


def _motion(camera: Camera, centre: tuple[int, int], place: Place, fit: Fit | None) -> Motion:
    """Movement of the robot by that of the template (Eq. 8), and how sure it is by patches."""
    c, s = np.cos(np.radians(place.angle)), np.sin(np.radians(place.angle))
    turn, there = np.array([[c, -s], [s, c]]), camera.ground(place.column, place.row)
    dx, dy = camera.ground(centre[1], centre[0]) - turn @ there
    slopes = np.eye(3)
    slopes[:2, :2] = -turn @ camera.to_robot[:, :2]
    slopes[:2, 2] = -np.array([[-s, -c], [c, -s]]) @ there
    degrees = np.diag([1, 1, np.degrees(1)])
    covariance = degrees @ slopes @ (fit.covariance if fit else np.diag(UNSURE)) @ slopes.T @ degrees
    motion = Motion(float(dx), float(dy), place.angle, covariance)
    if fit is None:
        return motion
    tilt = float(np.degrees(np.arctan(np.hypot(*fit.slope)))) if fit.slope is not None else np.nan
    return motion._replace(scale=1 + fit.scale, tilt_deg=tilt)


def _candidates(view: View, next_view: View, fine: Search) -> list[Place]:
    """Where the template may be, by the coarse frames."""
    n = coarseness(view.image)
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
