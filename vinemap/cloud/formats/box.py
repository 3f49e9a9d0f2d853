"""Boxes in the CRS of a file: about a polygon, where only that is read, and the one that its header states."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from vinemap.errors import InputError
from vinemap.geo.crs import horizontal, project

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import PurePath

    from pyproj import CRS

    from vinemap.compute.arrays import Floats
    from vinemap.geo.boundaries import Boundary

    Box = tuple[Floats, Floats]

EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)
"""Corners (3,) of all of space."""
MARGIN = 0.001
"""Share of its wider side that is added all around, as straight lines of one CRS bend in another."""
LOOSE = 0.003
"""Share of its widest side by which points may lie outside of the box that a header states."""
MOST_OUTSIDE, STRAYS = 0.0001, 3
"""Share of the points that may lie farther outside, and a number of them that always may."""


def box_about(boundary: Boundary, crs: CRS) -> Box:
    """Corners (3,) about a polygon in the CRS of a file; of all heights."""
    west, south, east, north = shapely.bounds(project(*boundary, horizontal(crs))).tolist()
    margin = MARGIN * max(east - west, north - south)
    return np.array([west - margin, south - margin, -np.inf]), np.array([east + margin, north + margin, np.inf])


def meet(low: Floats, high: Floats, box: Box) -> bool:
    """Whether what lies between two corners (3,) has something in common with a box."""
    return bool((low <= box[1]).all() and (high >= box[0]).all())


def stated_box(header: Any) -> Box | None:
    """Corners (3,) between which a header says that the points lie, with some room; None if it says nothing."""
    low, high = header.mins, header.maxs
    if not (np.isfinite([low, high]).all() and (high > low)[:2].all()):
        return None
    room = LOOSE * (high - low).max()
    return low - room, high + room


def n_outside(columns: Sequence[Floats] | Floats, box: Box | None) -> int:
    """How many points, of which there are three columns (n,) of coordinates, lie outside of a box."""
    within = list(zip(columns, *box, strict=True)) if box and len(columns[0]) else []
    if all(low <= column.min() and column.max() <= high for column, low, high in within):
        return 0
    return int(np.any([(column < low) | (column > high) for column, low, high in within], axis=0).sum())


def most_strays(n: int) -> float:
    """How many of n points may be out of place in a file that isn't damaged."""
    return max(STRAYS, MOST_OUTSIDE * n)


def check_outside(outside: int, n: int, path: PurePath) -> None:
    """Make sure that of n points of a file few lie outside of the box that its header states.

    Raises
    ------
    InputError
        If more do.
    """
    if outside > most_strays(n):
        raise InputError(
            f"{path}: {outside:,} points lie outside of the box that its header states, as in damaged files: copy or "
            "download it again, or have its header written anew"
        )
