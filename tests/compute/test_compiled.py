"""Compiled functions call others across files; what is kept of them goes when any of these changes."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from systems import POSIX

import vinemap
from vinemap.compute import compiled

CALLER = """
from vinemap.compute.compiled import compiled
from vinemap.rows.callee import FACTOR, twice

@compiled
def answer(x):
    return FACTOR * twice(x)
"""
CALLEE = """
from vinemap.compute.compiled import compiled

FACTOR = {factor}

@compiled
def twice(x):
    return {times} * x
"""
ASK = """
from numba import config
from vinemap.rows.caller import answer
kept = answer(1.0)
stats = answer.stats
print(kept, sum(stats.cache_hits.values()), repr(config.CACHE_DIR))
"""


@pytest.fixture
def package(tmp_path):
    """A copy of the package's beginnings, with a compiled function that calls another's file."""
    here = tmp_path / "site" / "vinemap"
    for name in ("__init__.py", "compute"):
        source = Path(vinemap.__file__).parent / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        copy(source, here / name, **({"ignore": shutil.ignore_patterns("__pycache__")} if source.is_dir() else {}))
    (here / "rows").mkdir()
    (here / "rows" / "__init__.py").touch()
    (here / "rows" / "caller.py").write_text(CALLER)
    (here / "rows" / "callee.py").write_text(CALLEE.format(factor=1, times=2))
    return here


def ask(package, **environment):
    """What the function answers in a process of its own, whether it was kept, and numba's own setting."""
    known = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
    known |= {"PYTHONPATH": str(package.parent), "HOME": str(package.parents[1] / "home")} | environment
    known["PYTHONDONTWRITEBYTECODE"] = "1"  # bytecode is taken for a source of the same second and size
    done = subprocess.run(
        [sys.executable, "-c", ASK], env=known, cwd=package.parents[1], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    value, hits, own = done.stdout.split(maxsplit=2)
    return float(value), int(hits), own.strip()


def folders(home):
    return sorted(path.name for path in home.glob("compiled-*"))


def test_a_change_in_a_callees_file_counts(package):
    assert ask(package) == (2.0, 0, "''")
    assert ask(package) == (2.0, 1, "''")
    callee = package / "rows" / "callee.py"
    callee.write_text(CALLEE.format(factor=10, times=3))
    assert ask(package)[:2] == (30.0, 0)
    callee.write_text(CALLEE.format(factor=1, times=2))
    assert ask(package)[:2] == (2.0, 1)
    assert len(folders(package / "__pycache__")) == 2


def test_what_is_left_of_earlier_sources_is_swept(package):
    ask(package)
    home = package / "__pycache__"
    (old,) = folders(home)
    (home / "compiled-recent").mkdir()
    (home / "something").mkdir()
    day = time.time() - 2 * compiled.KEPT
    for name in (old, "something"):
        os.utime(home / name, (day, day))
    (package / "rows" / "callee.py").write_text(CALLEE.format(factor=2, times=2))
    assert ask(package)[0] == 4.0
    assert old not in folders(home)
    assert "compiled-recent" in folders(home)
    assert (home / "something").is_dir()


def test_a_folder_of_ones_own(package, tmp_path):
    own = tmp_path / "own"
    assert ask(package, NUMBA_CACHE_DIR=str(own)) == (2.0, 0, repr(str(own)))
    assert ask(package, NUMBA_CACHE_DIR=str(own))[1] == 1
    assert len(folders(own)) == 1
    assert folders(package / "__pycache__") == []


@POSIX
@pytest.mark.parametrize("home", ["writable", "closed"])
def test_a_package_that_nobody_may_write_to(package, home):
    """Its cache goes to the user's home, and where that is closed too, each process compiles anew."""
    (package / "__pycache__").write_text("a file, so that there is no folder, even for root")
    place = package.parents[1] / "home"
    if home == "closed":
        place.write_text("a file")
    elsewhere = {"XDG_CACHE_HOME": str(place / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    assert ask(package, **elsewhere)[:2] == (2.0, 0)
    assert ask(package, **elsewhere)[:2] == (2.0, 1 if home == "writable" else 0)
