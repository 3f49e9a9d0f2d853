"""Gaps of a track that no frame tells, crossed by what the whole of a recording knows.

On its way a robot knows what came before a gap. Afterwards more is known: the steps behind it, and wheels that were
held against all other frames. How far each is to be believed is measured by the recording itself, over stretches as
long, in frames and in time, that frames do tell.
"""

from __future__ import annotations

from itertools import pairwise, takewhile
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.odometry.poses import Pose, moved, onward, onward_covariance
from vinemap.odometry.sensors.pulling import Pulled, pulled
from vinemap.odometry.sensors.wheels import UNTOLD
from vinemap.odometry.track import stretches

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from vinemap.compute.arrays import Ints, Values
    from vinemap.odometry.sensors.fixes import Fixes
    from vinemap.odometry.sensors.wheels import Odometer
    from vinemap.odometry.track import TrackPoint

AROUND = 5
"""Steps at either side of a gap, at most, that tell those within."""
DEGREES = (1, 2, 3, 4)
"""Of polynomials that fit them best."""
WINDOWS = 1000
"""Stretches as long as a gap that it is held against, at most: the nearest."""
DIFFERENT = 20
"""How many of them, at most, begin within the length of one: nearer ones tell the same."""
UNSEEN = frozenset({"unreadable", "size", "repeated", "blank"})
"""Flags of frames that were lost whatever the robot did meanwhile."""


class _Known(NamedTuple):
    """What a recording tells of the steps (n, 3) to its frames from those before, NaN where it doesn't."""

    seen: Values
    """By frames."""
    untold: Ints
    """How many of them up to each frame (n,) frames don't tell."""
    driven: Values
    """By wheels."""
    seconds: Values
    """That they took (n,): as most of them where nothing tells, and 1 of a recording without times."""
    period: float
    """What most of them took."""


def bridged(track: Sequence[TrackPoint], odometer: Odometer | None = None) -> list[TrackPoint]:
    """A track whose stretches are joined by the likeliest steps across the gaps between them.

    Each part of a step, ahead, to the left and its turn, is that of wheels, or of a polynomial through the steps beside
    the gap, by least squares: of what comes closest to frames over stretches as long that they do tell, and as sure as
    that. A gap that may come of the robot's own movement is no surer than a guess over its time, as nothing like that
    was seen. What compares with no other stretch is left as it was. Flags stay.

    Parameters
    ----------
    track : sequence of TrackPoint
        Of a whole recording, as :func:`vinemap.odometry.track.follow` tells them.
    odometer : Odometer, optional
        The sensor of that, which has learned of all frames.
    """
    numbers = stretches(track)
    known = _known(track, numbers, odometer)
    in_stretches = [(k, number) for k, number in enumerate(numbers) if number]
    measured = [np.diag(point.of_step) for point in track if point.motion] or [np.zeros(3)]
    surest = np.median(measured, axis=0)
    steps: dict[int, tuple[Pose, Values]] = {}
    for (before, stretch), (after, next_stretch) in pairwise(in_stretches):
        found = _crossing(known, before, after) if stretch != next_stretch else None
        if found is None:
            continue
        lost = after - before > 1 and all(point.flag in UNSEEN for point in track[before + 1 : after])
        told, variance = found
        for k, step in enumerate(told, start=before + 1):
            late = np.where(np.isnan(known.driven[k]), max(known.seconds[k] / known.period, 1), 1)
            least = surest if lost else np.diag(track[k].of_step) * late**2
            steps[k] = Pose(*map(float, step)), np.diag(np.maximum(variance, least))
    return _carried(track, steps)


def joined(track: Sequence[TrackPoint], fixes: Fixes, odometer: Odometer | None = None) -> Pulled:
    """A track that is bridged and pulled to fixes, or pulled as it was where they contradict what bridges it.

    Parameters are as of :func:`bridged` and :func:`vinemap.odometry.sensors.pulling.pulled`.
    """
    found = pulled(bridged(track, odometer), fixes)
    if found.fits and not found.left_out:
        return found
    return min(found, pulled(track, fixes), key=lambda one: (one.left_out, not one.fits))


def _known(track: Sequence[TrackPoint], numbers: Sequence[int], odometer: Odometer | None) -> _Known:
    seen, driven = np.full((2, len(track), 3), np.nan)
    seconds = np.full(len(track), np.nan)
    for k, (before, point) in enumerate(pairwise(track), start=1):
        if numbers[k] and numbers[k] == numbers[k - 1]:
            seen[k] = moved(before.pose, point.pose)
        if point.time is not None and before.time is not None:
            seconds[k] = point.time - before.time
        if odometer and (told := odometer.between(before.time, point.time, UNTOLD)):
            driven[k] = told[0]
    timed = seconds > 0
    period = float(np.median(seconds[timed])) if timed.any() else 1.0
    untold = np.cumsum(np.isnan(seen[:, 0]))
    return _Known(seen, untold, driven, np.where(timed, seconds, period), period)


