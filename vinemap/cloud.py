"""Point clouds: reading LAS, LAZ and COPC into metres of one projected CRS; sections of a cloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinemap.compiled import compiled, in_threads, stretches
from vinemap.crs import check_horizontal, horizontal, metric_crs, project, transformer, vertical_name, vertical_unit
from vinemap.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import shapely
    from numpy.typing import NDArray
    from pyproj import CRS

    Values = NDArray[np.floating]

CHUNK = 1_000_000
LARGEST_RELIEF = 2_000.0
"""Metres of height in one survey, at the most."""
LARGEST_SPAN = 50_000.0
"""Metres: what is wider isn't one survey but broken coordinates."""

Boundary = tuple["shapely.Geometry", "CRS"]
"""A polygon and its CRS."""


@dataclass(frozen=True)
class PointCloud:
    """Points (n, 3) in metres, x east, y north, z up.

    ``vertical`` names the vertical datum that the file states; heights are never moved to another.
    """

    xyz: NDArray[np.float64]
    crs: CRS
    vertical: str | None = None


class Sections(NamedTuple):
    """Sections S_k of all rows, ordered by row and position, with their points one after the other.

    Points ``start[k]`` to ``start[k + 1]`` are those of section k; a point may be in two sections (a > b).
    """

    row_id: NDArray[np.int64]
    """Row (m,) of each section."""
    position: Values
    """Metres (m,) along γ."""
    origin: Values
    """Points (m, 3) of γ at soil level in the parcel's CRS: the origins of {LOC_k}."""
    tangent: Values
    """Horizontal unit vectors (m, 2) along γ: the x axes of {LOC_k}."""
    spacing: Values
    """Local inter-row spacing δ (m,) in metres."""
    start: NDArray[np.int64]
    """First point (m + 1,) of each section."""
    points: Values
    """Points (n, 2) as y and z of {LOC_k}: metres to the left of γ, metres above its soil."""
    height: Values
    """Height above the terrain model (n,) in metres."""
    member: NDArray[np.int64]
    """Index (n,) of each point in the cloud; it climbs within a section."""

    def subset(self, points: NDArray[np.bool_], sections: NDArray[np.bool_] | None = None) -> Sections:
        """The points (n,) and sections (m,; by default all) that are flagged; no point of another section may be."""
        sections = np.ones(len(self.row_id), dtype=bool) if sections is None else sections
        n = np.zeros(len(sections), dtype=np.int64)
        in_threads(lambda part: _count_flags(*part, points, self.start, n), stretches(len(n)))
        before = np.concatenate([[0], np.cumsum(n)])
        index = np.empty(before[-1], dtype=np.int64)
        in_threads(lambda part: _find_flags(*part, points, self.start, before, index), stretches(len(n)))
        start = np.concatenate([[0], np.cumsum(n[sections])])
        return Sections(
            self.row_id[sections],
            self.position[sections],
            self.origin[sections],
            self.tangent[sections],
            self.spacing[sections],
            start,
            self.points[index],
            self.height[index],
            self.member[index],
        )


@compiled
def _count_flags(
    first: int, last: int, flags: NDArray[np.bool_], start: NDArray[np.int64], n: NDArray[np.int64]
) -> None:
    for k in range(first, last):
        for p in range(start[k], start[k + 1]):
            n[k] += flags[p]


@compiled
def _find_flags(
    first: int,
    last: int,
    flags: NDArray[np.bool_],
    start: NDArray[np.int64],
    before: NDArray[np.int64],
    index: NDArray[np.int64],
) -> None:
    for k in range(first, last):
        at = before[k]
        for p in range(start[k], start[k + 1]):
            if flags[p]:
                index[at] = p
                at += 1


def read_cloud(
    path: Path, *, crs: CRS | None = None, boundary: Boundary | None = None, tick: Callable[[float], None] | None = None
) -> PointCloud:
    """Read a LAS, LAZ or COPC file in chunks into a metric projected CRS, clipped to a polygon.

    Points flagged as withheld and points of ASPRS class 7 or 18 (noise) are left out.

    Parameters
    ----------
    path : Path
        The file.
    crs : CRS, optional
        CRS of the file's coordinates; needed where the file states none, and preferred to what it states.
    boundary : (Geometry, CRS), optional
        Polygon to clip to.
    tick : callable, optional
        Called with the share read so far (0 to 1).

    Raises
    ------
    InputError
        If the file can't be read whole, has no points, no CRS, or coordinates that can't be right.
    """
    import laspy  # 0.4 s of start-up

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with laspy.open(path, laz_backend=_backends(path)) as reader:
            header = reader.header
            source = crs or _stated_crs(header, path)
            _check_header(header, source, path)
            return _read(reader, source, boundary, path, tick)
    except InputError:
        raise
    except Exception as error:  # laspy and lazrs raise many kinds, a Rust panic among them
        reason = str(error).strip().split("\n")[0] or type(error).__name__
        raise InputError(f"{path}: can't be read as LAS or LAZ ({reason}): is it whole?") from error


