"""Two flights over one ground that disagree in height: two thin layers, one above the other, all over a place."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from vinemap.geo.raster import above

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Floats
    from vinemap.geo.raster import Raster

LEAST = 0.09
"""Metres between layers from which on it matters, less what a measured one may be short of 0.1."""
SAMPLE = 120_000
"""Points, about, that are looked at."""
LOWEST, BIN = -0.6, 0.01
"""Metres above the terrain from which on layers are looked for, and of a step."""
NEAR, FARTHEST = 1.2, 250.0
"""Metres above the terrain up to which they are looked for first, where nets hang over no vines, and then."""
BLUR = 1.2
"""Steps of the Gaussian over the numbers of points by height."""
BLOCK, CELL = 1500, 6
"""Points of a block in which layers are told, and of a cell in which both are looked for."""
SHARE = 0.1
"""Share of the greater layer's points that the lesser one has, at the peaks."""
DIP = 0.8
"""Share of the lesser peak to which the number of points falls between them."""
THIN = 0.5
"""Share of a peak to which it falls within half the way to the other, on its far side."""
FEW, ALIKE = 0.3, 1.3
"""Share of a peak at which its layer ends, and ratio up to which two layers are as thick."""
THICK = 0.15
"""Metres about a layer's peak in which its points are, at the most."""
MIXED = 0.85
"""Share of the cells in which both would be by chance, and are."""
AGREED = 0.6
"""Share of the blocks with two layers that must tell about the same."""
AREA = 0.05
"""Share of all blocks that must tell the same."""
GROWN, TALLEST, AS_MUCH = 0.3, 3.0, 0.3
"""Metres above a layer between which vines stand on it, and share of what stands on the lower one that does on the
upper one at the least: on a net there is nothing."""


class _Layers(NamedTuple):
    """Two layers in a block: the steps of height in which they are thickest, and the one that parts them."""

    lower: int
    between: int
    upper: int

    @property
    def apart(self) -> float:
        """Metres between them."""
        return (self.upper - self.lower) * BIN


def disagreement(cloud: Cloud, dtm: Raster) -> tuple[float, float] | None:
    """Metres by which two flights disagree in height, and the share of the ground where they do; None if none do.

    Where two flights lie over each other and one is higher, the ground is two thin layers, as far apart everywhere.
    Grass is a thick one; terraces, furrows and slopes have one at each place; a net is one, too, but bears nothing.

    Parameters
    ----------
    cloud : PointCloud or TiledCloud
        Points.
    dtm : Raster
        Terrain, that of the lower flight.
    """
    xy, height = _sampled(cloud, dtm)
    for top in (NEAR, min(FARTHEST, float(height.max(initial=NEAR)))):
        near = height < top - BIN
        if found := _in_two_layers(xy[near], height[near], top):
            return found
    return None


