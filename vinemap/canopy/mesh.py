"""Canopy meshes: sections joined to closed pieces (Eq. 22), their volume, glTF, and Open3D's opinion of them."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import vinemap
from vinemap.errors import DependencyError
from vinemap.product.json_values import jsonable

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

    Vertices = NDArray[np.float64]
    Faces = NDArray[np.int64]
    Lofted = tuple[Vertices, Faces, tuple["Piece", ...]]

Z_UP_TO_Y_UP = [-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
"""Quaternion (x, y, z, w) that takes x east, y north, z up to glTF's x east, y up, z south."""
GREEN = [0.13, 0.33, 0.07, 1.0]
"""Linear RGBA of foliage."""


class Piece(NamedTuple):
    """How a closed piece's vertices lie: section after section, corner after corner."""

    sections: int
    corners: int
    turned: bool
    """Whether the polygons turn so that Eq. 22's triangles had to be reversed to face outward."""


@dataclass(frozen=True)
class Mesh:
    """The canopy of one row: closed pieces, triangles counter-clockwise seen from outside."""

    vertices: Vertices
    """(n, 3) x east, y north, z up, m, in the parcel's metric CRS."""
    faces: Faces
    """(m, 3) indices of vertices."""
    pieces: tuple[Piece, ...] = ()
    """The lofted pieces that vertices and faces consist of, in their order; none for other meshes."""
    row_id: int = 0
    label: str = ""
    """Name of the row, "1 F"."""
    extras: Mapping[str, Any] = field(default_factory=dict)
    """The row's numbers, for the glTF node."""


class Audit(NamedTuple):
    """What Open3D says of a mesh."""

    watertight: bool
    edge_manifold: bool
    self_intersecting: bool
    volume: float
    """m³; NaN where not watertight."""


def loft(polygons: ArrayLike) -> Lofted:
    """Join consecutive sections' polygons to a closed piece.

    Parameters
    ----------
    polygons : array_like of shape (k, c, 3)
        Corresponding vertices of k sections, k >= 2, all turning the same way.

    Returns
    -------
    vertices : ndarray of shape (k * c, 3)
        The polygons' own.
    faces : ndarray of shape (2 * c * k - 4, 3)
        Eq. 22 with the index wrapped, section after section, then the caps; outward, whichever way the polygons turn.
    pieces : tuple of Piece
        The one.

    Raises
    ------
    ValueError
        For fewer than 2 sections or 3 vertices.
    """
    sections = np.asarray(polygons, dtype=np.float64)
    if sections.ndim != 3 or sections.shape[0] < 2 or sections.shape[1] < 3 or sections.shape[2] != 3:
        raise ValueError(f"polygons have shape {sections.shape}: give (k, c, 3) with k >= 2 and c >= 3")
    k, c = sections.shape[:2]
    i = np.arange(c)
    j = (i + 1) % c
    ring = np.concatenate([np.column_stack([i, j, i + c]), np.column_stack([j, j + c, i + c])])
    sides = (ring + c * np.arange(k - 1)[:, None, None]).reshape(-1, 3)
    faces = np.concatenate([sides, _cap(sections[0])[:, ::-1], _cap(sections[-1]) + c * (k - 1)])
    vertices = sections.reshape(-1, 3)
    turned = _volume(vertices, faces) < 0
    return vertices, faces[:, ::-1] if turned else faces, (Piece(k, c, turned),)


def merge(parts: Iterable[Lofted]) -> Lofted:
    """The pieces of a row (it breaks at gaps) as one list of vertices (n, 3), one of faces (m, 3) and one of pieces."""
    vertices, faces, pieces, total = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)], list[Piece](), 0
    for points, triangles, shapes in parts:
        vertices.append(points)
        faces.append(triangles + total)
        pieces += shapes
        total += len(points)
    return np.concatenate(vertices), np.concatenate(faces), tuple(pieces)


def volume(mesh: Mesh) -> float:
    """Volume of a closed mesh, m³ (divergence theorem)."""
    return _volume(mesh.vertices, mesh.faces)


def _volume(vertices: Vertices, faces: Faces) -> float:
    if len(faces) == 0:
        return 0.0
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _cap(polygon: Vertices) -> Faces:
    """Triangles (c - 2, 3) of a polygon (c, 3), convex or not, turning as it does (ear clipping)."""
    spread = polygon - polygon.mean(axis=0)
    normal = np.cross(spread, np.roll(spread, -1, axis=0)).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    u, v = ((axis + 1) % 3, (axis + 2) % 3) if normal[axis] >= 0 else ((axis + 2) % 3, (axis + 1) % 3)
    flat = [complex(*point) for point in spread[:, [u, v]]]
    left = list(range(len(flat)))
    triangles = []
    while len(left) > 3:
        corners = [(left[i - 1], left[i], left[(i + 1) % len(left)]) for i in range(len(left))]
        # Of the ears the fattest; where a crossing or rounding leaves none, the corner nearest to being one.
        ear = max(corners, key=lambda t: (_is_ear(flat, t, left), _fatness(*(flat[i] for i in t))))
        triangles.append(ear)
        left.remove(ear[1])
    return np.array([*triangles, left], dtype=np.int64)


def _cross(a: complex, b: complex, p: complex) -> float:
    return ((b - a).conjugate() * (p - a)).imag


def _fatness(a: complex, b: complex, c: complex) -> float:
    """Twice the area over the longest side squared: negative for a reflex corner."""
    longest = max(abs(a - b), abs(b - c), abs(c - a))
    return _cross(a, b, c) / longest**2 if longest > 0 else 0.0


