"""Canopy meshes: sections joined to closed pieces (Eq. 22), their volume, and Open3D's opinion of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap.compute.extras import load

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import geopandas as gpd
    from numpy.typing import ArrayLike

    from vinemap.canopy.points import Sections
    from vinemap.compute.arrays import Complex, Flags, Floats, Ints, Values

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


def loft(polygons: ArrayLike, caps: Sequence[Ints] | None = None) -> Lofted:
    """Join consecutive sections' polygons to a closed piece.

    Parameters
    ----------
    polygons : array_like of shape (k, c, 3)
        Corresponding vertices of k sections, k >= 2, all turning the same way.
    caps : sequence of two arrays of shape (c - 2, 3), optional
        Triangles of the first polygon and of the last, where they are known.

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
    first, last = _caps(sections[[0, -1]]) if caps is None else caps
    faces = np.concatenate([sides, first[:, ::-1], last + c * (k - 1)])
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


def _caps(polygons: Floats) -> Ints:
    """Triangles (m, c - 2, 3) of polygons (m, c, 3), convex or not, turning as they do (ear clipping)."""
    spread = polygons - polygons.mean(axis=1, keepdims=True)
    normal = np.cross(spread, np.roll(spread, -1, axis=1)).sum(axis=1)
    axis, each = np.abs(normal).argmax(axis=1), np.arange(len(polygons))
    turn = np.where(normal[each, axis] >= 0, 1, 2)
    u, v = (spread[each, :, (axis + way) % 3] for way in (turn, -turn))
    flat, left = u + 1j * v, np.tile(np.arange(polygons.shape[1]), (len(polygons), 1))
    triangles = []
    while left.shape[1] > 3:
        corners = np.stack([np.roll(left, 1, axis=1), left, np.roll(left, -1, axis=1)], axis=2)
        # Of the ears the fattest; where a crossing or rounding leaves none, the corner nearest to being one.
        a, b, c = np.moveaxis(flat[each[:, None, None], corners], 2, 0)
        best = (2 * _ears(a, b, c) + _fatness(a, b, c)).argmax(axis=1)
        triangles.append(corners[each, best])
        left = left[np.arange(left.shape[1]) != best[:, None]].reshape(len(left), left.shape[1] - 1)
    return np.stack([*triangles, left], axis=1)


def _cross(a: Complex, b: Complex, p: Complex) -> Floats:
    out: Floats = ((b - a).conj() * (p - a)).imag
    return out


def _fatness(a: Complex, b: Complex, c: Complex) -> Floats:
    """Twice the area over the longest side squared, below 1: negative for a reflex corner."""
    longest = np.maximum(np.maximum(abs(a - b), abs(b - c)), abs(c - a))
    out: Floats = np.divide(_cross(a, b, c), longest**2, out=np.zeros_like(longest), where=longest > 0)
    return out


def _ears(a: Complex, b: Complex, c: Complex) -> Flags:
    """Whether corners (m, n) of polygons with vertices ``b`` are convex, and their triangles hold no other vertex."""
    p, others = b[:, None], (a[..., None], b[..., None], c[..., None])
    inside = np.minimum.reduce([_cross(q, r, p) for q, r in pairwise([*others, others[0]])]) >= 0
    inside &= np.logical_and.reduce([p != corner for corner in others])
    out: Flags = (_cross(a, b, c) > 0) & ~inside.any(axis=2)
    return out


def audit(mesh: Mesh) -> Audit:
    """Check a mesh with Open3D.

    Raises
    ------
    DependencyError
        If Open3D can't be loaded.
    """
    open3d = load("open3d")  # 1 s, 400 MB, and needs system libraries
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


def breaks(row_id: Ints, position: Values, step: float) -> Flags:
    """Whether the canopy ends (m - 1,) between consecutive sections (m,): another row, or more than one lacks."""
    out: Flags = (np.diff(row_id) != 0) | (np.diff(position) > 2.5 * step)
    return out


def corners_of(canopy: Sections, polygons: Values) -> Floats:
    """Vertices (m, c, 3) of the sections' polygons (m, c, 2), in the CRS."""
    normal = np.column_stack([-canopy.tangent[:, 1], canopy.tangent[:, 0], np.zeros(len(canopy.row_id))])
    up = np.array([0.0, 0.0, 1.0])
    out: Floats = canopy.origin[:, None] + polygons[:, :, :1] * normal[:, None] + polygons[:, :, 1:] * up
    return out


def section_meshes(canopy: Sections, polygons: Values, rows: gpd.GeoDataFrame, *, step: float) -> list[Mesh]:
    """Closed meshes of the rows' canopies: polygons of consecutive sections, joined (Eq. 20–22).

    A mesh closes and starts anew where more than one section lacks, half a step into what lies between: a section
    stands for as much on either side, in volumes too.

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
    corners, half = corners_of(canopy, polygons), _ahead(canopy)[:, None] * step / 2
    parted = breaks(canopy.row_id, canopy.position, step)
    gap = np.concatenate([[False], parted & (np.diff(canopy.row_id) == 0), [False]])
    runs = []
    for run in np.split(np.arange(len(corners)), np.flatnonzero(parted) + 1):
        first, last = run[:1], run[-1:]
        parts = [corners[run]]
        if gap[first].any():
            parts.insert(0, corners[first] - half[first])
        if gap[last + 1].any():
            parts.append(corners[last] + half[last])
        if len(piece := np.concatenate(parts)) > 1:
            runs.append((int(canopy.row_id[run[0]]), piece))
    caps = _caps(np.array([piece[k] for _, piece in runs for k in (0, -1)]).reshape(-1, *corners.shape[1:]))
    pieces: dict[int, list[Any]] = {}
    for (row_id, piece), first, last in zip(runs, caps[::2], caps[1::2], strict=True):
        pieces.setdefault(row_id, []).append(loft(piece, (first, last)))
    numbers = rows.drop(columns="geometry").to_dict("records")
    return [
        Mesh(*merge(pieces[row["row_id"]]), row_id=int(row["row_id"]), label=str(row["label"]), extras=row)
        for row in numbers
        if row["row_id"] in pieces
    ]


def _ahead(canopy: Sections) -> Floats:
    """Where a metre along the row leads to from each section (m, 3), up or down the slope beside it."""
    same, away = np.diff(canopy.row_id) == 0, np.diff(canopy.position)
    slopes = (np.diff(canopy.origin[:, 2]) / np.where(away > 0, away, np.inf))[same]
    slope = np.zeros(len(canopy.row_id))
    slope[1:][same] = slopes
    slope[:-1][same] = slopes  # but for the last one of a row
    return np.column_stack([canopy.tangent, slope])