def _sampled(cloud: Cloud, dtm: Raster) -> tuple[Floats, Floats]:
    """Some of a cloud's points (n, 2), and their heights above the terrain (n,)."""
    step = max(1, cloud.size // SAMPLE)
    xyz = np.concatenate([part.xyz[::step] for part in cloud.parts()])
    height = above(dtm, xyz).astype(float)
    known = height > LOWEST
    return xyz[known, :2], height[known]


def _in_two_layers(xy: Floats, height: Floats, top: float) -> tuple[float, float] | None:
    """What :func:`disagreement` tells of points (n, 2) up to some height."""
    if len(xy) < BLOCK:
        return None
    low, high = xy.min(axis=0), xy.max(axis=0)
    block, n = _squares(xy, low, float(np.sqrt(BLOCK * np.prod(high - low) / len(xy))))
    steps = round((top - LOWEST) / BIN)
    step = ((height - LOWEST) / BIN).astype(np.int64)
    counts = np.bincount(block * steps + step, minlength=n * steps).reshape(n, steps)
    known = np.flatnonzero(counts.sum(axis=1) >= BLOCK / 4)
    smooth = gaussian_filter1d(counts[known].astype(float), BLUR, axis=1, mode="constant")
    found = [
        (layers, row)
        for k, row in zip(known.tolist(), smooth, strict=True)
        if (layers := _layers(row)) and _are_mixed(xy[block == k], height[block == k], layers)
    ]
    apart = np.array([layers.apart for layers, _ in found])
    far = apart >= LEAST
    if np.count_nonzero(far) < max(3, AREA * len(known), AGREED * len(apart)) or not _are_alike(found):
        return None
    middle = float(np.median(apart[far]))
    agreed = np.mean((apart >= middle / 2) & (apart <= 2 * middle))
    if agreed < AGREED or (middle > NEAR and not _is_grown(found)):
        return None
    return middle, float(np.count_nonzero(far) / len(known))


def _is_grown(found: Sequence[tuple[_Layers, Floats]]) -> bool:
    """Whether about as much stands on the upper layers as on the lower ones, below the upper ones."""
    thin, first = round(THICK / BIN), round(GROWN / BIN)
    last = min(round(TALLEST / BIN), min(layers.upper - layers.lower for layers, _ in found) - thin)
    sums = np.zeros((2, 2))
    for layers, row in found:
        for k, peak in enumerate((layers.lower, layers.upper)):
            sums[k] += row[peak - thin : peak + thin + 1].sum(), row[peak + first : peak + last].sum()
    (ground, grown), (upper, on_it) = sums
    return bool(on_it / upper >= AS_MUCH * grown / ground > 0)


def _squares(xy: Floats, low: Floats, side: float) -> tuple[NDArray[np.int64], int]:
    """Which square of a grid, by a number, points (n, 2) are in, and how many there are."""
    column, row = ((xy - low) / side).astype(np.int64).T
    across = int(column.max(initial=0)) + 1
    return row * across + column, across * (int(row.max(initial=0)) + 1)


def _layers(counts: Floats) -> _Layers | None:
    """The two greatest peaks among the numbers of points by height, if they are thin and apart."""
    steps = np.diff(counts)
    is_peak = (steps[:-1] > 0) & (steps[1:] <= 0) & (counts[1:-1] >= SHARE * counts.max())
    peaks = np.flatnonzero(is_peak) + 1
    if len(peaks) < 2:
        return None
    greatest = peaks[np.argsort(counts[peaks])[-2:]]
    a, b = int(greatest.min()), int(greatest.max())
    between = a + int(np.argmin(counts[a : b + 1]))
    half = max(1, (b - a) // 2)
    outside = counts[max(a - half, 0)] / counts[a], counts[min(b + half, len(counts) - 1)] / counts[b]
    if counts[between] > DIP * min(counts[a], counts[b]) or max(outside) > THIN:
        return None
    return _Layers(a, between, b)


def _are_alike(found: Sequence[tuple[_Layers, Floats]]) -> bool:
    """Whether the layers of blocks, laid over each other, are as thick: on their far sides, or both on the lower one.

    The ground of photographs has a tail upwards, of which the lower layer's is hidden.
    """
    lower = [row[layers.lower :: -1] for layers, row in found]
    inner = [row[layers.upper : layers.between - 1 : -1] for layers, row in found]
    outer = [row[layers.upper :] for layers, row in found]
    thick = _thickness(lower), _thickness(inner), _thickness(outer)
    return any(ALIKE * thick[0] >= other >= thick[0] / ALIKE for other in thick[1:])


def _thickness(sides: Sequence[Floats]) -> float:
    """Steps from a layer's peak to where its points are few, by sides of peaks in several blocks."""
    n = min(map(len, sides))
    side = np.sum([one[:n] for one in sides], axis=0)
    few = max(FEW, 1.1 * float(side.min() / side[0])) * side[0]
    k = int(np.argmax(side < few)) or n
    return float(k - 1 + (side[k - 1] - few) / (side[k - 1] - side[k])) if k < n else float(n)


def _are_mixed(xy: Floats, height: Floats, layers: _Layers) -> bool:
    """Whether both layers are all over a block of points (n, 2), as if each point were in one of them by chance."""
    off = [height - (LOWEST + (peak + 0.5) * BIN) for peak in (layers.lower, layers.upper)]
    near = np.abs(off).min(axis=0) < min(THICK, layers.apart / 2)
    upper = height[near] > LOWEST + (layers.between + 0.5) * BIN
    n_near = np.count_nonzero(near)
    if n_near < CELL:
        return False
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell, _ = _squares(xy[near], low, float(np.sqrt(CELL * np.prod(high - low) / n_near)))
    n, upper = np.bincount(cell), np.bincount(cell, upper)
    n, upper = n[n > 1], upper[n > 1]
    share = upper.sum() / n.sum()
    both, by_chance = (upper > 0) & (upper < n), 1 - share**n - (1 - share) ** n
    return bool(both.sum() >= MIXED * by_chance.sum())
