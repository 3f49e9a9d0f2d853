"""Whether PDAL can be used here, which version of it, and what stages it is to run.

Options of stages are those of https://pdal.io/stages. Everything here asks for its package only when it is called.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from typing import TYPE_CHECKING, Any

from vinemap.errors import ConfigError, DependencyError, reason_of

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from vinemap.config.settings import GroundOptions, Settings

OLDEST = (2, 7)
"""Version of PDAL that is needed, for Python's package of today asks for it."""
MOVING = ("filters.reprojection",)
"""Filters that would bring points away from where they are looked for."""


def load_pdal() -> Any:
    """PDAL's Python package.

    Raises
    ------
    DependencyError
        If it isn't installed, is too old, or its library can't be loaded.
    """
    try:
        import pdal

        _check_version(str(pdal.info.version))
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        reason = reason_of(error)
        raise DependencyError(
            f"ground.engine: pdal wants PDAL, which can't be loaded ({reason}): conda install -c conda-forge "
            "python-pdal, or leave ground.engine out, as vinemap has an engine of its own"
        ) from error
    return pdal


def _check_version(version: str) -> None:
    if tuple(map(int, re.findall(r"\d+", version)[:2])) < OLDEST:
        raise ImportError(f"{version} is older than {'.'.join(map(str, OLDEST))}")


def pdal_versions() -> dict[str, str]:
    """Versions of PDAL's Python package and of its library."""
    pdal = load_pdal()
    return {"pdal": str(pdal.__version__), "libpdal": str(pdal.info.version)}


def check_engines(settings: Iterable[Settings]) -> None:
    """Do nothing if the engines that settings name can run here.

    Raises
    ------
    DependencyError
        If one is PDAL, and PDAL can't be loaded.
    ConfigError
        If its pipeline can't be used.
    """
    for ground in dict.fromkeys(one.ground for one in settings):
        if ground.engine == "pdal":
            load_pdal()
            stages_of(ground)


def made_by(ground: GroundOptions) -> dict[str, str]:
    """What a product depends on beside the settings: PDAL's versions, and the content of its pipeline's file."""
    if ground.engine != "pdal":
        return {}
    stages = json.dumps(stages_of(ground), sort_keys=True)
    return pdal_versions() | {"stages": hashlib.sha256(stages.encode()).hexdigest()}


def stages_of(ground: GroundOptions) -> list[dict[str, Any]]:
    """Filters that classify ground: those of a pipeline's file, or else the one that is named, with its options.

    Raises
    ------
    ConfigError
        If the file can't be read, or holds no pipeline of filters that PDAL has.
    """
    if ground.pipeline is None:
        return [{"type": f"filters.{ground.filter}", **getattr(ground, ground.filter).model_dump()}]
    return _checked(_read(ground.pipeline), ground.pipeline)


def _read(path: Path) -> Any:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file: ground.pipeline names a pipeline of PDAL's in JSON") from error
    except OSError as error:
        raise ConfigError(f"{path}: can't be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: no valid JSON ({error})") from error
    return data.get("pipeline") if isinstance(data, dict) else data


def _checked(stages: Any, path: Path) -> list[dict[str, Any]]:
    if not isinstance(stages, list) or not stages:
        raise ConfigError(f"{path}: holds no pipeline: a list of PDAL's filters is wanted, or one under pipeline")
    known = {f"filters.{name}" for name in vars(load_pdal().Filter) if not name.startswith("_")}
    for stage in stages:
        kind = stage.get("type") if isinstance(stage, dict) else stage
        if isinstance(stage, str) or str(kind).startswith(("readers.", "writers.")):
            raise ConfigError(
                f"{path}: holds {kind}: leave readers and writers out, as vinemap reads and writes itself"
            )
        if not isinstance(kind, str):
            raise ConfigError(f"{path}: one of its stages has no type, as filters.smrf")
        if kind not in known:
            near = difflib.get_close_matches(kind, known, n=1)
            hint = f"did you mean {near[0]}?" if near else "pdal --drivers lists what it has"
            raise ConfigError(f"{path}: holds {kind}, which this PDAL doesn't have: {hint}")
        if kind in MOVING:
            raise ConfigError(f"{path}: holds {kind}: leave it out, as points are in metres already")
    return stages
