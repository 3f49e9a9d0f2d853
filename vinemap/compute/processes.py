"""Processes of our own: how they are started, what ended them, and that they end with the one that started them."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO

STOPPING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))
"""Signals by which this system asks a process to end, beside Ctrl-C."""
TAIL = 4096
"""Bytes at the end of what a process wrote in which its last line is looked for."""
PR_SET_PDEATHSIG = 1
"""Of Linux's prctl(2)."""


def python(code: str, *words: str) -> list[str]:
    """Command that runs code in another Python, with words as its arguments, which imports from where this one does.

    By itself it would import from the folder in which it is called first, whatever lies there.
    """
    return [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {code}", *words]


def last_line(said: IO[bytes]) -> str:
    """The last line that a process wrote to a file, blank ones aside; nothing if it wrote none."""
    said.seek(max(0, said.seek(0, os.SEEK_END) - TAIL))
    lines = [line for line in said.read().splitlines() if line.strip()]
    return lines[-1].decode(errors="replace").strip() if lines else ""


def ended_by(code: int) -> str:
    """What ended a process of this exit code: the name of the signal that did, or else the code itself."""
    with suppress(ValueError):
        return signal.Signals(-code).name
    return f"exit code {code}"


def descendants(process: int) -> list[int]:
    """Processes that a process has begun, and those that they have."""
    try:
        files = list(Path(f"/proc/{process}/task").glob("*/children"))
        children = [int(word) for file in files for word in file.read_text().split()]
    except OSError:
        return []
    return children + [one for child in children for one in descendants(child)]


def die_with_parent() -> None:
    """Have the system end this process with its parent (on Linux), even in the midst of a library's call."""
    parent = os.getppid()
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)
