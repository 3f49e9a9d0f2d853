"""Many parcels of one cloud in one job: read once, worked in processes, one parcel's fault costing no other."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import TimeoutError as OutOfTime
from concurrent.futures import as_completed
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from pebble import ProcessExpired, ProcessPool

from vinemap import compiled, paths
from vinemap.config import Settings
from vinemap.errors import InputError, OutputError, VinemapError
from vinemap.parcel import Summary, map_parcel
from vinemap.pieces import split_cloud
from vinemap.product import fingerprint
from vinemap.vector import read_boundary

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from concurrent.futures import Future
    from pathlib import Path

    from pyproj import CRS

    from vinemap.crs import Origin
    from vinemap.las import Boundary
    from vinemap.pieces import Piece


class Outcome(NamedTuple):
    """What came of a parcel: what was found, or why nothing was."""

    parcel: str
    summary: Summary | None
    reason: str = ""

    def line(self) -> str:
        """The same as a sentence."""
        return self.summary.line() if self.summary else f"{self.parcel}: failed: {' '.join(self.reason.split())}"


def map_survey(
    cloud: Path,
    folder: Path,
    *,
    parcels: Sequence[str],
    boundaries: Path,
    settings: Settings | None = None,
    crs: CRS | None = None,
    origin: Origin | None = None,
    workers: int | None = None,
    limit: float | None = None,
) -> Iterator[Outcome]:
    """Map parcels of a cloud, and leave the product of each in a folder of its name.

    The cloud is read once and every point goes to the parcels that hold it. Each parcel is then worked by a process of
    its own: what goes wrong there, a crash or too long a time even, is that parcel's alone.

    Parameters
    ----------
    cloud : Path
        LAS, LAZ or COPC file.
    folder : Path
        Folder of the products' folders.
    parcels : sequence of str
        Names of parcels.
    boundaries : Path
        File with the parcels' polygons.
    settings, crs, origin
        As for :func:`vinemap.parcel.map_parcel`.
    workers : int, optional
        Parcels that are worked at once; as many as there are cores by default.
    limit : float, optional
        Seconds that a parcel may take.

    Yields
    ------
    Outcome
        Of each parcel, as it comes.

    Raises
    ------
    VinemapError
        If the cloud or the boundaries can't be read at all, or nothing can be written.
    """
    settings = settings or Settings()
    polygons: dict[str, Boundary] = {}
    for parcel in parcels:
        try:
            polygons[parcel] = read_boundary(boundaries, parcel=parcel)
        except InputError as error:
            yield Outcome(parcel, None, str(error))
    if not polygons:
        return
    inputs = [fingerprint(cloud), fingerprint(boundaries)]
    n = min(workers or compiled.CORES, len(polygons))
    work = partial(
        _work, cloud, boundary=boundaries, settings=settings, crs=crs, origin=origin, inputs=inputs, share=1 / n
    )
    try:
        # What a process leaves that is killed lies aside as well.
        with paths.aside(folder) as aside, _processes(n) as pool:
            pool.submit(int, None)  # nothing: processes start while the cloud is read
            pieces = _pieces(cloud, polygons, aside, crs=crs, settings=settings)
            largest_first = sorted(zip(polygons, pieces, strict=True), key=lambda job: -_size(job[1]))
            jobs: dict[Future[Summary], str] = {
                pool.submit(work, limit, folder / parcel, parcel, piece, aside): parcel
                for parcel, piece in largest_first
            }
            for job in as_completed(jobs):
                yield _outcome(jobs[job], job, limit)
    except OSError as error:
        raise OutputError(f"{folder}: can't be written ({error.strerror or error}): choose another folder") from error


@contextmanager
def _processes(n: int) -> Iterator[ProcessPool]:
    """Processes that are stopped at once if their work is broken off."""
    with ProcessPool(
        n,
        context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(max(1, compiled.CORES // n),),
    ) as pool:
        try:
            yield pool
        except BaseException:
            pool.stop()  # type: ignore[no-untyped-call]
            raise


def _pieces(
    cloud: Path, polygons: dict[str, Boundary], folder: Path, *, crs: CRS | None, settings: Settings
) -> list[Piece] | list[None]:
    """The points of each parcel; None where it reads them itself: of a COPC's one parcel, or with PDAL."""
    if len(polygons) == 1 or settings.ground.engine == "pdal":
        return [None] * len(polygons)
    return split_cloud(cloud, list(polygons.values()), folder, crs=crs)


def _size(piece: Piece | None) -> int:
    return piece.path.stat().st_size if piece else 0


def _begin(cores: int) -> None:
    """Make a process ready for work on so many cores."""
    compiled.use_cores(cores)


def _work(cloud: Path, folder: Path, parcel: str, piece: Piece | None, drafts: Path, **options: Any) -> Summary:
    try:
        return map_parcel(cloud, folder, parcel=parcel, piece=piece, drafts=drafts, **options)
    finally:
        if piece:
            piece.path.unlink(missing_ok=True)


def _outcome(parcel: str, job: Future[Summary], limit: float | None) -> Outcome:
    try:
        return Outcome(parcel, job.result())
    except VinemapError as error:
        return Outcome(parcel, None, str(error))
    except OutOfTime:
        return Outcome(parcel, None, f"took longer than {limit:g} s")
    except ProcessExpired as error:
        return Outcome(parcel, None, f"its process died (code {error.exitcode})")
    except MemoryError:
        return Outcome(parcel, None, "not enough memory")
    except Exception as error:  # noqa: BLE001 - a fault of our own costs no other parcel
        return Outcome(parcel, None, f"a fault of vinemap's own ({type(error).__name__}: {error})")
