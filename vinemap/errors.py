"""Errors meant for people: one line, what was wrong, where, what to do."""

from __future__ import annotations


class VinemapError(Exception):
    """Root of every error that vinemap raises on purpose."""


class InputError(VinemapError):
    """A cloud, boundary or reference can't be used as it is."""


class ConfigError(VinemapError):
    """A configuration has an unknown key, a value out of bounds, or an unknown parcel."""


class OutputError(VinemapError):
    """A product can't be written where it was asked for."""


class DependencyError(VinemapError):
    """A library that this step needs can't be loaded on this machine."""
