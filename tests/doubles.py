"""Made-up work on parcels, quickly done or badly, which worker processes import."""

import ctypes
import json
import os
import signal
import sys
import time
from types import SimpleNamespace

from vinemap import errors, paths
from vinemap.product import store


def follow(recipe, folder, *, piece=None, drafts=None, within=None):
    """Leave a product of two files, unless the parcel's name tells of something else."""
    began = time.perf_counter()
    with store.product(folder, drafts=drafts, within=within) as draft:
        paths.geopackage(draft, recipe.parcel).write_text(recipe.parcel)
        deed = DEEDS.get(recipe.parcel.split()[0])
        if deed:
            deed()
        points = piece.path.stat().st_size // 24 if piece else 0
        (draft / "points.txt").write_text(str(points))
        record = {
            "key": recipe.key,
            "parcel": recipe.parcel,
            "survey": recipe.survey,
            "counts": {"rows": 3},
            "length_m": 12.5,
            "warnings": ["made up"],
            "settings": recipe.settings.model_dump(mode="json"),
            "files": {path.name: path.stat().st_size for path in draft.iterdir()},
        }
        (draft / "run.json").write_text(json.dumps(record))
    return SimpleNamespace(rows=3, length=12.5, seconds=time.perf_counter() - began, warnings=("made up",))


def refuse():
    raise errors.InputError("no vines here")


def lack():
    raise errors.GridError("not without the grid")


def die():
    raise errors.WorkerError("its process died")


def divide():
    return 1 / 0


def hang():
    time.sleep(600)


def gorge():
    return bytes(30 * 10**9)


def leave():
    sys.exit(7)


def crash():
    ctypes.string_at(0)


def kill():
    os.kill(os.getpid(), signal.SIGKILL)


DEEDS = {
    "refuses": refuse,
    "lacks": lack,
    "dies": die,
    "divides": divide,
    "hangs": hang,
    "gorges": gorge,
    "aborts": os.abort,
    "leaves": leave,
    "crashes": crash,
    "kills": kill,
}
