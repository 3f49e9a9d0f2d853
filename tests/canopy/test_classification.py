"""Classes and rows of a cloud's points."""

from dataclasses import replace
from datetime import UTC, datetime

import laspy
import numpy as np
import pytest

from vinemap.canopy.classification import CANOPY, GROUND, NOISE, OTHER, classify_points
from vinemap.canopy.model import find_canopies
from vinemap.chain import map_rows
from vinemap.cloud.files import date_of
from vinemap.cloud.points import PointCloud
from vinemap.cloud.write import write_classified
from vinemap.config.settings import Settings
from vinemap.geo.crs import horizontal, parse_crs, vertical_name

FLOWN = datetime(2024, 6, 1, tzinfo=UTC)


@pytest.fixture(scope="module")
def classified(cloud):
    """The vineyard with ten flyers far from all else, classified."""
    middle = cloud.xyz.mean(axis=0)
    flyers = middle + np.column_stack([np.linspace(-9, 9, 10), np.linspace(9, -9, 10), np.full(10, 12.0)])
    flown = PointCloud(np.concatenate([cloud.xyz, flyers]), cloud.crs)
    found = map_rows(flown, Settings())
    leaves = [canopy.sections for canopy in find_canopies(found.cloud, found.rows, found.gaps, found.dtm, Settings())]
    return flown, found, *classify_points(found.cloud, leaves)


def test_ground_canopy_and_noise(classified, vineyard):
    flown, found, classes, _ = classified
    assert set(classes) == {OTHER, GROUND, CANOPY, NOISE}
    assert (classes[-10:] == NOISE).all()
    assert (classes == NOISE).mean() < 0.005
    x, y, z = flown.xyz.T
    above = z - vineyard.terrain(x, y)
    assert np.abs(above[classes == GROUND]).max() < 0.2
    assert (classes[np.abs(above) < 0.05] == GROUND).mean() > 0.98
    assert above[classes == CANOPY].min() > 0.3
    # Nearly all that stands in the rows is canopy.
    tall = (above > 0.7) & (above < 2.3)
    assert (classes[tall] == CANOPY).mean() > 0.93
    assert len(found.rows) == 6


def test_canopy_knows_its_row(classified, vineyard):
    flown, _, classes, row_id = classified
    assert (row_id[classes != CANOPY] == 0).all()
    assert set(row_id[classes == CANOPY]) == {1, 2, 3, 4, 5, 6}
    for row, line in zip(vineyard.rows["row"], vineyard.rows.geometry, strict=True):
        points = flown.xyz[row_id == row, :2]
        (ax, ay, _), (bx, by, _) = line.coords[0], line.coords[-1]
        off = np.abs((bx - ax) * (points[:, 1] - ay) - (by - ay) * (points[:, 0] - ax)) / np.hypot(bx - ax, by - ay)
        assert off.max() < 1.0


def test_a_cloud_without_canopy(cloud):
    flat = PointCloud(cloud.xyz[:1000] * [1, 1, 0], cloud.crs)
    found = map_rows(flat, Settings())
    leaves = [canopy.sections for canopy in find_canopies(found.cloud, found.rows, found.gaps, found.dtm, Settings())]
    classes, row_id = classify_points(found.cloud, leaves)
    assert (classes == GROUND).all()
    assert (row_id == 0).all()


def test_file_read_back(classified, tmp_path):
    flown, found, classes, row_id = classified
    path = tmp_path / "classified.laz"
    write_classified(found.cloud, lambda part: (classes, row_id), path, flown=FLOWN)
    back = laspy.read(path)
    assert np.abs(back.xyz - flown.xyz).max() < 0.001
    assert (np.asarray(back.classification) == classes).all()
    assert (np.asarray(back["row_id"]) == row_id).all()
    assert np.abs(np.asarray(back["HeightAboveGround"]) - found.cloud.heights).max() < 1e-4
    assert back.header.parse_crs().to_epsg() == 32632
    assert date_of(path) == FLOWN


@pytest.mark.parametrize(
    "vertical", [None, "EGM96 height", "ellipsoidal height", "the harbour's", "Poolbeg height (ft(Br36))"]
)
@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:3003", "local"])
def test_the_datum_of_heights_is_kept(classified, tmp_path, crs, vertical):
    """As far as PROJ knows it; local coordinates have none."""
    _, found, classes, row_id = classified
    path = tmp_path / "classified.laz"
    part = replace(found.cloud, crs=parse_crs(crs), vertical=vertical)
    write_classified(part, lambda part: (classes, row_id), path, flown=FLOWN)
    back = laspy.read(path).header.parse_crs()
    assert horizontal(back) == part.crs
    known = crs != "local" and vertical in ("EGM96 height", "ellipsoidal height")
    assert vertical_name(back) == (vertical if known else None)
