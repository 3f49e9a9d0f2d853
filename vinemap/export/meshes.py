"""Canopies for CloudCompare, MeshLab, Blender and others, as PLY and OBJ."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from vinemap import paths
from vinemap.geo.crs import to_main
from vinemap.product.gltf import read_glb, write_obj, write_ply

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from vinemap.canopy.mesh import Mesh
    from vinemap.export.field import Field


class Placed(NamedTuple):
    """A product's canopies in a frame of their own."""

    meshes: list[Mesh]
    """Vertices about the frame's origin, m."""
    about: dict[str, Any]
    """The frame, in words and numbers."""

    def comments(self) -> list[str]:
        """What is said of the frame in the head of a file."""
        return [f"{key}: {value if isinstance(value, str) else json.dumps(value)}" for key, value in self.about.items()]


def write_canopy(field: Field, folder: Path, *, kind: str, grid: bool) -> None:
    """Write the canopies as one file, and what its frame is as JSON.

    Parameters
    ----------
    field : Field
        The parcel.
    folder : Path
        Where the files go.
    kind : {"ply", "obj"}
        The format; a PLY's vertices have their ``row_id``, an OBJ has an object a row, named by its label.
    grid : bool
        Metres of the product's CRS about an offset that header and JSON state, CloudCompare's *global shift* with its
        sign turned; otherwise {Main}, metres east, north and up about the origin that ``run.json`` states.

    Raises
    ------
    InputError
        If the product's meshes can't be read.
    OSError
        If nothing can be written.
    """
    canopy = place_canopies(field, grid=grid)
    write = {"ply": write_ply, "obj": write_obj}[kind]
    write(canopy.meshes, paths.exported_mesh(folder, field.parcel, kind), comments=canopy.comments())
    text = json.dumps(canopy.about, indent=2, ensure_ascii=False)
    paths.exported_frame(folder, field.parcel).write_text(text + "\n", encoding="utf-8")


def place_canopies(field: Field, *, grid: bool = False) -> Placed:
    """Read the canopies of a product, as :func:`write_canopy` places them.

    Raises
    ------
    InputError
        If they can't be read.
    """
    found = read_glb(paths.canopy_mesh(field.folder, field.parcel))
    about: dict[str, Any] = {
        "parcel": field.parcel,
        "axes": "x east, y north, z up, metres",
        "vertical": found.vertical,
    }
    if grid:
        about |= {"frame": f"{found.crs.to_string()} less the offset", "offset": found.origin.tolist()}
    else:
        about |= {"frame": "{Main}, topocentric at the origin (WGS84)", "origin": field.origin._asdict()}

    def place(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        return vertices - found.origin if grid else to_main(vertices, found.crs, field.origin)

    return Placed([replace(mesh, vertices=place(mesh.vertices)) for mesh in found.meshes], about)
