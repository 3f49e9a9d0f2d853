"""Reading LAS, LAZ and COPC files into metres of one projected CRS, and writing LAZ."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap.cloud import PointCloud
from vinemap.crs import check_horizontal, horizontal, metric_crs, project, transformer, vertical_name, vertical_unit
from vinemap.errors import InputError
from vinemap.raster import extent
from vinemap.zones import deal, zones_of

if TYPE_CHECKING:
    from pathlib import Path

    import shapely
    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.zones import Zones

CHUNK = 1_000_000
LARGEST_RELIEF = 2_000.0
"""Metres of height in one survey, at the most."""
LARGEST_SPAN = 50_000.0
"""Metres: what is wider isn't one survey but broken coordinates."""

Boundary = tuple["shapely.Geometry", "CRS"]
"""A polygon and its CRS."""


def read_cloud(path: Path, *, crs: CRS | None = None, boundary: Boundary | None = None) -> PointCloud:
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

    Raises
    ------
    InputError
        If the file can't be read whole, has no points, no CRS, or coordinates that can't be right.
    """
    import laspy  # 0.4 s of start-up

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with laspy.open(path, laz_backend=_backends(path), decompression_selection=_needed()) as reader:
            header = reader.header
            source = crs or _stated_crs(header, path)
            _check_header(header, source, path)
            return _read(reader, source, boundary, path)
    except InputError:
        raise
    except Exception as error:  # laspy and lazrs raise many kinds, a Rust panic among them
        reason = str(error).strip().split("\n")[0] or type(error).__name__
        raise InputError(f"{path}: can't be read as LAS or LAZ ({reason}): is it whole?") from error


def write_classified(cloud: PointCloud, classes: NDArray[np.uint8], row_id: NDArray[np.uint16], path: Path) -> None:
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
    out["HeightAboveGround"] = cloud.heights
    out["row_id"] = row_id
    with path.open("wb") as stream:
        out.write(stream, do_compress=True, laz_backend=laspy.LazBackend.LazrsParallel)


def _backends(path: Path) -> Any:
    import laspy

    return None if path.suffix.lower() == ".las" else [laspy.LazBackend.LazrsParallel, laspy.LazBackend.Lazrs]


def _needed() -> Any:
    """What is decompressed of a point, where the format lets the rest be: not colours, intensities and times."""
    from laspy import DecompressionSelection as Selection

    return Selection.XY_RETURNS_CHANNEL | Selection.Z | Selection.CLASSIFICATION | Selection.FLAGS


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


def _read(reader: Any, source: CRS, boundary: Boundary | None, path: Path) -> PointCloud:
    total = reader.header.point_count
    xyz = np.empty((0, 3))
    done = n = 0
    target: CRS | None = None
    zones: Zones | None = None
    for chunk in reader.chunk_iterator(CHUNK):
        done += len(chunk)
        part = _usable(chunk)
        if len(part) == 0:
            continue
        if target is None:
            target = metric_crs(source, *np.median(part[:, :2], axis=0))
            zones = zones_of([_boundary_in(boundary, target, path)]) if boundary else None
        part = _to_metric(part, source, target)
        if zones:
            part = deal(part, zones)[0]
        # Grown in place: a list of chunks joined at the end would take twice the memory.
        xyz.resize((n + len(part), 3), refcheck=False)
        xyz[n:] = part
        n += len(part)
    if done < total:
        raise InputError(f"{path}: ends after {done} of {total} points: copy or download it again")
    if target is None:
        raise InputError(f"{path}: holds no usable points (all are flagged as noise or have no number)")
    if n == 0:
        raise InputError(f"{path}: no point lies inside the boundary: do both show the same place, in the right CRS?")
    return PointCloud(_without_strays(xyz, path), target, vertical=vertical_name(source))


def _usable(chunk: Any) -> NDArray[np.float64]:
    """Coordinates (n, 3) of the points of a chunk that aren't flagged as noise and are numbers."""
    xyz = np.column_stack([chunk.x, chunk.y, chunk.z])
    classes = np.asarray(chunk.classification)
    noise = (classes == 7) | (classes == 18) | np.asarray(chunk.withheld, dtype=bool)
    if noise.any():
        xyz = xyz[~noise]
    if not np.isfinite(xyz.sum()):
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
    return xyz


def _to_metric(xyz: NDArray[np.float64], source: CRS, target: CRS) -> NDArray[np.float64]:
    flat = horizontal(source)
    if flat != target:
        xyz[:, 0], xyz[:, 1] = transformer(flat, target).transform(xyz[:, 0], xyz[:, 1])
        xyz = xyz[np.isfinite(xyz).all(axis=1)]
    xyz[:, 2] *= vertical_unit(source)
    return xyz


def _boundary_in(boundary: Boundary, target: CRS, path: Path) -> shapely.Geometry:
    import shapely

    polygon = project(*boundary, target)
    if not np.isfinite(shapely.bounds(polygon)).all():
        raise InputError(f"the boundary can't be brought to {target.name}, the CRS of {path}: check its CRS")
    return polygon


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
    lowest, highest = extent(xyz)
    if (lowest < low - reach).any() or (highest > high + reach).any():
        xyz = xyz[((xyz >= low - reach) & (xyz <= high + reach)).all(axis=1)]
    return xyz
