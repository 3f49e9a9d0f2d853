"""What the benchmark runs, each in a process of its own: ``python -m vinemap.measure.bench.jobs JOB RESULT ARGUMENTS``.

Apart from surveys and reading: what a user would pick instead of a step of the chain, timed as it is used. What an
alternative needs from the steps before it, the chain gives it, so that each is measured by its own step only.
"""

from __future__ import annotations

import inspect
import json
import math
import os
import resource
import sys
import time
import zlib
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import shapely
    from numpy.typing import NDArray

    from vinemap.geo.raster import Raster
    from vinemap.parcel import RowMap
    from vinemap.simulate.survey import Terrain, Vineyard

    Array = NDArray[np.float64]

T = TypeVar("T")

DENSITY = 500.0
"""Rays a square metre of the parcel; a tenth of them finds neither leaf nor ground."""
DENSITY_OUTSIDE = 60.0
SPACING = 2.7
"""Metres between rows."""
MARGIN = 13.0
"""Metres of bare ground about the rows, less about few: half of parcel F is such."""
CANOPY = (0.5, 2.9)
"""Heights (m) above ground between which a point is one of canopy."""
OUTLINE = 30
"""Vertices with which a polygon is as good as the foliage's outline."""
TURNS = 3
MEMORY = 0.75
"""Share of the machine's memory that a job may address."""


class Plot(NamedTuple):
    """A vineyard like the thesis's parcel F, of any size."""

    rows: list[Array]
    vineyard: Vineyard
    terrain: Terrain


def plot(millions: float) -> Plot:
    """Parcel on which about so many million points are found: number and length of rows grow with its square root.

    Rows are 2.7 m apart on a bend of 800 m radius and a slope of 15%, with bare ground about them: 16 rows of 112 m on
    a hectare where 4.7 million points lie, as in parcel F.
    """
    from vinemap.simulate.scenes import hillside, rows_of
    from vinemap.simulate.survey import Vineyard

    n = max(round(7.4 * math.sqrt(millions)), 3)
    margin = margin_of(millions)
    width = (n - 1) * SPACING + 2 * margin
    edge = 2 * 6 * DENSITY_OUTSIDE
    length = (1e6 * millions - edge * width) / (0.94 * DENSITY * width + edge) - 2 * margin
    rows = rows_of(n, length=max(length, 5.0), spacing=SPACING, azimuth=18, radius=800)
    gaps = (2, 3, 3, 4, 5) * math.ceil(n / 24)
    return Plot(rows, Vineyard("F", rows, gaps=gaps, outline=outline(rows, margin)), hillside(0.15, uphill=100))


def margin_of(millions: float) -> float:
    """Metres of bare ground about the rows of a parcel on which about so many million points are found."""
    return MARGIN * min(1.0, math.sqrt(millions / 4.7))


def outline(rows: list[Array], margin: float) -> shapely.Polygon:
    """Parcel of rows and the bare ground about them (m)."""
    import shapely

    return shapely.MultiLineString(rows).convex_hull.buffer(margin)


def survey(millions: float, folder: str) -> dict[str, Any]:
    """Simulate a survey of that size unless it is there; its name holds a hash of how it is made."""
    import geopandas as gpd

    from vinemap.simulate import scenes
    from vinemap.simulate import survey as synthetic

    source = "".join(
        inspect.getsource(part) for part in (plot, outline, margin_of, scenes.rows_of, scenes.hillside, synthetic)
    )
    recipe = zlib.crc32(f"{source}{DENSITY}{DENSITY_OUTSIDE}{SPACING}{MARGIN}".encode())
    name = f"{millions:g}M-{recipe:08x}"
    cloud = Path(folder, name, f"{name}.laz")
    if not cloud.is_file():
        made = plot(millions)
        found = synthetic.simulate(
            [made.vineyard], made.terrain, name=name, density=DENSITY, density_outside=DENSITY_OUTSIDE, seed=1
        )
        synthetic.write_survey(found, cloud.parent)
    boundary, truth = cloud.with_name("parcels.gpkg"), cloud.with_name("truth.gpkg")
    area = float(gpd.read_file(boundary).area.sum())
    return {"cloud": str(cloud), "boundary": str(boundary), "truth": str(truth), "area": area}


