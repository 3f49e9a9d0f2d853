"""vinemap as pip installs it: a wheel in a virtual environment of its own, outside of this checkout."""

import importlib.util
import os
import re
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest
from commands import ROOT, size

from vinemap import paths
from vinemap.compute.extras import EXTRAS
from vinemap.config.template import template

LARGEST = 850e6
"""Bytes that a bare installation may take, most of it LLVM, SciPy, pandas and GDAL."""
WHOLE = "VINEMAP_TEST_INSTALLED"


def call(*words, cwd):
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.run(list(map(str, words)), cwd=cwd, env=environment, capture_output=True, text=True, check=False)


def python_in(environment):
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built here where hatchling is installed, else as pip does it, which fetches that."""
    folder = tmp_path_factory.mktemp("wheel")
    alone = ["--no-build-isolation"] if importlib.util.find_spec("hatchling") else []
    done = call(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", *alone, "-w", folder, ROOT, cwd=folder)
    if done.returncode and not alone:
        pytest.skip("needs hatchling, or a package index from which pip fetches it")
    assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def bare(wheel, tmp_path_factory):
    """Python of an environment that has the wheel and what this one has, but for the extras."""
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder / "venv")
    python = python_in(folder / "venv")
    done = call(
        sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-compile", wheel, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    (folder / "others").mkdir()
    for path in Path(sysconfig.get_paths()["purelib"]).iterdir():
        if path.stem.split("-")[0] not in {*EXTRAS, "vinemap"} and path.suffix != ".pth":
            (folder / "others" / path.name).symlink_to(path)
    site = call(python, "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])", cwd=folder).stdout.strip()
    Path(site, "others.pth").write_text(f"{folder / 'others'}\n")
    return python


def test_the_wheel_is_one_package_with_all_that_it_needs(wheel):
    with ZipFile(wheel) as packed:
        names = packed.namelist()
        assert packed.read("vinemap/data/table_2_1.csv") == paths.TABLE_2_1.read_bytes()
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"vinemap"}
    flows = {path.name for path in (ROOT / "flows").glob("*.py")}
    assert flows <= {name.removeprefix("vinemap/flows/") for name in names}
    plugin = {path.name for path in paths.PLUGIN.iterdir() if path.is_file()}
    assert plugin == {name.removeprefix("vinemap/plugin/qgis/") for name in names if "/plugin/qgis/" in name}
    assert [name for name in names if "__pycache__" in name or "node_modules" in name] == []


def test_installed_alone_it_makes_the_example(bare, tmp_path):
    done = call(bare, "-m", "vinemap", "example", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[:2] == [str(paths.EXAMPLE), str(paths.survey_cloud("barolo"))]
    made = {path.name for path in (tmp_path / paths.survey_cloud("barolo").parent).iterdir()}
    assert made == {"barolo.laz", "parcels.gpkg", "truth.gpkg"}
    unknown = call(bare, "-m", "vinemap", "parcel", "G", cwd=tmp_path)
    assert unknown.returncode == 2
    assert unknown.stderr.startswith("vinemap: survey barolo has no parcel 'G': ")


def test_what_is_missing_says_what_to_install(bare, tmp_path):
    (tmp_path / "nightly.yaml").write_text("{}")
    (tmp_path / "camera.yaml").write_text(template("camera"))
    (tmp_path / "a.png").write_bytes(b"")
    for words, extra in (
        (["nightly", "--config", "nightly.yaml", "--once"], "nightly"),
        (["track", "a.png", "--camera", "camera.yaml"], "track"),
    ):
        done = call(bare, "-m", "vinemap", *words, cwd=tmp_path)
        assert done.returncode == 2
        said = rf"vinemap: .* isn't installed: pip install 'vinemap\[{extra}\]'\n"
        assert re.fullmatch(said, done.stderr), done.stderr


def test_the_doctor_tells_what_is_there_and_what_is_not(bare, tmp_path):
    done = call(bare, "-m", "vinemap", "doctor", cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    assert re.search(r"^  numpy +\d", done.stdout, re.MULTILINE)
    for extra in EXTRAS.values():
        assert f"{extra.library}, which isn't installed: pip install 'vinemap[{extra.name}]'" in done.stdout
    assert str(tmp_path) in done.stdout
    assert len(done.stdout.splitlines()) < 60


@pytest.mark.skipif(WHOLE not in os.environ, reason="takes minutes and a package index: make test-installed")
def test_pip_installs_what_a_map_needs(wheel, tmp_path):
    venv.create(tmp_path / "venv", with_pip=True)
    python = python_in(tmp_path / "venv")
    before = size(tmp_path / "venv")
    done = call(python, "-m", "pip", "install", "-q", "-c", ROOT / "configs" / "constraints.txt", wheel, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert size(tmp_path / "venv") - before < LARGEST
    assert call(python, "-m", "vinemap", "example", cwd=tmp_path).returncode == 0
    done = call(python, "-m", "vinemap", "parcel", "F", cwd=tmp_path)
    assert done.stdout.startswith("F: 16 rows, "), done.stderr
    assert (tmp_path / "data" / "products" / "barolo" / "F" / "F.gpkg").is_file()
