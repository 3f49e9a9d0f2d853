"""Closed pieces from sections, their volume, and Open3D."""

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import trimesh
from meshes import LEANING, NOTCHED, ORIGIN, SQUARE, along, area, closed
from sections import many_sections

from vinemap.canopy.mesh import Mesh, audit, loft, merge, section_meshes, volume
from vinemap.canopy.numbers import lengths_of
from vinemap.compute import extras
from vinemap.errors import DependencyError


@pytest.mark.parametrize("profile", [SQUARE, NOTCHED, LEANING, NOTCHED[::-1]])
def test_a_prism_is_closed_points_outward_and_has_its_volume(profile):
    vertices, faces, _ = loft(along(profile))
    c = len(profile)
    assert vertices.shape == (5 * c, 3)
    assert len(faces) == 2 * c * 4 + 2 * (c - 2)
    assert closed(vertices, faces)
    assert volume(Mesh(vertices, faces)) == pytest.approx(10 * area(profile), rel=1e-9)
    shape = trimesh.Trimesh(vertices - ORIGIN, faces, process=False)
    assert shape.is_watertight
    assert shape.is_winding_consistent
    # Each cap covers its polygon once: no triangle leaves it or turns over.
    for end, side in ((0, -1), (10, 1)):
        on = np.isclose(shape.triangles_center[:, 0], end)
        assert on.sum() == c - 2
        assert shape.area_faces[on].sum() == pytest.approx(area(profile))
        assert (shape.face_normals[on][:, 0] * side > 0.99).all()


def test_sides_are_equation_22():
    _, faces, _ = loft(along([[0, 0], [1, 0], [0, 1]], sections=3)[:, ::-1])
    assert faces[:6].tolist() == [[0, 1, 3], [1, 2, 4], [2, 0, 5], [1, 4, 3], [2, 5, 4], [0, 3, 5]]
    assert (faces[6:12] == faces[:6] + 3).all()


def test_repeated_and_flat_vertices_still_close():
    for profile in (
        [[0, 0]] * 7,
        [[0, 0], [1, 0], [1, 0], [1, 2], [1, 2], [-1, 2], [-1, 0]],
        [[i, i] for i in range(7)],
    ):
        vertices, faces, _ = loft(along(profile))
        assert closed(vertices, faces)
        assert volume(Mesh(vertices, faces)) == pytest.approx(10 * area(profile), abs=1e-6)


def test_a_crossed_polygon_still_closes():
    assert closed(*loft(along([[0, 0], [1, 1], [1, 0], [0, 1], [0.3, 2]]))[:2])


@pytest.mark.parametrize("shape", [(1, 7, 3), (2, 2, 3), (5, 7, 2), (7, 3)])
def test_too_few_sections_or_vertices_are_refused(shape):
    with pytest.raises(ValueError, match="polygons have shape"):
        loft(np.zeros(shape))


def test_pieces_of_a_row_merge():
    pieces = [loft(along(SQUARE)), loft(along(NOTCHED[::-1], length=4, sections=3, shift=(20, 0, 0)))]
    row = Mesh(*merge(pieces))
    assert row.pieces == ((5, 5, True), (3, 6, False))
    assert closed(row.vertices, row.faces)
    assert volume(row) == pytest.approx(10 * area(SQUARE) + 4 * area(NOTCHED))
    assert trimesh.Trimesh(row.vertices, row.faces).body_count == 2
    empty = Mesh(*merge([]))
    assert (empty.vertices.shape, empty.faces.shape, volume(empty)) == ((0, 3), (0, 3), 0)
    assert empty.pieces == ()


def test_meshes_reach_as_far_into_gaps_as_volumes_do():
    """Half a step on the slope, and a lone section both ways; a row's ends are its ends."""
    has = np.repeat([True, False, True, False, True], [3, 3, 1, 3, 2])
    sections = many_sections([[[0.0, 0.0]]] * len(has)).subset(has, has)
    sections = sections._replace(origin=sections.origin + 0.4 * sections.position[:, None] * [0, 0, 1])
    table = pd.DataFrame({"row_id": sections.row_id, "position_m": sections.position})
    rows = gpd.GeoDataFrame({"row_id": [1], "label": ["1"]}, geometry=[None])
    (mesh,) = section_meshes(sections, np.tile(SQUARE, (has.sum(), 1, 1)), rows, step=0.25)
    assert closed(mesh.vertices, mesh.faces)
    assert volume(mesh) == pytest.approx(area(SQUARE) * lengths_of(table, 0.25).sum())
    x, low = mesh.vertices[:, 0], mesh.vertices[:, 2] - 0.4 * mesh.vertices[:, 0]
    assert sorted(set(x.round(3))) == [0, 0.25, 0.5, 0.625, 1.375, 1.5, 1.625, 2.375, 2.5, 2.75]
    assert set(low.round(6)) == {0, 2}


def test_open3d_finds_pieces_watertight_and_broken_ones_not():
    row = Mesh(*merge([loft(along(SQUARE)), loft(along(NOTCHED, shift=(20, 0, 0)))]))
    try:
        result = audit(row)
    except DependencyError as error:
        pytest.skip(str(error))
    assert result == (True, True, False, pytest.approx(10 * (area(SQUARE) + area(NOTCHED))))
    assert not audit(Mesh(row.vertices, row.faces[1:])).watertight
    assert np.isnan(audit(Mesh(row.vertices, row.faces[1:])).volume)
    crossing = merge([loft(along(SQUARE)), loft(along(SQUARE, shift=(5, 0.5, 0.5)))])
    assert audit(Mesh(*crossing)).self_intersecting


@pytest.mark.parametrize("failure", [ImportError("No module named 'open3d'"), OSError("libusb-1.0.so.0: cannot open")])
def test_without_open3d_the_error_says_what_to_install(monkeypatch, failure):
    def fails(name):
        raise failure

    monkeypatch.setattr(extras, "import_module", fails)
    with pytest.raises(DependencyError) as caught:
        audit(Mesh(*loft(along(SQUARE))))
    message = str(caught.value)
    assert str(failure) in message
    assert "apt-get install libegl1 libgl1 libusb-1.0-0" in message
    assert "pip install 'vinemap[mesh]'" in message
    assert "\n" not in message