def write_classified(
    cloud: PointCloud, heights: Values, classes: NDArray[np.uint8], row_id: NDArray[np.uint16], path: Path
) -> None:
    """Write a LAZ file (LAS 1.4) of points with ``Classification``, ``HeightAboveGround`` (m) and ``row_id``.

    Raises
    ------
    OSError
        If it can't be written.
    """
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(cloud.xyz.min(axis=0))
    header.add_crs(cloud.crs)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("HeightAboveGround", "float32", "metres above the terrain model"),
            laspy.ExtraBytesParams("row_id", "uint16", "vine row, 0 for none"),
        ]
    )
    out = laspy.LasData(header)
    out.x, out.y, out.z = cloud.xyz.T
    out.classification = classes
    out["HeightAboveGround"] = heights.astype(np.float32)
    out["row_id"] = row_id
    with path.open("wb") as stream:
        out.write(stream, do_compress=True, laz_backend=laspy.LazBackend.LazrsParallel)


def _backends(path: Path) -> Any:
    import laspy

    return None if path.suffix.lower() == ".las" else [laspy.LazBackend.LazrsParallel, laspy.LazBackend.Lazrs]


def _stated_crs(header: Any, path: Path) -> CRS:
    try:
        stated: CRS | None = header.parse_crs()
    except Exception as error:
        raise InputError(f"{path}: its CRS can't be understood ({error}): give it with --crs EPSG:n") from error
    if stated is None:
        low, high = header.mins, header.maxs
        degrees = max(abs(low[0]), abs(high[0])) <= 180 and max(abs(low[1]), abs(high[1])) <= 90
        hint = "--crs EPSG:4326, as they look like degrees" if degrees else "--crs EPSG:n"
        raise InputError(f"{path}: states no CRS for its coordinates: give it with {hint}")
    return check_horizontal(stated)


def _check_header(header: Any, crs: CRS, path: Path) -> None:
    if header.point_count == 0:
        raise InputError(f"{path}: holds no points")
    numbers = np.concatenate([header.scales, header.offsets])
    if not np.isfinite(numbers).all() or (header.scales == 0).any():
        raise InputError(f"{path}: scale or offset in its header is no number: write the file again")
    box = np.concatenate([header.mins[:2], header.maxs[:2]])
    if not np.isfinite(box).all():
        return
    if crs.is_geographic and (np.abs(box).max() > 360):
        raise InputError(
            f"{path}: x reaches {np.abs(box).max():.0f}, which can't be degrees of {crs.name}: give its CRS with --crs"
        )


def _read(
    reader: Any,
    source: CRS,
    boundary: Boundary | None,
    path: Path,
    tick: Callable[[float], None] | None,
) -> PointCloud:
    total = reader.header.point_count
    parts: list[NDArray[np.float64]] = []
    done = 0
    target: CRS | None = None
    clip: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None
    for chunk in reader.chunk_iterator(CHUNK):
        done += len(chunk)
        xyz = np.column_stack([chunk.x, chunk.y, chunk.z])
        noise = np.isin(np.asarray(chunk.classification), (7, 18)) | np.asarray(chunk.withheld, dtype=bool)
        keep = np.isfinite(xyz).all(axis=1) & ~noise
        xyz = xyz if keep.all() else xyz[keep]
        if len(xyz) == 0:
            continue
        if target is None:
            middle = np.median(xyz[:, :2], axis=0)
            target = metric_crs(source, *middle)
            clip = _clipper(boundary, target, path) if boundary else None
        xyz = _to_metric(xyz, source, target)
        parts.append(xyz[clip(xyz)] if clip else xyz)
        if tick:
            tick(done / total)
    if done < total:
        raise InputError(f"{path}: ends after {done} of {total} points: copy or download it again")
    if target is None:
        raise InputError(f"{path}: holds no usable points (all are flagged as noise or have no number)")
    xyz = np.concatenate(parts)
    if len(xyz) == 0:
        raise InputError(f"{path}: no point lies inside the boundary: do both show the same place, in the right CRS?")
    return PointCloud(_without_strays(xyz, path), target, vertical=vertical_name(source))


def _to_metric(xyz: NDArray[np.float64], source: CRS, target: CRS) -> NDArray[np.float64]:
    flat = horizontal(source)
    if flat != target:
        xyz[:, 0], xyz[:, 1] = transformer(flat, target).transform(xyz[:, 0], xyz[:, 1])
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
    xyz[:, 2] *= vertical_unit(source)
    return xyz


def _clipper(boundary: Boundary, target: CRS, path: Path) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
    import shapely

    polygon = project(*boundary, target)
    bounds = shapely.bounds(polygon)
    if not np.isfinite(bounds).all():
        raise InputError(f"the boundary can't be brought to {target.name}, the CRS of {path}: check its CRS")
    shapely.prepare(polygon)
    west, south, east, north = bounds

    def inside(xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
        x, y = xyz[:, 0], xyz[:, 1]
        mask: NDArray[np.bool_] = (x >= west) & (x <= east) & (y >= south) & (y <= north)
        mask[mask] = shapely.contains_xy(polygon, x[mask], y[mask])
        return mask

    return inside


def _without_strays(xyz: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """Drop the few points that lie absurdly far from the rest, which would stretch every raster."""
    low, high = np.quantile(xyz[:: max(1, len(xyz) // 100_000)], [0.002, 0.998], axis=0)
    span = high - low
    if span[2] > LARGEST_RELIEF:
        raise InputError(f"{path}: heights span {span[2]:.0f} m, which is no survey: check scale, offset and units")
    if span[:2].max() > LARGEST_SPAN:
        raise InputError(
            f"{path}: coordinates span {span[:2].max() / 1000:.0f} km, which is no survey: check scale, offset and CRS"
        )
    reach = 0.5 * span + [50.0, 50.0, 100.0]
    inside = ((xyz >= low - reach) & (xyz <= high + reach)).all(axis=1)
    return xyz if inside.all() else xyz[inside]