def _crossing(known: _Known, before: int, after: int) -> tuple[Values, Values] | None:
    """The steps to the frames behind one and up to another (n, 3), and the variance (3,) of each."""
    inside = np.arange(1, after - before + 1)
    lasting = max(len(inside), round(known.seconds[before + inside].sum() / known.period))
    as_long = np.arange(1, lasting + 1)
    apart = 1 + lasting // DIFFERENT
    for around in range(AROUND, 0, -1):
        beside = _beside(known.seen, before, after, around)
        beside_it = beside + (lasting - len(inside)) * (beside > 0)
        alike = _alike(known.untold, before, np.concatenate([as_long, beside_it]), apart)
        if len(alike):
            break
    off = np.sum(_ways(known, alike, as_long, beside_it) - known.seen[alike[:, None] + as_long], axis=2)
    n = np.sum(~np.isnan(off), axis=1)
    few = 1 + 2 / np.maximum(n * apart / lasting, 1)  # as Student's distribution is wider
    told = _ways(known, np.array([before]), inside, beside)[:, 0]
    usable = (n > 0) & ~np.isnan(told).any(axis=1)
    spread = np.where(usable, few * np.nansum(off**2, axis=1) / np.maximum(n, 1), np.inf)
    best = np.argmin(spread, axis=0)
    variance = spread[best, range(3)]
    return (told[best, :, range(3)].T, variance / len(inside)) if np.isfinite(variance).all() else None


def _ways(known: _Known, at: Ints, inside: Ints, beside: Ints) -> Values:
    """Steps (w, n, m, 3) in stretches behind frames (n,), by wheels and by polynomials through those beside them."""
    at = at[:, None]
    ways = [known.driven[at + inside]]
    if beside.min(initial=1) < inside[0] and beside.max(initial=0) > inside[-1]:
        speeds = known.seen[at + beside] / known.seconds[at + beside, None]
        ways += [
            (_polynomial(beside, inside, degree) @ speeds) * known.seconds[at + inside, None]
            for degree in DEGREES
            if degree < len(beside)
        ]
    return np.array(ways)


def _polynomial(known: Ints, wanted: Ints, degree: int) -> Values:
    """Weights (m, n) of values at places (n,) that make up, at others (m,), the polynomial that fits them best."""
    unit = np.ptp(known)
    out: Values = np.vander(wanted / unit, degree + 1) @ np.linalg.pinv(np.vander(known / unit, degree + 1))
    return out


def _beside(seen: Values, before: int, after: int, around: int) -> Ints:
    """The steps nearest to a gap that frames tell without a break, by how far on from the frame before it they are."""
    found = []
    for first, way in ((before, -1), (after + 1, 1)):
        steps = range(first, first + way * around, way)
        found += list(takewhile(lambda k: 0 <= k < len(seen) and not np.isnan(seen[k, 0]), steps))
    return np.sort(np.array(found, int)) - before


def _alike(untold: Ints, before: int, steps: Ints, apart: int) -> Ints:
    """The frames (n,) nearest to the one before a gap, so far apart, from which all such steps on are told."""
    length = int(np.ptp(steps)) + 1
    found = (np.flatnonzero(untold[length:] == untold[:-length]) + 1 - steps.min())[::apart]
    return np.sort(found[np.argsort(np.abs(found - before), kind="stable")][:WINDOWS])


def _carried(track: Sequence[TrackPoint], steps: Mapping[int, tuple[Pose, Values]]) -> list[TrackPoint]:
    """The track with other steps, and covariances of them, to some of its poses from those before."""
    out: list[TrackPoint] = []
    for k, point in enumerate(track):
        if point.motion is not None and point.measured_from is not None:
            anchor, step, of_step = out[point.measured_from], point.motion.movement, point.of_step
        elif k in steps:
            anchor, (step, of_step) = out[k - 1], steps[k]
        elif steps and k > min(steps):
            anchor, step, of_step = out[k - 1], moved(track[k - 1].pose, point.pose), point.of_step
        else:
            out.append(point)
            continue
        pose, covariance = onward(anchor.pose, step), onward_covariance(anchor.pose, anchor.covariance, step, of_step)
        out.append(point._replace(pose=pose, covariance=covariance, of_step=of_step))
    return out
