"""Grids, binning, sampling and GeoTIFF."""

import numpy as np
import pytest
import rasterio
from pyproj import CRS

from vinemap.errors import InputError
from vinemap.raster import Grid, Raster, cell_of, coarser, extent, grid_over, sample, write_cog

UTM = CRS.from_epsg(32632)


def test_grid_holds_its_points():
    xy = np.random.default_rng(0).uniform([1000.3, 2000.7], [1010.9, 2005.2], (500, 2))
    grid = grid_over(*extent(xy), resolution=0.5)
    cells = cell_of(xy, grid)
    assert cells.max() < grid.ny * grid.nx
    x, y = grid.centres()
    i, j = np.divmod(cells, grid.nx)
    assert np.abs(x[j] - xy[:, 0]).max() <= 0.25 + 1e-9
    assert np.abs(y[i] - xy[:, 1]).max() <= 0.25 + 1e-9


def test_grid_of_a_single_point():
    assert grid_over([5.0, 7.0], [5.0, 7.0], resolution=0.25).shape == (1, 1)


def test_too_large_a_grid_says_what_to_do():
    with pytest.raises(InputError, match="--boundary"):
        grid_over([0.0, 0.0], [1e5, 1e5], resolution=0.1)


def test_coarser_grid_covers_the_same_area():
    fine = Grid(10.0, 20.0, 0.1, 101, 57)
    wide = coarser(fine, resolution=0.5)
    assert wide.shape == (21, 12)
    assert (wide.west, wide.north) == (10.0, 20.0)


def test_bilinear_sampling_is_exact_on_a_plane():
    grid = Grid(100.0, 50.0, 0.5, 40, 60)
    x, y = np.meshgrid(*grid.centres())
    raster = Raster(2 * x - 3 * y + 1, grid, UTM)
    xy = np.random.default_rng(1).uniform([101, 32], [129, 49], (200, 2))
    assert np.allclose(sample(raster, xy), 2 * xy[:, 0] - 3 * xy[:, 1] + 1)


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
