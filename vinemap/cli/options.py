"""Kinds of values that commands take, and options that are the same of several."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click


class FileParam(click.Path):
    """A file or a folder, which has a name: an empty one would be the folder where a command runs."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path in a text."""
        if not str(value):
            self.fail("its name is empty", param, ctx)
        return super().convert(value, param, ctx)


FILE = FileParam(path_type=Path)


class OriginParam(click.ParamType):  # type: ignore[type-arg]
    """Origin of {Main}."""

    name = "LAT,LON,ALT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The origin in a text, checked."""
        from vinemap.geo.main import Origin, check_origin

        try:
            lat, lon, alt = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(
                f"{value!r} isn't latitude, longitude and altitude: for example 44.61167,7.92442,428.7", param, ctx
            )
        return check_origin(Origin(lat, lon, alt))


class StartParam(click.ParamType):  # type: ignore[type-arg]
    """Where a robot's first frame was taken."""

    name = "LAT,LON,HEADING"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The start in a text, checked."""
        from vinemap.config.drives import Start, check_start

        try:
            start = Start(*(float(part) for part in str(value).split(",")))
        except (TypeError, ValueError):
            self.fail(
                f"{value!r} isn't latitude, longitude and heading in degrees: for example 44.61167,7.92442,72.5",
                param,
                ctx,
            )
        return check_start(start)


CRS = click.option(
    "--crs", help="CRS of the cloud, as EPSG:n, where it states none or a wrong one; local for local metres."
)
ROWS_CRS = click.option("--rows-crs", help="CRS of the known rows and vines, as EPSG:n, where their file states none.")
VINES = click.option(
    "--vines", type=FILE, help="Known vines, as points: where they stand isn't estimated. The same formats."
)
SETTINGS = click.option("--settings", type=FILE, help="YAML file with settings of the stages.")
