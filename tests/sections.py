"""Sections of a row with points of one's own, on flat soil."""

import numpy as np

from vinemap.canopy.foliage import living_canopies, separate_canopy
from vinemap.canopy.points import Sections


def separate(sections):
    """The canopy of the sections that have one."""
    return living_canopies([separate_canopy(sections)])


def one_section(points, heights=None):
    points = np.asarray(points, dtype=np.float32)
    one = np.ones(1)
    start = np.array([0, len(points)])
    return Sections(
        np.array([1]),
        one,
        np.zeros((1, 3)),
        np.array([[1.0, 0]]),
        2.5 * one,
        0.4 * one,
        start,
        points,
        points[:, 1].copy() if heights is None else heights,
        np.arange(len(points), dtype=np.int32),
    )


def many_sections(points, *, spacing=2.5, step=0.25, member=None):
    """Sections of one row with the points of each, on flat soil."""
    m = len(points)
    start = np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64)
    flat = np.concatenate(points).astype(np.float32) if m else np.empty((0, 2), dtype=np.float32)
    way = np.tile([1.0, 0], (m, 1))
    position = step * np.arange(m)
    origin = np.column_stack([position, np.zeros((m, 2))])
    member = np.arange(len(flat), dtype=np.int32) if member is None else np.concatenate(member)
    of_each = np.full(m, spacing), np.full(m, 0.4)
    return Sections(np.ones(m, int), position, origin, way, *of_each, start, flat, flat[:, 1].copy(), member)
