"""Loops over points, compiled: cached on disk, and run without the GIL.

Compiled functions call only others of their own file, because the cache doesn't notice changes in another.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar, cast

from numba import njit

if TYPE_CHECKING:
    from collections.abc import Callable

F = TypeVar("F", bound="Callable[..., object]")


def compiled(function: F) -> F:
    """Compile a function at its first call."""
    try:
        return cast("F", njit(cache=True, nogil=True)(function))
    except RuntimeError:  # no folder for the cache can be written: compile anew each time
        return cast("F", njit(nogil=True)(function))
