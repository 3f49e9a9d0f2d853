"""Files of whatever format PDAL reads, chunk by chunk."""

from __future__ import annotations

from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap import naming, paths
from vinemap.cloud.formats.box import box_about, check_outside, n_outside, stated_box
from vinemap.cloud.formats.ept import read_ept
from vinemap.cloud.formats.kinds import kind_of
from vinemap.cloud.formats.told import Header, Points
from vinemap.cloud.las_end import OURS
from vinemap.cloud.pdal.engine import load_pdal
from vinemap.cloud.pdal.stages import read
from vinemap.compute.apart import apart
from vinemap.errors import BusyError, InputError, VinemapError, WorkerError, reason_of
from vinemap.geo.stated import crs_of

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator

    from pyproj import CRS

    from vinemap.compute.arrays import Floats
    from vinemap.geo.boundaries import Boundary

WILD = set("[]*?~\\")
"""Characters by which PDAL takes a name for that of other files."""
COPC_AT = slice(377, 381)
"""Bytes of a LAS file that are those of a COPC's first record."""


def read_pdal(path: Path, crs: CRS | None, around: Boundary | None) -> Points:
    """Open a file with PDAL; of COPC and EPT only what lies about a polygon is read.

    Raises
    ------
    InputError
        If it can't be read.
    DependencyError
        If PDAL can't be loaded.
    """
    load_pdal()
    address = naming.url_of(path)
    if not address and not path.is_file():
        raise InputError(f"{path}: no such file")
    kind, known = _look(path)
    options: dict[str, Any] = {"type": f"readers.{kind}"} if kind in {"las", "copc"} else {}
    if known and around and kind in {"copc", "ept"}:
        options["bounds"] = _bounds(*box_about(around, crs_of(known, crs, path)))
    chunks = _chunks(path, options, known)
    told = next(chunks)
    return Points(known or _header(told), chunks)


def _look(path: Path) -> tuple[str | None, Any]:
    """What a file is (las, copc, ept) as far as that counts, and its header, where others tell more of it than PDAL.

    Of LAS that is laspy's, which has all of its records; if it has none, PDAL may have one.
    """
    if kind_of(path) == "ept":
        return "ept", read_ept(path, None, None).header
    if naming.url_of(path):
        return None, None
    with path.open("rb") as stream:
        head = stream.read(COPC_AT.stop)
    if not head.startswith(b"LASF"):
        return None, None
    kind = "copc" if head[COPC_AT] == b"copc" else "las"
    try:
        import laspy

        with laspy.open(path) as file:
            return kind, file.header
    except OURS:
        raise
    except BaseException:  # noqa: BLE001 - laspy and lazrs raise many kinds, and PDAL may read it all the same
        return kind, None


def _chunks(path: Path, options: dict[str, Any], known: Any) -> Generator[Any]:
    """What PDAL tells of a file, then the coordinates (n, 3) of its usable points, chunk by chunk."""
    las = options.get("type") and known
    total, box = (known.point_count, stated_box(known)) if las else (0, None)
    done = beyond = 0
    with _plain(path) as name, _said_of(path), closing(apart(read, {"filename": name} | options)) as answers:
        yield next(answers)
        for n, xyz in answers:
            done += n
            beyond += n_outside(xyz.T, box)
            yield xyz
    if las and "bounds" not in options and done != total:
        raise InputError(f"{path}: ends after {done} of {total} points: copy or download it again")
    check_outside(beyond, done, path)


@contextmanager
def _said_of(path: Path) -> Iterator[None]:
    """Say in a line what PDAL raises of a file, or its process dies of."""
    try:
        yield
    except WorkerError as error:
        if error.heals:
            raise BusyError(f"{path}: can't be read now ({error}): try again") from error
        raise InputError(f"{path}: can't be read by PDAL ({error}): is it whole?") from error
    except VinemapError:
        raise
    except (RuntimeError, OSError, ValueError) as error:
        reason = reason_of(error)[:200]
        raise InputError(f"{path}: can't be read by PDAL ({reason}): is it whole?") from error


@contextmanager
def _plain(path: Path) -> Iterator[str]:
    """A name of a file that stands for no other: PDAL looks for all that match one with brackets, say.

    Where there is need, that of a link in a folder that goes again.
    """
    name = naming.url_of(path) or str(path)
    if naming.url_of(path) or not WILD & set(path.as_posix()):
        yield name
        return
    with TemporaryDirectory(prefix="vinemap-") as folder:
        whole = path.absolute()
        if kind_of(path) == "ept":
            link = Path(folder) / "tiles"
            link.symlink_to(whole.parent, target_is_directory=True)
            yield str(link / paths.EPT)
        else:
            link = Path(folder) / f"cloud{''.join(s for s in path.suffixes[-2:] if not set(s) & WILD)}"
            link.symlink_to(whole)
            yield str(link)


def _header(told: dict[str, Any]) -> Header:
    """What PDAL tells of a file, as far as it does."""
    srs, bounds, n = told.get("srs") or {}, told.get("bounds") or {}, int(told.get("num_points") or 0)
    low, high = (np.array([float(bounds.get(f"{side}{axis}", np.nan)) for axis in "xyz"]) for side in ("min", "max"))
    return Header(srs.get("compoundwkt") or srs.get("wkt") or "", low, high, point_count=n)


def _bounds(low: Floats, high: Floats) -> str:
    """Bounds in the plane, as PDAL writes them."""
    (west, south), (east, north) = low[:2].tolist(), high[:2].tolist()
    return f"([{west!r}, {east!r}], [{south!r}, {north!r}])"
