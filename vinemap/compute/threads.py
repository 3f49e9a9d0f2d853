"""Work in threads: on all cores where it lets go of the GIL, and ahead of what is needed."""

from __future__ import annotations

import math
import os
import threading
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from vinemap.compute import machine

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

S = TypeVar("S")
T = TypeVar("T")

FEW = 16
"""Items that one core has done before another would have begun."""
CACHED = 200_000
"""Cells, about, of which a core's cache holds what is worked out for them."""
_here = threading.local()


def in_threads(function: Callable[[S], T], items: Iterable[S]) -> list[T]:
    """Results of a function for each item, in their order, worked out on all cores where it lets go of the GIL.

    Within one of its own threads it does one after the other. When one fails, nothing goes on behind its error. An item
    that nobody else holds is let go of once it is done.
    """
    work = deque(items)
    if len(work) < 2 or getattr(_here, "busy", False):
        return [function(work.popleft()) for _ in range(len(work))]
    jobs = [_pool().submit(function, work.popleft()) for _ in range(len(work))]
    try:
        return [job.result() for job in jobs]
    except BaseException:
        for job in jobs:
            job.cancel()
        wait(jobs)
        raise


@cache
def _pool() -> ThreadPoolExecutor:
    return _executor(machine.cores(), initializer=_mark_busy)


def _executor(workers: int, initializer: Callable[[], None] | None = None) -> ThreadPoolExecutor:
    machine.one_heap()
    return ThreadPoolExecutor(workers, initializer=initializer)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads don't live on in a child


def _mark_busy() -> None:
    _here.busy = True


@contextmanager
def aside() -> Iterator[Callable[..., Future[Any]]]:
    """Have functions called in another thread, one after the other, while one goes on.

    Given is ``start(function, *args, **kwargs)``, whose result tells when it's done, or its error. When the context
    ends by an error, what hasn't begun doesn't.
    """
    pool = _executor(1, initializer=_mark_busy)
    try:
        yield pool.submit
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def ahead(items: Iterator[T]) -> Iterator[Iterator[T]]:
    """Give items of which the next is made in another thread while one is worked on."""

    def following() -> Iterator[T]:
        coming = maker.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = maker.submit(next, items, None)
            yield item

    with _executor(1) as maker:
        yield following()


def stretches(n: int, most: float = math.inf) -> list[tuple[int, int]]:
    """Stretches of n items, one a core but for few items, or more, of so many at the most: first and last + 1."""
    parts = max(machine.cores() if n >= FEW else 1, math.ceil(n / most))
    bounds = [n * k // parts for k in range(parts + 1)]
    return list(pairwise(bounds))


class Strip(NamedTuple):
    """Some rows of a raster, and those that they are worked out from."""

    own: slice
    around: slice
    """Its own rows, and so many on both sides as there are of those that tell them."""
    inner: slice
    """Its own among those around."""


def strips(shape: tuple[int, int], *, beside: int) -> list[Strip]:
    """Strips of a raster (ny, nx) that are worked one by one, from themselves and so many rows beside.

    A core's cache holds one, and what lies beside it is little of it.
    """
    ny, nx = shape
    out = []
    for first, last in stretches(ny, max(CACHED / nx, 8 * beside)):
        start = max(first - beside, 0)
        out.append(Strip(slice(first, last), slice(start, last + beside), slice(first - start, last - start)))
    return out
