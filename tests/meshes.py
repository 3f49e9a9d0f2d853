"""Rows of canopy as meshes: profiles swept eastwards."""

import numpy as np

from vinemap.canopy.mesh import Mesh, loft, merge

ORIGIN = np.array([395_000.0, 4_650_000.0, 300.0])


def along(profile, length=10.0, sections=5, shift=(0.0, 0.0, 0.0)):
    """A profile (c, 2) of (lateral, height) swept eastwards, lateral positive to the south, as a row's right is."""
    x = np.linspace(0, length, sections)
    flat = np.broadcast_to(np.asarray(profile, dtype=float), (sections, len(profile), 2))
    swept = np.stack([np.broadcast_to(x[:, None], flat.shape[:2]), -flat[..., 0], flat[..., 1]], axis=2)
    return swept + ORIGIN + shift


SQUARE = [[0, 0], [1, 0], [1, 2], [-1, 2], [-1, 0]]
NOTCHED = [[0, 1.5], [1, 0], [1, 2], [0.5, 2.5], [-1, 2], [-1, 0]]
FLAT = [[0, 0], [0.5, 0], [1, 1], [0.5, 2], [-0.5, 2], [-1, 1], [-0.5, 0]]
LEANING = [[0, 0], [0.1, 1], [1, 1.2], [1, 2], [-1, 2], [-1, 1.2], [-0.1, 1]]


def area(profile):
    y, z = np.transpose(profile)
    return abs((y * np.roll(z, -1) - np.roll(y, -1) * z).sum()) / 2


def closed(vertices, faces):
    """Whether every edge is run through once in each direction."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = {tuple(edge) for edge in edges.tolist()}
    return len(forward) == len(edges) and all((b, a) in forward for a, b in forward)


def rows():
    number = {"length_m": np.float64(10), "gap_m": np.nan, "n_key_points": np.int64(5), "ends": np.array([1.5, np.inf])}
    return [
        Mesh(*loft(along(SQUARE)), row_id=1, label="1 F", extras=number),
        Mesh(*merge([loft(along(NOTCHED, shift=(0, 2.5, 1))), loft(along(SQUARE, shift=(90, 2.5, 1)))]), 2, "2 F"),
        Mesh(*merge([]), row_id=3, label="3 F"),
    ]


def bumpy(sections, turn=1, **fields):
    """A row of sections that all differ, a quarter of a metre apart, in a direction of its own."""
    corners = along(LEANING[::turn], length=sections / 4, sections=sections)
    corners[..., 1:] += np.random.default_rng(sections).uniform(-0.05, 0.05, corners.shape[:2] + (2,))
    corners[..., 1] += 0.6 * (corners[..., 0] - ORIGIN[0])
    return Mesh(*loft(corners), **fields)
