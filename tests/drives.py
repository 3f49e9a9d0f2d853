"""Drives of a robot whose poses are known, as frames in memory."""

from functools import cache

from vinemap.odometry.frames import Frame
from vinemap.odometry.poses import Pose
from vinemap.simulate.camera import LOW, lay_ground, render


def poses(n, *, step=40.0, turn=1.0, x=-1300.0):
    """A robot that drives a bend: its camera sees what lies within half a metre about the origin."""
    import numpy as np

    out, place, heading = [], np.array([x, 0.0]), -turn * n / 2
    for _ in range(n):
        out.append(Pose(*map(float, place), heading))
        a = np.radians(heading)
        place = place + step * np.array([np.cos(a), np.sin(a)])
        heading += turn
    return out


@cache
def ground(name="gravel", seed=4):
    return lay_ground(name, size_mm=(1800, 1400), seed=seed)


def images(robot, *, name="gravel", camera=LOW, **options):
    laid = ground(name)
    return [render(laid, pose, camera=camera, seed=k, **options) for k, pose in enumerate(robot)]


def frames(shots):
    return [Frame(str(k), None, image, "" if image is not None else "unreadable") for k, image in enumerate(shots)]
