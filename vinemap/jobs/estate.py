"""Surveys that arrive in a folder: which are there, whole, and need work."""

from __future__ import annotations

import time
from contextlib import suppress
from math import inf
from typing import TYPE_CHECKING, NamedTuple

from vinemap import naming, paths
from vinemap.cloud.files import CLOUDS, cloud_files, is_cloud, once, tiles_in
from vinemap.cloud.formats.identity import files_of
from vinemap.cloud.formats.kinds import kind_of
from vinemap.cloud.las_end import unfinished
from vinemap.config.names import check_name
from vinemap.errors import InputError, VinemapError
from vinemap.geo.layers import layers_in
from vinemap.geo.lines import ROW_LAYER

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from vinemap.config.surveys import EstateConfig, SurveyConfig

POLYGONS = (".gpkg", ".geojson", ".kml", ".kmz", ".shp", ".fgb", ".gml", ".geojsonl", ".tab", ".mif", ".json", ".zip")
"""Files of polygons; what is in the last two kinds must be seen."""
FEATURES = b"FeatureCollection"
"""What stands in the beginning of GeoJSON."""
BEGINNING = 4096
"""Bytes of it."""
USUAL = ("parcels", "boundaries", "boundary")
"""What the file of the parcels' polygons is called where there are others."""
ROWS = (*POLYGONS, ".dxf")
"""Files of known rows, which are called ``rows``."""
UNUSABLE = {
    "can't be read: unpack it": (
        *(".zip", ".7z", ".rar", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".zst", ".lz4", ".001", ".z01"),
    ),
    "can't be read: save it as LAS or LAZ": (
        *(".ptx", ".rcp", ".rcs", ".fls", ".zfs", ".zlas", ".lsproj"),
        *(".slpk", ".ldr", ".rdb", ".rxp"),
    ),
}
"""What to do with files that hold clouds in another form."""
NO_POLYGONS = "can't be read: if it holds the parcels, save them as GeoPackage"
OTHER_POLYGONS = (".dxf", ".dwg", ".gdb", ".mdb", ".parquet", ".topojson", ".sqlite", ".gpx")
"""Files that may hold polygons in another form; the third is a folder."""
MISNAMED = "is a cloud by its first bytes: let its name end in .las or .laz"
PARTIAL = (".part", ".partial", ".filepart", ".crdownload", ".download", ".opdownload", ".tmp", ".aria2", ".!ut")
"""How files end that are no whole uploads."""
DEEP = ("*/*", "*/*/*", "*/*/*/*")
"""Where clouds are looked for in a folder that has none at its top."""
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
    passed: tuple[str, ...] = ()
    """What lies beside it and can't be used, with what to do: a sentence each."""


class _Found(NamedTuple):
    """Files of a survey."""

    clouds: Sequence[Path]
    polygons: Sequence[Path]
    rows: Path | None
    own: Path | None
    unusable: dict[Path, str]
    partial: Sequence[Path]
    deeper: Sequence[Path]
    """Folders in its own in which there are clouds."""


