"""PDAL where it is installed, else a stand-in that works as it does; tests of what ends a process have that alone."""

import importlib.util
import sys
from pathlib import Path

import pytest

from vinemap.cloud.pdal import ground, reader
from vinemap.cloud.pdal.engine import load_pdal
from vinemap.errors import DependencyError

STAND_INS = Path(__file__).parents[2] / "stand_ins"


@pytest.fixture
def stand_in(monkeypatch):
    """The stand-in, here and in other processes."""
    spec = importlib.util.spec_from_file_location("pdal", STAND_INS / "pdal" / "__init__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, "pdal", module)
    monkeypatch.setattr(sys, "path", [str(STAND_INS), *sys.path])
    return module


@pytest.fixture
def pdal(request, monkeypatch):
    """PDAL or the stand-in, called in this process, as others are slow to start."""
    try:
        module = load_pdal()
    except DependencyError:
        module = request.getfixturevalue("stand_in")
    for room in (reader, ground):
        monkeypatch.setattr(room, "apart", lambda function, *args: function(*args))
    return module
