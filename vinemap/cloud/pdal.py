"""PDAL as another engine, where it is installed: its readers, and ground points by its SMRF (Pingel et al. 2013).

Options of stages are those of https://pdal.io/stages; pipelines are joined by ``|``, as PDAL's Python
package does it. Everything here asks for that package only when it is called.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import shapely

from vinemap.cloud.copc import is_copc
from vinemap.cloud.files import listed
from vinemap.cloud.formats.kinds import kind_of
from vinemap.cloud.las import OURS, collected, opened, unreadable
from vinemap.cloud.tiles import Collector
from vinemap.errors import DependencyError, InputError
from vinemap.geo.boundaries import boundary_in
from vinemap.geo.crs import horizontal, metric_crs, project, vertical_name, vertical_unit
from vinemap.geo.place import Place
from vinemap.geo.stated import check_together, examined

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.cloud.points import PointCloud
    from vinemap.geo.boundaries import Boundary

USABLE = "Classification != 7 && Classification != 18 && Withheld == 0"
"""Points that are neither noise nor withheld, as PDAL writes it."""
SAMPLE = 10_000
"""Points whose middle tells where a cloud lies."""
MARGIN = 0.01
"""Share of a boundary's width that is read from a COPC file around it, before the cloud is clipped."""


def load_pdal() -> Any:
    """PDAL's Python package.

    Raises
    ------
    DependencyError
        If it isn't installed, lacks what is used of it, or its library can't be loaded.
    """
    try:
        import pdal

        _ = pdal.Filter.smrf, pdal.Filter.expression, pdal.Reader.copc
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        raise DependencyError(
            f"ground.engine: pdal wants PDAL, which can't be loaded ({error}): conda install -c conda-forge "
            "python-pdal, or leave ground.engine out, as vinemap has an engine of its own"
        ) from error
    return pdal


def check_engine(engine: str) -> None:
    """Do nothing if an engine of ``GroundOptions`` can run here.

    Raises
    ------
    DependencyError
        If it is PDAL, and PDAL can't be loaded.
    """
    if engine == "pdal":
        load_pdal()


def pdal_versions() -> dict[str, str]:
    """Versions of PDAL's Python package and of its library."""
    pdal = load_pdal()
    return {"pdal": str(pdal.__version__), "libpdal": str(pdal.info.version)}


def read_cloud_pdal(
    clouds: Path | Sequence[Path], *, crs: CRS | None = None, boundary: Boundary | None = None
) -> PointCloud:
    """Read LAS, LAZ or COPC files as :func:`vinemap.cloud.las.read_cloud` does, with PDAL, and classify its ground.

    Parameters and what else is raised are those of that function.

    Returns
    -------
    PointCloud
        Points in metres with their ``classification``: 2 for ground, 1 for all else.

    Raises
    ------
    DependencyError
        If PDAL can't be loaded.
    """
    load_pdal()
    files, collector, remarks = listed(clouds), Collector(), list[str]()
    if other := next(filter(kind_of, files), None):
        raise InputError(f"{other}: ground.engine: pdal reads LAS, LAZ and COPC on a disk alone: leave it out")
    place: Place | None = None
    for path in files:
        source, target, copc, more = _look_into(path, crs)
        remarks += more
        place = place or Place(target, vertical_name(source), remarks)
        check_together(source, place, path, files[0])
        polygon = boundary_in(boundary, place.crs, path) if boundary else None
        reading = reading_pipeline(path, source=source, target=place.crs, polygon=polygon, copc=copc)
        xyz = _coordinates(_run(reading, path))
        del reading  # it holds every point with all its dimensions
        if len(xyz) == 0 and not boundary:
            raise InputError(f"{path}: holds no usable points (all are flagged as noise)")
        xyz[:, 2] *= vertical_unit(source)
        collector.add(xyz)
    (cloud,) = collected(collector, cast("Place", place), files).parts()
    points = _run(ground_pipeline(cloud.xyz), files[0])
    classes = points["Classification"].astype(np.uint8)
    return replace(cloud, xyz=_coordinates(points), classification=classes)


