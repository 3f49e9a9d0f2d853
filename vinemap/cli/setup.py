"""``vinemap warm`` and ``vinemap qgis-plugin``: what is done once, when vinemap has been installed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from vinemap.cli.options import FILE
from vinemap.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path


@click.command(short_help="Compile ahead what is slow in Python.")
def warm() -> None:
    """Compile what is slow in Python and keep it, as the first run would; at once where that is done."""
    from vinemap import warm

    click.echo(warm.warm().line())


@click.command("qgis-plugin", short_help="Write the plugin for QGIS.")
@click.option("--zip", "packed", type=FILE, help="File to write, for Install from ZIP; vinemap_qgis.zip by default.")
@click.option("--install", is_flag=True, help="Put it into your profile of QGIS instead.")
@click.option("--profile", help="Which profile; default by default.")
@click.option("--out", type=FILE, help="Folder to put its folder into instead.")
def qgis_plugin(packed: Path | None, install: bool, profile: str | None, out: Path | None) -> None:
    """Write the plugin for QGIS 3.22 and later, whose Processing algorithms call this vinemap."""
    from vinemap import paths
    from vinemap.plugin.install import profile_plugins, write_folder, write_zip

    if sum([packed is not None, install, out is not None]) > 1:
        raise ConfigError("--zip, --install and --out say different places: give one of them")
    if profile is not None and not install:
        raise ConfigError("--profile goes with --install")
    if install or out:
        place = write_folder(out or profile_plugins(profile or "default"))
        click.echo(f"{place}: enable vinemap in QGIS's Plugins › Manage and Install Plugins, or start QGIS anew")
    else:
        place = packed or paths.PLUGIN_ZIP
        write_zip(place)
        click.echo(f"{place}: take it in QGIS's Plugins › Manage and Install Plugins › Install from ZIP")
