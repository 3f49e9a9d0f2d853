"""``vinemap doctor``: what is installed, what is missing, and where things are kept."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from collections.abc import Iterator

GIB = 1 << 30
VARIABLES = ("NUMBA_CACHE_DIR", "PROJ_DATA", "GDAL_DATA", "PYTHONPATH")
"""Of the environment, which decide where things are found."""


@click.command(short_help="Tell of this installation on one page.")
def doctor() -> None:
    """Tell of this installation on one page, to paste into a report of a fault: versions, what is missing, folders.

    The exit code is 1 if something is missing that every map needs.
    """
    needed, whole = _needed()
    home = re.compile(rf"(?<![^\s(:;]){re.escape(f'{Path.home()}{os.sep}')}")
    for heading, lines in (
        ("this machine", _machine()),
        ("what every map needs", needed),
        ("what only a part needs", _extras()),
        ("where things are", _folders()),
    ):
        click.echo(f"{heading}:")
        for name, value in lines:
            click.echo(f"  {name:<24} {home.sub(lambda _: f'~{os.sep}', value)}")
    if not whole:
        sys.exit(1)


def _machine() -> Iterator[tuple[str, str]]:
    from vinemap import __version__
    from vinemap.compute import machine

    yield "vinemap", __version__
    yield "Python", f"{platform.python_version()} ({sys.executable})"
    yield "system", f"{platform.platform()}, {platform.machine()}"
    yield "cores, memory", f"{machine.cores()}, {machine.memory() / GIB:.1f} GiB"


def _needed() -> tuple[list[tuple[str, str]], bool]:
    """Libraries and their versions, and whether all of them are there and can be loaded."""
    from importlib.metadata import PackageNotFoundError, requires, version

    try:
        lines = requires("vinemap") or []
    except PackageNotFoundError:
        return [("vinemap itself", "isn't installed, but found beside: pip install -e . lists what it needs")], True
    names = [re.split(r"[^\w.-]", line)[0] for line in lines if ";" not in line]
    told, whole = [], True
    for name in sorted(names):
        try:
            told.append((name, version(name)))
        except PackageNotFoundError:
            told.append((name, f"is missing: pip install {name}"))
            whole = False
    try:
        import pyogrio
        import pyproj
        import rasterio

        gdal = ".".join(map(str, pyogrio.__gdal_version__))
        told.append(("GDAL", f"{gdal} (pyogrio), {rasterio.__gdal_version__} (rasterio)"))
        told.append(("PROJ", f"{pyproj.proj_version_str} ({pyproj.datadir.get_data_dir()})"))
    except (ImportError, OSError) as error:
        told.append(("GDAL, PROJ", f"can't be loaded: {' '.join(str(error).split())}"))
        whole = False
    return told, whole


def _extras() -> Iterator[tuple[str, str]]:
    from importlib.metadata import packages_distributions, version

    from vinemap.cloud.pdal.engine import pdal_versions
    from vinemap.compute.extras import EXTRAS, load
    from vinemap.errors import DependencyError, reason_of

    owners = packages_distributions()
    for module, extra in EXTRAS.items():
        try:
            load(module)
        except DependencyError as error:
            yield extra.library, reason_of(error)
        else:
            yield extra.library, version(owners[module][0]) if module in owners else "is there"
    try:
        yield "PDAL", ", ".join(f"{name} {number}" for name, number in pdal_versions().items())
    except DependencyError:
        yield "PDAL", "isn't there; only ground.engine: pdal needs it: conda install -c conda-forge python-pdal"


def _folders() -> Iterator[tuple[str, str]]:
    import vinemap
    from vinemap import paths
    from vinemap.compute import compiled

    kept = compiled.folder()
    yield "vinemap", str(Path(vinemap.__file__).parent)
    yield "compiled loops", str(kept or "nowhere, so that each run compiles them: set NUMBA_CACHE_DIR")
    here = Path.cwd()
    yield "working folder", f"{here} ({shutil.disk_usage(here).free / GIB:.1f} GiB free)"
    for name, path in (
        ("surveys", paths.SURVEYS),
        ("products", paths.PRODUCTS),
        ("register", paths.REGISTER),
        ("estate", paths.ESTATE),
        ("Prefect", paths.prefect_home()),
    ):
        yield name, f"{path}{'' if path.exists() else ' (not there)'}"
    for name in VARIABLES:
        if value := os.environ.get(name):
            yield name, value
