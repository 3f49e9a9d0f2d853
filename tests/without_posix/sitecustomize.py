"""Python as on a system that isn't POSIX: it reads this as it starts, where this folder is among its paths."""

import os
import signal
import sys
from importlib.abc import MetaPathFinder

from posix_only import CALLS, MODULES, SIGNALS


class Hiding(MetaPathFinder):
    """Refuses what only POSIX has."""

    def find_spec(self, name, path=None, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, Hiding())
for name in MODULES & set(sys.modules):
    del sys.modules[name]
for name in SIGNALS:
    delattr(signal, name)
for name in CALLS:
    delattr(os, name)
