"""Values of a rank, in compiled code."""

from __future__ import annotations

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
def quantile(values: Values, n: int, q: float) -> float:
    """Quantile of the first n values, between two ranks a straight line, as numpy's; their order changes."""
    at, first = q * (n - 1), int(np.int64(0))  # a plain 0 would have `select` compiled twice
    rank = int(at)
    lower = select(values, first, n, rank)
    if rank == n - 1:
        return lower
    upper = values[rank + 1]
    for k in range(rank + 2, n):
        upper = min(upper, values[k])
    return float(lower + (at - rank) * (upper - lower))
