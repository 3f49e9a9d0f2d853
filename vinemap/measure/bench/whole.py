"""The whole job, from the cloud of a parcel to its rows and volumes, as one would do it with the best tools there are.

Ground and heights by PDAL where it is installed, else by the cloth simulation filter and a raster of its ground points;
a raster of tops; their cells clustered by scikit-learn, turned and squeezed along the rows, as rows are long; a line
through every cluster; and the convex hulls of slabs of its points.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap.cloud.pdal.engine import load_pdal, pdal_versions, stages_of
from vinemap.config.settings import GroundOptions
from vinemap.errors import DependencyError
from vinemap.measure.bench.alternatives import CANOPY, cloth, course

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.compute.arrays import Floats

SOIL, TOPS = 0.25, 0.2
"""Cells (m) of the rasters of ground and tops."""
SQUEEZE = 10.0
"""By which what is along the rows counts less than what is across."""
REACH = 0.4
"""Metres across rows, and a tenth of metres along them, over which DBSCAN takes cells for one row."""
SLAB = 1.0
"""Metres of row in a hull."""


def whole(cloud: str, boundary: str, clustering: str, out: str) -> dict[str, Any]:
    """Map a parcel by a clustering of scikit-learn, write its rows, and tell by what tools, and the seconds of each."""
    import geopandas as gpd

    seconds: dict[str, float] = {}

    def timed(name: str, function: Callable[..., Any], *args: Any) -> Any:
        began = time.perf_counter()
        result = function(*args)
        seconds[name] = time.perf_counter() - began
        return result

    xyz, crs = timed("reading", clipped, cloud, boundary)
    xyz, heights, ground = timed("ground", above_ground, xyz)
    xyz, heights = (values[(heights > CANOPY[0]) & (heights < CANOPY[1])] for values in (xyz, heights))
    cells, cell_of, along = timed("raster", tops, xyz[:, :2], heights)
    labels = timed("rows", clustered, cells, along, clustering)
    lines = [course(cells[labels == k]) for k in range(labels.max() + 1)]
    volumes = timed("hulls", volumes_of, np.column_stack([xyz[:, :2] @ along, xyz]), labels[cell_of], len(lines))
    table = gpd.GeoDataFrame({"volume_m3": volumes}, geometry=lines, crs=crs).dropna(subset="geometry")
    if table.empty:
        sys.exit("found no row")
    table.to_file(out, layer="rows")
    tools = f"{ground}; {clustering} of scikit-learn {version('scikit-learn')}, {len(cells):,} cells of {TOPS} m; "
    tools += f"convex hulls of scipy {version('scipy')}, {SLAB:g} m of row each"
    return {"tools": tools, "seconds": ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())}


def clipped(cloud: str, boundary: str) -> tuple[Floats, CRS]:
    """Points (n, 3) of a cloud within a boundary, and their CRS."""
    import geopandas as gpd
    import laspy
    import shapely

    las = laspy.read(cloud)
    crs = las.header.parse_crs()
    outline = gpd.read_file(boundary).to_crs(crs).union_all()
    xyz: Floats = np.asarray(las.xyz)
    shapely.prepare(outline)
    return xyz[shapely.contains_xy(outline, *xyz[:, :2].T)], crs


def above_ground(xyz: Floats) -> tuple[Floats, Floats, str]:
    """Points (n, 3), their heights (n,) above ground, and by what."""
    try:
        pdal = load_pdal()
    except DependencyError:
        by = f"cloth-simulation-filter {version('cloth-simulation-filter')}"
        return xyz, xyz[:, 2] - soil_at(xyz[cloth(xyz)], xyz[:, :2]), by
    stages = [*stages_of(GroundOptions(engine="pdal")), {"type": "filters.hag_nn"}]
    given = np.ascontiguousarray(xyz).view([(name, "f8") for name in "XYZ"]).ravel()
    pipeline = pdal.Pipeline(json.dumps(stages), arrays=[given])
    pipeline.execute()
    points = np.concatenate(pipeline.arrays)
    xyz = np.column_stack([points[name] for name in "XYZ"])
    return xyz, points["HeightAboveGround"], f"SMRF and HeightAboveGround of PDAL {pdal_versions()['libpdal']}"


def soil_at(soil: Floats, xy: Floats) -> Floats:
    """Heights (n,) of a raster of ground points (m, 3), empty cells filled by the nearest, at places (n, 2)."""
    from scipy.ndimage import distance_transform_edt, map_coordinates

    corner = xy.min(axis=0)
    nx, ny = (np.ptp(xy, axis=0) / SOIL).astype(int) + 1
    column, row = ((soil[:, :2] - corner) / SOIL).astype(int).T
    cells = row * nx + column
    n = np.bincount(cells, minlength=nx * ny).reshape(ny, nx)
    total = np.bincount(cells, soil[:, 2], nx * ny).reshape(ny, nx)
    nearest = distance_transform_edt(n == 0, return_distances=False, return_indices=True)
    values = (total / np.maximum(n, 1))[tuple(nearest)]
    heights: Floats = map_coordinates(values, ((xy - corner) / SOIL - 0.5).T[::-1], order=1, mode="nearest")
    return heights


def tops(xy: Floats, heights: Floats) -> tuple[Floats, NDArray[np.intp], Floats]:
    """Middles (m, 2) of the cells that hold canopy, the cell (n,) of each point, and the rows' direction (2,)."""
    from scipy.ndimage import gaussian_filter

    corner = xy.min(axis=0)
    nx, ny = (np.ptp(xy, axis=0) / TOPS).astype(int) + 1
    column, row = ((xy - corner) / TOPS).astype(int).T
    raster = np.zeros(nx * ny)
    np.maximum.at(raster, row * nx + column, heights)
    up, right = np.gradient(gaussian_filter(raster.reshape(ny, nx), 2.0))
    across = np.arctan2(2 * np.sum(up * right), np.sum(right**2 - up**2)) / 2
    held = np.flatnonzero(raster)
    middles = corner + (np.column_stack([held % nx, held // nx]) + 0.5) * TOPS
    return middles, np.searchsorted(held, row * nx + column), np.array([-np.sin(across), np.cos(across)])


def clustered(cells: Floats, along: Floats, clustering: str) -> NDArray[np.intp]:
    """Row (m,) of cells (m, 2), from 0 on; -1 of those in none."""
    from sklearn.cluster import DBSCAN, HDBSCAN

    from_here = cells - cells.mean(axis=0)
    turned = np.column_stack([from_here @ along / SQUEEZE, from_here @ [-along[1], along[0]]])
    by = {
        "DBSCAN": DBSCAN(eps=REACH, min_samples=10, n_jobs=-1),
        "HDBSCAN": HDBSCAN(min_cluster_size=100, min_samples=10, n_jobs=-1, copy=True),
    }
    labels: NDArray[np.intp] = by[clustering].fit_predict(turned)
    return labels


def volumes_of(points: Floats, labels: NDArray[np.intp], n: int) -> Floats:
    """Volume (n,) of clusters: the convex hulls of slabs of their points (distance along the rows, x, y, z)."""
    from scipy.spatial import ConvexHull, QhullError

    points, labels = points[labels >= 0], labels[labels >= 0]
    slab = np.floor(points[:, 0] / SLAB)
    order = np.lexsort([slab, labels])
    points, labels, slab = points[order, 1:], labels[order], slab[order]
    starts = np.flatnonzero(np.diff(labels, prepend=-1) | np.diff(slab, prepend=np.nan).astype(bool))
    volumes = np.zeros(n)
    for start, end in zip(starts, np.append(starts[1:], len(points)), strict=True):
        try:
            volumes[labels[start]] += ConvexHull(points[start:end] - points[start]).volume
        except (QhullError, ValueError):  # too few points, or flat ones
            continue
    return volumes
