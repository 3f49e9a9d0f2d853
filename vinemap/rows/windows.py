"""Waves of windows settled among each other: which of two, one a block, and none that those about it deny."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_closing, binary_dilation, binary_opening, distance_transform_edt, label

from vinemap.compute.links import NEXT, parts_of
from vinemap.geo.curve import turn_between
from vinemap.surfaces.waves import ASKEW, CLEAR, Peaks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.compute.arrays import Flags, Values
    from vinemap.surfaces.waves import Grain

AS_GOOD = 0.5
"""Strength of a second wave over that of the first from which both may be the rows'."""
LONE, WEAK = 0.6, 0.3
"""How clearly a lone row is drawn out, and strength that a wave has where it is none."""
EVEN, REGULAR = 0.1, 0.8
"""Share by which a planting's spacings may differ, and share of the waves that are so regular in each direction."""
NEAR_WAY, EQUAL = np.radians(12), 1.05
"""Radians from a block's direction within which a wave has it, and ratio of spacings up to which they are alike."""
ALIKE, LIKE_SPACING = np.radians(10), 1.15
"""Radians of turn, and ratio of spacings, up to which windows beside each other have the same wave."""
FAR_STRONGER = 4.0
"""Strength of a block over that of windows which it may decide."""


def axial_median(peaks: Peaks) -> Peaks:
    """Replace each window's wave by the one of its 3 x 3 neighbours that differs least from all of them."""
    my, mx = peaks.direction.shape
    wave = np.where(np.isfinite(peaks.direction), np.exp(2j * np.nan_to_num(peaks.direction)), 0)
    shifts = [(a, b) for a in (0, 1, 2) for b in (0, 1, 2)]
    padded = [np.pad(v, 1) for v in (wave, np.nan_to_num(peaks.spacing), peaks.strength)]
    waves, spacings, weights = (np.stack([p[a : a + my, b : b + mx] for a, b in shifts]) for p in padded)
    cost = np.zeros_like(weights)
    for n in range(len(shifts)):
        turn = np.abs(waves - waves[n])
        stretch = np.abs(np.log(np.maximum(spacings, 0.1) / np.maximum(spacings[n], 0.1)))
        cost[n] = (weights * (turn + stretch)).sum(axis=0)
    cost[weights == 0] = np.inf
    best = cost.argmin(axis=0)[None]
    direction = np.mod(np.angle(np.take_along_axis(waves, best, 0)[0]) / 2, np.pi)
    spacing = np.take_along_axis(spacings, best, 0)[0]
    empty = peaks.strength == 0
    return Peaks(np.where(empty, np.nan, direction), np.where(empty, np.nan, spacing), peaks.strength)


def with_the_grain(peaks: Peaks, second: Peaks, drawn: Grain) -> tuple[Peaks, Peaks]:
    """Put that wave first, window by window, that runs as the canopies in its middle are drawn out.

    That of a wall or a hedge at a window's edge may be stronger, and where blocks meet the other block's. A lone row
    has hardly any: the grain is its direction.
    """
    off, other = (drawn.off(wave.direction) for wave in (peaks, second))
    turned = (second.strength > 0) & (other < off - ASKEW)
    first, then = (
        Peaks(*(np.where(turned, a, b) for a, b in zip(*waves, strict=True)))
        for waves in ((second, peaks), (peaks, second))
    )
    alone = (drawn.clear >= LONE) & (drawn.off(first.direction) > ASKEW) & (first.strength < WEAK)
    direction = np.where(alone, drawn.direction, first.direction)
    return Peaks(direction, first.spacing, np.where(alone, drawn.clear * WEAK, first.strength)), then


def one_way(peaks: Peaks, second: Peaks, drawn: Grain, *, least: float) -> tuple[Peaks, Flags]:
    """Give plantings in a square, or a quincunx, where several directions are about as good, one a block; tell where.

    Rows run where vines are closer together, so that rows are farther apart; if both are alike, where rows are longer.
    Only windows whose canopies aren't drawn out along one wave count, and only where there are ``least`` of them at the
    least, in a block as wide as long: beside a hedge there are fewer.
    """
    side = max(1, int(np.sqrt(least)))
    either = drawn.clear < CLEAR
    both = either & (second.strength >= AS_GOOD * peaks.strength) & (peaks.strength > 0)
    closed = binary_closing(np.pad(both, 2), np.ones((3, 3)))
    blocks, n = label(binary_opening(closed, np.ones((side, side)))[2:-2, 2:-2])
    out, square = [values.copy() for values in peaks], np.zeros(both.shape, dtype=bool)
    for k in range(1, n + 1):
        block = blocks == k
        if np.count_nonzero(block & both) < least:
            continue
        waves = [np.concatenate([one[block], other[block]]) for one, other in zip(peaks, second, strict=True)]
        direction, spacing, strength = (values[waves[2] > 0] for values in waves)
        ways, apart = _ways(direction, spacing, strength)
        if not ways:
            continue  # the block's edge, or gaps, and no second planting
        square |= block
        i, j = np.nonzero(block)
        long = [float(np.ptp(j * np.cos(way) - i * np.sin(way))) for way in ways]
        alike = [length if EQUAL * its > max(apart) else 0.0 for length, its in zip(long, apart, strict=True)]
        chosen = ways[int(np.argmax(alike))]
        around = binary_dilation(block, np.ones((5, 5))) & (peaks.strength > 0)
        mine = around & (turn_between(peaks.direction, chosen) < NEAR_WAY)
        other = around & ~mine & (second.strength > 0) & (turn_between(second.direction, chosen) < NEAR_WAY)
        for values, second_values in zip(out, second, strict=True):
            values[other] = second_values[other]
        _spread(out, mine | other, around & ~mine & ~other)
    return Peaks(*out), square