def reading_pipeline(
    path: Path, *, source: CRS, target: CRS, polygon: shapely.Geometry | None = None, copc: bool = False
) -> Any:
    """Pipeline that reads the usable points of a file into a projected CRS, and clips them to a polygon.

    The reader is told only the horizontal part of the file's CRS, so that no height is moved to another datum.

    Parameters
    ----------
    path : Path
        LAS, LAZ or COPC file.
    source, target : CRS
        CRS of the file's coordinates, and the horizontal one they are brought to.
    polygon : Geometry, optional
        Polygon in ``target`` to clip to.
    copc : bool
        Whether the file is a COPC, of which only what lies about the polygon is read.

    Returns
    -------
    pdal.Pipeline
    """
    pdal = load_pdal()
    flat = horizontal(source)
    where = {"filename": str(path), "override_srs": flat.to_wkt()}
    if copc and polygon is not None:
        where["bounds"] = _box(project(polygon, target, flat))
    reader = pdal.Reader.copc(**where) if copc else pdal.Reader.las(**where)
    pipeline = reader | pdal.Filter.expression(expression=USABLE)
    if flat != target:
        pipeline = pipeline | pdal.Filter.reprojection(in_srs=flat.to_wkt(), out_srs=target.to_wkt())
    if polygon is not None:
        pipeline = pipeline | pdal.Filter.crop(polygon=shapely.to_wkt(polygon), a_srs=target.to_wkt())
    return pipeline


def ground_pipeline(
    xyz: NDArray[np.float64],
    *,
    cell: float = 0.5,
    slope: float = 0.7,
    window: float = 8.0,
    scalar: float = 0.35,
    threshold: float = 0.15,
) -> Any:
    """Pipeline that classifies the ground among points by ``filters.smrf``.

    It is apart from the reading, as SMRF lays a raster over all points, which a stray one would stretch. Returns
    aren't told apart: it looks for the lowest points itself, and stops at files that number some returns from 0.

    Parameters
    ----------
    xyz : ndarray (n, 3)
        Points in metres.
    cell : float
        Cell size in metres of the raster of lowest points, less than the width of an inter-row; PDAL's is 1.
    slope : float
        Rise over run above which the edge of a thing isn't terrain: more than that of steep vineyards, less than that
        of foliage above the soil half a metre away; PDAL's is 0.15.
    window : float
        Half the width in metres of the widest thing that isn't terrain: trees and houses; PDAL's is 18.
    scalar : float
        Metres by which ground may be farther from the lowest points for each unit of the terrain's slope: half a
        cell's diagonal; PDAL's is 1.25.
    threshold : float
        Metres by which ground may be from the lowest points: noise, but no high weeds; PDAL's is 0.5.

    Returns
    -------
    pdal.Pipeline
    """
    points = np.ascontiguousarray(xyz).view([("X", "f8"), ("Y", "f8"), ("Z", "f8")]).ravel()
    smrf = load_pdal().Filter.smrf(cell=cell, slope=slope, window=window, scalar=scalar, threshold=threshold)
    return smrf.pipeline(points)


def _look_into(path: Path, crs: CRS | None) -> tuple[CRS, CRS, bool, list[str]]:
    """CRS of a file's coordinates, CRS to work it in, whether it is a COPC, and what is to be known of its place."""
    with opened(path, crs=crs) as (reader, source, _):
        try:
            some = reader.read_points(SAMPLE)
        except OURS:
            raise
        except BaseException as error:
            raise unreadable(path, error) from error
        xyz = np.column_stack([some.x, some.y, some.z])
        target = metric_crs(source, *np.median(xyz[:, :2], axis=0).tolist())
        return source, target, is_copc(reader.header), examined(xyz, reader.header, source, path, given=crs is not None)


def _run(pipeline: Any, path: Path) -> NDArray[np.void]:
    """Points (n,) that come out of a pipeline, as fields named after PDAL's dimensions."""
    try:
        pipeline.execute()
    except RuntimeError as error:
        raise unreadable(path, error) from error
    parts: NDArray[np.void] = np.concatenate(pipeline.arrays)
    return parts


def _coordinates(points: NDArray[np.void]) -> NDArray[np.float64]:
    return np.column_stack([points["X"], points["Y"], points["Z"]])


def _box(polygon: shapely.Geometry) -> str:
    """Bounds of a polygon with a margin, as PDAL writes them."""
    west, south, east, north = shapely.bounds(polygon).tolist()
    margin = MARGIN * max(east - west, north - south)
    return f"([{west - margin!r}, {east + margin!r}], [{south - margin!r}, {north + margin!r}])"
