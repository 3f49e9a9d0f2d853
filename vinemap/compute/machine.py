"""What the machine has, or what of it a container or a scheduler gives to this process."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Where Linux states the memory of a container, in its second and first version of control groups."""
MOST = 0.8
"""Share of the memory that processes take together."""
LEAST = 1_500_000_000
"""Bytes that each has at the least: on small machines there are fewer."""
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
