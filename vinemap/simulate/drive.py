"""A recording to try ``vinemap track`` on: ``python -m vinemap.simulate.drive FOLDER``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
import yaml

from vinemap import paths
from vinemap.odometry.poses import Pose
from vinemap.simulate.camera import LOW, PHOTOGRAPHS, lay_ground, render, sinusoid
from vinemap.simulate.grounds import MADE
from vinemap.terminal import frame_progress, plain_errors

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vinemap.simulate.camera import Ground

BEGUN = 1_778_745_600
"""Seconds since 1970 of the first frame: 14 May 2026, 8 h UTC."""
PERIOD = 0.2
"""Seconds from a frame to the next."""
ROOM = (10300.0, 1100.0)
"""Millimetres of ground that the thesis's path needs."""
AHEAD = 5750.0
"""Millimetres from the path's first pose to the middle of what its camera sees."""


def record(folder: Path, ground: Ground, poses: Sequence[Pose], *, seed: int = 0) -> None:
    """Write the frames of a drive, named by their time, and the file of the camera that took them."""
    import cv2

    frames = paths.drive_frames(folder)
    frames.mkdir(parents=True, exist_ok=True)
    for k, pose in enumerate(frame_progress(poses, len(poses))):
        image = render(ground, pose, seed=seed + k)
        cv2.imwrite(str(paths.drive_frame(frames, BEGUN + k * PERIOD)), image)
    keys = LOW.model_dump(exclude_defaults=True)
    paths.drive_camera(folder).write_text(yaml.safe_dump(keys, sort_keys=False), encoding="utf-8")


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--ground", type=click.Choice([*PHOTOGRAPHS, *MADE]), default="gravel", help="gravel by default.")
def command(folder: Path, ground: str) -> None:
    """Record the thesis's sinusoidal path of 9.6 m in FOLDER."""
    poses = [Pose(pose.x_mm - AHEAD, pose.y_mm, pose.heading_deg) for pose in sinusoid()]
    record(folder, lay_ground(ground, size_mm=ROOM, seed=1), poses)
    click.echo(f"{folder}: {len(poses)} frames")


if __name__ == "__main__":
    with plain_errors():
        command(standalone_mode=False)
