"""Drives of a robot as a Prefect flow: each is a flow run of its own, its stages are task runs.

``python -m flows.odometry configs/drives.yaml``
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from prefect import flow, get_run_logger
from prefect.states import Completed, Failed

from vinemap import paths
from vinemap.config.drives import DrivesConfig, load_camera, load_drives
from vinemap.errors import ConfigError, OutputError, VinemapError, own_fault
from vinemap.odometry.drive import map_drive
from vinemap.terminal import frame_progress, plain_errors

from .parcel import as_tasks

if TYPE_CHECKING:
    from collections.abc import Callable

    from prefect import State

    from vinemap.config.camera import Camera
    from vinemap.odometry.drive import DriveSummary


@flow(name="drive", flow_run_name="{drive}", persist_result=False, validate_parameters=False)
def drive_flow(drive: str, config: DrivesConfig, camera: Camera) -> DriveSummary:
    """Follow a robot through one of its drives."""
    own, options = config.drives[drive], config.odometry
    return map_drive(
        own.frames,
        paths.track(config.out, drive),
        camera=camera,
        start=own.start,
        rows=config.rows if own.start else None,
        motion=own.motion,
        fixes=own.fixes,
        template_share=options.template_share,
        angles=(-options.turn_deg, options.turn_deg),
        method=options.method,
        show=frame_progress,
        step=as_tasks(_plainly),
    )


@flow(name="odometry", persist_result=False, validate_parameters=False)
def odometry_flow(config: DrivesConfig, camera: Camera) -> State[list[str]]:
    """Make the tracks of all drives; failed if one of them fails, which costs no other."""
    log = get_run_logger()
    failed = []
    for drive in config.drives:
        try:
            said = drive_flow(drive, config, camera).line()
        except VinemapError as error:
            failed.append(f"{drive}: {error}")
        except Exception as error:  # noqa: BLE001 - of one drive, that others shouldn't suffer from
            failed.append(f"{drive}: {own_fault(error)}")
        else:
            log.info(said)
            click.echo(said)
            continue
        log.error(failed[-1])
        click.echo(" ".join(f"vinemap: {failed[-1]}".split()), err=True)
    message = f"{len(failed)} of {len(config.drives)} drives failed"
    return Failed(message=message, data=failed) if failed else Completed(message=f"{len(config.drives)} drives")


def _plainly(name: str, function: Callable[..., Any]) -> Any:
    del name
    return function()


def main() -> None:
    """Make the tracks that are configured in the file named on the command line; exit code 1 if one fails."""
    with plain_errors():
        if len(sys.argv) != 2:
            raise ConfigError("give the configuration of drives: python -m flows.odometry configs/drives.yaml")
        config = load_drives(Path(sys.argv[1]))
        camera = load_camera(config.camera)
        try:
            config.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{config.out}: can't be made ({error.strerror}): choose another 'out'") from error
        if odometry_flow(config, camera, return_state=True).is_failed():
            sys.exit(1)


if __name__ == "__main__":
    main()
