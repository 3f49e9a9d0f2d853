"""A product's canopies for CloudCompare, MeshLab and others, as PLY and OBJ."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from vinemap import paths
from vinemap.crs import Origin, to_main
from vinemap.errors import InputError
from vinemap.mesh_files import read_glb, write_obj, write_ply
from vinemap.store import unwritable

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from vinemap.mesh import Mesh

    Frame = Literal["main", "crs"]


class Placed(NamedTuple):
    """A product's canopies in a frame of their own."""

    parcel: str
    meshes: list[Mesh]
    about: dict[str, Any]
    """The frame, in words and numbers."""


def export_ply(product: Path, folder: Path, *, frame: Frame = "main") -> list[Path]:
    """Write the canopies of a product as one PLY, and what its frame is as JSON.

    Parameters
    ----------
    product : Path
        Folder of the product.
    folder : Path
        Where the files go.
    frame : {"main", "crs"}
        {Main}, metres east, north and up about the origin that ``run.json`` states; or metres of the product's CRS
        about an offset that header and JSON state, CloudCompare's *global shift* with its sign turned.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        If there is no product.
    OutputError
        If nothing can be written.
    """
    canopy = place_canopies(product, frame)

    def write(draft: Path) -> None:
        write_ply(canopy.meshes, paths.exported_mesh(draft, canopy.parcel, "ply"), comments=comments(canopy))
        _write_frame(canopy, draft)

    return write_files(folder, write)


def export_obj(product: Path, folder: Path, *, frame: Frame = "main") -> list[Path]:
    """Write the canopies of a product as OBJ, one object a row, and its frame as JSON; as :func:`export_ply`."""
    canopy = place_canopies(product, frame)

    def write(draft: Path) -> None:
        write_obj(canopy.meshes, paths.exported_mesh(draft, canopy.parcel, "obj"), comments=comments(canopy))
        _write_frame(canopy, draft)

    return write_files(folder, write)


def place_canopies(product: Path, frame: Frame = "main") -> Placed:
    """Read the canopies of a product, their vertices about the origin of a frame, m.

    Raises
    ------
    InputError
        If there is no product in the folder, or it can't be read.
    """
    try:
        record = json.loads(paths.run_record(product).read_text(encoding="utf-8"))
        parcel, main = record["parcel"], Origin(**record["origin"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{product}: holds no product of vinemap's: give the folder that has its run.json") from error
    found = read_glb(paths.canopy_mesh(product, parcel))
    about: dict[str, Any] = {"axes": "x east, y north, z up, metres", "vertical": found.vertical}
    if frame == "main":
        about |= {"frame": "{Main}, topocentric at the origin (WGS84)", "origin": main._asdict()}
    else:
        about |= {"frame": f"{found.crs.to_string()} less the offset", "offset": found.origin.tolist()}

    def place(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        return to_main(vertices, found.crs, main) if frame == "main" else vertices - found.origin

    return Placed(parcel, [replace(mesh, vertices=place(mesh.vertices)) for mesh in found.meshes], about)


def _write_frame(canopy: Placed, folder: Path) -> None:
    text = json.dumps({"parcel": canopy.parcel, **canopy.about}, indent=2, ensure_ascii=False)
    paths.exported_frame(folder, canopy.parcel).write_text(text, encoding="utf-8")


def comments(canopy: Placed) -> list[str]:
    """What is said of the frame in the head of a file."""
    about = [f"{key}: {value if isinstance(value, str) else json.dumps(value)}" for key, value in canopy.about.items()]
    return [f"vinemap, canopies of parcel {canopy.parcel}", *about]


def write_files(folder: Path, write: Callable[[Path], None]) -> list[Path]:
    """Have files written into a draft of a folder, and then put into it; gives where they are.

    Raises
    ------
    OutputError
        If they can't be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".", suffix=".part", dir=folder) as inner:
            draft = Path(inner)
            write(draft)
            files = [path for path in sorted(draft.rglob("*")) if path.is_file()]
            for path in files:
                target = folder / path.relative_to(draft)
                target.parent.mkdir(parents=True, exist_ok=True)
                path.replace(target)
            return [folder / path.relative_to(draft) for path in files]
    except OSError as error:
        raise unwritable(folder, error) from error
