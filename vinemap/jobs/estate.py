"""Surveys that arrive in a folder: which are there, whole, and need work."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

from vinemap import paths
from vinemap.cloud.las_end import unfinished
from vinemap.config.names import check_name
from vinemap.errors import InputError, VinemapError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from vinemap.config.surveys import EstateConfig, SurveyConfig

CLOUDS = (".las", ".laz")
POLYGONS = (".gpkg", ".geojson", ".shp")
USUAL = ("parcels", "boundaries", "boundary")
"""What the file of the parcels' polygons is called where there are others."""
LATE = 86_400
"""Seconds after which what isn't whole is no upload any more."""


class Arrival(NamedTuple):
    """A survey that has arrived, or is arriving."""

    name: str
    config: SurveyConfig | None
    """None if it can't be worked."""
    reason: str = ""
    """Why not."""
    waits: bool = False
    """Whether it only isn't there as a whole yet."""


def arrivals(estate: EstateConfig, *, now: float | None = None) -> Iterator[Arrival]:
    """Look through an estate's folder: each LAS, LAZ or COPC file in it is a survey, and each folder that holds one.

    Names that begin with a dot are left out, as tools of upload choose them for what isn't whole.

    Parameters
    ----------
    estate : EstateConfig
        Names the folder, and for how long the files of a survey must have stayed as they are.
    now : float, optional
        Seconds since 1970.

    Raises
    ------
    InputError
        If the folder can't be read.
    """
    seen: dict[str, Path] = {}
    try:
        found = sorted(estate.surveys.iterdir())
    except OSError as error:
        raise InputError(f"{estate.surveys}: can't be read ({error.strerror}): make it, or name another") from error
    for path in found:
        if path.name.startswith(".") or not (path.is_dir() or path.suffix.lower() in CLOUDS):
            continue
        name = path.name if path.is_dir() else path.stem.removesuffix(".copc")
        try:
            name = check_name(name)
            if name in seen:
                yield Arrival(path.name, None, f"{path} has the name of {seen[name]}: give it another")
                continue
            seen[name] = path
            if arrival := _arrival(name, path, estate, now or time.time()):
                yield arrival
            else:
                del seen[name]
        except VinemapError as error:
            yield Arrival(paths.shown(path.name), None, str(error))
        except OSError as error:
            yield Arrival(path.name, None, f"{path}: can't be read ({error.strerror})")


def _arrival(name: str, path: Path, estate: EstateConfig, now: float) -> Arrival | None:
    """The survey of a folder or file; None if a folder holds nothing of one yet."""
    files = [path] if path.is_file() else [p for p in path.iterdir() if p.is_file() and not p.name.startswith(".")]
    clouds = [p for p in files if p.suffix.lower() in CLOUDS]
    polygons = [p for p in files if p.suffix.lower() in POLYGONS]
    if len(polygons) > 1:
        polygons = [p for p in polygons if p.stem.lower() in USUAL] or polygons
    own = path / paths.OWN_CONFIGURATION if path.is_dir() and (path / paths.OWN_CONFIGURATION).is_file() else None
    if not clouds and not own:
        return None
    config = estate.of_survey(name, own, cloud=_only(clouds), boundaries=_only(polygons))
    for found, kind, chosen in ((clouds, "clouds", config.cloud), (polygons, "files of polygons", config.boundaries)):
        if len(found) > 1 and not chosen:
            key = "cloud" if found is clouds else "boundaries"
            raise InputError(
                f"{path}: holds {len(found)} {kind}: name one in its {paths.OWN_CONFIGURATION}, as '{key}: FILE'"
            )
    if not config.cloud:
        raise InputError(f"{path}: holds no cloud, and its {paths.OWN_CONFIGURATION} names none")
    used = [p for p in (config.cloud, config.boundaries, own) if p]
    for file in used:
        _check(file)
    age = now - max(p.stat().st_mtime for p in used)
    if 0 <= age < estate.settle:
        return Arrival(name, None, f"changed {age:.0f} s ago, waits until {estate.settle:.0f} s", waits=True)
    if lacks := unfinished(config.cloud):
        return Arrival(name, None, f"{config.cloud}: {lacks}: is its upload over?", waits=age < LATE)
    return Arrival(name, config)


def _check(file: Path) -> None:
    if (shown := paths.shown(file)) != str(file):
        raise InputError(f"{shown}: its name isn't Unicode: rename it")
    if not file.is_file():
        raise InputError(f"{file}: no such file")


def _only(files: list[Path]) -> Path | None:
    return files[0] if len(files) == 1 else None
