"""Disks on which files can't be locked, as shares of some kinds: a library to preload stands in for one."""

import os
import shutil
import subprocess
import sys

import geopandas as gpd
import pytest
from systems import LINUX

from vinemap import paths

C = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#define LOCKLESS(name) int name(int fd, int what, ...) { \\
    va_list rest; va_start(rest, what); void *given = va_arg(rest, void *); va_end(rest); struct flock *lock = given; \\
    if ((what == F_SETLK || what == F_SETLKW) && (WHEN)) { errno = EAGAIN; return -1; } \\
    int (*real)(int, int, ...) = dlsym(RTLD_NEXT, #name); return real(fd, what, given); }
LOCKLESS(fcntl)
LOCKLESS(fcntl64)
"""
WHEN = {
    "at the end of a write": "lock->l_type == F_WRLCK && lock->l_start == 0x40000002",
    "of writers": "lock->l_type == F_WRLCK",
    "of all": "lock->l_type != F_UNLCK",
}
WRITE = """
import sys
from pathlib import Path
import geopandas as gpd
from vinemap.product.geopackage import write_geopackage, write_layer
from vinemap.product.layers import LAYERS
at = {"geometry": gpd.points_from_xy([1], [2], [3])}
frame = gpd.GeoDataFrame({"row_id": [7]}, crs=32632, **at)
ends = gpd.GeoDataFrame({"row_id": [7], "label": "7", "end": "E1", "beyond": "seen"}, crs=4326, **at)
write_layer(frame, Path(sys.argv[1]), layer="track")
write_layer(frame, Path(sys.argv[1]), layer="track")
write_geopackage({"row_ends": ends}, Path(sys.argv[2]), contract={"row_ends": LAYERS["row_ends"]})
"""


@LINUX
@pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")
@pytest.mark.parametrize("when", WHEN)
def test_geopackages_are_written_without_locks(tmp_path, when):
    library = tmp_path / "lock.so"
    command = ["gcc", "-x", "c", "-", "-shared", "-fPIC", f"-DWHEN={WHEN[when]}", "-ldl", "-o", str(library)]
    subprocess.run(command, input=C, text=True, check=True)
    (tmp_path / "out").mkdir()
    made = paths.track(tmp_path / "out", "drive"), paths.geopackage(tmp_path / "out", "F")
    settings = os.environ | {"LD_PRELOAD": str(library)}
    done = subprocess.run(
        [sys.executable, "-c", WRITE, *map(str, made)], env=settings, capture_output=True, text=True, check=False
    )
    assert (done.stderr, done.returncode) == ("", 0)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["F.gpkg", "drive_track.gpkg"]
    assert [gpd.read_file(path, layer=0).row_id.tolist() for path in made] == [[7], [7]]
