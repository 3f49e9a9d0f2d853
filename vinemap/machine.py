"""What the machine has, or what of it a container or a scheduler gives to this process."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Where Linux states the memory of a container, in its second and first version of control groups."""
_given: int | None = None


def cores() -> int:
    """Cores that this process may run on."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Windows or macOS
        return os.cpu_count() or 1


def use_memory(most: int) -> None:
    """Let this process know of so many bytes of memory, as others work beside it."""
    global _given  # noqa: PLW0603
    _given = most


def memory() -> int:
    """Bytes of memory, or of its part that is a container's or this process's."""
    if _given:
        return _given
    try:
        most = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError):  # not on Windows
        most = 8 << 30
    for path in LIMITS:
        with suppress(OSError, ValueError):  # "max" is no number
            most = min(most, int(Path(path).read_text(encoding="ascii")))
    return most
