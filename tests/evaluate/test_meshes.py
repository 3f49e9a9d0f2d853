"""How far meshes are off: as their canopies' points tell it, as Open3D measures it, and as it is."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vinemap.canopy.mesh import section_meshes
from vinemap.canopy.numbers import judge_canopies, quantile_of, summarise_rows
from vinemap.chain import map_rows, model_canopies
from vinemap.cloud.tiles import Collector
from vinemap.compute.extras import load
from vinemap.errors import DependencyError
from vinemap.evaluate.meshes import distances, measure_meshes
from vinemap.measure.accuracy.meshes import compare_meshes

STEP = 0.25


@pytest.fixture(scope="module")
def mapped(cloud):
    found = map_rows(cloud)
    model = model_canopies(found)
    return found, model, judge_canopies(summarise_rows(found.rows, model.table, step=STEP), model.table, step=STEP)


def moved(model, by):
    return model._replace(polygons=model.polygons + by)


def grown(model, by):
    """The model with polygons as much larger to all sides, about."""
    middle = model.polygons.mean(axis=1, keepdims=True)
    half = np.ptp(model.polygons, axis=1, keepdims=True) / 2
    return model._replace(polygons=middle + (model.polygons - middle) * (1 + by / half))


def test_points_tell_the_error_that_the_true_surface_has(mapped, vineyard):
    found, model, rows = mapped
    assert len(rows) == len(vineyard.rows)
    for other, least, most in (
        (model, 0.015, 0.03),
        (moved(model, [0.06, 0.0]), 0.045, 0.07),
        (grown(model, -0.05), 0.03, 0.05),
    ):
        told, true = compare_meshes(vineyard, found, other, step=STEP)
        assert np.isfinite(told).all()
        assert told.mean() == pytest.approx(true.mean(), abs=0.01)
        assert least < true.mean() < most


def test_a_flank_that_was_not_seen_is_told_by_the_other(mapped, vineyard):
    """One that the mesh cuts off, whether the line of the row runs along its middle or 0.15 m beside."""
    found, model, rows = mapped
    y, z = model.sample.points.T
    seen = (y < 0) | (z > np.repeat(quantile_of(z, model.sample.start, 0.7), np.diff(model.sample.start)))
    half = model.polygons * [[[0.4, 1.0]]]
    lower = model.polygons[..., 1] < model.polygons[..., 1].max(axis=1, keepdims=True) - 0.3
    cut = np.where((lower & (model.polygons[..., 0] > 0))[..., None], half, model.polygons)
    other = model._replace(polygons=cut, sample=model.sample.subset(seen))
    told, true = compare_meshes(vineyard, found, other, step=STEP)
    assert true.mean() > 0.045
    assert told.mean() == pytest.approx(true.mean(), abs=0.01)
    aside = 0.15 * np.array([-1.0, 1.0]) * other.at.tangent[:, ::-1]
    beside = other._replace(
        at=other.at._replace(origin=other.at.origin + np.pad(aside, [(0, 0), (0, 1)])),
        polygons=cut - [0.15, 0.0],
        sample=other.sample._replace(points=other.sample.points - [0.15, 0.0]),
    )
    same = measure_meshes(found.cloud, beside, rows, step=STEP)["mesh_error_m"].to_numpy()
    assert same == pytest.approx(told, abs=1e-6)


def test_distances_are_those_of_open3d(mapped):
    try:
        open3d = load("open3d")
    except DependencyError as error:
        pytest.skip(str(error))
    found, model, rows = mapped
    told = measure_meshes(found.cloud, model, rows, step=STEP)
    section = np.repeat(np.flatnonzero(model.sampled), np.diff(model.sample.start))
    points = found.cloud.xyz[model.sample.member]
    near = distances(points, section, model.at, model.polygons, step=STEP)
    for mesh in section_meshes(model.at, model.polygons, rows.assign(label=""), step=STEP)[:2]:
        mine = (model.at.row_id[section] == mesh.row_id) & np.isfinite(near.distance)
        zero = mesh.vertices.mean(axis=0)
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles((mesh.vertices - zero).astype(np.float32), mesh.faces.astype(np.uint32))
        asked = open3d.core.Tensor((points[mine] - zero).astype(np.float32))
        theirs = scene.compute_signed_distance(asked, nsamples=3).numpy()
        assert np.quantile(np.abs(near.distance[mine] - theirs), 0.98) < 1e-4
        row = told[told["row_id"] == mesh.row_id].iloc[0]
        assert [row["mesh_median_m"], row["mesh_95_m"]] == pytest.approx(np.quantile(theirs, [0.5, 0.95]), abs=1e-3)
        assert row["mesh_inside"] == pytest.approx(np.mean(theirs <= 0), abs=0.002)


def test_distances_to_a_box(mapped):
    """A square canopy of 1 m by 2 m, from 0.5 m above the ground: what is inside, beside, above and under it."""
    at = mapped[1].at
    mine = np.flatnonzero(at.row_id == at.row_id[0])[:9]
    flat = at._replace(
        **{name: getattr(at, name)[mine] for name in ("row_id", "position", "origin", "tangent", "spacing")}
    )
    box = np.array([[0, 0.5], [0.5, 0.5], [0.5, 2.5], [0.2, 2.5], [-0.2, 2.5], [-0.5, 2.5], [-0.5, 0.5]])
    along, left = flat.tangent[0], np.array([-flat.tangent[0, 1], flat.tangent[0, 0]])
    flat = flat._replace(
        origin=np.column_stack([flat.origin[0, :2] + STEP * np.arange(9)[:, None] * along, np.zeros(9)]),
        tangent=np.tile(along, (9, 1)),
        position=STEP * np.arange(9),
    )
    places = np.array([[0.45, 1.0], [0.75, 1.5], [0.0, 2.7], [0.0, 0.6], [0.0, 0.3], [0.8, 2.9]])
    points = np.column_stack([flat.origin[4, :2] + 0.05 * along + places[:, :1] * left, places[:, 1]])
    near = distances(points, np.full(6, 4), flat, np.tile(box, (9, 1, 1)), step=STEP)
    assert near.distance == pytest.approx([-0.05, 0.25, 0.2, -0.1, 0.2, 0.5])
    assert (near.patch < 0).tolist() == [False, False, False, True, True, False]
    ends = distances(points[:2], np.array([0, 8]), flat, np.tile(box, (9, 1, 1)), step=STEP)
    assert np.isnan(ends.distance).all()


def test_what_cannot_be_told_is_left_empty(mapped):
    found, model, rows = mapped
    doubtful = rows.assign(canopy_confidence=[0.4, np.nan, *rows["canopy_confidence"][2:]])
    told = measure_meshes(found.cloud, model, doubtful, step=STEP)
    assert told["mesh_error_m"].isna().tolist() == [True, True, *[False] * (len(rows) - 2)]
    assert told["mesh_median_m"].notna().all()
    tops = measure_meshes(found.cloud, model, rows, step=STEP, tops=True)
    assert tops["mesh_error_m"].isna().all()
    other = measure_meshes(found.cloud, model, rows.assign(row_id=rows["row_id"] + 100), step=STEP)
    assert other[["mesh_error_m", "mesh_median_m", "mesh_95_m", "mesh_inside"]].isna().all(axis=None)
    none = measure_meshes(found.cloud, model, rows[:0], step=STEP)
    assert none.columns.tolist() == told.columns.tolist()


def test_tiles_tell_the_same(mapped, tmp_path):
    found, model, rows = mapped
    tiles = Collector(tmp_path / "tiles", most=1000)
    tiles.add(found.cloud.xyz)
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    cloud = tiles.cloud(found.cloud.crs, None, low, high)
    number = cKDTree(np.concatenate([part.xyz for part in cloud.parts()])).query(found.cloud.xyz[model.sample.member])[
        1
    ]
    other = model._replace(sample=model.sample._replace(member=number))
    one, two = (
        measure_meshes(c, m, rows, step=STEP)["mesh_error_m"] for c, m in ((found.cloud, model), (cloud, other))
    )
    assert one.tolist() == two.tolist()
