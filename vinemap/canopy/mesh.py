"""Canopy meshes: sections joined to closed pieces (Eq. 22), their volume, and Open3D's opinion of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap.errors import DependencyError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import geopandas as gpd
    from numpy.typing import ArrayLike

    from vinemap.canopy.points import Sections
    from vinemap.compute.arrays import Flags, Floats, Ints, Values

    Lofted = tuple[Floats, Ints, tuple["Piece", ...]]


class Piece(NamedTuple):
    """How a closed piece's vertices lie: section after section, corner after corner."""

    sections: int
    corners: int
    turned: bool
    """Whether the polygons turn so that Eq. 22's triangles had to be reversed to face outward."""


@dataclass(frozen=True)
class Mesh:
    """The canopy of one row: closed pieces, triangles counter-clockwise seen from outside."""

    vertices: Floats
    """(n, 3) x east, y north, z up, m, in the parcel's metric CRS."""
    faces: Ints
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


def _volume(vertices: Floats, faces: Ints) -> float:
    if len(faces) == 0:
        return 0.0
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _cap(polygon: Floats) -> Ints:
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


def _breaks(row_id: Ints, position: Values, step: float) -> Flags:
    """Whether the canopy ends (m - 1,) between consecutive sections (m,): another row, or more than one lacks."""
    out: Flags = (np.diff(row_id) != 0) | (np.diff(position) > 2.5 * step)
    return out


def section_meshes(canopy: Sections, polygons: Values, rows: gpd.GeoDataFrame, *, step: float) -> list[Mesh]:
    """Closed meshes of the rows' canopies: polygons of consecutive sections, joined (Eq. 20–22).

    A mesh closes and starts anew where more than one section lacks.

    Parameters
    ----------
    canopy : Sections
        m sections in order of row and position.
    polygons : (m, c, 2) array
        Their c-gons.
    rows : GeoDataFrame
        Rows with ``row_id`` and ``label``; their numbers go with the meshes.
    step : float
        Metres between sections.
    """
    normal = np.column_stack([-canopy.tangent[:, 1], canopy.tangent[:, 0], np.zeros(len(canopy.row_id))])
    corners = canopy.origin[:, None] + polygons[:, :, :1] * normal[:, None] + polygons[:, :, 1:] * np.array([0, 0, 1.0])
    breaks = _breaks(canopy.row_id, canopy.position, step)
    pieces: dict[int, list[Any]] = {}
    for run in np.split(np.arange(len(corners)), np.flatnonzero(breaks) + 1):
        if len(run) > 1:
            pieces.setdefault(int(canopy.row_id[run[0]]), []).append(loft(corners[run]))
    numbers = rows.drop(columns="geometry").to_dict("records")
    return [
        Mesh(*merge(pieces[row["row_id"]]), row_id=int(row["row_id"]), label=str(row["label"]), extras=row)
        for row in numbers
        if row["row_id"] in pieces
    ]
