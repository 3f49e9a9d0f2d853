"""Configurations of a robot: its camera, and drives whose tracks are made in one job."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import Field

from vinemap.config.camera import Camera
from vinemap.config.names import Name
from vinemap.config.settings import OdometryOptions, Options
from vinemap.config.yaml_files import checked_by, read_yaml, validated
from vinemap.errors import ConfigError
from vinemap.geo.main import Origin, check_origin


class Start(NamedTuple):
    """Where a robot's first frame was taken: WGS84 latitude and longitude, heading clockwise from north, in degrees."""

    lat: float
    lon: float
    heading_deg: float


def check_start(start: Start) -> Start:
    """Return a start that lies on the globe.

    Raises
    ------
    ConfigError
        If it doesn't, or its heading is no angle.
    """
    check_origin(Origin(start.lat, start.lon, 0.0))
    if not abs(start.heading_deg) <= 360:
        raise ConfigError(f"heading {start.heading_deg:g}: give degrees clockwise from north")
    return start


MapStart = Annotated[Start, checked_by(check_start)]


class DriveConfig(Options):
    """One drive of a robot."""

    frames: list[Path] = Field(min_length=1, description="images, folders of images, or videos, in order")
    start: MapStart | None = Field(None, description="latitude, longitude, heading clockwise from north (degrees)")
    motion: Path | None = Field(None, description="CSV of wheel speeds or yaw rates")
    fixes: Path | None = Field(None, description="CSV of satellite fixes; they want a start")


class DrivesConfig(Options):
    """Drives of a robot whose tracks are made in one job."""

    camera: Path = Field(description="file of the robot's camera")
    rows: Path | None = Field(None, description="vine rows, for the distance to the nearest one")
    out: Path = Field(Path("data/tracks"), description="folder of the tracks")
    odometry: OdometryOptions = OdometryOptions()
    drives: dict[Name, DriveConfig] = Field(min_length=1, description="the drives by their names")


def load_drives(path: Path) -> DrivesConfig:
    """Read the YAML file of a robot's drives; ConfigError names the key, its value and what it may be."""
    return validated(DrivesConfig, read_yaml(path), path)


def load_camera(path: Path) -> Camera:
    """Read the YAML file of a robot's camera; ConfigError names the key, its value and what it may be."""
    return validated(Camera, read_yaml(path), path)