def _is_ear(flat: Sequence[complex], corner: tuple[int, int, int], others: Sequence[int]) -> bool:
    """Whether a corner is convex, and its triangle holds no other vertex."""
    a, b, c = (flat[i] for i in corner)
    if _cross(a, b, c) <= 0:
        return False
    rest = {flat[i] for i in others} - {a, b, c}
    return not any(min(_cross(a, b, p), _cross(b, c, p), _cross(c, a, p)) >= 0 for p in rest)


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
    root = gltf.Node(name="canopy", rotation=Z_UP_TO_Y_UP, extras=jsonable(placed))
    out = gltf.GLTF2(
        asset=gltf.Asset(version="2.0", generator=f"vinemap {vinemap.__version__}"),
        scene=0,
        scenes=[gltf.Scene(nodes=[0])],
        nodes=[root],
    )
    positions, indices = bytearray(), bytearray()
    stored: dict[bytes, int] = {}
    for mesh in meshes:
        node = gltf.Node(name=mesh.label, extras=jsonable({"row_id": mesh.row_id, **mesh.extras}))
        out.nodes.append(node)
        if len(mesh.faces) == 0:
            continue
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        node.translation = (middle - zero).tolist()
        node.mesh = len(out.meshes)
        local, pieces = (mesh.vertices - middle).astype("<f4"), () if plain else mesh.pieces
        if not plain:
            local, step = _quantise(mesh.vertices - middle)
            node.scale = [step] * 3
        ends = np.cumsum([piece.sections * piece.corners for piece in pieces])
        orders = [_strip(*piece) for piece in pieces] or [mesh.faces.ravel()]
        mode, primitives = gltf.TRIANGLE_STRIP if pieces else gltf.TRIANGLES, []
        for points, order in zip(np.split(local, ends[:-1]), orders, strict=True):
            # 65535 is the primitive restart value.
            kind, code = ("<u2", gltf.UNSIGNED_SHORT) if len(points) <= 65535 else ("<u4", gltf.UNSIGNED_INT)
            drawn = order.astype(kind).tobytes()
            if drawn not in stored:
                stored[drawn] = len(out.accessors)
                indices += b"\0" * (-len(indices) % 4)
                out.accessors.append(
                    gltf.Accessor(
                        bufferView=1, byteOffset=len(indices), componentType=code, count=len(order), type=gltf.SCALAR
                    )
                )
                indices += drawn
            out.accessors.append(
                gltf.Accessor(
                    bufferView=0,
                    byteOffset=len(positions),
                    componentType=gltf.FLOAT if plain else gltf.SHORT,
                    count=len(points),
                    type=gltf.VEC3,
                    min=points[:, :3].min(axis=0).tolist(),
                    max=points[:, :3].max(axis=0).tolist(),
                )
            )
            positions += points.tobytes()
            attributes = gltf.Attributes(POSITION=len(out.accessors) - 1)
            primitives.append(gltf.Primitive(attributes=attributes, indices=stored[drawn], material=0, mode=mode))
        out.meshes.append(gltf.Mesh(name=mesh.label, primitives=primitives))
    root.children = list(range(1, len(out.nodes)))
    if out.meshes:
        if not plain:
            out.extensionsUsed = out.extensionsRequired = ["KHR_mesh_quantization"]
        out.materials = [
            gltf.Material(
                name="foliage",
                pbrMetallicRoughness=gltf.PbrMetallicRoughness(
                    baseColorFactor=GREEN, metallicFactor=0.0, roughnessFactor=0.9
                ),
            )
        ]
        out.bufferViews = [
            gltf.BufferView(
                buffer=0,
                byteOffset=0,
                byteLength=len(positions),
                byteStride=12 if plain else 8,
                target=gltf.ARRAY_BUFFER,
            ),
            gltf.BufferView(
                buffer=0, byteOffset=len(positions), byteLength=len(indices), target=gltf.ELEMENT_ARRAY_BUFFER
            ),
        ]
        out.buffers = [gltf.Buffer(byteLength=len(positions) + len(indices))]
    # pygltflib's own save_binary writes an empty, thus invalid, buffer where there are no rows.
    document = out.gltf_to_json(separators=(",", ":"), indent=None).encode()
    binary = _chunk(b"BIN\0", bytes(positions + indices), b"\0") if positions else b""
    chunks = _chunk(b"JSON", document, b" ") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _quantise(centred: Vertices) -> tuple[NDArray[np.int16], float]:
    """Vertices (n, 3) about 0 as numbers of steps (n, 4), the last 0 to fill 8 bytes, and the step's length, m."""
    step = float(np.abs(centred).max()) / 32767 or 1.0
    return np.pad(np.rint(centred / step), [(0, 0), (0, 1)]).astype("<i2"), step


def _strip(sections: int, corners: int, turned: bool) -> NDArray[np.int64]:
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


def audit(mesh: Mesh) -> Audit:
    """Check a mesh with Open3D.

    Raises
    ------
    DependencyError
        If Open3D can't be loaded.
    """
    try:
        import open3d  # 1 s, 400 MB, and needs system libraries
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"Open3D can't be loaded ({error}): apt-get install libegl1 libgl1 libusb-1.0-0, or pip install open3d-cpu"
        ) from error
    middle = mesh.vertices.mean(axis=0) if len(mesh.vertices) else 0.0
    shape = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices - middle), open3d.utility.Vector3iVector(mesh.faces)
    )
    watertight = bool(shape.is_watertight())
    return Audit(
        watertight,
        bool(shape.is_edge_manifold(allow_boundary_edges=False)),
        bool(shape.is_self_intersecting()),
        volume(mesh) if watertight else math.nan,
    )
