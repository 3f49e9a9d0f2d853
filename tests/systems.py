"""Marks of tests that want what not every system has."""

import os
import sys

import pytest

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="needs what only Linux has")
POSIX = pytest.mark.skipif(os.name != "posix", reason="needs links, signals, times or names of files as POSIX has them")
