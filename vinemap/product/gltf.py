"""Canopies as binary glTF: written, and read back."""

from __future__ import annotations

import json
import math
import struct
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import vinemap
from vinemap.canopy.mesh import Mesh
from vinemap.errors import InputError
from vinemap.geo.crs import parse_crs
from vinemap.product.json_values import jsonable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray
    from pyproj import CRS

    from vinemap.compute.arrays import Floats, Ints

TRIANGLES, STRIP = 4, 5
"""glTF's modes of triangles one by one, and of a strip of them."""
Z_UP_TO_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Quaternion (x, y, z, w) that takes x east, y north, z up to glTF's x east, y up, z south."""
GREEN = [0.13, 0.33, 0.07, 1.0]
"""Linear RGBA of foliage."""


class Canopies(NamedTuple):
    """The rows of a product's glTF."""

    meshes: list[Mesh]
    """Vertices in the CRS; rows without canopy have none."""
    crs: CRS
    vertical: str | None
    """Name of the vertical datum."""
    origin: Floats
    """(3,) the file's own origin in the CRS, m."""


def read_glb(path: Path) -> Canopies:
    """Read what :func:`vinemap.product.gltf.write_glb` wrote, quantised and in strips or plain.

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
        raise InputError(f"{path}: can't be read ({error.strerror or error}): map the parcel again") from error
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, struct.error) as error:
        raise InputError(f"{path}: isn't a mesh of vinemap's: give the .glb of a product") from error
    return Canopies(meshes, crs, vertical, origin)


def _read_row(document: Any, node: Any, origin: Floats) -> Mesh:
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


def _triangles(strip: Ints) -> Ints:
    """Triangles (m, 3) of a strip, all turning as its first one does, without those that repeat a vertex."""
    faces: Ints = np.column_stack([strip[:-2], strip[1:-1], strip[2:]])
    faces[1::2] = faces[1::2, [1, 0, 2]]
    a, b, c = faces.T
    return np.compress((a != b) & (b != c) & (c != a), faces, axis=0)


def write_glb(
    meshes: Sequence[Mesh],
    path: Path,
    *,
    origin: ArrayLike,
    crs: str,
    extras: Mapping[str, Any] | None = None,
    plain: bool = False,
) -> None:
    """Write rows as binary glTF: metres, Y up, one node and one mesh a row.

    The root node turns Z up to Y up and holds ``crs`` and ``origin`` in its extras; each row's node, named by its
    label, is moved to the row's middle. Faces are shaded flat (no normals).

    Positions are 16-bit steps of 1/65534 of the row's longest side, 1.8 mm in 120 m, that the node scales to metres
    (KHR_mesh_quantization). Each lofted piece is a primitive: one triangle strip that closes it, caps included, without
    triangles of repeated vertices. Its quadrilaterals are those of Eq. 22, some split along the other diagonal. Other
    meshes are lists of triangles.

    Parameters
    ----------
    meshes : sequence of Mesh
        Rows; those without faces get a node without a mesh.
    path : Path
        File to write.
    origin : array_like of shape (3,)
        Point of the CRS (x, y, z) that becomes (0, 0, 0), m.
    crs : str
        The horizontal CRS, "EPSG:32632".
    extras : mapping, optional
        More for the root node: vertical datum ("vertical"), parcel, survey.
    plain : bool
        Write float32 positions, to micrometres, and one list of triangles a row, the mesh's own faces, for readers
        that know no extensions: a file twice as large.

    References
    ----------
    https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_mesh_quantization
    """
    import pygltflib as gltf  # 100 ms, for one function

    zero = np.asarray(origin, dtype=np.float64)
    placed = {"crs": crs, **(extras or {}), "origin": zero}
    root = gltf.Node(name="canopy", rotation=Z_UP_TO_Y_UP, extras=_known(jsonable(placed)))
    out = gltf.GLTF2(
        asset=gltf.Asset(version="2.0", generator=f"vinemap {vinemap.__version__}"),
        scene=0,
        scenes=[gltf.Scene(nodes=[0])],
        nodes=[root],
    )
    packed = _Packed()
    for mesh in meshes:
        node = gltf.Node(name=mesh.label, extras=_known(jsonable({"row_id": mesh.row_id, **mesh.extras})))
        out.nodes.append(node)
        if len(mesh.faces) == 0:
            continue
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        node.translation = (middle - zero).tolist()
        node.mesh = len(out.meshes)
        if plain:
            local = (mesh.vertices - middle).astype("<f4")
        else:
            local, step = _quantise(mesh.vertices - middle)
            node.scale = [step] * 3
        primitives = [packed.primitive(*drawn) for drawn in _drawn(mesh, local, plain=plain)]
        out.meshes.append(gltf.Mesh(name=mesh.label, primitives=primitives))
    root.children = list(range(1, len(out.nodes)))
    out.accessors = packed.accessors
    if out.meshes:
        if not plain:
            out.extensionsUsed = out.extensionsRequired = ["KHR_mesh_quantization"]
        foliage = gltf.PbrMetallicRoughness(baseColorFactor=GREEN, metallicFactor=0.0, roughnessFactor=0.9)
        out.materials = [gltf.Material(name="foliage", pbrMetallicRoughness=foliage)]
        first, second = len(packed.positions), len(packed.indices)
        stride = 12 if plain else 8
        out.bufferViews = [
            gltf.BufferView(buffer=0, byteOffset=0, byteLength=first, byteStride=stride, target=gltf.ARRAY_BUFFER),
            gltf.BufferView(buffer=0, byteOffset=first, byteLength=second, target=gltf.ELEMENT_ARRAY_BUFFER),
        ]
        out.buffers = [gltf.Buffer(byteLength=first + second)]
    # pygltflib's own save_binary writes an empty, thus invalid, buffer where there are no rows.
    document = json.dumps(out, default=_properties, separators=(",", ":")).encode()
    binary = _chunk(b"BIN\0", bytes(packed.positions + packed.indices), b"\0") if out.meshes else b""
    chunks = _chunk(b"JSON", document, b" ") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _drawn(
    mesh: Mesh, local: NDArray[np.float32 | np.int16], *, plain: bool
) -> Iterator[tuple[NDArray[np.float32 | np.int16], Ints, int]]:
    """Vertices of each primitive of a mesh, in what order they are drawn, and glTF's mode of that."""
    if plain or not mesh.pieces:
        yield local, mesh.faces.ravel(), TRIANGLES
        return
    ends = np.cumsum([piece.sections * piece.corners for piece in mesh.pieces])
    for piece, points in zip(mesh.pieces, np.split(local, ends[:-1]), strict=True):
        yield points, _strip(*piece), STRIP


