"""Small vineyards that several tests share."""

import struct
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from lasfiles import write_each
from products import map_here

from vinemap.cloud.points import PointCloud
from vinemap.config.surveys import survey_config
from vinemap.geo.crs import parse_crs
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate, write_survey
from vinemap.simulate.terrain import hillside

SHARED = Path(__file__).parents[2] / "shared"
ORDER = ["test_parcel.py", "odometry", "config", "simulate", "jobs", "flows", "cli", "measure"]
"""Files and folders that come first: one that compiles all loops, what needs none of them meanwhile, and the slow ones.

So no two processes compile the same, and at the end neither waits long for the other.
"""


def pytest_collection_modifyitems(items):
    ranks = {name: k for k, name in enumerate(ORDER)}
    items.sort(key=lambda item: min(ranks.get(name, len(ORDER)) for name in (item.path.name, item.path.parent.name)))


@pytest.fixture(scope="session")
def vineyard():
    """Six rows of 25 m, 2.5 m apart, at 33° from east on a slope of 15%, with two runs of missing vines."""
    plots = Vineyard("A", rows_of(6, length=25, azimuth=33), gaps=(3, 4))
    return simulate([plots], hillside(0.15), name="small", density=350, seed=3)


@pytest.fixture(scope="session")
def survey(vineyard, tmp_path_factory):
    """The same as a file, with its polygons and its truth beside it."""
    return write_survey(vineyard, tmp_path_factory.mktemp("survey"))


@pytest.fixture(scope="session")
def cloud(vineyard):
    return PointCloud(vineyard.xyz, parse_crs("EPSG:32632"))


@pytest.fixture(scope="session")
def shared():
    """The folder of shared surveys, where there is one."""
    if not (SHARED / "surveys").is_dir():
        pytest.skip("needs the shared surveys, which are not on this machine")
    return SHARED


@pytest.fixture(scope="session")
def clouds(tmp_path_factory):
    """A whole file of each kind."""
    return write_each(tmp_path_factory.mktemp("clouds"))


@pytest.fixture(scope="session")
def three(tmp_path_factory):
    """Three small parcels; in ``more.gpkg`` beside them one that shares its points with A, and one without any."""
    place = np.mean(rows_of(1)[0], axis=0)
    plots = [
        Vineyard("A", rows_of(4, length=20, azimuth=33)),
        Vineyard("B", rows_of(4, length=15, centre=tuple(place + [40, 0]))),
        Vineyard("C", rows_of(5, length=18, azimuth=90, centre=tuple(place + [0, 40]))),
    ]
    survey = simulate(plots, hillside(0.1), name="three", density=200, seed=1)
    path = write_survey(survey, tmp_path_factory.mktemp("survey"))
    polygons = survey.parcels[["name", "geometry"]]
    shapes = [*polygons.geometry, polygons.geometry[0].buffer(-2), shapely.box(0, 0, 9, 9)]
    names = [*polygons["name"], "inner A", "empty"]
    gpd.GeoDataFrame({"name": names}, geometry=shapes, crs=polygons.crs).to_file(path.with_name("more.gpkg"))
    return path


@pytest.fixture(scope="session")
def flights(tmp_path_factory):
    """Folder of the products of two surveys, ``june`` and ``september``, of a vineyard that changes between them.

    Of A's six places for rows the last but one is planted by September and the second is no more; the canopies have
    grown by 0.2 m, and the later flight lies 0.4 m to the west and 0.3 m to the north of the earlier. There are a
    parcel of one row, a meadow, and in September a parcel that isn't there.
    """
    folder = tmp_path_factory.mktemp("flights")
    place = np.mean(rows_of(1)[0], axis=0)
    for name, day, year, kept, height, shift in (
        ("june", 169, 2026, (0, 1, 2, 3, 5), 1.8, (0.4, -0.3)),
        ("september", 257, 2026, (0, 2, 3, 4, 5), 2.0, (0.0, 0.0)),
    ):
        at = place + shift
        rows = rows_of(6, length=22, azimuth=33, centre=tuple(at))
        plots = [
            Vineyard("A", [rows[k] for k in kept], height=height, dead=0.0, gaps=(3,)),
            Vineyard("one", rows_of(1, length=15, centre=tuple(at + [35, 0])), height=height),
            Vineyard("meadow", (), outline=shapely.box(*(at + [25, 15]), *(at + [45, 30]))),
        ]
        path = write_survey(simulate(plots, hillside(0.1), name=name, density=130, seed=2), folder / "in" / name)
        with path.open("r+b") as cloud:  # the date in its header
            cloud.seek(90)
            cloud.write(struct.pack("<HH", day, year))
        parcels = ["A", "one", "meadow", *(["nobody's"] if name == "september" else [])]
        config = survey_config(survey=name, cloud=path, boundaries=path.with_name("parcels.gpkg"), parcels=parcels)
        map_here(config, folder / "products" / name)
    return folder / "products"
