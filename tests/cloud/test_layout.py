"""Files whose parts don't agree are refused in a line before a decoder takes them at their word."""

import struct

import laspy
import numpy as np
import pytest
import shapely
from commands import assert_refused, vinemap
from lasfiles import FORMATS, as_las, points

from vinemap.cloud.copc import points_about
from vinemap.cloud.las import opened, read_cloud
from vinemap.cloud.las_end import unfinished
from vinemap.cloud.layout import read_layout
from vinemap.cloud.pieces import split_cloud
from vinemap.errors import InputError
from vinemap.geo.crs import parse_crs

CRS = parse_crs("EPSG:32632")
WIDE = shapely.box(414_600, 4_940_600, 414_800, 4_940_800)
COPC = "copc"
LAZ = ["laz 1.2", "laz 1.4"]


@pytest.fixture
def damaged(clouds, tmp_path):
    """A file of a kind, with words put into it."""

    def damage(kind, *words):
        if kind not in clouds:
            pytest.skip("needs copclib, which writes COPC files")
        data = bytearray(clouds[kind].read_bytes())
        for place, form, value in words:
            at = place(data) if callable(place) else place
            struct.pack_into(form, data, at, value)
        path = tmp_path / clouds[kind].name
        path.write_bytes(data)
        return path

    return damage


def points_at(data):
    return struct.unpack("<I", data[96:100])[0]


def table_at(data):
    return struct.unpack("<q", data[points_at(data) : points_at(data) + 8])[0]


def packing_at(data):
    return bytes(data).index(b"laszip encoded") + 52


def refused(path, words):
    for read in (
        lambda: read_cloud(path, crs=CRS),
        lambda: split_cloud(path, [(WIDE, CRS)], path.parent, crs=CRS),
    ):
        with pytest.raises(InputError) as error:
            read()
        assert str(path) in str(error.value)
        assert words in str(error.value)
        assert "\n" not in str(error.value)


def words_for(kind, words):
    """What is said of a kind of file: of all the same, or by how the kind begins."""
    return words if isinstance(words, str) else next(words[begins] for begins in words if kind.startswith(begins))


@pytest.mark.parametrize("kind", [*FORMATS, "evlr", COPC])
def test_whole_files_are_as_they_say(damaged, kind):
    layout = read_layout(damaged(kind))
    assert layout.head.n == 2000
    assert sum(chunk.n for chunk in layout.chunks) == (0 if kind.startswith("las") else 2000)


@pytest.mark.parametrize("kind", [*FORMATS, "evlr", COPC])
@pytest.mark.parametrize("n", [1000, 1900])
def test_a_header_that_counts_too_few_points_is_not_obeyed(damaged, kind, n):
    refused(damaged(kind, (107, "<I", n), *([(247, "<Q", n)] if "2" not in kind else [])), f"counts {n:,} points, but")


def test_a_header_that_counts_less_than_a_whole_chunk(tmp_path):
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), [414_700, 4_940_700, 0]
    las = laspy.LasData(header)
    las.xyz = points(120_000)
    path = tmp_path / "a.laz"
    las.write(path)
    assert [chunk.n for chunk in read_layout(path).chunks] == [50_000, 50_000, 20_000]
    with path.open("r+b") as stream:
        stream.seek(107)
        stream.write(struct.pack("<I", 60_000))
    refused(path, "counts 60,000 points, but 150,000 are in it")


NO_TABLE, OTHER_TABLE = "ends before its table of chunks", "its table of chunks doesn't fit its points"
OTHER_CHUNKS = "its chunks have other numbers of points than its table of chunks says"
OTHER_WAY = "its points are packed in another way than those of its point format"
NO_POINTS, NO_ROOM = "ends before the last of its 2,000 points", "records, for which there is no room"