def _ways(direction: Values, spacing: Values, strength: Values) -> tuple[list[float], list[float]]:
    """Radians of the two directions of a square, or the three of a quincunx, in which waves (n,) are regular; spacings.

    Both are empty where there are none.
    """
    ways: list[float] = []
    apart: list[float] = []
    held = []
    left = np.ones(len(direction), dtype=bool)
    while left.any() and len(ways) < 3:
        way = _most_common(direction[left], strength[left])
        near = turn_between(direction, way) < NEAR_WAY
        usual = float(np.median(spacing[near]))
        ways, apart = [*ways, way], [*apart, usual]
        held.append(strength[near & (np.abs(spacing - usual) < EVEN * usual)].sum() / strength.sum())
        left &= turn_between(direction, way) > np.pi / 6
        if len(ways) == 2 and min(held) >= REGULAR / 2:
            return ways, apart
    if len(ways) < 3 or sum(held) < REGULAR or min(held) < REGULAR / 6:
        return [], []
    # Where vines stand in a lattice, two of its waves make up the third.
    one, two, three = np.exp(1j * np.array(ways)) / apart
    off = min(abs(one + a * two + b * three) for a in (-1, 1) for b in (-1, 1))
    return (ways, apart) if off < EVEN / min(apart) else ([], [])


def prescribed(waves: Sequence[Peaks], way: float) -> Peaks:
    """The first wave of each window within ``NEAR_WAY`` of a direction; where there is none, that of the nearest."""
    out = [values.copy() for values in waves[0]]
    known = np.zeros(out[0].shape, dtype=bool)
    for wave in waves:
        near = ~known & (wave.strength > 0) & (turn_between(wave.direction, way) < NEAR_WAY)
        for values, mine in zip(out, wave, strict=True):
            values[near] = mine[near]
        known |= near
    if not known.any():
        return Peaks(out[0], out[1], np.zeros_like(out[2]))
    _spread(out, known, ~known & (waves[0].strength > 0))
    return Peaks(*out)


def shown(peaks: Peaks, drawn: Grain, square: Flags) -> Values:
    """How clearly rows show in windows beside their wave, 0–1: by the canopies' grain, or as they stand in a square."""
    turn = np.cos(2 * (np.nan_to_num(peaks.direction) - drawn.direction))
    out: Values = np.where(square, 1.0, drawn.clear * np.maximum(turn, 0.0))
    return out


def _spread(waves: list[Values], known: Flags, wrong: Flags) -> None:
    """Give windows that are wrong the direction and spacing of the nearest that are known."""
    if known.any():
        a, b = distance_transform_edt(~known, return_distances=False, return_indices=True)
        for values in waves[:2]:
            values[wrong] = values[a, b][wrong]


def _most_common(direction: Values, weight: Values) -> float:
    """Direction in radians about which most others lie."""
    ways = np.radians(np.arange(0, 180, 2))
    near = np.exp(-0.5 * (turn_between(direction[:, None], ways) / NEAR_WAY * 2) ** 2)
    best = float(ways[int((near * weight[:, None]).sum(axis=0).argmax())])
    close = turn_between(direction, best) < NEAR_WAY
    return float(np.angle((weight * np.exp(2j * direction))[close].sum()) / 2 % np.pi)


def settled(peaks: Peaks, *, least: float) -> Peaks:
    """Give windows that disagree with the block about them that block's wave.

    Windows beside each other with about the same wave belong together. Fewer of them than ``least`` are no block of
    their own where they touch one that is far stronger: gaps that line up, or a row's vines, have deceived them.
    """
    my, mx = peaks.direction.shape
    index = np.arange(my * mx).reshape(my, mx)
    held = peaks.strength > 0
    pairs = np.concatenate([np.column_stack([index[a].ravel(), index[b].ravel()]) for a, b in NEXT])
    pairs = pairs[held.ravel()[pairs].all(axis=1)]
    one, other = pairs.T
    direction, spacing = peaks.direction.ravel(), peaks.spacing.ravel()
    alike = (turn_between(direction[one], direction[other]) < ALIKE) & (
        np.abs(np.log(spacing[one] / spacing[other])) < np.log(LIKE_SPACING)
    )
    block = parts_of(my * mx, one[alike], other[alike])
    mass, n = np.bincount(block, weights=peaks.strength.ravel()), np.bincount(block, weights=held.ravel())
    strongest = np.zeros(len(mass))  # of the blocks that touch each
    a, b = np.concatenate([block[pairs], block[pairs[:, ::-1]]]).T
    np.maximum.at(strongest, a, np.where(a == b, 0.0, mass[b]))
    doubtful = ((n < least) & (strongest > FAR_STRONGER * mass))[block].reshape(my, mx) & held
    sure = held & ~doubtful
    if not (doubtful.any() and sure.any()):
        return peaks
    i, j = distance_transform_edt(~sure, return_distances=False, return_indices=True)
    return Peaks(
        np.where(doubtful, peaks.direction[i, j], peaks.direction),
        np.where(doubtful, peaks.spacing[i, j], peaks.spacing),
        peaks.strength,
    )
