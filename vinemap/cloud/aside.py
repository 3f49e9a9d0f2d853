"""Files over one ground that lie aside of each other, as flights do whose positions don't agree."""

from __future__ import annotations

from itertools import combinations, islice, product
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable
    from pathlib import PurePath

    from vinemap.compute.arrays import Flags, Floats

    Tops = dict[int, dict[PurePath, Floats]]
    """Highest points of each file in the cells of patches of ground."""

EVERY, MOST = 16.0, 60
"""Metres from one patch of ground to the next, and how many are looked at: the first that a file shows."""
PAIRS = 40
"""Of files in patches that are compared, at the most."""
COLUMN = 1 << 24
"""What numbers of patches differ by from one column to the next."""
CELL, CELLS = 0.2, 60
"""Metres of a cell, and cells along a side of a patch."""
DENSE = 4
"""Points in a cell that are enough: of more, some are taken."""
REACH = 7
"""Cells by which files may lie aside: half of the distance of most rows."""
WINDOW = 15
"""Cells of a window whose lowest point stands for the ground."""
TALLEST = 2.0
"""Metres above it that are told apart."""
KNOWN, VARIED = 0.2, 0.2
"""Share of a patch's cells that both files must show, and metres by which heights must differ in it."""
ALIKE = 0.6
"""Correlation at which two files show the same canopies."""
NEARLY = 0.1
"""Share of the range of correlations by which those along a row fall short of the greatest."""
LEAST, FEWEST, AGREED = 0.3, 4, 0.7
"""Metres aside that matter, patches that must tell of them, and share of all that tell anything."""


def watched(chunks: Iterable[tuple[Floats, PurePath]], remarks: list[str]) -> Generator[Floats]:
    """Points (n, 3) of several files in metres, as their chunks come; at the end it is added if two lie aside."""
    tops: Tops = {}
    for xyz, path in chunks:
        _add(tops, xyz, path)
        yield xyz
    if (metres := _aside(tops)) is not None:
        remarks.append(
            f"two flights lie about {metres:.1f} m aside of each other, and canopies come out too wide, or rows twice: "
            "align them, or take one"
        )


def _add(tops: Tops, xyz: Floats, path: PurePath) -> None:
    """Note the highest of a file's points (n, 3) in each cell of the patches."""
    cells = max(1.0, np.prod(np.ptp(xyz[:, :2], axis=0)) / CELL**2) if len(xyz) else 1.0
    xyz = xyz[:: max(1, int(len(xyz) / cells / DENSE))]
    xyz = xyz[(np.mod(xyz[:, :2], EVERY) < CELL * CELLS).all(axis=1)]
    patch = np.floor(xyz[:, :2] / EVERY).astype(np.int64) @ [COLUMN, 1]
    for key in np.unique(patch).tolist():
        if key in tops or len(tops) < MOST:
            points = xyz[patch == key]
            column, row = (np.mod(points[:, :2], EVERY) / CELL).astype(int).T
            top = tops.setdefault(key, {}).setdefault(path, np.full((CELLS, CELLS), -np.inf))
            np.maximum.at(top, (row, column), points[:, 2])


def _aside(tops: Tops) -> float | None:
    """Metres by which files lie aside of each other; None where they don't, or nothing tells it."""
    pairs = (pair for shown in tops.values() for pair in combinations(map(_heights, shown.values()), 2))
    found = np.array([metres for one, other in islice(pairs, PAIRS) if (metres := _between(one, other)) is not None])
    far = found[found >= LEAST]
    return float(np.median(far)) if len(far) >= max(FEWEST, AGREED * len(found)) else None


def _heights(top: Floats) -> tuple[Floats, Flags]:
    """Heights above the lowest points about, and which cells have one."""
    from scipy.ndimage import minimum_filter  # only surveys of several files need it

    known = np.isfinite(top)
    ground = minimum_filter(np.where(known, top, np.inf), WINDOW)
    return np.where(known, np.minimum(top, ground + TALLEST) - np.where(known, ground, 0.0), 0.0), known


def _between(one: tuple[Floats, Flags], other: tuple[Floats, Flags]) -> float | None:
    """Metres by which two files' heights of a patch are shifted; None where too little or nothing alike is shown.

    Along a row every shift fits about as well: of all that do, the shortest counts.
    """
    shifts = np.array(list(product(range(-REACH, REACH + 1), repeat=2)))
    inner = slice(REACH, CELLS - REACH)
    heights, known = one[0][inner, inner], one[1][inner, inner]
    correlations = []
    for row, column in shifts.tolist():
        at = slice(REACH + row, CELLS - REACH + row), slice(REACH + column, CELLS - REACH + column)
        both = known & other[1][at]
        a, b = heights[both], other[0][at][both]
        if both.mean() < KNOWN or min(a.std(), b.std()) < VARIED:
            return None
        correlations.append(np.corrcoef(a, b)[0, 1])
    greatest, least = max(correlations), min(correlations)
    if greatest < ALIKE:
        return None
    nearly = np.array(correlations) >= greatest - NEARLY * (greatest - least)
    return CELL * float(np.hypot(*shifts[nearly].T).min())
