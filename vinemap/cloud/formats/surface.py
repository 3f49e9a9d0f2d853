"""Surface models: a raster of the highest surface, as photogrammetry leaves it, each pixel a point."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap.cloud.formats.box import EVERYWHERE, box_about
from vinemap.cloud.formats.told import CHUNK, Header, Points, reading, unit_of, usable
from vinemap.errors import InputError
from vinemap.geo.crs import vertical, vertical_unit
from vinemap.geo.place import doubts_of_heights
from vinemap.geo.stated import crs_of, step_of

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence
    from pathlib import Path

    from pyproj import CRS

    from vinemap.cloud.formats.box import Box
    from vinemap.compute.arrays import Flags, Floats, Values
    from vinemap.geo.boundaries import Boundary

LOWEST, HIGHEST = -1_000.0, 30_000.0
"""Metres or feet between which all land lies: what is beyond stands for nothing."""
SMALLEST = 0.001
"""Metres of the smallest unit in which heights may be stored as whole numbers."""
NEAR = 10.0
"""Metres or feet from a height beyond which land lies where that stands for nothing, as 0 in rasters without nodata."""
NEAREST = 0.01
"""Share of the land's pixels that may lie nearer, as those blended with the filling do."""
MANY = 10
"""Pixels of the lowest or the highest height, and other heights beside it, from which on it may stand for nothing."""
LOOKED_AT = 32
"""Lines of a raster that tell both, evenly over it."""
COARSE = 0.2
"""Metres of a step in heights from which on canopies are hardly more than one."""


def read_surface(path: Path, crs: CRS | None, around: Boundary | None) -> Points:
    """Open a surface model as GeoTIFF, or that part of it which lies about a polygon.

    Raises
    ------
    InputError
        If it is none, is a photograph or a picture of one, or has heights as no land has.
    """
    import rasterio
    from rasterio.enums import ColorInterp

    if not path.is_file():
        raise InputError(f"{path}: no such file")
    with reading(path, "GeoTIFF"), rasterio.open(path) as raster:
        if raster.count - (ColorInterp.alpha in raster.colorinterp) != 1:
            raise InputError(f"{path}: is a photograph, or several rasters in one: give the surface model alone")
        if raster.dtypes[0] == "uint8":
            raise InputError(f"{path}: is a picture of 256 greys: give the surface model itself, as heights")
        if raster.transform.is_identity:
            raise InputError(f"{path}: has no place: export the surface model as GeoTIFF, with its coordinates")
        corners = _placed(raster, np.array([0, 0, raster.height, raster.height]), np.array([0, raster.width] * 2))
        header = Header(
            raster.crs.to_wkt() if raster.crs else "",
            np.append(corners.min(axis=0), np.nan),
            np.append(corners.max(axis=0), np.nan),
            point_count=raster.width * raster.height,
        )
        unit = unit_of(raster.units[0] or "")
        some = _some_heights(raster, path)
    remark = (
        f"{path.name} is a surface model, which shows canopies from above alone: their meshes reach down to the soil, "
        "where foliage begins isn't known (bottom_m, lwa_m2_ha), and volumes are of what was seen"
    )
    source = crs_of(header, crs, path)
    size = unit / vertical_unit(source) if unit and not vertical(source) else 1.0
    step = step_of(some) * size * vertical_unit(source)
    coarse = f"{path.name} has heights in steps of {step:.2g} m, in which canopies hardly show: export it with decimals"
    remarks = remark, *([coarse] if step > COARSE else []), *(() if unit else doubts_of_heights(source))
    box = box_about(around, source) if around else EVERYWHERE
    chunks = _read(path, box, size, blanks=_blanks(some))
    return Points(header, chunks, remarks, steps=False)


def _some_heights(raster: Any, path: Path) -> Floats:
    """Heights (n,) along some lines of a raster, which mustn't all be beyond any land, though numbers of some unit."""
    rows = np.unique(np.linspace(0, raster.height - 1, LOOKED_AT).round().astype(int))
    lines = [_heights(raster, row, 1, 0, raster.width) for row in rows.tolist()]
    some = np.concatenate([heights[seen] for heights, seen in lines])
    beyond = np.concatenate([heights[(heights >= HIGHEST) & (heights < HIGHEST / SMALLEST)] for heights, _ in lines])
    if len(some) == 0 and len(np.unique(beyond)) > 1:
        raise InputError(
            f"{path}: its heights are {beyond.min():.0f} and more: export them in metres, or state their scale"
        )
    return some


def _blanks(some: Floats) -> list[float]:
    """Heights among some (n,) of a raster that stand for nothing: 0, the lowest or the highest, far from all others."""
    land = some[some != 0]
    blanks = [] if len(land) and _is_near(land, 0.0) else [0.0]
    land = land if blanks else some
    for end in (land.min(), land.max()) if len(land) else ():
        others = land[land != end]
        if len(land) - len(others) >= MANY <= len(np.unique(others)) and not _is_near(others, end):
            blanks.append(float(end))
    return blanks


def _is_near(land: Floats, height: float) -> bool:
    """Whether heights (n,) of land are about one that may stand for nothing."""
    return bool(np.quantile(np.abs(land - height), NEAREST) <= NEAR)


def _read(path: Path, box: Box, size: float, *, blanks: Sequence[float]) -> Generator[Floats]:
    """Points (n, 3) of what meets a box, chunk by chunk, without heights that stand for nothing.

    ``size`` is that of the raster's unit in that of heights.
    """
    import rasterio

    with rasterio.open(path) as raster:
        first, last, left, right = _part(raster, box)
    rows = max(1, CHUNK // max(1, right - left))
    for row in range(first, last, rows):
        with rasterio.open(path) as raster:  # anew, as GDAL keeps to the thread that opened it
            heights, seen = _heights(raster, row, min(rows, last - row), left, right - left)
            i, j = np.nonzero(seen & ~np.isin(heights, blanks))
            xyz = np.column_stack([_placed(raster, i + row + 0.5, j + left + 0.5), heights[i, j] * size])
        yield usable(xyz)


def _heights(raster: Any, row: int, rows: int, column: int, columns: int) -> tuple[Floats, Flags]:
    """Heights of some rows and columns, and which of them are some."""
    from rasterio.windows import Window

    window = Window(column, row, columns, rows)
    heights = raster.read(1, window=window).astype(float) * raster.scales[0] + raster.offsets[0]
    heights[raster.read_masks(1, window=window) == 0] = np.nan
    return heights, (heights > LOWEST) & (heights < HIGHEST)


def _placed(raster: Any, rows: Values, columns: Values) -> Floats:
    """Coordinates (n, 2) of places in a raster."""
    t = raster.transform
    return np.column_stack([t.c + t.a * columns + t.b * rows, t.f + t.d * columns + t.e * rows])


def _part(raster: Any, box: Box) -> tuple[int, int, int, int]:
    """First and last + 1 of the rows and of the columns that meet a box."""
    if not np.isfinite(box[0][:2]).all():
        return 0, raster.height, 0, raster.width
    (west, south), (east, north) = box[0][:2], box[1][:2]
    t = raster.transform
    away = np.array([[west, west, east, east], [south, north, south, north]]) - [[t.c], [t.f]]
    columns, rows = np.linalg.solve([[t.a, t.b], [t.d, t.e]], away)
    first, left = (max(0, int(np.floor(side.min()))) for side in (rows, columns))
    return first, min(raster.height, int(rows.max()) + 1), left, min(raster.width, int(columns.max()) + 1)