@pytest.mark.parametrize("kind", [*LAZ, "evlr", COPC])
@pytest.mark.parametrize(
    ("place", "form", "value", "words"),
    [
        (lambda data: table_at(data) + 4, "<I", 0xAAAA_AAAA, NO_TABLE),  # would be 46 GB
        (lambda data: table_at(data) + 4, "<I", 50, {"evlr": OTHER_TABLE, "": NO_TABLE}),
        (lambda data: table_at(data) + 8, "<I", 0xFFFF_FFFF, OTHER_TABLE),  # the decoder panics
        (points_at, "<q", 1 << 40, NO_TABLE),
        (points_at, "<q", -1, NO_TABLE),
        (lambda data: packing_at(data) + 12, "<I", 0, {"evlr": OTHER_TABLE, COPC: OTHER_CHUNKS, "": NO_TABLE}),
        (lambda data: packing_at(data) + 34, "<H", 8, OTHER_WAY),
        (lambda data: packing_at(data) + 32, "<H", 60_000, NO_TABLE),
        (packing_at, "<H", 1, OTHER_WAY),
    ],
)
def test_the_table_of_chunks_is_not_trusted(damaged, kind, place, form, value, words):
    path = damaged(kind, (place, form, value))
    if (place, value, kind) != (packing_at, 1, "laz 1.2"):  # as in the oldest files, of one chunk
        refused(path, words_for(kind, words))
    assert isinstance(unfinished(path), str)


@pytest.mark.parametrize("each", [100, 2_100_000_000])
def test_chunks_of_any_size_take_no_more_memory_than_their_points(damaged, each):
    path = damaged("laz 1.2", (lambda data: packing_at(data) + 12, "<I", each))
    if each == 100:
        refused(path, "counts 2,000 points, but 100 are in it")
    else:
        assert read_cloud(path, crs=CRS).size == 2000


@pytest.mark.parametrize("kind", ["laz 1.4", "evlr", COPC])
@pytest.mark.parametrize("layer", [0, 1, 9])
def test_layers_are_not_trusted(damaged, kind, layer):
    path = damaged(kind, (lambda data: points_at(data) + 8 + 36 + 4 + 4 * layer, "<I", 0xFFFF_FFF0))
    refused(path, "the layers of its points don't fit its table of chunks")


@pytest.mark.parametrize("kind", [*FORMATS, "evlr", COPC])
@pytest.mark.parametrize(
    ("place", "form", "value", "words"),
    [
        (100, "<I", 4_000_000_000, NO_ROOM),
        (96, "<I", 4_000_000_000, {"las": NO_POINTS, "": NO_TABLE}),
        (96, "<I", 300, {"las 1.2": NO_POINTS, "las 1.4": NO_ROOM, "": NO_TABLE}),
        (94, "<H", 65_535, {"las": NO_ROOM, "": NO_TABLE}),
        (104, "<B", 127, {"las": "states point format 63, which there isn't", "": NO_POINTS}),
        (105, "<H", 65_535, {"las": NO_POINTS, "": OTHER_WAY}),
        (105, "<H", 12, "points of 12 bytes"),
        (0, "<I", 0, "doesn't begin as such a file"),
    ],
)
def test_the_header_is_not_trusted(damaged, kind, place, form, value, words):
    refused(damaged(kind, (place, form, value)), words_for(kind, words))


@pytest.mark.parametrize("kind", ["las 1.4", "laz 1.4", "evlr", COPC])
@pytest.mark.parametrize(("at", "n"), [(1000, 4_000_000_000), (1 << 63, 1)])
def test_records_behind_the_points_are_not_trusted(damaged, kind, at, n):
    refused(damaged(kind, (235, "<Q", at), (243, "<I", n)), "ends before the last of its records")


@pytest.mark.parametrize("kind", FORMATS)
def test_an_offset_that_no_place_has(damaged, kind):
    refused(damaged(kind, (155, "<d", 1e40)), "is no number that a place has")
    refused(damaged(kind, (155, "<d", 9e8)), "coordinates (9000000")
    refused(damaged(kind, (131, "<d", 1e-300)), "is no number that a place has")


@pytest.mark.parametrize("kind", FORMATS)
def test_points_outside_of_the_box_that_is_stated(damaged, kind):
    refused(damaged(kind, (179, "<d", 414_725.0)), "points lie outside of the box that its header states")


@pytest.mark.parametrize("byte", [b"\0", b"\xff"])
@pytest.mark.parametrize("kind", ["las 1.2", "las 1.4"])
@pytest.mark.parametrize("part", [slice(1000, None), slice(500, 700)])
def test_points_that_a_disk_has_lost(tmp_path, byte, kind, part):
    """All of its length, and of one bit throughout at the end or within."""
    las, path = as_las(2000, kind), tmp_path / "a.las"
    las.return_number[:] = 1
    las.write(path)
    data = bytearray(path.read_bytes())
    begin, length = points_at(data), las.point_format.size
    first, last, _ = part.indices(2000)
    data[begin + first * length : begin + last * length] = byte * (last - first) * length
    path.write_bytes(data)
    refused(path, f"{last - first:,} of its points hold nothing but zeros")


