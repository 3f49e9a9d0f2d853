"""What the machine has, or what of it a container or a scheduler gives to this process."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
from pathlib import Path

LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Where Linux states the memory of a container, in its second and first version of control groups."""
MOST = 0.8
"""Share of the memory that processes take together."""
LEAST = 1_500_000_000
"""Bytes that each has at the least: on small machines there are fewer."""
M_ARENA_MAX = -8
"""Of ``mallopt``: how many heaps there are."""
_given: dict[str, int] = {}


def use(*, cores: int, memory: int | None = None) -> None:
    """Let this process take so many cores, and bytes of memory, as others work beside it; before any work."""
    _given.update({"cores": cores} | ({"memory": memory} if memory else {}))


def cores() -> int:
    """Cores that this process may run on."""
    if "cores" in _given:
        return _given["cores"]
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Windows or macOS
        return os.cpu_count() or 1


def memory() -> int:
    """Bytes of memory, or of its part that is a container's or this process's."""
    if "memory" in _given:
        return _given["memory"]
    try:
        most = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError):  # not on Windows
        most = 8 << 30
    for path in LIMITS:
        with suppress(OSError, ValueError):  # "max" is no number
            most = min(most, int(Path(path).read_text(encoding="ascii")))
    return most


def share(n: int) -> int:
    """Bytes of memory for each of n processes beside this one."""
    return max(LEAST, int(MOST * memory() / n))


def most_processes() -> int:
    """Processes for which there are cores and memory."""
    return max(1, min(cores(), int(MOST * memory() / LEAST)))


def one_heap() -> None:
    """Have threads take memory from one heap: GNU's library gives each its own, of which none takes what another frees.

    Before there are any.
    """
    _malloc("mallopt", M_ARENA_MAX, 1)


def give_back() -> None:
    """Give memory that is free in this process back to the system: GNU's library keeps it for the next arrays."""
    _malloc("malloc_trim", 0)


def _malloc(name: str, *values: int) -> None:
    """Tell GNU's library; others haven't that function."""
    if sys.platform == "linux":
        with suppress(AttributeError, OSError):
            getattr(ctypes.CDLL(None), name)(*values)
