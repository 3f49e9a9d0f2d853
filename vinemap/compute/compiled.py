"""Compiled loops, and where they are kept.

numba keeps what it has compiled until the file changes that holds it, and doesn't look at the functions that it calls.
Here all of it lies in a folder named by a hash of every file with compiled functions: they may call each other across
files, and take constants from them.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import threading
import time
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

import platformdirs
from numba import config, njit

if TYPE_CHECKING:
    from collections.abc import Callable

F = TypeVar("F", bound="Callable[..., object]")

PACKAGE = Path(__file__).parents[1]
PREFIX = "compiled-"
"""How the names of the folders begin."""
KEPT = 86_400.0
"""Seconds after its last use when the folder of earlier sources is swept."""
_one_at_a_time = threading.Lock()


def compiled(function: F) -> F:
    """Compile a function at its first call, for threads without the GIL, and keep it for later processes.

    In it, too, divisions by zero are as numpy's.
    """
    where = folder()
    if where is None:
        return cast("F", njit(nogil=True, error_model="numpy")(function))
    with _one_at_a_time:  # numba reads where to keep a function when that is decorated, from what all of it shares
        elsewhere, config.CACHE_DIR = config.CACHE_DIR, str(where)
        try:
            return cast("F", njit(cache=True, nogil=True, no_cfunc_wrapper=True, error_model="numpy")(function))
        finally:
            config.CACHE_DIR = elsewhere


def folder() -> Path | None:
    """Folder of what these sources compile to; None where none can be written, and each process compiles anew."""
    return _folder()[0]


def is_new() -> bool:
    """Whether this process made that folder, so that all is still to be compiled."""
    return _folder()[1]


def kept() -> set[str]:
    """Files of what is kept there, one for each kind of numbers that a function was compiled for."""
    where = folder()
    return {path.name for path in where.glob("*/*.nbc")} if where else set()


@cache
def _folder() -> tuple[Path | None, bool]:
    name = PREFIX + _hash(PACKAGE)
    own = Path(config.CACHE_DIR) if config.CACHE_DIR else None  # NUMBA_CACHE_DIR
    for home in [own] if own else [PACKAGE / "__pycache__", platformdirs.user_cache_path("vinemap", appauthor=False)]:
        where = home / name
        try:
            new = not where.is_dir()
            where.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=where).close()
            os.utime(where)
        except OSError:
            continue
        _sweep(home, where)
        return where, new
    return None, False


def _hash(package: Path) -> str:
    """Hash of all files of a package that hold compiled functions."""
    digest = hashlib.sha256()
    for path in sorted(package.glob("*/*.py")):
        source = path.read_bytes()
        if b"@compiled" in source:
            digest.update(path.relative_to(package).as_posix().encode() + source)
    return digest.hexdigest()[:16]


def _sweep(home: Path, kept: Path) -> None:
    """Remove the folders of earlier sources, but for those that something may still use."""
    for folder in home.glob(f"{PREFIX}*"):
        try:
            unused = folder != kept and time.time() - folder.stat().st_mtime > KEPT
        except OSError:  # swept by another process
            continue
        if unused:
            shutil.rmtree(folder, ignore_errors=True)
