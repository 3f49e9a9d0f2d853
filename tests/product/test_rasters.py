"""Rasters as Cloud Optimized GeoTIFF."""

import numpy as np
import rasterio
from pyproj import CRS

from vinemap.geo.raster import Grid, Raster
from vinemap.product.rasters import write_cog

UTM = CRS.from_epsg(32632)


def test_cog_keeps_values_nodata_units_and_place(tmp_path):
    values = np.arange(300 * 700, dtype=float).reshape(300, 700)
    values[5, 7] = np.nan
    write_cog(
        Raster(values, Grid(414000.0, 4940000.0, 0.25, 300, 700), UTM),
        tmp_path / "x.tif",
        description="terrain",
        unit="m",
    )
    with rasterio.open(tmp_path / "x.tif") as src:
        assert src.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert src.crs.to_epsg() == 32632
        assert src.units == ("m",)
        assert src.descriptions == ("terrain",)
        assert src.overviews(1)
        read = src.read(1, masked=True)
        assert read.mask.sum() == 1
        assert read.mask[5, 7]
        assert src.transform.c == 414000.0
        assert src.transform.f == 4940000.0
        assert np.array_equal(read.compressed(), values[np.isfinite(values)].astype(np.float32))