def estate(millions: float, parcels: int, folder: str) -> dict[str, Any]:
    """Simulate a survey of that size with many parcels, some way apart, unless it is there."""
    import laspy
    import pandas as pd
    from shapely import affinity

    from vinemap.geo.crs import parse_crs
    from vinemap.simulate import survey as synthetic

    source = "".join(inspect.getsource(part) for part in (plot, outline, margin_of, estate, synthetic))
    name = f"{millions:g}M-{parcels}-{zlib.crc32(f'{source}{DENSITY}{DENSITY_OUTSIDE}{SPACING}{MARGIN}'.encode()):08x}"
    cloud = Path(folder, name, f"{name}.laz")
    boundary = cloud.with_name("parcels.gpkg")
    if not cloud.is_file():
        cloud.parent.mkdir(parents=True, exist_ok=True)
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.scales, header.offsets = np.full(3, 0.001), np.array([414_000.0, 4_940_000.0, 300.0])
        header.add_crs(parse_crs("EPSG:32632"))
        draft, polygons = cloud.with_suffix(".part"), []
        made = plot(millions / parcels)
        hull = outline(made.rows, margin_of(millions / parcels))
        apart = np.ptp(np.concatenate(made.rows), axis=0).max() + 2 * MARGIN + 10
        with laspy.open(draft, mode="w", header=header, do_compress=True) as writer:
            for k in range(parcels):
                shift = apart * np.array(divmod(k, 5))
                rows = [row + shift for row in made.rows]
                where = affinity.translate(hull, *shift)
                vineyard = synthetic.Vineyard(f"{k + 1}", rows, gaps=made.vineyard.gaps, outline=where)
                found = synthetic.simulate(
                    [vineyard], made.terrain, density=DENSITY, density_outside=DENSITY_OUTSIDE, seed=k
                )
                points = laspy.ScaleAwarePointRecord.zeros(len(found.xyz), header=header)
                points.x, points.y, points.z = found.xyz.T
                writer.write_points(points)
                polygons.append(found.parcels)
        pd.concat(polygons).to_file(boundary, layer="parcels")
        draft.replace(cloud)
    return {"cloud": str(cloud), "boundaries": str(boundary)}


def reading(cloud: str) -> dict[str, Any]:
    """Seconds of plain laspy until the coordinates are there, best of three."""
    import laspy

    seconds, points = best(lambda: len(np.asarray(laspy.read(cloud).xyz)))
    return {"points": points, "seconds": seconds}


def best(function: Callable[[], T], *, turns: int = TURNS) -> tuple[float, T]:
    """Least seconds that a function takes in a few turns, and what it returns; the first turn warms it up."""
    seconds = []
    for _ in range(turns):
        began = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - began)
    return min(seconds), result


def high_water(*, status: Path = Path("/proc/self/status"), reset: Path = Path("/proc/self/clear_refs")) -> int | None:
    """Most memory (bytes) that this process has held since the last call; None where the system doesn't tell."""
    try:
        kilobytes = next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        reset.write_text("5")
    except (OSError, StopIteration):
        return None
    return int(kilobytes) * 1024


