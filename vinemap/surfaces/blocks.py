"""Blocks of cells in which the terrain is sought first; they divide no tile of a cloud."""

from __future__ import annotations

COARSE = 1.0
"""Cell size in metres of the first, coarse surface."""


def cells_a_block(resolution: float) -> int:
    """Cells a side of the blocks of the coarse surface."""
    return max(1, round(COARSE / resolution))


def block_side(resolution: float) -> float:
    """Side in metres of the terrain model's blocks of cells, which a cloud in tiles must not divide."""
    return cells_a_block(resolution) * resolution
