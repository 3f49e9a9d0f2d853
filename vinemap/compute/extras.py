"""Libraries that only a part of vinemap needs, and what is said in a line where one is missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

from vinemap.errors import DependencyError


class Extra(NamedTuple):
    """A library, the extra by which pip installs it, and what needs it."""

    name: str
    library: str
    use: str
    hint: str = ""
    """What it may lack besides, where it is installed and can't be loaded."""


EXTRAS = {
    "prefect": Extra("nightly", "Prefect", "a schedule"),
    "open3d": Extra("mesh", "Open3D", "looking at meshes", ", and apt-get install libegl1 libgl1 libusb-1.0-0"),
    "cv2": Extra("track", "OpenCV", "visual odometry"),
    "distributed": Extra("dask", "Dask", "a cluster"),
    "pye57": Extra("e57", "pye57", "reading E57"),
    "pyarrow": Extra("parquet", "pyarrow", "Parquet"),
}
"""By the name of their module."""


def load(module: str) -> Any:
    """An extra's library.

    Raises
    ------
    DependencyError
        If it isn't installed or can't be loaded; says what installs it.
    """
    extra = EXTRAS[module]
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise DependencyError(
            f"{extra.use} needs {extra.library}, which isn't installed: pip install 'vinemap[{extra.name}]'"
        ) from error
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"{extra.use} needs {extra.library}, which can't be loaded ({error}): "
            f"pip install 'vinemap[{extra.name}]'{extra.hint}"
        ) from error
