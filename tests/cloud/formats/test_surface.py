"""Surface models are clouds of a point a pixel, seen from above."""

import json

import formats
import geopandas as gpd
import numpy as np
import pytest
import rasterio
import shapely
from lasfiles import in_order
from pyproj import CRS

from vinemap.cloud.formats import surface
from vinemap.cloud.las import read_cloud
from vinemap.errors import EmptyError, InputError
from vinemap.parcel import map_parcel

UTM = CRS.from_epsg(32632)


def test_a_surface_model_is_a_point_a_pixel(tmp_path):
    xyz = np.array([[0.1, 0.1, 5], [0.1, 0.1, 6], [0.6, 0.1, 7], [0.1, 0.6, 8]]) + [414_700, 4_940_700, 0]
    path = formats.write_surface(tmp_path / "a.tif", xyz, UTM, resolution=0.5)
    cloud = read_cloud(path)
    assert cloud.crs == UTM
    assert in_order(cloud.xyz - [414_700, 4_940_700, 0]).tolist() == [[0.25, 0.25, 6], [0.75, 0.25, 7], [0.25, 0.75, 8]]
    part = read_cloud(path, boundary=(shapely.box(414_700.1, 4_940_700.1, 414_700.4, 4_940_700.4), UTM))
    assert part.xyz[:, 2].tolist() == [6]
    with rasterio.open(path, "r+") as raster:
        raster.nodata = None
    assert np.array_equal(read_cloud(path).xyz, cloud.xyz)


@pytest.mark.parametrize(
    ("unit", "crs", "corner", "metres"),
    [("ft", 32632, (414_700, 4_940_700, 0), 0.3048), ("metre", 2226, (6_475_000, 1_907_000, 0), 1.0)],
)
def test_heights_of_a_surface_model_are_in_the_unit_that_it_states(tmp_path, unit, crs, corner, metres):
    xyz = np.array([[0.1, 0.1, 600], [0.6, 0.1, 700]]) + corner
    path = formats.write_surface(tmp_path / "a.tif", xyz, CRS.from_epsg(crs), resolution=0.5)
    with rasterio.open(path, "r+") as raster:
        raster.units = (unit,)
    assert sorted(read_cloud(path).xyz[:, 2]) == pytest.approx([600 * metres, 700 * metres])
    given = read_cloud(path, crs=CRS.from_user_input(f"EPSG:{crs}+6360"))
    assert sorted(given.xyz[:, 2]) == pytest.approx([600 * 1200 / 3937, 700 * 1200 / 3937])


def test_zeros_of_a_surface_model_are_land_only_beside_land_at_sea_level(tmp_path):
    xyz = np.array([[0.1, 0.1, 0.0], [0.6, 0.1, 0.0], [0.1, 0.6, 8], [0.6, 0.6, 3]]) + [414_700, 4_940_700, 0]
    assert len(read_cloud(formats.write_surface(tmp_path / "a.tif", xyz, UTM, resolution=0.5)).xyz) == 4
    xyz[2:, 2] += 400
    inland = read_cloud(formats.write_surface(tmp_path / "b.tif", xyz, UTM, resolution=0.5))
    assert sorted(inland.xyz[:, 2]) == [403, 408]


def test_what_zeros_are_is_decided_for_the_whole_raster(tmp_path, monkeypatch):
    """Pixels at its edge, blended with the zeros about it, don't make land of these."""
    monkeypatch.setattr(surface, "CHUNK", 400)
    heights = np.full((40, 20), 400.0, np.float32)
    heights[:20], heights[19, :3] = 0, 5
    cloud = read_cloud(write_raster(tmp_path / "a.tif", heights))
    assert np.unique(cloud.xyz[:, 2], return_counts=True)[1].tolist() == [3, 400]


@pytest.mark.parametrize("filling", [-999, -99, 0, 9999])
def test_what_fills_a_raster_up_without_saying_so_is_no_land(tmp_path, filling):
    heights = np.full((40, 20), 400, np.float32)
    heights[:20] = filling
    heights[20:, :10] = np.linspace(380, 410, 200).reshape(20, 10)
    assert read_cloud(write_raster(tmp_path / "a.tif", heights)).size == 400
    heights[:20] = 375  # a lake
    assert read_cloud(write_raster(tmp_path / "a.tif", heights)).size == 800


