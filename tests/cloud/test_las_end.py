"""Files that are cut anywhere are told from whole ones."""

import os
import struct

import laspy
import numpy as np
import pytest
from lasfiles import FORMATS, as_las

from vinemap.cloud.las_end import unfinished


def cuts(whole):
    """Lengths at which a file is cut: all of its beginning and its end, many between."""
    near = {*range(700), *range(len(whole) - 300, len(whole))}
    return sorted(near | set(np.linspace(0, len(whole) - 1, 200).astype(int).tolist()))


@pytest.mark.parametrize("kind", [*FORMATS, "evlr", "copc"])
def test_a_file_that_is_cut_is_unfinished_and_a_whole_one_never(clouds, tmp_path, kind):
    if kind not in clouds:
        pytest.skip("needs copclib, which writes COPC files")
    whole = clouds[kind].read_bytes()
    assert unfinished(clouds[kind]) == ""
    path = tmp_path / clouds[kind].name
    path.write_bytes(whole)
    slipped = []
    for n in reversed(cuts(whole)):
        os.truncate(path, n)
        if not unfinished(path):
            slipped.append(len(whole) - n)
    assert slipped == []


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("n", [0, 1, 120_000])
def test_few_points_and_many(tmp_path, kind, n):
    path = tmp_path / f"a.{kind[:3]}"
    as_las(n, kind).write(path)
    assert unfinished(path) == ""
    size = path.stat().st_size
    for less in (1, 2, 5, 12) if n else ():
        os.truncate(path, size - less)
        assert unfinished(path)


@pytest.mark.parametrize("kind", ["laz 1.2", "laz 1.4"])
def test_a_file_whose_writer_could_not_go_back(clouds, tmp_path, kind):
    """The place of its table of chunks is its last number then, and -1 where it is otherwise."""
    whole = bytearray(clouds[kind].read_bytes())
    (offset,) = struct.unpack("<I", whole[96:100])
    whole += whole[offset : offset + 8]
    whole[offset : offset + 8] = struct.pack("<q", -1)
    path = tmp_path / "a.laz"
    path.write_bytes(whole)
    assert len(laspy.read(path).points) == 2000
    assert unfinished(path) == ""
    slipped = []
    for n in reversed(cuts(whole)):
        os.truncate(path, n)
        if not unfinished(path):
            slipped.append(len(whole) - n)
    assert slipped == []


@pytest.mark.parametrize("kind", ["las 1.4", "laz 1.4"])
def test_a_file_of_its_full_length_that_holds_zeros_at_its_end(clouds, tmp_path, kind):
    """As tools leave it that make room first. Of LAS nothing tells."""
    whole = clouds[kind].read_bytes()
    path = tmp_path / "a.laz"
    for n in (0, 4, 100, 300, 500, 1000, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:n] + bytes(len(whole) - n))
        assert bool(unfinished(path)) == (kind.startswith("laz") and n >= 300), n


def test_what_is_no_cloud_is_not_called_unfinished(tmp_path):
    for content in (b"no cloud at all", bytes(1000), b"LASX" * 200):
        (tmp_path / "a.laz").write_bytes(content)
        assert unfinished(tmp_path / "a.laz") == ""


def test_a_broken_header_is_no_reason_to_break(clouds, tmp_path):
    """Random bytes in the header of a whole file: something is said, or nothing, but soon."""
    rng = np.random.default_rng(0)
    for kind in ("las 1.4", "laz 1.2", "evlr"):
        whole = bytearray(clouds[kind].read_bytes())
        path = tmp_path / "a.laz"
        for _ in range(100):
            broken = whole.copy()
            for k in rng.integers(4, 450, 4):
                broken[k] = rng.integers(256)
            path.write_bytes(broken)
            assert isinstance(unfinished(path), str)
