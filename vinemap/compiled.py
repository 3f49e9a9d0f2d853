"""Loops over points, compiled, and run on all cores.

Compiled functions are cached on disk and run without the GIL. They call only others of their own file, because the
cache doesn't notice changes in another.
"""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar, cast

from numba import njit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

F = TypeVar("F", bound="Callable[..., object]")
S = TypeVar("S")
T = TypeVar("T")

CORES = os.cpu_count() or 1
_here = threading.local()


def compiled(function: F) -> F:
    """Compile a function at its first call."""
    try:
        return cast("F", njit(cache=True, nogil=True)(function))
    except RuntimeError:  # no folder for the cache can be written: compile anew each time
        return cast("F", njit(nogil=True)(function))


def in_threads(function: Callable[[S], T], items: Iterable[S]) -> list[T]:
    """Results of a function for each item, in their order, worked out on all cores where it lets go of the GIL.

    Within one of its own threads it does one after the other.
    """
    if getattr(_here, "busy", False):
        return [function(item) for item in items]
    with ThreadPoolExecutor(CORES, initializer=_mark_busy) as pool:
        return list(pool.map(function, items))


def _mark_busy() -> None:
    _here.busy = True


def stretches(n: int) -> list[tuple[int, int]]:
    """Stretches of n items, one a core, as first and last + 1."""
    bounds = [n * k // CORES for k in range(CORES + 1)]
    return list(pairwise(bounds))
