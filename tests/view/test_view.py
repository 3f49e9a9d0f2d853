"""Products in Open3D: what is shown, the picture, and what is said where there is none."""

import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from matplotlib.image import imread

from vinemap import paths
from vinemap.cli.main import commands
from vinemap.compute import extras
from vinemap.compute.extras import load
from vinemap.errors import DependencyError, InputError
from vinemap.parcel import map_parcel
from vinemap.simulate.survey import write_survey
from vinemap.view.scene import scene_of
from vinemap.view.window import show


@pytest.fixture(scope="module")
def product(vineyard, tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    cloud = write_survey(vineyard, folder / "in")
    map_parcel(cloud, folder / "A", parcel="A")
    return folder / "A", cloud


def test_points_rows_and_meshes_lie_together(product, vineyard):
    folder, cloud = product
    scene = scene_of([folder], cloud, most=20_000)
    assert 5_000 < len(scene.points) <= 20_000
    assert len(scene.rows) == len(vineyard.rows)
    assert scene.faces.max() == len(scene.vertices) - 1
    for part in (scene.vertices, np.concatenate(scene.rows)):
        assert (part[:, :2].min(axis=0) > scene.points[:, :2].min(axis=0)).all()
        assert (part[:, :2].max(axis=0) < scene.points[:, :2].max(axis=0)).all()
    assert np.abs(scene.points).max() < 60
    green = scene.colours[:, 1] > 0.6
    assert 0.02 < green.mean() < 0.5
    assert len(scene_of([folder]).points) == 0


def test_a_picture(product, tmp_path):
    folder, cloud = product
    scene, path = scene_of([folder], cloud, most=20_000), tmp_path / "new" / "a.png"
    try:
        load("open3d")
        show(scene, path)
    except DependencyError as error:
        assert not path.exists()
        pytest.skip(str(error))
    red, green, blue = (255 * imread(path)[:, :, :3]).astype(int).transpose(2, 0, 1)
    assert 0.05 < np.mean(red + green + blue < 3 * 250) < 0.95
    assert np.mean((green > red + 20) & (green > blue + 20)) > 0.01


def test_what_cannot_be_shown_is_said_in_a_line(product, tmp_path, monkeypatch):
    folder, cloud = product
    with pytest.raises(InputError, match="no product of vinemap: give its folder"):
        scene_of([tmp_path])
    broken = shutil.copytree(folder, tmp_path / "A")
    paths.raster(broken, "A", "dtm").unlink()
    with pytest.raises(InputError, match=r"A_dtm\.tif: can't be read: map the parcel anew"):
        scene_of([broken], cloud)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")

    def fails(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(extras, "import_module", lambda name: None)
    said = CliRunner().invoke(commands, ["view", str(folder)]).exception
    assert isinstance(said, InputError)
    assert str(said) == "There is no screen here: give --png FILE for a picture"
    said = CliRunner().invoke(commands, ["view", str(folder), "--png", str(broken / "A.gpkg")]).exception
    assert isinstance(said, InputError)
    assert str(said).endswith("A.gpkg: a picture ends in .png or .jpg: give it such a name")
    monkeypatch.setattr(extras, "import_module", fails)
    said = CliRunner().invoke(commands, ["view", str(folder)]).exception
    assert isinstance(said, DependencyError)
    assert "pip install 'vinemap[mesh]'" in str(said)
