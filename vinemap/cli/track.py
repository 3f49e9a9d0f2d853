"""``vinemap track``: follow a robot by its camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from vinemap import paths
from vinemap.cli.options import FILE, StartParam
from vinemap.terminal import frame_progress

if TYPE_CHECKING:
    from pathlib import Path

SHARE = click.FloatRange(0, 0.8, min_open=True)
METHODS = ("aligned", "quadratic", "centroid", "maximum")


@click.command(short_help="Follow a robot by the frames of its camera.")
@click.argument("frames", nargs=-1, required=True, type=FILE)
@click.option("--camera", type=FILE, required=True, help="YAML file of the camera: see vinemap config camera.")
@click.option("--out", type=FILE, default=paths.TRACK, help="GeoPackage to write; track.gpkg by default.")
@click.option("--start", type=StartParam(), help="Where the first frame was taken, heading clockwise from north.")
@click.option("--rows", type=FILE, help="GeoPackage of vine rows, for the distance to the nearest one.")
@click.option(
    "--motion", type=FILE, help="CSV of time and wheel speeds or yaw rates, to bridge what frames don't tell."
)
@click.option("--fixes", type=FILE, help="CSV of time, lat, lon and accuracy_m of satellite fixes, to pull the track.")
@click.option(
    "--template-share",
    type=SHARE,
    default=0.2,
    help="Width of the template, of the images' shorter side; 0.2 by default.",
)
@click.option("--turn", type=click.FloatRange(1, 90), default=9.0, help="Most degrees a frame; 9 by default.")
@click.option(
    "--method", type=click.Choice(METHODS), default="aligned", help="How peaks are refined; aligned by default."
)
def track(
    frames: tuple[Path, ...],
    camera: Path,
    out: Path,
    start: Any,
    rows: Path | None,
    motion: Path | None,
    fixes: Path | None,
    template_share: float,
    turn: float,
    method: Any,
) -> None:
    """Follow a robot by the FRAMES of its camera that looks down: images, folders of images, or videos, in order."""
    from vinemap.config.drives import load_camera
    from vinemap.odometry.drive import map_drive

    summary = map_drive(
        frames,
        out,
        camera=load_camera(camera),
        start=start,
        rows=rows,
        motion=motion,
        fixes=fixes,
        template_share=template_share,
        angles=(-turn, turn),
        method=method,
        show=frame_progress,
    )
    click.echo(summary.line())