def test_points_at_the_offset_are_points(tmp_path):
    """As scanners tell of what they don't see."""
    las = as_las(2000, "las 1.4")
    las.X[:20], las.Y[:20], las.Z[:20] = 0, 0, 0
    las.return_number[:] = 1
    las.write(tmp_path / "a.las")
    assert read_cloud(tmp_path / "a.las", crs=CRS).size == 2000


def test_one_stray_outside_of_the_box_costs_nothing_but_itself(damaged):
    path = damaged("las 1.2", (lambda data: points_at(data) + 34 * 77, "<i", 2_000_000_000))
    assert read_cloud(path, crs=CRS).size == 1999


@pytest.mark.parametrize(("at", "value", "axis"), [(131, 0.00117, "x"), (139, 0.0007, "y"), (163, 4_940_700.0004, "y")])
def test_a_scale_that_its_own_box_denies(damaged, at, value, axis):
    refused(damaged("laz 1.2", (at, "<d", value)), f"don't fit each other in {axis}")


COPC_INFO = 375 + 54
"""Where a COPC's cube, and then the place and length of its index, stand."""


@pytest.mark.parametrize("broken", ["circle", "root", "nodes", "cube"])
def test_an_index_is_not_trusted(damaged, broken):
    """It leads in circles, out of the file, to other chunks, or lies elsewhere: the file is read through."""
    path = damaged(COPC)
    data = bytearray(path.read_bytes())
    root, length = struct.unpack_from("<QQ", data, COPC_INFO + 40)
    low, high = points(2000).min(axis=0), points(2000).max(axis=0)
    struct.pack_into("<4d", data, COPC_INFO, *(low + high) / 2, 15.001 if broken != "cube" else 120.0)
    key = struct.pack("<4i", 0, 0, 0, 0)
    entry = key + data[root + 16 : root + 32]
    if broken == "circle":
        entry = key + struct.pack("<Qii", root, length, -1)
    elif broken == "nodes":
        entry = key + struct.pack("<Qii", 500, 1 << 30, 1000)
    data[root : root + 32] = entry
    if broken == "root":
        struct.pack_into("<Q", data, COPC_INFO + 48, 1 << 62)
    path.write_bytes(data)
    box = low + [0, 0, -1], low + [5, 5, 9]
    with opened(path, crs=CRS) as (_, _, layout):
        assert points_about(path, layout, box, laspy.DecompressionSelection.all()) is None
    near = shapely.box(*box[0][:2], *box[1][:2])
    assert read_cloud(path, crs=CRS, boundary=(near, CRS)).size == shapely.contains_xy(near, points(2000)[:, :2]).sum()


def test_what_a_decoder_says_of_damage_stays_with_us(damaged):
    """Ones where an arithmetic decoder begins have it panic, which it tells on stderr by itself."""
    path = damaged("laz 1.2", (lambda data: points_at(data) + 8 + 34, "<I", 0xFFFF_FFFF))
    done = vinemap("run", path, "--crs", "EPSG:32632", cwd=path.parent)
    assert_refused(done, path.name, "can't be read as LAS or LAZ")
    assert not (path.parent / "data").exists()


def outcome(path):
    """What comes of a file: a cloud, or a line that begins with its name."""
    try:
        read_cloud(path, crs=CRS)
    except InputError as error:
        return str(error).removeprefix(f"{path.parent}/").partition(": ")[0]
    return "a cloud"


def test_random_damage_ends_in_a_cloud_or_a_line(clouds, tmp_path):
    rng = np.random.default_rng(5)
    for k in range(120):
        whole = clouds[[*clouds][k % len(clouds)]]
        data = bytearray(whole.read_bytes())
        for at in rng.integers(0, len(data) if k % 2 else 700, 3):
            data[at] = rng.integers(256)
        path = tmp_path / f"{k}{''.join(whole.suffixes[-1:])}"
        path.write_bytes(data)
        assert outcome(path) in {"a cloud", path.name}
