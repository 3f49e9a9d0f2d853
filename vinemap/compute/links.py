"""What hangs together by links of two."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

if TYPE_CHECKING:
    from vinemap.compute.arrays import Ints


NEXT = (
    (np.s_[:, :-1], np.s_[:, 1:]),
    (np.s_[:-1], np.s_[1:]),
    (np.s_[:-1, :-1], np.s_[1:, 1:]),
    (np.s_[:-1, 1:], np.s_[1:, :-1]),
)
"""Pairs of slices of a raster, cell beside cell: over all four every cell meets each of its neighbours once."""


def parts_of(n: int, one: Ints, other: Ints) -> Ints:
    """Number of the part, from 0, to which each of n things (n,) belongs; links are ``one`` to ``other`` (k,)."""
    graph = coo_array((np.ones(len(one), dtype=bool), (one, other)), shape=(n, n))
    out: Ints = connected_components(graph, directed=False)[1]
    return out