@pytest.mark.parametrize("unit", [0.01, 0.001])
def test_heights_in_small_units_that_are_not_stated_are_refused(tmp_path, unit):
    heights = np.round(np.linspace(400, 410, 100) / unit).astype(np.int32).reshape(10, 10)
    path = write_raster(tmp_path / "a.tif", heights)
    with pytest.raises(InputError, match=rf"a\.tif: its heights are {400 / unit:.0f} and more: export them in metres"):
        read_cloud(path)
    with rasterio.open(path, "r+") as raster:
        raster.scales = (unit,)
    assert read_cloud(path).xyz[:, 2].min() == pytest.approx(400)
    with pytest.raises(EmptyError):
        read_cloud(write_raster(tmp_path / "a.tif", np.full((10, 10), 65_535, np.uint16)))


def test_heights_in_whole_metres_are_told(tmp_path):
    heights = np.random.default_rng(0).uniform(400, 410, (40, 40))
    assert not [said for said in remarks_of(tmp_path, heights) if "steps" in said]
    assert not [said for said in remarks_of(tmp_path, heights.round(1)) if "steps" in said]
    for step, scale in ((1, 1), (0.3, 0.3048)):
        said = f"a.tif has heights in steps of {step} m, in which canopies hardly show: export it with decimals"
        assert said in remarks_of(tmp_path, np.round(heights / scale) * scale)


def remarks_of(folder, heights):
    return read_cloud(write_raster(folder / "a.tif", heights.astype(np.float32))).remarks


def write_raster(path, heights):
    how = {"driver": "GTiff", "count": 1, "dtype": heights.dtype.name, "crs": UTM.to_wkt()}
    how |= {"height": heights.shape[0], "width": heights.shape[1]}
    with rasterio.open(path, "w", transform=rasterio.Affine(0.1, 0, 414_700, 0, -0.1, 4_940_700), **how) as raster:
        raster.write(heights, 1)
    return path


def test_a_picture_is_no_surface_model(tmp_path):
    path = write_raster(tmp_path / "a.tif", np.full((4, 4), 200, np.uint8))
    with pytest.raises(InputError, match=r"a\.tif: is a picture of 256 greys: give the surface model itself"):
        read_cloud(path)


def test_a_photograph_is_no_surface_model(tmp_path):
    how = {"driver": "GTiff", "count": 3, "dtype": "uint8", "width": 4, "height": 4, "crs": UTM.to_wkt()}
    with rasterio.open(tmp_path / "a.tif", "w", transform=rasterio.Affine(1, 0, 0, 0, -1, 9), **how):
        pass
    with pytest.raises(InputError, match=r"a\.tif: is a photograph, or several rasters in one"):
        read_cloud(tmp_path / "a.tif")


def test_rows_of_a_surface_model(tmp_path, vineyard):
    """They are where they are and as high as they are; what it doesn't show isn't told."""
    path = formats.write_surface(tmp_path / "dsm.tif", vineyard.xyz, UTM, resolution=0.08)
    summary = map_parcel([path], tmp_path / "A", parcel="A")
    rows = gpd.read_file(tmp_path / "A" / "A.gpkg", layer="rows")
    truth = vineyard.rows.geometry
    nearest = [
        int(truth.distance(shapely.line_interpolate_point(line, 0.5, normalized=True)).argmin())
        for line in rows.geometry
    ]
    assert sorted(nearest) == list(range(6))
    for line, k in zip(rows.geometry, nearest, strict=True):
        assert shapely.hausdorff_distance(shapely.force_2d(line), shapely.force_2d(truth.iloc[k])) < 0.2
    assert np.abs(rows["height_m"] - vineyard.rows["mean_height"].to_numpy()[nearest]).max() < 0.1
    assert rows[["bottom_m", "lwa_m2_ha"]].isna().all(axis=None)
    assert any("dsm.tif is a surface model" in warning for warning in summary.warnings)
    assert json.loads((tmp_path / "A" / "run.json").read_text())["settings"]["polygon"]["foot"] == "soil"
