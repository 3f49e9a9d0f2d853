"""The example survey, which comes with the package: made where it is configured and isn't there yet."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import click

from vinemap import paths
from vinemap.cloud.pdal.engine import check_engines
from vinemap.config.surveys import SurveyConfig, choose_parcel, load_survey
from vinemap.errors import InputError, OutputError
from vinemap.simulate.scenes import barolo
from vinemap.simulate.survey import write_survey

if TYPE_CHECKING:
    from pathlib import Path


def write_example() -> tuple[Path, Path]:
    """Write the example's configuration and its survey in this folder, if they aren't there; gives both.

    Raises
    ------
    OutputError
        If nothing can be written there.
    """
    try:
        if not paths.EXAMPLE.is_file():
            paths.EXAMPLE.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(paths.PACKED_EXAMPLE, paths.EXAMPLE)
        config = load_survey(paths.EXAMPLE)
        ensure_cloud(config)
    except OSError as error:
        raise OutputError(f"the example can't be written here ({error.strerror}): change to another folder") from error
    return paths.EXAMPLE, paths.survey_cloud(config.survey)


def ready(path: Path, parcel: str) -> tuple[SurveyConfig, str]:
    """Configuration of a survey in a file, and its parcel of a name, once all is there to map it.

    Raises
    ------
    VinemapError
        If it isn't.
    """
    config = load_survey(path)
    parcel = choose_parcel(config, parcel)
    check_engines([config.of_parcel(parcel).settings])
    ensure_cloud(config)
    return config, parcel


def ensure_cloud(config: SurveyConfig) -> None:
    """Simulate the survey if it is an example that has not been made yet.

    Raises
    ------
    InputError
        If the cloud of a real survey is missing.
    """
    cloud = paths.survey_cloud(config.survey)
    if config.cloud or cloud.is_file():
        return
    if config.simulate is None:
        raise InputError(f"{cloud}: no such file: put the cloud of survey {config.survey} there, or name it as 'cloud'")
    click.echo(f"Simulating the survey {config.survey} in {cloud.parent} (once)…", err=True)
    write_survey(barolo(), cloud.parent)
