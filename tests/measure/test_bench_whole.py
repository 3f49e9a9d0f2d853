"""The whole job by other tools: its steps on rows made by hand."""

import json
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest

from vinemap.measure.bench import whole
from vinemap.measure.bench.whole import above_ground, clustered, soil_at, tops, volumes_of

PLACE = np.array([414_000.0, 4_940_000.0])
TURN = np.radians(25.0)
ALONG, LEFT = np.array([[np.cos(TURN), np.sin(TURN)], [-np.sin(TURN), np.cos(TURN)]])


def three_rows(n=20_000):
    """Points of three rows 20 m long, 0.5 m wide and 1.7 m apart, their heights, and their row."""
    rng = np.random.default_rng(0)
    row = rng.integers(0, 3, n)
    u, v = rng.uniform(0, 20, n), rng.uniform(-0.25, 0.25, n) + 1.7 * row
    return PLACE + u[:, None] * ALONG + v[:, None] * LEFT, rng.uniform(0.6, 1.6, n), row


def test_soil_between_ground_points():
    rng = np.random.default_rng(0)
    xy = PLACE + rng.uniform(0, 20, (40_000, 2))
    z = 300 + (xy - PLACE) @ [0.1, 0.05]
    hidden = np.abs(xy[:, 0] - PLACE[0] - 10) < 0.4
    soil = np.column_stack([xy, z])[~hidden]
    errors = np.abs(soil_at(soil, xy) - z)
    assert np.median(errors) < 0.01
    assert errors.max() < 0.1


def test_rows_stand_out_in_a_raster_of_tops():
    xy, heights, _ = three_rows()
    cells, cell_of, along = tops(xy, heights)
    assert abs(along @ ALONG) > np.cos(np.radians(2))
    assert np.abs(cells[cell_of] - xy).max() <= 0.1 + 1e-6
    assert len(np.unique(cells, axis=0)) == len(cells)


@pytest.mark.skipif(not find_spec("sklearn"), reason="scikit-learn isn't installed: pip install 'vinemap[bench]'")
@pytest.mark.parametrize("clustering", ["HDBSCAN", "DBSCAN"])
def test_cells_of_rows_are_clusters(clustering):
    xy, heights, row = three_rows()
    cells, cell_of, _ = tops(xy, heights)
    labels = clustered(cells, ALONG, clustering)[cell_of]
    assert [len(np.unique(labels[row == k])) for k in range(3)] == [1, 1, 1]
    assert len(np.unique(labels)) == 3


def test_volumes_of_slabs():
    xy, heights, row = three_rows()
    points = np.column_stack([xy @ ALONG, xy, heights])
    row[:3] = -1
    few = np.array([[1e4, *PLACE, 1.0]] * 2)  # make no hull
    volumes = volumes_of(np.vstack([points, few]), np.append(row, [3, 3]), 4)
    assert volumes[:3] == pytest.approx(0.5 * 20, rel=0.2)
    assert volumes[3] == 0


def test_pdal_goes_before_the_cloth(monkeypatch):
    points = np.array([(1.0, 2.0, 3.5, 0.5)], dtype=[(name, float) for name in ("X", "Y", "Z", "HeightAboveGround")])

    class Pipeline:
        arrays = (points, points)

        def __init__(self, stages, arrays):
            assert [stage["type"] for stage in json.loads(stages)] == ["filters.smrf", "filters.hag_nn"]
            assert arrays[0].dtype.names == ("X", "Y", "Z")

        def execute(self):
            pass

    monkeypatch.setattr(whole, "load_pdal", lambda: SimpleNamespace(Pipeline=Pipeline))
    monkeypatch.setattr(whole, "pdal_versions", lambda: {"libpdal": "2.9"})
    xyz, heights, by = above_ground(np.zeros((2, 3)))
    assert xyz.tolist() == [[1.0, 2.0, 3.5]] * 2
    assert heights.tolist() == [0.5, 0.5]
    assert "PDAL 2.9" in by
