"""Names of files: the only place where one is written."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
import uuid
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from vinemap.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

DATA = Path("data")
PIECES = ".pieces-"
"""How the name of a folder begins that holds the points of a survey's parcels while it is worked."""
RUN = "run.json"


def stem(cloud: Path) -> str:
    """Name of a cloud without what tells its format (``.laz``, ``.copc.laz``), fit to name other files."""
    return re.sub(r"^[. -]+|[. ]+$|[^\w .()+#&-]", "", cloud.stem.removesuffix(".copc"))[:64] or "cloud"


def survey_cloud(survey: str) -> Path:
    """Cloud of a survey."""
    return DATA / "surveys" / survey / f"{survey}.laz"


def survey_boundaries(survey: str) -> Path:
    """Polygons of a survey's parcels."""
    return DATA / "surveys" / survey / "parcels.gpkg"


def survey_products(survey: str) -> Path:
    """Folder of the products of a survey's parcels."""
    return DATA / "products" / survey


def prefect_home() -> Path:
    """Folder of the Prefect server that runs flows on a schedule: its database and its log."""
    return DATA / ".prefect"


def product_folder(survey: str, parcel: str) -> Path:
    """Folder of a parcel's product."""
    return survey_products(survey) / parcel


def geopackage(folder: Path, parcel: str) -> Path:
    """GeoPackage of a product."""
    return folder / f"{parcel}.gpkg"


def raster(folder: Path, parcel: str, kind: str) -> Path:
    """One of the rasters of a product."""
    return folder / f"{parcel}_{kind}.tif"


def canopy_mesh(folder: Path, parcel: str) -> Path:
    """Mesh of the canopies, as glTF."""
    return folder / f"{parcel}_canopy.glb"


def classified_cloud(folder: Path, parcel: str) -> Path:
    """Cloud of a parcel with a class and a row for every point."""
    return folder / f"{parcel}_classified.laz"


def tiles(folder: Path) -> Path:
    """Folder for the tiles of a cloud too large for memory, gone when the product is whole."""
    return folder / "tiles"


def run_record(folder: Path) -> Path:
    """Record of the run that made a product."""
    return folder / RUN


@contextmanager
def aside(folder: Path) -> Iterator[Path]:
    """Give a folder in another, for what goes again; so does the other if it has been made for it and stays empty.

    Raises
    ------
    OSError
        If they can't be made.
    """
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=PIECES, dir=folder) as inner:
            yield Path(inner).resolve()
    finally:
        _remove_empty(made)


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def product(target: Path, drafts: Path | None = None) -> Iterator[Path]:
    """Give a folder to write a product into, and put it in place of ``target`` if all went well.

    A target that is missing, empty or holds an earlier product is replaced whole. In one that holds other files, the
    product's replace those of the same name and the others stay. The folder is made beside the target, or among
    ``drafts``, on the same disk, where somebody clears up even if this process dies.

    Raises
    ------
    OutputError
        If nothing can be written there.
    """
    target = target.resolve()
    draft = (drafts or target.parent) / f".{target.name}.{uuid.uuid4().hex[:8]}.part"
    made = [folder for folder in target.parents if not folder.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        draft.mkdir()
        if target.exists() and not target.is_dir():
            raise NotADirectoryError(20, "is a file")
    except OSError as error:
        shutil.rmtree(draft, ignore_errors=True)
        raise _unwritable(target, error) from error
    try:
        yield draft
        _publish(draft, target)
    except OSError as error:
        raise _unwritable(target, error) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        _remove_empty(made)


def _unwritable(target: Path, error: OSError) -> OutputError:
    return OutputError(f"{target}: can't be written ({error.strerror or error}): choose another folder with --out")


def _publish(draft: Path, target: Path) -> None:
    if not target.exists():
        draft.rename(target)
    elif _replaceable(target, draft):
        old = target.with_name(draft.with_suffix(".old").name)
        target.rename(old)
        try:
            draft.rename(target)
        except OSError:
            # Another run has put its product there meanwhile; if not, the earlier one goes back.
            with suppress(OSError):
                old.rename(target)
            raise
        finally:
            shutil.rmtree(old, ignore_errors=True)
    else:
        run_record(target).unlink(missing_ok=True)
        for path in sorted(draft.iterdir(), key=lambda p: p.name == RUN):
            path.replace(target / path.name)


def _replaceable(target: Path, draft: Path) -> bool:
    """Whether a folder holds nothing, or nothing but an earlier product of the same parcel."""
    names = {p.name for p in target.iterdir()}
    if not names:
        return True
    try:
        old, new = (json.loads(run_record(folder).read_text(encoding="utf-8")) for folder in (target, draft))
        return bool(old["parcel"] == new["parcel"] and names <= {*old["files"], RUN})
    except (OSError, ValueError, KeyError, TypeError):
        return False