class _Packed:
    """Bytes of positions and of indices, and the accessors that find in them those of each primitive."""

    def __init__(self) -> None:
        self.positions, self.indices = bytearray(), bytearray()
        self.accessors: list[Any] = []
        self._orders: dict[bytes, int] = {}

    def primitive(self, points: NDArray[np.float32 | np.int16], order: Ints, mode: int) -> Any:
        """Take a primitive's vertices (n, ≥3), and the order in which they are drawn, which may be another's, too."""
        import pygltflib as gltf

        # 65535 is the primitive restart value.
        kind, code = ("<u2", gltf.UNSIGNED_SHORT) if len(points) <= 65535 else ("<u4", gltf.UNSIGNED_INT)
        drawn = order.astype(kind).tobytes()
        if drawn not in self._orders:
            self._orders[drawn] = len(self.accessors)
            self.indices += b"\0" * (-len(self.indices) % 4)
            at = {"bufferView": 1, "byteOffset": len(self.indices)}
            self.accessors.append(gltf.Accessor(**at, componentType=code, count=len(order), type=gltf.SCALAR))
            self.indices += drawn
        self.accessors.append(
            gltf.Accessor(
                bufferView=0,
                byteOffset=len(self.positions),
                componentType=gltf.FLOAT if points.dtype == np.float32 else gltf.SHORT,
                count=len(points),
                type=gltf.VEC3,
                min=points[:, :3].min(axis=0).tolist(),
                max=points[:, :3].max(axis=0).tolist(),
            )
        )
        self.positions += points.tobytes()
        attributes = gltf.Attributes(POSITION=len(self.accessors) - 1)
        return gltf.Primitive(attributes=attributes, indices=self._orders[drawn], material=0, mode=mode)


def _properties(part: Any) -> dict[str, Any]:
    """Properties of a part of a glTF document, but for what is empty."""
    return {name: value for name, value in _known(vars(part)).items() if value not in ({}, [])}


def _known(properties: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in properties.items() if value is not None}


def _quantise(centred: Floats) -> tuple[NDArray[np.int16], float]:
    """Vertices (n, 3) about 0 as numbers of steps (n, 4), the last 0 to fill 8 bytes, and the step's length, m."""
    step = float(np.abs(centred).max()) / 32767 or 1.0
    return np.pad(np.rint(centred / step), [(0, 0), (0, 1)]).astype("<i2"), step


def _strip(sections: int, corners: int, turned: bool) -> Ints:
    """One triangle strip (2 * k * c - 2,) that closes a piece of k sections of c corners, outward.

    Numbered ring by ring, it goes from vertex n to n + c, n + 1 and on up the sides as a helix; below the first vertex
    and above the last it folds back, and zigzags across the cap. Rings are numbered so that it faces outward, and that
    the caps' triangles have no tip at corner 0, which may lie on its neighbours' line (unless c < 5).
    """
    last, over, odd = sections * corners - 1, corners // 2, corners % 2 == 1
    n = np.arange(-over, last - corners + over + 1)
    strip = np.column_stack([abs(n), last - abs(last - corners - n)]).ravel()
    strip = strip if odd else strip[1:-1]  # where it folds, an even ring has one vertex, not two
    return strip - strip % corners + (strip - 1 if turned == odd else 1 - strip) % corners


def _chunk(kind: bytes, data: bytes, pad: bytes) -> bytes:
    data += pad * (-len(data) % 4)
    return struct.pack("<I4s", len(data), kind) + data
