"""What comes of a file: worked as ``vinemap run`` and a survey's job do it, and judged; run by worker processes."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap import paths
from vinemap.errors import BusyError, InputError, VinemapError
from vinemap.terminal import hushed

if TYPE_CHECKING:
    from collections.abc import Callable

    from vinemap.compute.arrays import Floats

CLOSE = 0.1
"""Metres by which rows of a right product may be off."""
SAME, RIGHT, WARNED, TOLD = "the same points", "the same rows", "other rows, warned", "told in a line"
GOOD = SAME, RIGHT, WARNED, TOLD
WRONG, LATER, FAULT, DIED, HUNG, MEMORY_OUT, NOISE, UNCLEAR = (
    "other rows, not a word",
    "'try again'",
    "a fault of our own",
    "the process died",
    "hung",
    "too much memory",
    "more than a line",
    "an unclear line",
)
OUTCOMES = *GOOD, WRONG, LATER, FAULT, DIED, HUNG, MEMORY_OUT, NOISE, UNCLEAR


class Verdict(NamedTuple):
    """What a case ended in, and what was said."""

    outcome: str
    said: str = ""


@dataclass(frozen=True)
class Whole:
    """A whole file, its polygon, and what comes of it."""

    path: Path
    boundary: Path
    points: str = ""
    """Digest of the points."""
    rows: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Vertices of each row (m)."""


class _Same(Exception):  # noqa: N818 - no error
    """The points are those of the whole file, and so is what would come of them."""


def digest(xyz: Floats, crs: Any) -> str:
    """Digest of points (n, 3) in any order, to the millimetre, and of their CRS."""
    import hashlib

    whole = np.round(xyz * 1000).astype(np.int64)
    return hashlib.sha256(whole[np.lexsort(whole.T)].tobytes() + crs.to_wkt().encode()).hexdigest()


def measure(path: Path, boundary: Path) -> Whole:
    """What comes of a whole file."""
    found: list[str] = []

    def step(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        if name == "Reading":
            found.append(digest(result.xyz, result.crs))
        return result

    rows = _map(path, boundary, step)[1]
    return Whole(path, boundary, found[0], rows)


def _map(path: Path, boundary: Path, step: Callable[..., Any]) -> tuple[tuple[str, ...], tuple[Any, ...]]:
    """Warnings and rows of a file that is worked as ``vinemap run`` does it."""
    import geopandas as gpd

    from vinemap.parcel import map_parcel

    folder = Path(tempfile.mkdtemp(dir=path.parent))
    try:
        summary = map_parcel(path, folder / "A", parcel="A", named=False, boundary=boundary, step=step)
        rows = gpd.read_file(paths.geopackage(folder / "A", "A"), layer="rows")
    finally:
        left = [p.name for p in folder.iterdir()] if folder.is_dir() else []
        shutil.rmtree(folder)
    if left not in ([], ["A"]):
        raise AssertionError(f"left behind: {left}")
    return summary.warnings, tuple(tuple(map(tuple, line.coords)) for line in rows.geometry)


def examine(path: Path, whole: Whole) -> Verdict:
    """Work a damaged file in all ways, and judge what comes of it; run by a worker."""

    def step(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        if name == "Reading" and digest(result.xyz, result.crs) == whole.points:
            raise _Same
        return result

    with hushed():
        verdict = _examined(path, whole, step)
    if not (size := os.fstat(2).st_size):
        return verdict
    os.lseek(2, 0, os.SEEK_SET)
    return Verdict(NOISE, os.read(2, size).decode(errors="replace"))


def _examined(path: Path, whole: Whole, step: Callable[..., Any]) -> Verdict:
    from vinemap.cloud.las_end import unfinished
    from vinemap.cloud.pieces import split_cloud
    from vinemap.geo.boundaries import read_boundary

    verdict = Verdict(SAME)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        try:
            unfinished(path)
            split_cloud(path, [read_boundary(whole.boundary)] * 2, Path(folder))
        except VinemapError as error:
            verdict = _judge(error, path)
    if verdict.outcome not in (SAME, TOLD):
        return verdict
    try:
        warnings, rows = _map(path, whole.boundary, step)
    except _Same:
        return Verdict(SAME)
    except VinemapError as error:
        return _judge(error, path)
    return Verdict(RIGHT if _alike(rows, whole.rows) else WARNED if warnings else WRONG, "; ".join(warnings))


def _judge(error: VinemapError, path: Path) -> Verdict:
    said = str(error)
    if isinstance(error, BusyError):
        return Verdict(LATER, said)
    if not isinstance(error, InputError) or path.name not in said or "\n" in said or len(said) > 400:
        return Verdict(UNCLEAR, f"{type(error).__name__}: {said}")
    return Verdict(TOLD, said)


def _alike(rows: tuple[Any, ...], others: tuple[Any, ...]) -> bool:
    import shapely

    if len(rows) != len(others):
        return False
    lines, wanted = ([shapely.LineString(row) for row in found] for found in (rows, others))
    return bool((shapely.hausdorff_distance(lines, wanted) < CLOSE).all())
