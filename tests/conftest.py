"""Small vineyards that several tests share."""

from pathlib import Path

import pytest

from vinemap.cloud import PointCloud
from vinemap.crs import parse_crs
from vinemap.scenes import hillside, rows_of
from vinemap.synthetic import Vineyard, simulate

SHARED = Path(__file__).parents[2] / "shared"


@pytest.fixture(scope="session")
def vineyard():
    """Six rows of 25 m, 2.5 m apart, at 33° from east on a slope of 15%, with two runs of missing vines."""
    plots = Vineyard("A", rows_of(6, length=25, azimuth=33), gaps=(3, 4))
    return simulate([plots], hillside(0.15), name="small", density=350, seed=3)


@pytest.fixture(scope="session")
def cloud(vineyard):
    return PointCloud(vineyard.xyz, parse_crs("EPSG:32632"))


@pytest.fixture(scope="session")
def shared():
    """The folder of shared surveys, where there is one."""
    if not (SHARED / "surveys").is_dir():
        pytest.skip("needs the shared surveys, which are not on this machine")
    return SHARED
