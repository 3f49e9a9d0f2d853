"""A track that is pulled to satellite fixes by least squares.

A pose graph solved by Gauss–Newton with sparse factors: G. Grisetti and others, A tutorial on graph-based SLAM, IEEE
Intelligent Transportation Systems Magazine 2, 2010.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu
from scipy.special import chdtr

from vinemap.odometry.poses import Pose, moved

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Flags, Values
    from vinemap.odometry.sensors.fixes import Fixes
    from vinemap.odometry.track import TrackPoint

START_MM, START_DEG = 1000.0, 10.0
"""Standard deviations of a start where fixes know better."""
PRIOR = np.array([1 / START_MM, 1 / START_MM, 1 / np.radians(START_DEG)])
"""Square roots of the information (3,) that a start is."""
FAR = 4.0
"""Standard deviations from the track from which on a fix is left out."""
LIKELY = 0.999
"""Probability of an error that is no larger, from which on steps and fixes contradict each other."""


class Pulled(NamedTuple):
    """A track that was pulled to fixes."""

    track: list[TrackPoint]
    left_out: int
    """Fixes that don't count."""
    fits: bool
    """Whether steps and fixes contradict each other no more than they err by what is said of them."""


def pulled(track: Sequence[TrackPoint], fixes: Fixes) -> Pulled:
    """A track with the poses and covariances that fit steps and fixes best.

    Fixes that lie far from where all others put the robot don't count, nor those beside the recording.
    """
    poses = np.array([point.pose for point in track])
    poses[:, 2] = np.radians(poses[:, 2])
    at, weight, used = _frames_at(fixes, track)
    unit = np.array([1, 1, np.radians(1)])
    start = np.arange(len(track)) - 1
    ends = [(start[k] if point.measured_from is None else point.measured_from, k) for k, point in enumerate(track)][1:]
    links = np.array(ends, int).reshape(-1, 2)
    steps = [track[j].motion.movement if track[j].motion else moved(track[i].pose, track[j].pose) for i, j in links]
    sure = [np.linalg.cholesky(np.linalg.inv(unit[:, None] * track[j].of_step * unit)).T for _, j in links]
    graph = _Graph(links, np.array(steps).reshape(-1, 3) * unit, np.array(sure).reshape(-1, 3, 3), at, weight)
    way = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    kept = used & (np.hypot(*fixes.xy.T) < 2 * way + FAR * (START_MM + fixes.sd))
    at_first = poses
    for _ in range(int(used.sum()) + 1):
        poses, misfit = _solved(at_first, graph, fixes, kept)
        off = np.hypot(*(_place_at(poses, at, weight) - fixes.xy).T) / fixes.sd
        worst = int(np.argmax(np.where(kept, off, 0)))
        if not kept[worst] or off[worst] <= FAR or kept.sum() <= 1:
            break
        kept[worst] = False
    covariances = _covariances(poses, graph, fixes, kept) / unit[:, None] / unit
    poses[:, 2] = np.degrees(poses[:, 2])
    out = [
        point._replace(pose=Pose(*map(float, pose)), covariance=covariance)
        for point, pose, covariance in zip(track, poses, covariances, strict=True)
    ]
    fits = not kept.any() or chdtr(2 * kept.sum(), misfit) <= LIKELY  # chi-squared
    return Pulled(out, int(len(kept) - kept.sum()), bool(fits))


class _Graph(NamedTuple):
    """Steps (n, 3) from poses to others (n, 2), square roots of their information; frames at fixes, and shares."""

    links: Values
    steps: Values
    sure: Values
    frames: Values
    weight: Values


def _frames_at(fixes: Fixes, track: Sequence[TrackPoint]) -> tuple[Values, Values, Values]:
    """The frame before each place in time, how far it is on to the next, and whether there are both."""
    told = np.array([k for k, point in enumerate(track) if point.time is not None])
    times = np.maximum.accumulate([track[k].time for k in told])
    after = np.clip(np.searchsorted(times, fixes.times, "right"), 1, len(times) - 1)
    share = (fixes.times - times[after - 1]) / np.maximum(times[after] - times[after - 1], 1e-9)
    period = float(np.median(np.diff(times))) or 1.0
    near = (fixes.times >= times[0] - period) & (fixes.times <= times[-1] + period)
    return np.column_stack([told[after - 1], told[after]]), np.clip(share, 0, 1), near


def _place_at(poses: Values, at: Values, weight: Values) -> Values:
    return poses[at[:, 0], :2] * (1 - weight[:, None]) + poses[at[:, 1], :2] * weight[:, None]


