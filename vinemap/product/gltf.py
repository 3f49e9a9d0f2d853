"""Canopies read back from glTF, and written as PLY and OBJ."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap.canopy.mesh import Mesh
from vinemap.errors import InputError
from vinemap.geo.crs import parse_crs

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from pyproj import CRS

STRIP = 5
"""glTF's mode of triangle strips."""


class Canopies(NamedTuple):
    """The rows of a product's glTF."""

    meshes: list[Mesh]
    """Vertices in the CRS; rows without canopy have none."""
    crs: CRS
    vertical: str | None
    """Name of the vertical datum."""
    origin: NDArray[np.float64]
    """(3,) the file's own origin in the CRS, m."""


def read_glb(path: Path) -> Canopies:
    """Read what :func:`vinemap.canopy.mesh.write_glb` wrote, quantised and in strips or plain.

    Raises
    ------
    InputError
        If the file can't be read, or is none of these.
    """
    import pygltflib as gltf  # 100 ms, for one function

    try:
        document = gltf.GLTF2().load_binary(str(path))
        root, *nodes = document.nodes
        origin = np.array(root.extras["origin"], dtype=float).reshape(3)
        crs, vertical = parse_crs(root.extras["crs"]), root.extras.get("vertical")
        meshes = [_read_row(document, node, origin) for node in nodes]
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror or error})") from error
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, struct.error) as error:
        raise InputError(f"{path}: isn't a mesh of vinemap's: give the .glb of a product") from error
    return Canopies(meshes, crs, vertical, origin)


def _read_row(document: Any, node: Any, origin: NDArray[np.float64]) -> Mesh:
    about = {"row_id": node.extras["row_id"], "label": node.name, "extras": node.extras}
    if node.mesh is None:
        return Mesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64), **about)
    points, faces, total = [], [], 0
    for primitive in document.meshes[node.mesh].primitives:
        positions = _array(document, primitive.attributes.POSITION, 3)
        order = _array(document, primitive.indices, 1)[:, 0].astype(np.int64)
        faces.append(total + (_triangles(order) if primitive.mode == STRIP else order.reshape(-1, 3)))
        points.append(positions.astype(float))
        total += len(positions)
    scale = np.array(node.scale or [1.0, 1.0, 1.0])
    vertices = np.concatenate(points) * scale + np.array(node.translation) + origin
    return Mesh(vertices, np.concatenate(faces), **about)


def _array(document: Any, index: int, width: int) -> NDArray[Any]:
    """Values (n, width) of an accessor."""
    accessor = document.accessors[index]
    view = document.bufferViews[accessor.bufferView]
    kind = np.dtype({5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor.componentType])
    strides = (view.byteStride or kind.itemsize * width, kind.itemsize)
    start = view.byteOffset + accessor.byteOffset
    return np.ndarray((accessor.count, width), kind, document.binary_blob(), start, strides)


def _triangles(strip: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (m, 3) of a strip, all turning as its first one does, without those that repeat a vertex."""
    faces: NDArray[np.int64] = np.column_stack([strip[:-2], strip[1:-1], strip[2:]])
    faces[1::2] = faces[1::2, [1, 0, 2]]
    a, b, c = faces.T
    return np.compress((a != b) & (b != c) & (c != a), faces, axis=0)


def write_ply(meshes: Sequence[Mesh], path: Path, *, comments: Sequence[str] = ()) -> None:
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
    meshes: Sequence[Mesh], path: Path, *, comments: Sequence[str] = (), material: tuple[str, str] | None = None
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
