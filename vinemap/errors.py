"""Errors meant for people: one line, what was wrong, where, what to do."""

from __future__ import annotations

import errno

PASSING = {errno.EBUSY, errno.EAGAIN, errno.EINTR, errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENOLCK}
"""What the system says of a disk that may do the same a little later."""


class VinemapError(Exception):
    """Root of every error that vinemap raises on purpose."""

    heals = False
    """Whether the same may go well a few minutes later."""


class InputError(VinemapError):
    """A cloud, boundary or reference can't be used as it is."""


class GridError(InputError):
    """PROJ lacks a grid without which an input has no place; where it gets it, the same input will do."""

    heals = True


class EmptyError(InputError):
    """A file has no points that count, or a product no rows."""


class OutsideError(InputError):
    """A cloud has no point in a parcel."""


class ConfigError(VinemapError):
    """A configuration has an unknown key, a value out of bounds, or an unknown parcel."""


class OutputError(VinemapError):
    """A product can't be written where it was asked for."""


class DependencyError(VinemapError):
    """A library that this step needs can't be loaded on this machine."""


class BusyError(VinemapError):
    """Something is in use, or is changing, just now."""

    heals = True


class WorkerError(VinemapError):
    """A process died of its work, or would have taken more than it may."""


def own_fault(error: BaseException, where: str = "") -> str:
    """What is said of an error that vinemap didn't raise on purpose."""
    return f"a fault of vinemap's own ({type(error).__name__}: {error}{where})"


def reason_of(error: BaseException) -> str:
    """What an error says, in one line; its kind, if it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__
