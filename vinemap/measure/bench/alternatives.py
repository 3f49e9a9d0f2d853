"""What a user would pick instead of a step of the chain, timed as it is used.

What an alternative needs from the steps before it, the chain gives it, so that each is measured by its own step only.
"""

from __future__ import annotations

import time
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from vinemap.measure.bench.surveys import plot
from vinemap.measure.bench.watched import high_water

if TYPE_CHECKING:
    from collections.abc import Callable

    import shapely
    from numpy.typing import NDArray

    from vinemap.chain import RowMap
    from vinemap.compute.arrays import Floats
    from vinemap.geo.raster import Raster

T = TypeVar("T")
STEP = 2.0
"""Metres of a piece of a cluster, of which a line goes through the middle."""
CANOPY = (0.5, 2.9)
"""Heights (m) above ground between which a point is one of canopy."""
OUTLINE = 30
"""Vertices with which a polygon is as good as the foliage's outline."""
TURNS = 3


def best(function: Callable[[], T], *, turns: int = TURNS) -> tuple[float, T]:
    """Least seconds that a function takes in a few turns, and what it returns; the first turn warms it up."""
    seconds = []
    for _ in range(turns):
        began = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - began)
    return min(seconds), result


def ground(cloud: str, boundary: str, millions: float) -> dict[str, str]:
    """The cloth simulation filter, and a raster of its ground points, beside the terrain model."""
    import shapely

    from vinemap.geo.boundaries import read_boundary
    from vinemap.geo.raster import sample

    xyz, found = mapped(cloud, boundary)

    before = held_now()
    filtering, soil = best(lambda: xyz[cloth(xyz)])
    rasterising, theirs = best(lambda: rasterised(soil, found.dtm))

    parcel = read_boundary(Path(boundary))[0]
    west, south, east, north = shapely.bounds(parcel)
    xy = np.random.default_rng(0).uniform([west, south], [east, north], (20_000, 2))
    xy = xy[shapely.contains_xy(parcel, *xy.T)]
    errors = np.abs([sample(dtm, xy) - plot(millions).terrain(*xy.T) for dtm in (theirs, found.dtm)])
    errors = errors[:, np.isfinite(errors).all(axis=0)]
    said = [f"|error| median {np.median(e):.3f} m, 95% {np.quantile(e, 0.95):.3f} m" for e in errors]
    return {
        "tool": f"cloth-simulation-filter {version('cloth-simulation-filter')}: "
        "cloth 0.5 m, threshold 0.2 m, rigidness 2, slopes smoothed",
        "seconds": f"{filtering:.2f} s, its raster {rasterising:.2f} s more",
        "result": f"{said[0]}{memory_since(before)}",
        "ours": said[1],
    }


def cloth(xyz: Floats) -> NDArray[np.intp]:
    """Ground among points (n, 3), by the cloth simulation filter: their indices."""
    import CSF

    csf = CSF.CSF()
    csf.params.cloth_resolution = 0.5
    csf.params.class_threshold = 0.2
    csf.params.rigidness = 2
    csf.params.bSloopSmooth = True
    csf.setPointCloud(xyz)
    inside, outside = CSF.VecInt(), CSF.VecInt()
    csf.do_filtering(inside, outside, False)  # noqa: FBT003 - it knows no keywords
    return np.array(inside, dtype=np.intp)


def rasterised(soil: Floats, like: Raster) -> Raster:
    """Means of ground points (n, 3) in the cells of a raster, the empty ones filled from around."""
    from rasterio.fill import fillnodata

    from vinemap.geo.raster import Raster, cell_of

    grid = like.grid
    cells = cell_of(soil[:, :2], grid)
    n = np.bincount(cells, minlength=grid.nx * grid.ny).reshape(grid.shape)
    total = np.bincount(cells, soil[:, 2], grid.nx * grid.ny).reshape(grid.shape)
    level = soil[:, 2].mean()  # single precision is for differences
    values = fillnodata((total / np.maximum(n, 1) - level).astype(np.float32), mask=n > 0, max_search_distance=20.0)
    return Raster(np.where(np.isfinite(like.values), values + level, np.nan), grid, like.crs)


