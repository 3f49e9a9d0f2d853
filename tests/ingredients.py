"""Small clouds and polygons that products are made of."""

from datetime import UTC, datetime

import geopandas as gpd
import laspy
import numpy as np
import shapely

from vinemap.geo.crs import parse_crs

PLACE = np.array([414_700.0, 4_940_700.0])


def write_las(path, *, seed=0, date=datetime(2024, 6, 1, tzinfo=UTC)):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = [*PLACE, 0]
    header.creation_date = date
    header.add_crs(parse_crs("EPSG:32632"))
    las = laspy.LasData(header)
    las.xyz = np.random.default_rng(seed).uniform([*PLACE, 0], [*(PLACE + 20), 2], (50, 3))
    las.write(path)
    return path


def write_polygons(path, names, *, crs=32632, grow=0.0):
    squares = [shapely.box(*(PLACE + 20 * k), *(PLACE + 20 * k + 15)).buffer(grow) for k in range(len(names))]
    gpd.GeoDataFrame({"name": names}, geometry=squares, crs=32632).to_crs(crs).to_file(path)
    return path
