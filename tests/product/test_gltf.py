"""Meshes as glTF: the GLB read back, as JSON and by trimesh."""

import json
import struct
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from meshes import FLAT, LEANING, NOTCHED, ORIGIN, SQUARE, along, area, bumpy, closed, rows

import vinemap
from vinemap.canopy.mesh import Mesh, loft, merge, volume
from vinemap.product.gltf import write_glb

TURN = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
"""Z up to Y up."""


def chunks(path):
    """The JSON of a GLB and its binary chunk."""
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + size], parse_constant=pytest.fail), data[28 + size :]


def read(path):
    return chunks(path)[0]


class Row(NamedTuple):
    """A row's node as the file holds it."""

    node: dict
    modes: list
    """Of each primitive."""
    orders: list
    """Of each primitive: indices as they are stored."""
    stored: np.ndarray
    """(n, 3) positions of all primitives, as numbers of the file."""
    vertices: np.ndarray
    """(n, 3) the same about the origin, z up, m."""
    faces: np.ndarray
    """(m, 3) triangles of all primitives."""


def decode(path):
    """The rows of a GLB that have a mesh, read as the specification says."""
    document, binary = chunks(path)
    kinds = {5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}

    def array(index):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        kind, width = np.dtype(kinds[accessor["componentType"]]), {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        start = view["byteOffset"] + accessor["byteOffset"]
        stride = view.get("byteStride") or kind.itemsize * width
        assert start % 4 == stride % 4 == 0 or width == 1
        assert accessor["byteOffset"] + stride * accessor["count"] <= view["byteLength"]
        assert not accessor.get("normalized")
        whole = np.frombuffer(binary, np.uint8, stride * accessor["count"], start).reshape(-1, stride)
        values = np.ascontiguousarray(whole[:, : kind.itemsize * width]).view(kind)
        if width == 3:
            assert accessor["min"] == values.min(axis=0).tolist()
            assert accessor["max"] == values.max(axis=0).tolist()
        return values

    rows = []
    for node in document["nodes"]:
        if "mesh" not in node:
            continue
        primitives = document["meshes"][node["mesh"]]["primitives"]
        modes = [primitive["mode"] for primitive in primitives]
        points = [array(primitive["attributes"]["POSITION"]) for primitive in primitives]
        orders = [array(primitive["indices"]).ravel().astype(int) for primitive in primitives]
        first = np.cumsum([0] + [len(p) for p in points])
        faces = [triangles(mode, order) + i for mode, order, i in zip(modes, orders, first[:-1], strict=True)]
        stored = np.concatenate(points)
        vertices = stored * np.array(node.get("scale", [1, 1, 1])) + node["translation"]
        rows.append(Row(node, modes, orders, stored, vertices, np.concatenate(faces)))
    return rows


def triangles(mode, order):
    """Triangles (m, 3) of a primitive's indices."""
    if mode == 4:
        return order.reshape(-1, 3)
    faces = np.lib.stride_tricks.sliding_window_view(order, 3).copy()
    faces[1::2] = faces[1::2, ::-1]
    return faces


def loaded(path):
    """The shapes of each row, by its node's name, as trimesh places them; all of them watertight at once."""
    scene = trimesh.load(path)
    assert all(shape.is_watertight and shape.is_winding_consistent for shape in scene.geometry.values())
    assert all(shape.volume > 0 for shape in scene.dump())
    shapes = {}
    for node in scene.graph.nodes_geometry:
        parent = scene.graph.transforms.parents[node]
        transform, name = scene.graph[node]
        shape = scene.geometry[name].copy().apply_transform(transform)
        shapes.setdefault(node if parent == "canopy" else parent, []).append(shape)
    return shapes


def test_glb_has_a_node_a_row_with_its_numbers(tmp_path):
    path = tmp_path / "F_canopy.glb"
    write_glb(rows(), path, origin=ORIGIN, crs="EPSG:32632", extras={"vertical": "EGM2008 height", "quality": np.nan})
    document = read(path)
    root, *nodes = document["nodes"]
    assert root["extras"] == {"crs": "EPSG:32632", "vertical": "EGM2008 height", "origin": ORIGIN.tolist()}
    assert [node["name"] for node in nodes] == ["1 F", "2 F", "3 F"]
    assert nodes[0]["extras"] == {"row_id": 1, "length_m": 10.0, "n_key_points": 5, "ends": [1.5, None]}
    assert "mesh" not in nodes[2]
    assert document["asset"]["generator"] == f"vinemap {vinemap.__version__}"
    assert [m["doubleSided"] for m in document["materials"]] == [False]


@pytest.mark.parametrize("plain", [False, True])
def test_glb_reads_back_in_metres_y_up(tmp_path, plain):
    path = tmp_path / "F_canopy.glb"
    doubled = [[0, 0], [1, 0], [1, 0], [1, 2], [1, 2], [-1, 2], [-1, 0]]
    meshes = [
        *rows(),
        bumpy(100, turn=1, row_id=4, label="4 F"),
        bumpy(100, turn=-1, row_id=5, label="5 F"),
        Mesh(*loft(along(doubled, sections=30)), row_id=6, label="6 F"),
        Mesh(
            *merge(loft(along(NOTCHED, length=k / 4, sections=k, shift=(k, 0, 0))) for k in range(2, 30, 9)), 7, "7 F"
        ),
    ]
    write_glb(meshes, path, origin=ORIGIN, crs="EPSG:32632", plain=plain)
    shapes = loaded(path)
    assert set(shapes) == {"1 F", "2 F", "4 F", "5 F", "6 F", "7 F"}
    for row in meshes:
        if row.label not in shapes:
            continue
        assert len(shapes[row.label]) == (1 if plain else len(row.pieces))
        shape = trimesh.util.concatenate(shapes[row.label])
        assert shape.volume == pytest.approx(volume(row), rel=1e-5 if plain else 0.01)
        expected = trimesh.transform_points(row.vertices - ORIGIN, TURN)
        tolerance = 1e-5 if plain else 0.001
        np.testing.assert_allclose(shape.bounds, [expected.min(axis=0), expected.max(axis=0)], atol=tolerance)


def test_positions_are_whole_steps_that_the_node_scales(tmp_path):
    meshes = [*rows()[:2], bumpy(480, turn=-1)]
    write_glb(meshes, tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    document = read(tmp_path / "a.glb")
    assert document["extensionsUsed"] == document["extensionsRequired"] == ["KHR_mesh_quantization"]
    assert document["bufferViews"][0]["byteStride"] == 8
    for row, mesh in zip(decode(tmp_path / "a.glb"), meshes, strict=True):
        (step,) = set(row.node["scale"])
        assert step == pytest.approx(np.ptp(mesh.vertices, axis=0).max() / 65534, rel=1e-6)
        assert row.stored.dtype == np.int16
        assert np.abs(row.stored.astype(int)).max() == 32767
        # Half a step along each axis, and what float64 loses at northings of 4650 km.
        assert np.abs(row.vertices - (mesh.vertices - ORIGIN)).max() <= step / 2 + 2e-9


def test_vertices_in_one_place_are_written(tmp_path):
    mesh = Mesh(np.broadcast_to(ORIGIN, (10, 3)), *loft(along(SQUARE, sections=2))[1:])
    write_glb([mesh], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    assert not decode(tmp_path / "a.glb")[0].vertices.any()


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize("k", [2, 3, 4, 11])
@pytest.mark.parametrize("c", [3, 4, 5, 6, 7, 8, 12])
def test_a_piece_is_one_strip_that_closes_it(tmp_path, c, k, turn):
    angle = 2 * np.pi * np.arange(c)[::turn] / c
    profile = np.column_stack([np.sin(angle), np.cos(angle)])
    write_glb([Mesh(*loft(along(profile, sections=k)))], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    (row,) = decode(tmp_path / "a.glb")
    (order,) = row.orders
    assert (row.modes, len(order), set(order.tolist())) == ([5], 2 * k * c - 2, set(range(k * c)))
    assert (row.faces != np.roll(row.faces, 1, axis=1)).all()
    assert closed(row.vertices, row.faces)
    assert volume(Mesh(row.vertices, row.faces)) == pytest.approx(10 * area(profile), rel=1e-3)
    # The sides' triangles are halves of Eq. 22's quadrilaterals, the others lie in the caps.
    section, corner = np.divmod(row.faces, c)
    side = np.ptp(section, axis=1) > 0
    assert (side.sum(), np.ptp(section, axis=1).max()) == (2 * c * (k - 1), 1)
    steps = (corner[side] - np.roll(corner[side], 1, axis=1)) % c
    assert (np.isin(steps, [0, 1, c - 1]) & (np.sort(steps, axis=1)[:, :1] == 0)).all()
    assert set(section[~side].ravel().tolist()) == {0, k - 1}


def test_a_strip_zigzags_over_the_caps_and_winds_up_the_sides(tmp_path):
    write_glb([Mesh(*loft(along(LEANING, sections=2)))], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    (row,) = decode(tmp_path / "a.glb")
    sides = [6, 13, 0, 7, 1, 8, 2, 9, 3, 10, 4, 11, 5, 12]
    assert row.orders[0].tolist() == [2, 3, 1, 4, 0, 5, *sides, 13, 11, 7, 10, 8, 9]


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize("profile", [SQUARE, NOTCHED, FLAT])
def test_a_strips_caps_cover_the_polygons_once(tmp_path, profile, turn):
    profile = [profile[0], *profile[1:][::turn]]
    write_glb([Mesh(*loft(along(profile, sections=9)))], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    (row,) = decode(tmp_path / "a.glb")
    shape = trimesh.Trimesh(row.vertices, row.faces, process=False)
    assert (shape.area_faces > 0.01).all()
    for end, side in ((0, -1), (10, 1)):
        on = np.isclose(shape.triangles[:, :, 0], end).all(axis=1)
        assert on.sum() == len(profile) - 2
        assert shape.area_faces[on].sum() == pytest.approx(area(profile), rel=1e-3)
        assert (shape.face_normals[on][:, 0] * side > 0.99).all()


def test_trimesh_finds_no_triangle_to_drop(tmp_path):
    for profile in (FLAT, [FLAT[0], *FLAT[1:][::-1]]):
        write_glb([Mesh(*loft(along(profile)))], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
        (shape,) = trimesh.load(tmp_path / "a.glb", validate=True).geometry.values()
        assert shape.is_watertight
        assert len(shape.faces) == 2 * 7 * 5 - 4


def test_a_row_has_a_primitive_a_piece_of_any_profile_and_turn(tmp_path):
    profiles = (SQUARE, LEANING[::-1], NOTCHED[::-1], LEANING, [[0, 0], [1, 0], [0, 1]])
    pieces = [loft(along(p, sections=20 + i, shift=(20 * i, i, 0))) for i, p in enumerate(profiles)]
    write_glb([Mesh(*merge(pieces))], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    (row,) = decode(tmp_path / "a.glb")
    assert row.modes == [5] * 5
    shapes = trimesh.load(tmp_path / "a.glb").dump()
    volumes = sorted(shape.volume for shape in shapes)
    assert volumes == pytest.approx(sorted(volume(Mesh(*piece)) for piece in pieces), rel=0.01)
    assert closed(row.vertices, row.faces)


def test_faces_that_no_loft_made_are_a_list(tmp_path):
    whole = bumpy(100)
    sphere = trimesh.creation.icosphere()
    orders = [whole.faces, np.random.default_rng(0).permutation(whole.faces), sphere.faces, np.full((1, 3), 5)]
    for faces in orders:
        write_glb([Mesh(whole.vertices, faces)], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
        (row,) = decode(tmp_path / "a.glb")
        assert (row.modes, row.stored.dtype) == ([4], np.int16)
        assert (row.faces == faces).all()


def test_a_section_takes_half_the_bytes_of_plain_lists(tmp_path):
    size = {}
    for k in (480, 960):
        for plain in (False, True):
            write_glb([bumpy(k)], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632", plain=plain)
            size[k, plain] = (tmp_path / "a.glb").stat().st_size
    assert (size[960, False] - size[480, False]) / 480 == pytest.approx(84, abs=0.1)
    assert (size[960, True] - size[480, True]) / 480 == pytest.approx(168, abs=0.1)
    assert size[480, False] < 88 * 480


def test_rows_of_several_pieces_stay_light(tmp_path):
    numbers = {f"number_{i:02d}_m": round(100 * np.sin(i), 3) for i in range(30)}
    meshes, sections = [], 0
    for i in range(16):
        lengths = [30 + 5 * i, 31 + 5 * i, 32 + 5 * i, 33 + 5 * i, 334 - 20 * i]
        starts = np.cumsum([0, *lengths]) / 4
        pieces = [
            loft(along(LEANING, length=k / 4, sections=k, shift=(x, 2.5 * i, 0)))
            for k, x in zip(lengths, starts[:-1], strict=True)
        ]
        meshes.append(Mesh(*merge(pieces), row_id=i, label=f"{i} F", extras=numbers))
        sections += sum(lengths)
    assert sections == 16 * 460
    write_glb(meshes, tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    assert (tmp_path / "a.glb").stat().st_size <= 92 * sections
    assert sum(len(row.modes) for row in decode(tmp_path / "a.glb")) == 80


def test_plain_is_float32_and_lists_without_extensions(tmp_path):
    meshes = [*rows()[:2], bumpy(100)]
    write_glb(meshes, tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632", plain=True)
    document = read(tmp_path / "a.glb")
    assert not any(key.startswith("extensions") for key in document)
    assert document["bufferViews"][0]["byteStride"] == 12
    for row, mesh in zip(decode(tmp_path / "a.glb"), meshes, strict=True):
        assert (row.modes, row.stored.dtype, "scale" in row.node) == ([4], np.float32, False)
        assert (row.faces == mesh.faces).all()
        np.testing.assert_allclose(row.vertices, mesh.vertices - ORIGIN, atol=4e-6)


@pytest.mark.parametrize("plain", [False, True])
def test_rows_of_the_same_faces_share_them(tmp_path, plain):
    meshes = [Mesh(*loft(along(SQUARE, shift=(0, 2.5 * i, 0))), row_id=i, label=f"{i} F") for i in range(3)]
    write_glb(meshes, tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632", plain=plain)
    document = read(tmp_path / "a.glb")
    assert len({mesh["primitives"][0]["indices"] for mesh in document["meshes"]}) == 1


def test_pieces_share_indices_if_they_turn_alike_and_are_as_long(tmp_path):
    kinds = [(LEANING, 9), (LEANING[::-1], 9), (LEANING, 9), (LEANING, 8), (LEANING[::-1], 9)]
    pieces = [loft(along(p, sections=k, shift=(20 * i, 0, 0))) for i, (p, k) in enumerate(kinds)]
    write_glb([Mesh(*merge(pieces))], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    a, b, c, d, e = (p["indices"] for p in read(tmp_path / "a.glb")["meshes"][0]["primitives"])
    assert (a, b) == (c, e)
    assert len({a, b, d}) == 3


def test_pieces_of_more_than_65535_vertices_take_wide_indices(tmp_path):
    long, short = (loft(along(LEANING, length=k / 4, sections=k, shift=(-k, 0, 0))) for k in (9400, 4000))
    write_glb([Mesh(*merge([long, short, short]))], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    document = read(tmp_path / "a.glb")
    primitives = document["meshes"][0]["primitives"]
    assert [document["accessors"][p["indices"]]["componentType"] for p in primitives] == [5125, 5123, 5123]
    (row,) = decode(tmp_path / "a.glb")
    assert closed(row.vertices, row.faces)


def test_no_rows_give_a_root_alone(tmp_path):
    write_glb([], tmp_path / "a.glb", origin=ORIGIN, crs="EPSG:32632")
    document = read(tmp_path / "a.glb")
    assert len(document["nodes"]) == 1
    assert "meshes" not in document
    assert "extensionsRequired" not in document
