"""The chain, once: from the cloud of a parcel to its product."""

from __future__ import annotations

import hashlib
import json
import platform
import time
from datetime import datetime, timezone
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import geopandas as gpd
import numpy as np
import shapely

from vinemap import __version__, paths
from vinemap.canopy import find_feet, measure_sections, separate_canopy, summarise_rows
from vinemap.cgon import enclose
from vinemap.cloud import PointCloud, read_cloud
from vinemap.clustering import cluster_rows
from vinemap.config import Settings, check_name
from vinemap.crs import Origin, horizontal, to_wgs84, transformer
from vinemap.curves import trace_rows
from vinemap.errors import InputError
from vinemap.ground import canopy_height_model, height_above_ground, terrain_model
from vinemap.key_points import detect_key_points
from vinemap.mesh import Mesh, loft_rows, write_glb
from vinemap.raster import Raster, RowField, write_cog
from vinemap.row_field import canopy_cover, estimate_row_field
from vinemap.row_table import describe_rows, number_rows
from vinemap.sections import cut_sections
from vinemap.vector import read_boundary, write_geopackage

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from pyproj import CRS

    Boundary = tuple[shapely.Geometry, CRS]

T = TypeVar("T")

LIBRARIES = ("numpy", "scipy", "laspy", "lazrs", "pyproj", "geopandas", "shapely", "rasterio", "numba", "pygltflib")


class Summary(NamedTuple):
    """What a run found, and where it left it."""

    parcel: str
    folder: Path
    rows: int
    length: float
    seconds: float


def call(name: str, function: Callable[..., T], *args: Any, **kwargs: Any) -> T:  # noqa: ANN401
    """Run a stage as it is."""
    del name
    return function(*args, **kwargs)


def map_parcel(
    cloud: Path,
    folder: Path,
    *,
    parcel: str,
    settings: Settings | None = None,
    boundary: Path | None = None,
    crs: CRS | None = None,
    origin: Origin | None = None,
    step: Callable[..., Any] = call,
) -> Summary:
    """Map the rows and canopies of one parcel, and leave the product in a folder.

    Parameters
    ----------
    cloud : Path
        LAS, LAZ or COPC file.
    folder : Path
        Where the product goes, whole or not at all.
    parcel : str
        Its name, which names its files and follows the numbers of its rows.
    settings : Settings, optional
        Settings of the stages.
    boundary : Path, optional
        File with the polygon to clip to.
    crs : CRS, optional
        CRS of the cloud's coordinates, where the file states none or a wrong one.
    origin : Origin, optional
        Origin of {Main}; by default the south-western corner of the parcel at its lowest terrain.
    step : callable
        Runs a stage, as ``step(name, function, *args, **kwargs)``.

    Raises
    ------
    VinemapError
        If the input can't be used or the product can't be written.
    """
    check_name(parcel)
    settings = settings or Settings()
    seconds: dict[str, float] = {}

    def run(name: str, function: Callable[..., T], *args: Any, **kwargs: Any) -> T:  # noqa: ANN401
        start = time.perf_counter()
        out: T = step(name, function, *args, **kwargs)
        seconds[name] = round(time.perf_counter() - start, 3)
        return out

    with paths.product(folder) as draft:
        polygon = read_boundary(boundary, parcel=parcel) if boundary else None
        points = run("Reading", read_cloud, cloud, crs=crs, boundary=polygon)
        dtm, heights = run("Ground", _ground, points, settings)
        field, cover = run("Row field", _row_field, points, heights, settings)
        key_points = run("Key points", detect_key_points, cover, dtm, field, **settings.key_points.model_dump())
        clusters = run("Clusters", cluster_rows, key_points, **settings.clustering.model_dump())
        curves = run("Curves", trace_rows, clusters, cover, dtm, **settings.curves.model_dump())
        rows, gaps = number_rows(*curves)
        sections, polygons = run("Canopy", _canopy, points, heights, rows, gaps, dtm, settings)
        rows = summarise_rows(rows, sections, step=settings.sections.step)
        origin = origin or _default_origin(dtm)
        rows, ends, enhanced = describe_rows(
            rows, parcel=parcel, origin=origin, threshold=settings.curves.threshold
        )
        layers = {
            "rows": rows,
            "row_ends": ends,
            "key_points": enhanced,
            "sections": _labelled(sections, rows),
            "gaps": _labelled(gaps, rows),
            "parcel": _parcel_layer(parcel, rows, dtm, polygon, points),
        }
        meshes = run("Meshes", loft_rows, polygons, rows)
        rasters = {"dtm": dtm, "chm": canopy_height_model(points, heights)}
        run("Writing", _write, draft, parcel, layers, rasters, field, meshes, points)
        record = {
            "parcel": parcel,
            "inputs": [_fingerprint(path) for path in (cloud, boundary) if path],
            "settings": settings.model_dump(mode="json"),
            "crs": _crs_name(points.crs),
            "vertical_datum": points.vertical,
            "origin": origin._asdict(),
            "counts": {
                "points": len(points.xyz),
                "key_points_found": len(key_points),
                "rows": len(rows),
                "gaps": len(gaps),
                "sections": len(sections),
            },
            "seconds": seconds,
        }
        _write_record(draft, record)
    return Summary(parcel, folder, len(rows), float(rows["length_m"].sum()), sum(seconds.values()))


def _ground(points: PointCloud, settings: Settings) -> tuple[Raster, np.ndarray[Any, np.dtype[np.float64]]]:
    dtm = terrain_model(points, **settings.ground.model_dump())
    return dtm, height_above_ground(points, dtm)
