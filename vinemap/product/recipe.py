"""What a product is made of, and whether an earlier one is made of the same."""

from __future__ import annotations

import hashlib
import json
import time
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import shapely

from vinemap import __version__, naming, paths
from vinemap.cloud.files import cloud_files, date_of, shows_tops
from vinemap.cloud.formats.identity import digest_of, stamp_of
from vinemap.cloud.pdal.engine import made_by
from vinemap.config.settings import Settings
from vinemap.errors import PASSING, BusyError, InputError
from vinemap.geo.boundaries import read_parcel
from vinemap.geo.crs import is_local
from vinemap.geo.layers import read_points, some_of
from vinemap.geo.zones import points_near
from vinemap.product.json_values import read_object
from vinemap.product.qgis.changed import changed

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    import geopandas as gpd
    from pyproj import CRS

    from vinemap.geo.boundaries import Boundary
    from vinemap.geo.lines import KnownRows
    from vinemap.geo.main import Origin

VINES = "vines"
"""Layer of known vines."""
BESIDE = 0.5
"""Metres beside a parcel at which its vines may stand."""
SETTLED = 2.0
"""Seconds within which a file can change twice without its time telling."""


class Source(NamedTuple):
    """A file that was read, by its content."""

    path: Path
    sha256: str
    stamp: tuple[int, ...]
    """Bytes, times of change (ns) and inode, which stay while the file does."""
    read: float
    """When it was read, in seconds since 1970."""

    def record(self) -> dict[str, Any]:
        """Name, size and SHA-256."""
        return {"file": self.path.name, "bytes": self.stamp[0], "sha256": self.sha256}

    def check(self) -> None:
        """Make sure that the file is still the same.

        Raises
        ------
        BusyError
            If it isn't, or is gone, as with its disk.
        """
        try:
            same = _stamp(self.path) == self.stamp
        except InputError:
            same = False
        if not same:
            raise BusyError(f"{naming.named(self.path)}: changed while it was read: try again when it stays as it is")


def read_source(path: Path, known: Iterable[Source] = ()) -> Source:
    """Work out a file's SHA-256, unless it is known and the file has not been touched since.

    Raises
    ------
    InputError
        If the file can't be read, or its name can't be written down.
    BusyError
        If it changes meanwhile.
    """
    if (shown := naming.shown(path)) != str(path):
        raise InputError(f"{shown}: its name isn't Unicode: rename it")
    began, stamp = time.time(), _stamp(path)
    for source in known:
        if (source.path, source.stamp) == (path, stamp) and max(stamp[1:3]) < (source.read - SETTLED) * 1e9:
            return source
    settled = max(stamp[1:3]) < (began - SETTLED) * 1e9
    try:
        digest = (_digest if settled else _digest.__wrapped__)(path, stamp)
    except OSError as error:
        raise _unreadable(path, error) from error
    source = Source(path, digest, stamp, began)
    source.check()
    return source


@lru_cache(maxsize=65_536)
def _digest(path: Path, stamp: tuple[int, ...]) -> str:
    """SHA-256 of a file, worked out once a process: a night's plan asks for it, and then its job."""
    del stamp
    return digest_of(path)


def _stamp(path: Path) -> tuple[int, ...]:
    try:
        return stamp_of(path)
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> InputError | BusyError:
    if isinstance(error, FileNotFoundError):
        return InputError(f"{path}: no such file")
    kind = BusyError if error.errno in PASSING else InputError
    return kind(f"{path}: can't be read ({error.strerror})")


class Recipe(NamedTuple):
    """All that the product of a parcel depends on, but for PROJ's grids and the libraries that are installed.

    For others of these alone no product is made anew; PDAL's versions count where it is the engine.
    """

    parcel: str
    clouds: tuple[Path, ...]
    sources: tuple[Source, ...]
    """The clouds first."""
    boundary: Boundary | None
    settings: Settings
    crs: CRS | None
    """CRS of the cloud's coordinates, where it is given."""
    origin: Origin | None
    """Origin of {Main}, where it is given."""
    flown: datetime
    """For the record: a file that is only touched makes no other product."""
    survey: str | None = None
    """Name of the survey whose parcels' products lie side by side."""
    remarks: tuple[str, ...] = ()
    """What is to be known of the boundary: a sentence each."""
    known: KnownRows | None = None
    """Its rows, where they are known."""
    vines: gpd.GeoSeries | None = None
    """Points of its vines, where they are known."""

    @property
    def flights(self) -> tuple[Source, ...]:
        """The clouds' sources."""
        return self.sources[: len(self.clouds)]

    @property
    def tops(self) -> bool:
        """Whether canopies were seen from above alone."""
        return shows_tops(self.clouds)

    def check(self) -> None:
        """Make sure that the clouds are still the same; BusyError if they aren't."""
        for source in self.flights:
            source.check()

    @property
    def key(self) -> str:
        """Hash of what it depends on, this version of vinemap included."""
        polygon = None
        if self.boundary:
            shape, crs = self.boundary
            polygon = [shapely.to_wkb(shapely.normalize(shape), hex=True), crs.to_string()]
        parts: dict[str, Any] = {
            "vinemap": __version__,
            "parcel": self.parcel,
            "cloud": [source.sha256 for source in self.flights],
            "polygon": polygon,
            "crs": self.crs.to_string() if self.crs else None,
            "origin": self.origin,
            "settings": self.settings.model_dump(mode="json"),
            "survey": self.survey,
        }
        if made := made_by(self.settings.ground):
            parts["engine"] = made
        if self.known:
            lines = self.known.lines
            shapes = shapely.to_wkb(lines.geometry.to_numpy(), hex=True).tolist()
            parts["rows"] = lines.crs.to_string(), lines["row_id"].tolist(), lines["label"].tolist(), shapes
        if self.vines is not None and len(self.vines):
            parts["vines"] = self.vines.crs.to_string(), self.vines.get_coordinates().to_numpy().tolist()
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def read_clouds(clouds: Path | Sequence[Path], known: Iterable[Source] = ()) -> tuple[Source, ...]:
    """Work out the SHA-256 of a cloud's files; of those with the same content the first counts.

    Raises
    ------
    InputError
        If there is none, or one can't be read.
    BusyError
        If one changes meanwhile.
    """
    by_path = {source.path: [source] for source in known}
    found: dict[str, Source] = {}
    for path in cloud_files(clouds):
        source = read_source(path, by_path.get(path, ()))
        found.setdefault(source.sha256, source)
    return tuple(found.values())


