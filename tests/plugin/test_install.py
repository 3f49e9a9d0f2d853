"""The plugin as files: what is written where, what is left alone, and that it says what the command line takes."""

import ast
import configparser
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest
from click.testing import CliRunner
from commands import ROOT

from vinemap import __version__, export, paths
from vinemap.cli.main import commands
from vinemap.cloud.formats.kinds import KINDS
from vinemap.errors import ConfigError, OutputError

SOURCES = {path.stem: path.read_text(encoding="utf-8") for path in paths.PLUGIN.glob("*.py")}
LEFT_OUT = {
    "run": {"--rows-crs"},
    "survey": {"--rows-crs", "--engine", "--scheduler"},
    "export": set(),
    "evaluate": {"--layer"},
}
"""Options that are none of the plugin's: a layer in QGIS has a CRS and a name, and a desk no cluster."""
WANTED = {"name", "description", "about", "version", "qgisMinimumVersion", "author", "email", "tracker", "repository"}
"""What QGIS's repository of plugins wants to know of one."""


@pytest.fixture
def say(tmp_path, monkeypatch):
    """Runs the command in a folder of its own; gives what it says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("QGIS_CUSTOM_CONFIG_PATH", str(tmp_path / "qgis"))

    def run(*words):
        words = ["qgis-plugin", *map(str, words)]
        return CliRunner().invoke(commands, words, catch_exceptions=False, standalone_mode=False).stdout

    return run


def test_the_zip_is_what_qgis_takes(say, tmp_path, monkeypatch):
    command = tmp_path / "bin" / "vinemap"
    command.parent.mkdir()
    command.write_text("")
    command.chmod(0o755)
    monkeypatch.setattr(sys, "argv", [str(command)])
    for _ in range(2):
        assert (
            say() == f"{paths.PLUGIN_ZIP}: take it in QGIS's Plugins › Manage and Install Plugins › Install from ZIP\n"
        )
    with ZipFile(paths.PLUGIN_ZIP) as packed:
        files = {name: packed.read(name).decode() for name in packed.namelist()}
    assert {name.partition("/")[0] for name in files} == {"vinemap"}
    assert {f"vinemap/{name}.py" for name in SOURCES} <= set(files)
    about = configparser.ConfigParser(interpolation=None)
    about.read_string(files["vinemap/metadata.txt"])
    general = about["general"]
    assert {name for name in WANTED if general.get(name)} >= WANTED
    assert general["version"] == __version__
    assert general.getboolean("hasProcessingProvider")
    assert f"vinemap/{general['icon']}" in files
    assert files["vinemap/LICENSE"] == (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert files["vinemap/command.txt"] == f"{command}\n"
    assert [path.name for path in tmp_path.iterdir() if path.name.endswith(".part")] == []


def test_it_goes_into_a_profile_of_qgis(say, tmp_path):
    with pytest.raises(OutputError, match="no profile 'default' of QGIS: start QGIS once"):
        say("--install")
    (tmp_path / "qgis" / "profiles" / "work").mkdir(parents=True)
    with pytest.raises(OutputError, match="name one of them with --profile: work"):
        say("--install")
    place = tmp_path / "qgis" / "profiles" / "work" / "python" / "plugins" / "vinemap"
    assert say("--install", "--profile", "work").startswith(f"{place}: enable vinemap")
    (place / "old.py").write_text("of an earlier version")
    say("--install", "--profile", "work")
    assert {path.stem for path in place.glob("*.py")} == set(SOURCES)
    assert [path.name for path in place.parent.iterdir()] == ["vinemap"]


def test_what_is_another_s_is_left_alone(say, tmp_path):
    (tmp_path / "my.zip").write_text("mine")
    (tmp_path / "vinemap").mkdir()
    (tmp_path / "vinemap" / "metadata.txt").write_text("[general]\nname=Other\n")
    for words in (("--zip", "my.zip"), ("--out", tmp_path)):
        with pytest.raises(OutputError, match="is there already"):
            say(*words)
    assert (tmp_path / "my.zip").read_text() == "mine"
    assert [path.name for path in (tmp_path / "vinemap").iterdir()] == ["metadata.txt"]
    for words in (("--zip", "a.zip", "--install"), ("--profile", "work")):
        with pytest.raises(ConfigError):
            say(*words)


@pytest.mark.parametrize("source", SOURCES.values(), ids=SOURCES)
def test_it_runs_in_the_python_of_qgis_and_needs_nothing_beside(source):
    tree = ast.parse(source, feature_version=(3, 8))
    named = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and not node.level]
    named += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    roots = {name.partition(".")[0] for name in named}
    assert roots - {"qgis", "processing"} <= sys.stdlib_module_names


@pytest.mark.parametrize("name", LEFT_OUT)
def test_parameters_are_the_options_of_the_command(name):
    source = SOURCES["parcel" if name == "run" else name]
    common = SOURCES["algorithm"] if "MAPPING" in source else ""
    said = [node.value for node in ast.walk(ast.parse(source + common)) if isinstance(node, ast.Constant)]
    flags = {word for word in said if isinstance(word, str) and word.startswith("--") and len(word) > 2}
    taken = {option for parameter in commands.commands[name].params for option in parameter.opts if option[0] == "-"}
    assert flags | LEFT_OUT[name] == taken


def assigned(name):
    """Values of the constants of a file of the plugin."""
    found = [node for node in ast.parse(SOURCES[name]).body if isinstance(node, ast.Assign)]
    return {node.targets[0].id: node.value for node in found}


def test_formats_are_those_of_the_command():
    constants = assigned("export")
    assert ast.literal_eval(constants["FORMATS"]) == list(export.FORMATS)
    assert ast.literal_eval(constants["LINES"]) == list(export.LINES)


def test_clouds_to_choose_are_all_that_can_be_read():
    ends = {word.lstrip("*") for word in ast.literal_eval(assigned("algorithm")["ENDS"]).split()}
    assert ends == {".las", ".laz", Path(paths.EPT).suffix, *KINDS}
