"""Values of a rank, faster than NumPy's."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vinemap.compute.compiled import compiled

if TYPE_CHECKING:
    from vinemap.compute.arrays import Values


@compiled
def select(values: Values, first: int, last: int, rank: int) -> float:
    """Value of a rank among those from first to last - 1, which it puts where it belongs, none larger before it."""
    low, high = first, last - 1
    while low < high:
        a, b, c = values[low], values[(low + high) // 2], values[high]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return float(values[rank])


@compiled
def quantile(values: Values, first: int, last: int, q: float) -> float:
    """Quantile of the values from first to last - 1, between ranks as numpy's; they lose their order."""
    place = 1 + (last - first - 1) * q
    rank = math.floor(place)
    at, part = first + rank - 1, place - rank
    lower = select(values, first, last, at)
    upper = values[min(at + 1, last - 1)]
    for p in range(at + 2, last):
        upper = min(upper, values[p])
    return float(lower * (1 - part) + upper * part)


def median(values: Values) -> float:
    """The median of some values (n,), as numpy's, which takes twice as long for so few."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    return float(np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1].mean())
