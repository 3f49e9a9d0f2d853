"""Open3D's opinion of a product's meshes, as warnings."""

from dataclasses import replace

import pytest
from meshes import LEANING, ORIGIN, SQUARE, along, rows

from vinemap.canopy.mesh import Mesh, loft, merge
from vinemap.compute import extras
from vinemap.product.gltf import write_glb
from vinemap.product.write import audit_meshes


def written(meshes, path, **how):
    write_glb(meshes, path, origin=ORIGIN, crs="EPSG:32632", **how)
    return path


@pytest.mark.parametrize("plain", [False, True])
def test_each_mesh_with_a_flaw_is_named_and_no_other(tmp_path, plain):
    crossing = merge([loft(along(SQUARE)), loft(along(SQUARE, shift=(5, 0.5, 0.5)))])
    broken = Mesh(*merge([loft(along(LEANING, shift=(0, 40, 0)))]), 5, "5 F")
    torn = replace(broken, faces=broken.faces[1:], pieces=())
    both = replace(Mesh(*crossing), row_id=6, label="6 F", faces=crossing[1][1:], pieces=())
    found = audit_meshes(written([*rows(), Mesh(*crossing, 4, "4 F"), torn, both], tmp_path / "a.glb", plain=plain))
    if found and found[0].startswith("the meshes were not audited: "):
        pytest.skip(found[0])
    assert found == [
        "the mesh of row 4 F intersects itself",
        "the mesh of row 5 F isn't closed",
        "the mesh of row 6 F isn't closed and intersects itself",
    ]


def test_without_open3d_it_is_said_once(monkeypatch, tmp_path):
    def fails(name):
        raise OSError("libusb-1.0.so.0: cannot open")

    monkeypatch.setattr(extras, "import_module", fails)
    (said,) = audit_meshes(written(rows(), tmp_path / "a.glb"))
    assert said.startswith("the meshes were not audited: looking at meshes needs Open3D, which can't be loaded")
    assert audit_meshes(written([], tmp_path / "none.glb")) == []
