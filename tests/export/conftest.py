"""A parcel and its exports, which several tests share."""

import geopandas as gpd
import numpy as np
import pytest
import shapely
from exported import NAME

from vinemap.export import FORMATS
from vinemap.export.lanes import lanes_between
from vinemap.export.write import export_products
from vinemap.parcel import map_parcel
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate, write_survey
from vinemap.simulate.terrain import hillside


@pytest.fixture(scope="session")
def product(tmp_path_factory):
    """A parcel of two blocks: four rows on arcs, and three straight ones across their end."""
    place = np.mean(rows_of(1)[0], axis=0)
    arcs = rows_of(4, length=30, radius=45, azimuth=20)
    rows = [*arcs, *rows_of(3, length=16, azimuth=110, centre=tuple(place + [28, 0]))]
    survey = simulate([Vineyard(NAME, rows)], hillside(0.15), name="small", density=200, seed=3)
    cloud = write_survey(survey, tmp_path_factory.mktemp("in"))
    folder = tmp_path_factory.mktemp("products") / NAME
    map_parcel(cloud, folder, parcel=NAME, boundary=cloud.with_name("parcels.gpkg"))
    return folder


@pytest.fixture(scope="session")
def rows(product):
    return gpd.read_file(product / f"{NAME}.gpkg", layer="rows")


@pytest.fixture(scope="session")
def lanes(rows):
    lanes = lanes_between(rows)
    assert lanes["block"].tolist() == [1, 1, 1, 2, 2]
    return lanes


@pytest.fixture(scope="session")
def outline(product):
    return shapely.get_parts(gpd.read_file(product / f"{NAME}.gpkg", layer="parcel").geometry.to_numpy())[0]


@pytest.fixture(scope="session")
def exported(product, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    line, table = export_products([product], out, formats=FORMATS, lines="both")
    assert line.startswith(f"{NAME}: 7 rows, 5 lanes → ")
    assert table.startswith("table: 7 lines of rows, 0 lines of vines (csv")
    return out / NAME