def rows(cloud: str, boundary: str, truth: str, thin: float) -> dict[str, str]:
    """DBSCAN of canopy points in plan, all of them or one in every cell of ``thin`` m, beside the rows that we find."""
    import geopandas as gpd
    from sklearn.cluster import DBSCAN

    from vinemap.evaluate.reference import read_lines
    from vinemap.evaluate.rows import evaluate_rows
    from vinemap.geo.raster import sample

    xyz, found = mapped(cloud, boundary)
    heights = xyz[:, 2] - sample(found.dtm, xyz[:, :2])
    canopy = xyz[(heights > CANOPY[0]) & (heights < CANOPY[1]), :2]

    def clustered() -> tuple[Floats, NDArray[np.intp]]:
        some = (
            np.unique(np.floor(canopy / thin).astype(np.int64), axis=0, return_index=True)[1] if thin else slice(None)
        )
        xy = canopy[some]
        return xy, DBSCAN(eps=1.0, min_samples=10, n_jobs=-1).fit_predict(xy - xy.min(axis=0))

    before = held_now()
    # All points take long, and more memory at every turn.
    seconds, (xy, labels) = best(clustered, turns=TURNS if thin else 1)
    used = memory_since(before)

    drawn = read_lines(truth, "rows")[["geometry"]]
    clusters = [line for k in range(labels.max() + 1) if (line := course(xy[labels == k])) is not None]
    said = []
    for lines in (gpd.GeoDataFrame(geometry=clusters, crs=drawn.crs), found.rows[["geometry"]]):
        evaluation = evaluate_rows(lines, drawn)
        said.append(f"{len(evaluation.pairs)} of {len(drawn)} rows right, {len(evaluation.extra_rows)} extra")
    some = f"a canopy point in {thin:g} m cells" if thin else "all canopy points"
    return {
        "tool": f"DBSCAN of scikit-learn {version('scikit-learn')}: eps 1 m, min_samples 10, all cores, "
        f"{some} ({len(xy):,})",
        "seconds": f"{seconds:.2f} s",
        "result": f"{said[0]}{used}",
        "ours": said[1],
    }


def course(xy: Floats) -> shapely.LineString | None:
    """Line through a cluster (n, 2): the middles of pieces of ``STEP`` m along its longest axis, None of no length."""
    import shapely

    middle = xy.mean(axis=0)
    axes = np.linalg.svd(np.cov((xy - middle).T))[0]
    along, across = (xy - middle) @ axes.T[0], (xy - middle) @ axes.T[1]
    start, end = along.min(), along.max()
    if end - start < STEP:
        return None
    pieces = max(round((end - start) / STEP), 1)
    piece = np.minimum(((along - start) / (end - start) * pieces).astype(int), pieces - 1)
    kept = np.flatnonzero(np.bincount(piece, minlength=pieces))
    left = (np.bincount(piece, across, pieces)[kept] / np.bincount(piece, minlength=pieces)[kept])[
        [0, *range(len(kept)), -1]
    ]
    at = np.concatenate([[start], start + (kept + 0.5) * (end - start) / pieces, [end]])
    return shapely.LineString(middle + np.column_stack([at, left]) @ axes.T)


def polygons(cloud: str, boundary: str, c: int = 7) -> dict[str, str]:
    """OpenCV's approxPolyN beside our c-gons, around the same hulls: the foliage's outlines in sections."""
    import cv2

    from vinemap.canopy.cgon import enclose
    from vinemap.canopy.hull import hull
    from vinemap.chain import model_canopies
    from vinemap.config.settings import PolygonOptions, Settings

    _, found = mapped(cloud, boundary)
    outlines = model_canopies(found, Settings(polygon=PolygonOptions(c=OUTLINE))).polygons
    feet = outlines[:, [0, 1, -1]]
    hulls = [outline[hull(outline)] for outline in outlines]
    rings = [cv2.convexHull(ring.astype(np.float32)) for ring in hulls]
    # With so few vertices approxPolyN has nothing to do.
    some = np.array([len(ring) > c for ring in rings])
    hulls, rings = ([ring for ring, kept in zip(r, some, strict=True) if kept] for r in (hulls, rings))
    start = np.concatenate([[0], np.cumsum([len(ring) for ring in hulls])])
    flat, feet = np.concatenate(hulls), feet[some]
    mine, ours = best(lambda: enclose(flat, start, feet, c=c, slide=True))
    other, theirs = best(lambda: [cv2.approxPolyN(ring, c) for ring in rings])
    area = np.array([cv2.contourArea(ring) for ring in theirs])
    return {
        "tool": f"approxPolyN of OpenCV {version('opencv-python-headless')}: {c} vertices",
        "seconds": f"{1e6 * other / len(hulls):.1f} µs a section, one core",
        "result": f"{100 * np.mean(area / ours.area):.1f}% of our area on the mean, {len(hulls):,} sections, feet free",
        "ours": "100%, stands on its feet",
        "our_seconds": f"{1e6 * mine / len(hulls):.1f} µs a section, all cores",
    }


def mapped(cloud: str, boundary: str) -> tuple[Floats, RowMap]:
    """Points (n, 3) of a parcel, and its rows as they come."""
    from vinemap.chain import map_rows
    from vinemap.cloud.las import read_cloud
    from vinemap.config.settings import Settings
    from vinemap.geo.boundaries import read_boundary

    points = read_cloud(Path(cloud), boundary=read_boundary(Path(boundary)))
    return np.concatenate([part.xyz for part in points.parts()]), map_rows(points, Settings())


def held_now() -> int | None:
    """Memory (bytes) that this process holds; None where the system doesn't tell."""
    high_water()
    return high_water()


def memory_since(before: int | None) -> str:
    """Most memory beyond what was held before, in words."""
    most = high_water()
    return "" if most is None or before is None else f"; {max(most - before, 0) / 1e9:.1f} GB"
