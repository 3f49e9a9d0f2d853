"""Where something stands on a plane and which way it looks, and movements from one such place to another."""

from __future__ import annotations

from math import cos, radians, sin
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from vinemap.compute.arrays import Values


class Pose(NamedTuple):
    """Place and heading in a frame; of one pose in the frame of another, a movement."""

    x_mm: float
    """To the right, or forward."""
    y_mm: float
    """Upward, or to the left."""
    heading_deg: float
    """Anticlockwise from the x axis."""


STILL = Pose(0.0, 0.0, 0.0)


def moved(pose: Pose, next_pose: Pose) -> Pose:
    """The movement from a pose to the next: forward, to the left, and turned by -180° to 180°."""
    c, s = cos(radians(pose.heading_deg)), sin(radians(pose.heading_deg))
    x, y = next_pose.x_mm - pose.x_mm, next_pose.y_mm - pose.y_mm
    turn = (next_pose.heading_deg - pose.heading_deg + 180) % 360 - 180
    return Pose(x * c + y * s, y * c - x * s, turn)


def onward(pose: Pose, movement: Pose) -> Pose:
    """The pose after a movement; headings run on beyond 180°."""
    c, s = cos(radians(pose.heading_deg)), sin(radians(pose.heading_deg))
    dx, dy, turn = movement
    return Pose(pose.x_mm + dx * c - dy * s, pose.y_mm + dx * s + dy * c, pose.heading_deg + turn)


def onward_covariance(pose: Pose, covariance: Values, movement: Pose, of_movement: Values) -> Values:
    """Covariance (3, 3) in mm and degrees of the pose after a movement, from that of the pose and of the movement."""
    c, s = cos(radians(pose.heading_deg)), sin(radians(pose.heading_deg))
    dx, dy, _ = movement
    of_pose = np.array([[1, 0, -radians(dx * s + dy * c)], [0, 1, radians(dx * c - dy * s)], [0, 0, 1]])
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.asarray(of_pose @ covariance @ of_pose.T + turn @ of_movement @ turn.T)
