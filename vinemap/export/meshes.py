"""Canopies for CloudCompare, MeshLab, Blender and others, as PLY and OBJ."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap import paths
from vinemap.geo.crs import is_local
from vinemap.geo.main import to_main
from vinemap.product.gltf import read_glb

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

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
        frame = "{Main}, local" if is_local(found.crs) else "{Main}, topocentric at the origin (WGS84)"
        about |= {"frame": frame, "origin": field.origin._asdict()}

    def place(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        return vertices - found.origin if grid else to_main(vertices, found.crs, field.origin)

    return Placed([replace(mesh, vertices=place(mesh.vertices)) for mesh in found.meshes], about)


def write_ply(meshes: Sequence[Mesh], path: Path, *, comments: Sequence[str]) -> None:
    """Write meshes as one binary PLY, little-endian: float32 positions and the ``row_id`` of every vertex.

    Parameters
    ----------
    meshes : sequence of Mesh
        In a frame whose origin is near: float32 has steps of 0.06 mm at 1 km.
    path : Path
        File to write.
    comments : sequence of str
        Lines for its header.
    """
    vertices = np.empty(sum(len(mesh.vertices) for mesh in meshes), [("xyz", "<f4", 3), ("row_id", "<i4")])
    faces = np.empty(sum(len(mesh.faces) for mesh in meshes), [("n", "u1"), ("corners", "<i4", 3)])
    faces["n"], first, n = 3, 0, 0
    for mesh in meshes:
        vertices["xyz"][first : first + len(mesh.vertices)] = mesh.vertices
        vertices["row_id"][first : first + len(mesh.vertices)] = mesh.row_id
        faces["corners"][n : n + len(mesh.faces)] = mesh.faces + first
        first, n = first + len(mesh.vertices), n + len(mesh.faces)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        "property int row_id",
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    path.write_bytes("\n".join(header).encode("ascii", "replace") + vertices.tobytes() + faces.tobytes())


def write_obj(
    meshes: Sequence[Mesh], path: Path, *, comments: Sequence[str], material: tuple[str, str] | None = None
) -> None:
    """Write meshes as Wavefront OBJ, one object a row, named by its label; coordinates in tenths of a millimetre.

    Parameters
    ----------
    meshes : sequence of Mesh
        Rows; those without faces are left out.
    path : Path
        File to write.
    comments : sequence of str
        Lines for its beginning.
    material : (str, str), optional
        Name of a file of materials beside it, and of the material in it.
    """
    lines = [f"# {line}" for line in comments]
    if material:
        lines.append(f"mtllib {material[0]}")
    first = 1
    for mesh in meshes:
        if len(mesh.faces) == 0:
            continue
        lines.append(f"o {mesh.label}")
        lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices.tolist()]
        if material:
            lines.append(f"usemtl {material[1]}")
        lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + first).tolist()]
        first += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