def _solved(poses: Values, graph: _Graph, fixes: Fixes, kept: Flags) -> tuple[Values, float]:
    """Poses by Gauss–Newton, and what is left of all squared errors over their variances."""
    poses = poses.copy()
    first = poses[0].copy()
    i, j = graph.links.T
    n = len(i)
    rows = np.repeat(np.arange(3 * n).reshape(n, 3), 3, axis=1).reshape(-1)
    at, weight = graph.frames[kept], graph.weight[kept]
    under = 3 * n + 3 + np.arange(2 * len(at))
    for _ in range(10):
        off, of_i, of_j = _linear(poses, graph)
        entries = [
            (rows, np.tile(3 * ends[:, None] + np.arange(3), 3).reshape(-1), part.reshape(-1))
            for ends, part in ((i, of_i), (j, of_j))
        ]
        entries.append((3 * n + np.arange(3), np.arange(3), PRIOR))
        entries += [
            (under, (3 * at[:, [end]] + np.arange(2)).reshape(-1), np.repeat(part / fixes.sd[kept], 2))
            for end, part in ((0, 1 - weight), (1, weight))
        ]
        row, column, value = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        slopes = coo_matrix((value, (row, column)), shape=(3 * n + 3 + 2 * len(at), poses.size)).tocsc()
        misses = (_place_at(poses, at, weight) - fixes.xy[kept]) / fixes.sd[kept, None]
        residuals = np.concatenate([off.reshape(-1), PRIOR * (poses[0] - first), misses.reshape(-1)])
        normal = slopes.T @ slopes
        scale = 1 / np.sqrt(normal.diagonal())  # unknowns alike
        factors = splu((diags(scale) @ normal @ diags(scale)).tocsc())
        step = scale * factors.solve(scale * (slopes.T @ residuals))
        poses -= step.reshape(-1, 3)
        if np.abs(step).max() < 1e-6:
            break
    return poses, float(residuals @ residuals)


def _linear(poses: Values, graph: _Graph) -> tuple[Values, Values, Values]:
    """Errors (n, 3) of steps in standard deviations, and their slopes (n, 3, 3) by poses they lead from and to."""
    i, j = graph.links.T
    c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
    d = poses[j] - poses[i]
    ahead, left = d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s
    off = np.column_stack([ahead, left, d[:, 2]]) - graph.steps
    of_j, of_i = np.zeros((2, len(i), 3, 3))
    of_j[:, 0, 0], of_j[:, 0, 1], of_j[:, 1, 0], of_j[:, 1, 1], of_j[:, 2, 2] = c, s, -s, c, 1
    of_i[:] = -of_j
    of_i[:, 0, 2], of_i[:, 1, 2] = left, -ahead
    return np.einsum("nij,nj->ni", graph.sure, off), graph.sure @ of_i, graph.sure @ of_j


def _covariances(poses: Values, graph: _Graph, fixes: Fixes, kept: Flags) -> Values:
    """Covariances (n + 1, 3, 3) of poses in mm and radians.

    As each pose has one step to it, the graph is a tree but for fixes between two frames, which count for the nearer
    one: what is known of a pose comes from the leaves up, and of the rest down from the root. D. Koller and
    N. Friedman, Probabilistic Graphical Models, 2009, chapter 10.
    """
    known = np.zeros((len(poses), 3, 3))
    known[0] = np.diag(PRIOR**2)
    nearer = np.where(graph.weight[kept] < 0.5, *graph.frames[kept].T)
    for axis in range(2):
        np.add.at(known[:, axis, axis], nearer, fixes.sd[kept] ** -2.0)
    _, above, below = _linear(poses, graph)
    turned, parents = above.transpose(0, 2, 1), graph.links[:, 0]
    own, cross, passed = below.transpose(0, 2, 1) @ below, turned @ below, turned @ above
    out, gains = np.empty_like(known), np.empty_like(above)
    for k in range(len(poses) - 1, 0, -1):
        out[k] = np.linalg.inv(known[k] + own[k - 1])
        gains[k - 1] = out[k] @ cross[k - 1].T
        known[parents[k - 1]] += passed[k - 1] - cross[k - 1] @ gains[k - 1]
    out[0] = np.linalg.inv(known[0])
    for k in range(1, len(poses)):
        out[k] += gains[k - 1] @ out[parents[k - 1]] @ gains[k - 1].T
    return out
