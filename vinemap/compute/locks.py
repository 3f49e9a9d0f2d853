"""Locks between processes: files that one alone holds."""

from __future__ import annotations

import errno
import warnings
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from vinemap.errors import BusyError, OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LOCKLESS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL}


@contextmanager
def held(lock: Path, reason: str, *, patience: float = 0.0) -> Iterator[None]:
    """Hold a lock, which the system lets go of if this process dies.

    Parameters
    ----------
    lock : Path
        Its file, which goes when it is let go of.
    reason : str
        What BusyError says if another has it.
    patience : float
        Seconds for which another may have it.

    Raises
    ------
    BusyError
        If another keeps it.
    OutputError
        If the disk has no locks.
    OSError
        If its file can't be written.
    """
    holder = FileLock(lock)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that the system's locks are only files
            holder.acquire(timeout=patience)
    except Timeout as error:
        raise BusyError(reason) from error
    except OSError as error:
        if error.errno not in LOCKLESS:
            raise
        lock.unlink(missing_ok=True)
        raise OutputError(
            f"{lock.parent}: its disk has no locks ({error.strerror}): choose a folder on another disk"
        ) from error
    try:
        yield
    finally:
        # Who waits for it finds out that it is no longer the file of that name, and makes another.
        with suppress(OSError):
            lock.unlink()
        holder.release()