def arrivals(estate: EstateConfig, *, now: float | None = None) -> Iterator[Arrival]:
    """Look through an estate's folder: each cloud in it is a survey, and each folder that holds some.

    Files in one folder are worked as one: tiles, flights. What can't be used, but may be meant to be, is named. Names
    that begin with a dot are left out, as tools of upload choose them for what isn't whole.

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
    for name, group in _surveys(found):
        path = group[0]
        try:
            known = check_name(name)
            if known in seen:
                yield Arrival(path.name, None, f"{path} has the name of {seen[known]}: give it another")
                continue
            seen[known] = path
            if arrival := _arrival(known, group, estate, now or time.time()):
                yield arrival
            else:
                del seen[known]
        except VinemapError as error:
            yield Arrival(naming.shown(path.name), None, str(error))
        except OSError as error:
            yield Arrival(path.name, None, f"{path}: can't be read ({error.strerror})")


def _surveys(found: Iterable[Path]) -> Iterator[tuple[str, list[Path]]]:
    """Folders, and files of one name, that may be surveys."""
    groups: dict[tuple[str, bool], list[Path]] = {}
    for path in found:
        if path.name.startswith("."):
            continue
        folder = path.is_dir()
        if not folder and path.suffix.lower() in CLOUDS:
            groups.setdefault((paths.bare(path), False), []).append(path)
        elif folder or path.suffix.lower() in PARTIAL or _unusable(path):
            groups[path.name, folder] = [path]
    for (name, _), group in groups.items():
        yield name, group


def _arrival(name: str, group: list[Path], estate: EstateConfig, now: float) -> Arrival | None:
    """The survey of a folder or of files; None if a folder holds nothing of one."""
    folder = group[0] if group[0].is_dir() else None
    if not folder and not all(path.is_file() for path in group):
        raise InputError(f"{group[0]}: can't be read: it is no file")
    found = _found(folder.iterdir() if folder else group, folder)
    passed = [f"{path.name} {why}" for path, why in found.unusable.items()]
    passed += [f"{path.name} holds clouds, too: move them up" for path in found.deeper]
    for path in found.partial:
        age = _age(path, now, estate.settle)
        reason = f"{path}: is no whole file: is its upload over?"
        if age < LATE or not found.clouds:
            return Arrival(name, None, reason, waits=age < LATE, passed=tuple(passed))
        passed.append(f"{path.name} is no whole file, and over a day old: upload it again")
    if not found.clouds and not found.own:
        return _without_cloud(name, group[0], found)
    arrival = _whole(name, _config(name, group[0], found, estate), found.own, estate, now)
    return arrival._replace(passed=tuple(passed))


def _config(name: str, path: Path, found: _Found, estate: EstateConfig) -> SurveyConfig:
    """What holds for a survey with the files that were found."""
    there: dict[str, Path | list[Path] | None] = {"cloud": _several(found.clouds), "rows": found.rows}
    rows = estate.of_survey(name, found.own, **there).rows
    polygons = [p for p in found.polygons if p != rows]
    config = estate.of_survey(name, found.own, boundaries=_only(polygons), **there)
    if len(polygons) > 1 and not config.boundaries:
        raise InputError(
            f"{path}: holds {len(polygons)} files of polygons: name one in its {paths.OWN_CONFIGURATION}, "
            "as 'boundaries: FILE'"
        )
    if not config.cloud:
        raise InputError(f"{path}: holds no cloud, and its {paths.OWN_CONFIGURATION} names none")
    return config


def _whole(name: str, config: SurveyConfig, own: Path | None, estate: EstateConfig, now: float) -> Arrival:
    """A survey, if its files have stayed as they are, and are there to their ends."""
    clouds = cloud_files(config.cloud or ())
    used = [p for p in (*clouds, config.boundaries, config.rows, config.vines, own) if p]
    for file in used:
        _check(file)
    age = min(_age(part, now, estate.settle) for p in used if not naming.url_of(p) for part in files_of(p))
    if age < estate.settle:
        return Arrival(name, None, f"changed {age:.0f} s ago, waits until {estate.settle:.0f} s", waits=True)
    for cloud in clouds:
        if not kind_of(cloud) and (lacks := unfinished(cloud)):
            return Arrival(name, None, f"{cloud}: {lacks}: is its upload over?", waits=age < LATE)
    return Arrival(name, config)


def _age(file: Path, now: float, settle: float) -> float:
    """Seconds since a file changed: 0 if its disk's clock is ahead, infinite if it is so by a day.

    A time that is ahead by more than ``settle`` seconds may have come with the file, as from a camera's clock; then it
    counts when the file was put where it is.
    """
    stat = file.stat()
    changed = stat.st_mtime if stat.st_mtime < now + settle else stat.st_ctime
    return max(now - changed, 0) if changed < now + LATE else inf


def _found(files: Iterable[Path], folder: Path | None) -> _Found:
    """What is what among the files of a survey."""
    everything = sorted(p for p in files if not p.name.startswith("."))
    shown = [p for p in everything if p.is_file() or not folder]
    known = [p for p in shown if p.stem.lower() == ROW_LAYER and p.suffix.lower() in ROWS] if folder else []
    polygons = [p for p in shown if p not in known and _has_polygons(p)] if folder else []
    if len(polygons) > 1:
        polygons = [p for p in polygons if p.stem.lower() in USUAL] or polygons
    own = folder / paths.OWN_CONFIGURATION if folder and (folder / paths.OWN_CONFIGURATION).is_file() else None
    unusable = {p: why for p in shown if (why := _unusable(p))}
    if folder and not polygons:
        unusable |= {p: NO_POLYGONS for p in everything if p.suffix.lower() in OTHER_POLYGONS and p not in known}
    partial = [p for p in shown if p.suffix.lower() in PARTIAL]
    clouds = once([p for p in map(tiles_in, everything) if is_cloud(p)])
    deeper = _deeper(folder, DEEP[:1] if clouds else DEEP) if folder and not own else []
    return _Found(clouds, polygons, known[0] if known else None, own, unusable, partial, deeper)


def _deeper(folder: Path, patterns: Sequence[str]) -> list[Path]:
    """Folders in a folder that hold clouds."""
    tiles = {part for path in (folder, *folder.iterdir()) for part in files_of(path / paths.EPT)}
    clouds = (path for pattern in patterns for path in folder.glob(pattern) if is_cloud(path) and path not in tiles)
    shown = (path.parent for path in clouds if not any(p.startswith(".") for p in path.relative_to(folder).parts))
    return list(dict.fromkeys(shown))


def _without_cloud(name: str, path: Path, found: _Found) -> Arrival | None:
    """What is said of something in which there is no cloud; None where none seems to be meant."""
    if found.deeper:
        sub = found.deeper[0].relative_to(path)
        known = f"move them up, or say 'cloud: {sub}' in its {paths.OWN_CONFIGURATION}"
        return Arrival(name, None, f"{path}: its clouds lie in {sub}: {known}")
    if found.unusable:
        first, *others = (f"{file} {why}" for file, why in found.unusable.items())
        return Arrival(name, None, first, passed=tuple(others))
    if found.polygons:
        return Arrival(name, None, f"{path}: holds polygons, but no cloud: put LAS or LAZ there", waits=True)
    return None


def _has_polygons(path: Path) -> bool:
    """Whether a file is one of polygons, by its name, or by what is in it where many things have such a name."""
    kind = path.suffix.lower()
    if kind == ".zip":
        return bool(layers_in(path))
    if kind == ".json":
        with path.open("rb") as stream:
            return FEATURES in stream.read(BEGINNING)
    return kind in POLYGONS


def _unusable(path: Path) -> str | None:
    """What to do with a file that can't be read, but may be meant to be."""
    kind = path.suffix.lower()
    what = next((why for why, kinds in UNUSABLE.items() if kind in kinds), None)
    if what is None and kind not in (*CLOUDS, *PARTIAL) and path.is_file():
        with suppress(OSError), path.open("rb") as stream:
            what = MISNAMED if stream.read(4) == b"LASF" else None
    return None if kind == ".zip" and layers_in(path) else what


def _check(file: Path) -> None:
    if (shown := naming.shown(file)) != str(file):
        raise InputError(f"{shown}: its name isn't Unicode: rename it")
    if not (file.is_file() or naming.url_of(file)):
        raise InputError(f"{file}: no such file")


def _several(files: Sequence[Path]) -> Path | list[Path] | None:
    return list(files) if len(files) > 1 else _only(files)


def _only(files: Sequence[Path]) -> Path | None:
    return files[0] if len(files) == 1 else None