def peaks(cloud: str, boundary: str, out: str) -> dict[str, int | None]:
    """Most memory (bytes) that every stage of a run holds, and what lies between them ("other")."""
    from vinemap.parcel import map_parcel

    held: dict[str, int | None] = {}

    def note(name: str) -> None:
        now = high_water()
        held[name] = None if now is None else max(now, held.get(name) or 0)

    def step(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        note("other")
        result = function(*args, **kwargs)
        note(name)
        return result

    map_parcel(Path(cloud), Path(out), parcel="F", named=False, boundary=Path(boundary), step=step)
    note("other")
    return held


def ground(cloud: str, boundary: str, millions: float) -> dict[str, str]:
    """The cloth simulation filter, and a raster of its ground points, beside the terrain model."""
    import CSF
    import shapely

    from vinemap.geo.boundaries import read_boundary
    from vinemap.geo.raster import sample

    xyz, found = mapped(cloud, boundary)

    def filtered() -> Array:
        csf = CSF.CSF()
        csf.params.cloth_resolution = 0.5
        csf.params.class_threshold = 0.2
        csf.params.rigidness = 2
        csf.params.bSloopSmooth = True
        csf.setPointCloud(xyz)
        inside, outside = CSF.VecInt(), CSF.VecInt()
        csf.do_filtering(inside, outside, False)  # noqa: FBT003 - it knows no keywords
        soil: Array = xyz[np.array(inside)]
        return soil

    before = held_now()
    filtering, soil = best(filtered)
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


def rasterised(soil: Array, like: Raster) -> Raster:
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

    from vinemap.evaluate.rows import evaluate_rows
    from vinemap.geo.lines import read_lines
    from vinemap.geo.raster import sample

    xyz, found = mapped(cloud, boundary)
    heights = xyz[:, 2] - sample(found.dtm, xyz[:, :2])
    canopy = xyz[(heights > CANOPY[0]) & (heights < CANOPY[1]), :2]

    def clustered() -> tuple[Array, NDArray[np.intp]]:
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


def course(xy: Array, *, step: float = 2.0) -> shapely.LineString | None:
    """Line through a cluster (n, 2): the middles of pieces of ``step`` m along its longest axis, None of no length."""
    import shapely

    middle = xy.mean(axis=0)
    axes = np.linalg.svd(np.cov((xy - middle).T))[0]
    along, across = (xy - middle) @ axes.T[0], (xy - middle) @ axes.T[1]
    start, end = along.min(), along.max()
    if end - start < step:
        return None
    pieces = max(round((end - start) / step), 1)
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
    from vinemap.config.settings import PolygonOptions, Settings
    from vinemap.parcel import model_canopies

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
    mine, ours = best(lambda: enclose(flat, start, feet, c=c, share=0.0, slide=True))
    other, theirs = best(lambda: [cv2.approxPolyN(ring, c) for ring in rings])
    area = np.array([cv2.contourArea(ring) for ring in theirs])
    return {
        "tool": f"approxPolyN of OpenCV {version('opencv-python-headless')}: {c} vertices",
        "seconds": f"{1e6 * other / len(hulls):.1f} µs a section, one core",
        "result": f"{100 * np.mean(area / ours.area):.1f}% of our area on the mean, {len(hulls):,} sections, feet free",
        "ours": "100%, stands on its feet",
        "our_seconds": f"{1e6 * mine / len(hulls):.1f} µs a section, all cores",
    }


def mapped(cloud: str, boundary: str) -> tuple[Array, RowMap]:
    """Points (n, 3) of a parcel, and its rows as they come."""
    from vinemap.cloud.las import read_cloud
    from vinemap.config.settings import Settings
    from vinemap.geo.boundaries import read_boundary
    from vinemap.parcel import map_rows

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


OURS = survey, estate, reading, peaks
INSTEAD = ground, rows, polygons
JOBS: Mapping[str, Callable[..., dict[str, Any]]] = {job.__name__: job for job in OURS + INSTEAD}


def main(name: str, result: str, arguments: str) -> None:
    """Do a job with arguments given as JSON, and leave what it returns in a file as JSON."""
    job = JOBS[name]
    if job in INSTEAD:
        limit_memory()
    try:
        Path(result).write_text(json.dumps(job(**json.loads(arguments))), encoding="utf-8")
    except MemoryError:
        sys.exit(f"wants more than {MEMORY:.0%} of this machine's memory")


def limit_memory() -> None:
    """Let what wants too much memory fail, rather than take the machine down."""
    most = int(MEMORY * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


if __name__ == "__main__":
    main(*sys.argv[1:])
