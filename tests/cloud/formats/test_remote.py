"""COPC files on a web server: what is fetched of them, and what is said where servers fail."""

from pathlib import Path

import numpy as np
import pytest
import shapely
from lasfiles import UTM, in_order, write_copc
from laspy.copc import Bounds, CopcReader, load_octree_for_query
from servers import serving

from vinemap.cloud.files import cloud_files
from vinemap.cloud.formats import remote
from vinemap.cloud.formats.identity import digest_of, stamp_of
from vinemap.cloud.las import read_cloud
from vinemap.cloud.pieces import read_piece, split_cloud
from vinemap.cloud.tiles import Collector
from vinemap.errors import BusyError, InputError

LOW, HIGH = (414_700, 4_940_700, 460), (414_760, 4_940_750, 470)
BOX = shapely.box(414_705, 4_940_705, 414_715, 4_940_717), UTM


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("served")
    write_copc(
        folder / "a.copc.laz", np.random.default_rng(0).uniform(LOW, HIGH, (30_000, 3)).round(3), levels=3, noise={3}
    )
    data = (folder / "a.copc.laz").read_bytes()
    points, behind = int.from_bytes(data[96:100], "little"), int.from_bytes(data[235:243], "little")
    (folder / "plain.laz").write_bytes(data.replace(b"copc", b"cops"))
    (folder / "nowhere.laz").write_bytes(data.replace(b"LASF_Projection", b"LASF_Elsewhere."))
    (folder / "damaged.laz").write_bytes(data[: points + 40].ljust(behind, b"\x01") + data[behind:])
    return folder


@pytest.fixture(autouse=True)
def hasty(monkeypatch):
    monkeypatch.setattr(remote, "PAUSE", 0.01)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)


def address(server, name="a.copc.laz"):
    return Path(f"{server.url}/{name}")


def test_only_what_lies_about_the_boundary_is_fetched(folder):
    with (folder / "a.copc.laz").open("rb") as stream:
        reader = CopcReader(stream)
        west, south, east, north = BOX[0].bounds
        near = Bounds(np.array([west, south, 0.0]), np.array([east, north, 1000.0]))
        nodes = load_octree_for_query(stream, reader.copc_info, reader.root_page, near)
        least = sum(node.byte_size for node in nodes if node.point_count > 0)
    with serving(folder) as server:
        cloud = read_cloud(address(server), boundary=BOX)
    assert least < server.sent <= 1.3 * least < 0.6 * (folder / "a.copc.laz").stat().st_size
    local = read_cloud(folder / "a.copc.laz", boundary=BOX)
    assert cloud.crs == local.crs
    assert np.array_equal(in_order(cloud.xyz), in_order(local.xyz))


def test_without_a_boundary_all_is_read(folder):
    with serving(folder) as server:
        assert np.array_equal(
            in_order(read_cloud(address(server)).xyz), in_order(read_cloud(folder / "a.copc.laz").xyz)
        )


def test_parcels_of_a_survey_are_fetched_at_once(folder, tmp_path):
    other = shapely.box(414_706, 4_940_718, 414_716, 4_940_722), UTM
    with serving(folder) as server:
        pieces = split_cloud(address(server), [BOX, other], tmp_path)
    assert server.sent < 0.6 * (folder / "a.copc.laz").stat().st_size
    for piece, boundary in zip(pieces, (BOX, other), strict=True):
        local = read_cloud(folder / "a.copc.laz", boundary=boundary)
        assert np.array_equal(in_order(read_piece(piece, Collector()).xyz), in_order(local.xyz))


@pytest.mark.parametrize("fault", [{"breaks": 3}, {"stalls": 1}, {"refusals": [503, 429]}])
def test_what_passes_is_asked_for_again(folder, monkeypatch, fault):
    if "stalls" in fault:
        monkeypatch.setattr(remote, "PATIENCE", 0.3)
    with serving(folder, **fault) as server:
        cloud = read_cloud(address(server), boundary=BOX)
    assert cloud.size == read_cloud(folder / "a.copc.laz", boundary=BOX).size
    assert server.breaks == server.stalls == len(server.refusals) == 0


def test_an_answer_that_broke_off_is_not_fetched_twice(folder):
    with serving(folder) as server:
        read_cloud(address(server), boundary=BOX)
    with serving(folder, breaks=3) as broken:
        read_cloud(address(broken), boundary=BOX)
    assert broken.sent == server.sent


@pytest.mark.parametrize(
    ("how", "name", "kind", "reason"),
    [
        ({"ranges": False}, "a.copc.laz", InputError, "gives whole files only, no ranges of bytes: download it"),
        ({"stalls": 99}, "a.copc.laz", BusyError, "can't be read now .*timed out.* after 4 attempts: try again"),
        ({"refusals": [503] * 9}, "a.copc.laz", BusyError, "can't be read now .the server says 503"),
        ({"refusals": [403]}, "a.copc.laz", InputError, "it may not be read .the server says 403"),
        ({}, "b.copc.laz", InputError, "b.copc.laz: there is no such file .the server says 404"),
        ({}, "plain.laz", InputError, "is no COPC, of which parts can be fetched: download it"),
        ({}, "nowhere.laz", InputError, "states no CRS for its coordinates: give it with --crs"),
        ({}, "damaged.laz", InputError, "can't be read as COPC .*: is it whole"),
    ],
)
def test_a_server_that_fails_is_told_in_a_line(folder, monkeypatch, how, name, kind, reason):
    if "stalls" in how:
        monkeypatch.setattr(remote, "PATIENCE", 0.05)
    with serving(folder, silence=0.3, **how) as server, pytest.raises(kind, match=reason) as caught:
        read_cloud(address(server, name), boundary=BOX)
    assert f"{server.url}/{name}: " in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_server_that_is_not_there():
    with pytest.raises(BusyError, match=r"http://127.0.0.1:9/a.copc.laz: can't be read now \(.*refused"):
        read_cloud(Path("http://127.0.0.1:9/a.copc.laz"), boundary=BOX)


def test_a_file_that_changes_is_another(folder):
    with serving(folder) as server:
        (path,) = cloud_files(address(server))
        before, digest = stamp_of(path), digest_of(path)
        assert (stamp_of(path), digest_of(path)) == (before, digest)
        signed = [address(server, f"a.copc.laz?signature={key}") for key in "12"]
        assert digest_of(signed[0]) == digest_of(signed[1]) == digest
        server.tag = '"2"'
        assert stamp_of(path) != before
        assert digest_of(path) != digest
        file = remote.Ranges(path)
        server.tag = '"3"'
        with pytest.raises(BusyError, match="changed while it was read"):
            file.fetch(5000, 6000)


@pytest.mark.parametrize(
    ("told", "when"), [("Thu, 01 Jan 1970 00:00:05 GMT", 5), ("", 0), ("0", 0), (f"1 Jan 1970 {'9' * 20}:00 GMT", 0)]
)
def test_a_servers_date_that_is_none_counts_as_none(folder, told, when):
    with serving(folder) as server:
        server.modified = told
        assert stamp_of(address(server))[1] == when * 10**9
