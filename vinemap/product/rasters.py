"""Rasters of a product, as Cloud Optimized GeoTIFF."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from affine import Affine

from vinemap import paths
from vinemap.product.qgis.style import raster_style

if TYPE_CHECKING:
    from pathlib import Path

    from vinemap.geo.raster import Raster
    from vinemap.surfaces.waves import RowField

NODATA = -9999.0
RASTERS = {
    "dtm": ("Terrain elevation", "m"),
    "chm": ("Height above terrain", "m"),
    "row_direction": ("Row direction, anticlockwise from east", "degree"),
    "row_spacing": ("Inter-row spacing", "m"),
    "vineyard_likelihood": ("Vineyard likelihood", "1"),
}
"""Rasters of a product: what they hold, and its unit."""


def write_cog(raster: Raster, path: Path, *, description: str, unit: str, resampling: str = "average") -> None:
    """Write a float32 Cloud Optimized GeoTIFF with nodata, overviews, description and unit of its band.

    ``resampling`` makes the overviews: angles have no average, so they want "nearest".

    Raises
    ------
    OSError
        If it can't be written.
    """
    import rasterio  # half a second of start-up, needed only here
    from rasterio.io import MemoryFile
    from rasterio.shutil import copy

    grid = raster.grid
    values = np.where(np.isfinite(raster.values), raster.values, NODATA).astype(np.float32)
    profile = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": 1,
        "height": grid.ny,
        "width": grid.nx,
        "nodata": NODATA,
        "crs": raster.crs.to_wkt(),
        "transform": Affine(grid.resolution, 0, grid.west, 0, -grid.resolution, grid.north),
    }
    options = {"compress": "DEFLATE", "predictor": "YES", "blocksize": 256, "overview_resampling": resampling}
    # GDAL writes to memory and Python to the disk, as a full disk would make GDAL talk on the terminal.
    with rasterio.Env(GDAL_PAM_ENABLED=False), MemoryFile() as plain, MemoryFile() as cog:
        with plain.open(**profile) as target:
            target.write(values, 1)
            target.set_band_description(1, description)
            target.set_band_unit(1, unit)
            target.update_tags(AREA_OR_POINT="Area")
        copy(plain.name, cog.name, driver="COG", **options)
        path.write_bytes(cog.read())


def rasters_of(dtm: Raster, chm: Raster, field: RowField) -> dict[str, Raster]:
    """Rasters of a product by their kinds: terrain, canopy height, and what the row field tells."""
    return dict(zip(RASTERS, (dtm, chm, field.direction, field.spacing, field.likelihood), strict=True))


def write_rasters(folder: Path, parcel: str, rasters: dict[str, Raster]) -> None:
    """Write the rasters of a product, each with its colours beside it."""
    for kind, raster in rasters.items():
        description, unit = RASTERS[kind]
        path, resampling = paths.raster(folder, parcel, kind), "nearest" if unit == "degree" else "average"
        write_cog(raster, path, description=description, unit=unit, resampling=resampling)
        paths.raster_style(path).write_text(raster_style(kind, raster.values).qml(), encoding="utf-8")
