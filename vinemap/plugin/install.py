"""The plugin as a zip that QGIS installs, or as a folder where it looks for plugins."""

from __future__ import annotations

import configparser
import os
import shutil
import sys
import zipfile
from pathlib import Path

import platformdirs

from vinemap import __version__, paths
from vinemap.errors import OutputError
from vinemap.product.store import drafted, unwritable

NAME = "vinemap"
"""What QGIS calls the plugin, and its folder."""
DATE = (2000, 1, 1, 0, 0, 0)
"""Of files in the zip, so that the same version gives the same."""


def plugin_files() -> dict[str, bytes]:
    """Files of the plugin by name, with this version and where this vinemap is."""
    own = [path for path in sorted(paths.PLUGIN.iterdir()) if path.is_file()]
    files = {path.name: path.read_bytes() for path in own}
    files[paths.PLUGIN_ABOUT] = files[paths.PLUGIN_ABOUT].replace(b"{version}", __version__.encode())
    if command := _this_command():
        files[paths.PLUGIN_COMMAND] = f"{command}\n".encode()
    return files


def _this_command() -> str | None:
    """Path of the command that runs, or of the one that belongs to this Python."""
    called = Path(sys.argv[0])
    found = shutil.which(called) if called.stem == NAME else None
    found = found or shutil.which(NAME, path=str(Path(sys.executable).parent))
    return str(Path(found).absolute()) if found else None


def write_zip(path: Path) -> None:
    """Write the zip that QGIS's *Install from ZIP* takes, in place of an earlier one.

    Raises
    ------
    OutputError
        If it can't be written, or another file has that name.
    """
    if path.exists() and not _is_our_zip(path):
        raise OutputError(f"{path}: is there already, and no plugin of vinemap's: choose another name")
    try:
        with drafted(path) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as packed:
            for name, content in plugin_files().items():
                packed.writestr(zipfile.ZipInfo(f"{NAME}/{name}", DATE), content, zipfile.ZIP_DEFLATED)
    except OSError as error:
        raise unwritable(path, error) from error


def write_folder(plugins: Path) -> Path:
    """Put the plugin's folder into one of plugins, in place of an earlier one.

    Raises
    ------
    OutputError
        If it can't be written, or a folder of that name holds something else.
    """
    place = plugins / NAME
    about = place / paths.PLUGIN_ABOUT
    if place.exists() and not (about.is_file() and _is_ours(about.read_bytes())):
        raise OutputError(f"{place}: is there already, and not vinemap's plugin: move it away")
    draft = plugins / f".{NAME}.part"
    try:
        plugins.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir()
        for name, content in plugin_files().items():
            (draft / name).write_bytes(content)
        shutil.rmtree(place, ignore_errors=True)
        draft.rename(place)
    except OSError as error:
        raise unwritable(place, error) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return place


def profile_plugins(profile: str) -> Path:
    """Folder of the plugins of one of the user's profiles in QGIS.

    Raises
    ------
    OutputError
        If there is no such profile.
    """
    home = _home() / "profiles"
    if not (home / profile).is_dir():
        there = sorted(path.name for path in home.iterdir() if path.is_dir()) if home.is_dir() else []
        advice = f"name one of them with --profile: {', '.join(there)}" if there else "start QGIS once"
        raise OutputError(f"{home}: has no profile {profile!r} of QGIS: {advice}")
    return home / profile / "python" / "plugins"


def _home() -> Path:
    """Where QGIS keeps what is the user's."""
    own = os.environ.get("QGIS_CUSTOM_CONFIG_PATH")
    return Path(own) if own else platformdirs.user_data_path("QGIS", appauthor=False, roaming=True) / "QGIS3"


def _is_our_zip(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as packed:
            return _is_ours(packed.read(f"{NAME}/{paths.PLUGIN_ABOUT}"))
    except (OSError, KeyError, zipfile.BadZipFile):
        return False


def _is_ours(about: bytes) -> bool:
    """Whether a plugin says that it is this one."""
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(about.decode())
    except (configparser.Error, UnicodeDecodeError):
        return False
    return parser.get("general", "name", fallback="") == NAME
