"""Vine rows and light canopy meshes from UAV point clouds of vineyards.

What a notebook needs is here and loaded at its first use; everything else is imported from its room, as
``from vinemap.canopy.mesh import section_meshes``. A room may use those above it in this list, never those below::

    errors, naming, paths         one root exception; names of files, as any system takes them; where files lie
    compute, geo, config, cloud   threads and compiled loops; places; settings; points
    surfaces, rows, canopy        chapters 2 and 3 of the thesis, a stage a file
    evaluate, product, odometry   how good a map is; what a run leaves; chapter 4
    export, view                  other programs' formats; cloud, rows and meshes on a screen
    stages, chain, making         the stages' names; rows and canopies of a cloud; a product of them
    parcel, warm, jobs            a parcel, once; loops compiled ahead; many parcels and surveys
    plugin                        what calls vinemap from QGIS, and puts it there
    terminal, simulate, example   what people see in one; vineyards of known truth; that which comes with vinemap
    flows, cli, measure           the chain as flows of Prefect; the command line; accuracy and speed

``flows`` lies beside this package in the repository, and within it where that is installed. `tests/test_house.py` holds
the order, docs/method.md is the map of the house.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vinemap.chain import map_rows, model_canopies
    from vinemap.cloud.las import read_cloud
    from vinemap.config.settings import Settings
    from vinemap.evaluate.rows import evaluate_rows
    from vinemap.jobs.survey import map_survey
    from vinemap.odometry.step import estimate_motion
    from vinemap.parcel import map_parcel

__version__ = "0.2.0"
__all__ = [
    "Settings",
    "estimate_motion",
    "evaluate_rows",
    "map_parcel",
    "map_rows",
    "map_survey",
    "model_canopies",
    "read_cloud",
]

_ROOMS = {
    "Settings": "vinemap.config.settings",
    "estimate_motion": "vinemap.odometry.step",
    "evaluate_rows": "vinemap.evaluate.rows",
    "map_parcel": "vinemap.parcel",
    "map_rows": "vinemap.chain",
    "map_survey": "vinemap.jobs.survey",
    "model_canopies": "vinemap.chain",
    "read_cloud": "vinemap.cloud.las",
}


def __getattr__(name: str) -> object:
    """Load what this package offers from its room."""
    if name in _ROOMS:
        return getattr(import_module(_ROOMS[name]), name)
    raise AttributeError(f"module 'vinemap' has no attribute {name!r}")


def __dir__() -> list[str]:
    """What can be asked for, for completion."""
    return sorted({*globals(), *__all__})
