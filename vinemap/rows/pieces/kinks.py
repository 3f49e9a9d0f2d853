"""Kinks of pieces of rows, at which blocks abut, or which all rows have."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import maximum_filter1d

from vinemap.geo.curve import cross

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from vinemap.compute.arrays import Ints, Values

TANGENT_LENGTH = 5.0
"""Metres of a piece's end that tell its tangent."""
KINK = 0.16
"""Radians that a row may turn beyond what it does before and after."""
SHORT = 2.5
"""Metres below which a piece is too short to tell its own direction: the row field does."""
STRIDE = 0.5
"""Metres between the places of a piece at which it is asked whether it turns."""
BESIDE, ASLANT, STRETCH = 4, 2.5, 3.5
"""Rows on each side of a kink that are looked at, from so many metres before and after it, and over so many."""


def torn_at_kinks(tree: cKDTree, spacing: Values, pieces: Ints, position: Values) -> tuple[Ints, Values]:
    """Pieces (n,) of a tree of key points and their places along them, torn at kinks where more rows end than go on.

    There two blocks abut, at a track that narrows to nothing, and rows of both touch.
    """
    xy, pieces, position = tree.data, pieces.copy(), position.copy()
    order = np.argsort(pieces, kind="stable")
    first = np.searchsorted(pieces[order], np.arange(pieces.max() + 2))
    for p in np.flatnonzero(np.diff(first)):
        members = order[first[p] : first[p + 1]]
        for s in reversed(_kinks(xy[members], position[members])):
            middle, before, after = (
                xy[members[np.abs(position[members] - at).argmin()]]
                for at in (s, s - TANGENT_LENGTH, s + TANGENT_LENGTH)
            )
            own = pieces[members[:1]]
            through, ended = pieces_beside(tree, own, middle, after - before, pieces=pieces, spacing=spacing)
            if ended > 2 * through:
                beyond = members[position[members] > s]
                pieces[beyond] = pieces.max() + 1
                position[beyond] -= position[beyond].min()
                members = members[position[members] <= s]
    return pieces, position


def _kinks(xy: Values, position: Values) -> Values:
    """Metres along a piece (n, 2) at which it turns more than it bends before and after."""
    k, least = round(TANGENT_LENGTH / STRIDE), round(SHORT / STRIDE)
    order = np.argsort(position)
    along = np.arange(0, position[order[-1]], STRIDE)
    if len(along) <= 2 * least:
        return np.empty(0)
    curve = np.column_stack([np.interp(along, position[order], xy[order, axis]) for axis in (0, 1)])
    here = np.arange(least, len(along) - least)
    before, after = (
        curve[here] - curve[np.maximum(here - k, 0)],
        curve[np.minimum(here + k, len(along) - 1)] - curve[here],
    )
    turn = np.zeros(len(along))
    turn[here] = np.arctan2(cross(before, after), (before * after).sum(axis=1))
    padded = np.pad(turn, k)
    sides = np.stack([padded[: -2 * k], padded[2 * k :]])
    bend = sides.sum(axis=0) / np.maximum(np.count_nonzero(sides, axis=0), 1)
    # Beside a kink it is a bend, and what is straight there no kink.
    kink = np.minimum(np.abs(turn), np.abs(turn - bend))
    out: Values = along[(kink > KINK) & (kink == maximum_filter1d(kink, 4 * k - 1))]
    return out


def pieces_beside(
    tree: cKDTree, own: Ints, middle: Values, way: Values, length: float = 0.0, *, pieces: Ints, spacing: Values
) -> tuple[int, int]:
    """How many pieces beside a gap of a length, or a kink, go on through it, and how many don't, of a tree of points.

    A row that ends there and another that begins are two that don't.
    """
    past = max(length / 2, ASLANT)
    reach = np.hypot(past + STRETCH, BESIDE * float(spacing[tree.query(middle)[1]]))
    near = np.array(tree.query_ball_point(middle, reach), dtype=np.intp)
    x = (tree.data[near] - middle) @ way / np.hypot(*way)
    sides = [pieces[near[(sign * x >= past) & (sign * x <= past + STRETCH)]] for sign in (-1, 1)]
    before, after = (set(side) - set(own.tolist()) for side in sides)
    return len(before & after), len(before ^ after)
