"""Sections of canopy for tests of their polygons, and what is measured of these."""

import numpy as np

from vinemap.canopy.cgon import enclose


def cross(a, b, p):
    return (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (p[..., 0] - a[..., 0])


def shoelace(polygon):
    y, z = (polygon - polygon[0]).T
    return (y * np.roll(z, -1) - np.roll(y, -1) * z).sum() / 2


def one(points, feet, **kwargs):
    return enclose(points, [0, len(points)], np.asarray(feet)[None], **kwargs)


def canopy(rng, n):
    """Points of a section of canopy, top-heavy, round or ragged, on one foot or two."""
    z = rng.beta(*rng.uniform(1, 4, 2), n)
    y = rng.normal(0, 0.1 + 0.2 * z ** rng.uniform(0, 2), n) + rng.normal(0, 0.05)
    points = np.column_stack([y, 0.5 + rng.uniform(0.5, 1.5) * z])
    low = points[:, 1].min() - rng.uniform(0.01, 0.1)
    half = rng.choice([0.02, 0.15, 0.5])
    return points, np.array([[0, low + rng.uniform(-0.3, 0.1)], [half, low], [-half, low]])