def recipe_of(
    clouds: Path | Sequence[Path],
    *,
    parcel: str,
    named: bool = True,
    boundary: Path | None = None,
    settings: Settings | None = None,
    crs: CRS | None = None,
    origin: Origin | None = None,
    rows: Path | None = None,
    rows_crs: CRS | None = None,
    vines: Path | None = None,
) -> Recipe:
    """Gather what the product of one parcel, of no survey, depends on, as :func:`vinemap.parcel.map_parcel` is told.

    Raises
    ------
    InputError
        If the cloud, the boundary, the rows or the vines can't be read, or none of these lies in the parcel.
    """
    local = crs is not None and is_local(crs)
    # A product's name by default says nothing of a polygon.
    how = {"lone": parcel == paths.named_by(cloud_files(clouds)), "local": local}
    polygon, remarks = read_parcel(boundary, parcel=parcel if named else None, **how) if boundary else (None, ())
    sources = read_clouds(clouds)
    files, date = tuple(source.path for source in sources), min(map(flown, sources))
    sources += (read_source(boundary),) if boundary else ()
    known = None
    if rows:
        from vinemap.geo.lines import read_rows, rows_of

        sources += (read_source(rows),)
        found, outside = rows_of(read_rows(rows, crs=rows_crs, local=local), {parcel: polygon})
        if parcel not in found:
            raise InputError(f"{rows}: none of its {len(outside)} rows lies in the parcel: is its CRS the right one?")
        known = found[parcel]
        if outside:
            left = f"{len(outside)} known rows lie outside of the parcel, and are left out: {some_of(outside)}"
            remarks += (left,)
    points = None
    if vines:
        sources += (read_source(vines),)
        points = vines_of(read_points(vines, VINES, crs=rows_crs, local=local), {parcel: polygon})[parcel]
        if len(points) == 0:
            raise InputError(f"{vines}: none of its vines stands in the parcel: is its CRS the right one?")
    return Recipe(
        parcel=parcel,
        clouds=files,
        sources=sources,
        boundary=polygon,
        settings=fit_for(settings or Settings(), files),
        crs=crs,
        origin=origin,
        flown=date,
        remarks=remarks,
        known=known,
        vines=points,
    )


def fit_for(settings: Settings, clouds: Sequence[Path]) -> Settings:
    """Settings for a cloud: where canopies were seen from above alone, their polygons stand on the soil."""
    if not shows_tops(clouds):
        return settings
    return settings.model_copy(update={"polygon": settings.polygon.model_copy(update={"foot": "soil"})})


def vines_of(points: gpd.GeoSeries, parcels: Mapping[str, Boundary | None]) -> dict[str, gpd.GeoSeries]:
    """Known vines that stand in each parcel, or just beside it, as boundaries may follow outermost rows."""
    return points_near(points, parcels, reach=BESIDE)


def flown(cloud: Source) -> datetime:
    """When a cloud's survey was flown: the date in its header, or else when the file was written, but not after now.

    Raises
    ------
    InputError
        If it can't be read.
    """
    try:
        return date_of(cloud.path) or min(datetime.fromtimestamp(cloud.stamp[1] // 10**9, UTC), datetime.now(UTC))
    except OSError as error:
        raise _unreadable(cloud.path, error) from error


class Recorded(NamedTuple):
    """What the record of a run tells of a product, all of whose files are there."""

    key: str
    parcel: str
    rows: int
    length: float
    warnings: tuple[str, ...]


def product_in(folder: Path) -> Recorded | None:
    """The product in a folder; None where there is none, or not all of its files, but for what is ``changed``."""
    record = read_object(paths.run_record(folder))
    try:
        others = [name for name, size in record["files"].items() if (folder / name).stat().st_size != size]
        if others and not set(others) <= changed(folder).keys():
            return None
        known = record["key"], record["parcel"], record["counts"]["rows"], record["length_m"]
        return Recorded(*known, tuple(record["warnings"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def made_of(folder: Path) -> dict[str, str]:
    """Names of the files that the product in a folder was made of, and their SHA-256; nothing where there is none."""
    try:
        inputs = read_object(paths.run_record(folder))["inputs"]
        return {str(one["file"]): str(one["sha256"]) for one in inputs}
    except (KeyError, TypeError):
        return {}
