"""Files without any usable points among others, which are left out and named, whatever their format."""

import formats
import laspy
import numpy as np
import pytest
import shapely
from pyproj import CRS

from vinemap.cloud.las import read_cloud
from vinemap.errors import EmptyError, InputError

UTM = CRS.from_epsg(32632)
BOX = shapely.box(414_705, 4_940_705, 414_750, 4_940_745), UTM
NONE, NO_NUMBERS = np.empty((0, 3)), np.full((3, 3), np.nan)
TEXT = {
    "a.xyz": "",
    "b.xyz": "\n\n",
    "a.csv": "X,Y,Z\n",
    "a.pts": "0\n",
    "a.txt": "//X Y Z\n",
    "c.xyz": "nan nan nan\n",
}


def write_e57(path):
    pye57 = pytest.importorskip("pye57", reason="needs pye57: pip install 'vinemap[e57]'")
    pye57.E57(str(path), mode="w").close()


def write_las(path):
    laspy.LasData(laspy.LasHeader(version="1.4", point_format=6)).write(str(path))


WITHOUT = {
    "a.ply": lambda path: formats.write_ply(path, NONE),
    "b.ply": lambda path: formats.write_ply(path, NO_NUMBERS, order="ascii"),
    "a.pcd": lambda path: formats.write_pcd(path, NONE),
    "b.pcd": lambda path: formats.write_pcd(path, NONE, form="ascii"),
    "a.e57": write_e57,
    "a.las": write_las,
    **{name: lambda path, text=text: path.write_text(text) for name, text in TEXT.items()},
}


@pytest.fixture(scope="module")
def tile(tmp_path_factory):
    points = np.random.default_rng(0).uniform((414_700, 4_940_700, 460), (414_760, 4_940_750, 470), (500, 3)).round(3)
    return formats.write_las(tmp_path_factory.mktemp("tile") / "full.laz", points, UTM)


@pytest.mark.parametrize("name", WITHOUT)
def test_among_others_they_are_left_out(tmp_path, tile, name):
    empty = tmp_path / name
    WITHOUT[name](empty)
    for boundary in (None, BOX):
        cloud = read_cloud([empty, tile], boundary=boundary)
        assert cloud.remarks == (f"{name} holds no usable points, and is left out",)
        assert np.array_equal(cloud.xyz, read_cloud(tile, boundary=boundary).xyz)
        with pytest.raises(EmptyError, match=rf"{name}: holds no (usable )?points"):
            read_cloud(empty, boundary=boundary)


@pytest.mark.parametrize("text", ["one two three\nfour five six\n", "# of\n" * 20_000])
def test_text_that_is_not_understood_is_not_taken_for_empty(tmp_path, tile, text):
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(InputError, match="no line of it begins with x, y and z"):
        read_cloud([tmp_path / "a.xyz", tile])
