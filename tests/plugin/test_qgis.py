"""The plugin in a real QGIS without windows: a parcel mapped by ``qgis_process``, layers loaded, a run stopped."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import pytest
from commands import ROOT

from vinemap.plugin.install import write_folder
from vinemap.simulate.survey import write_survey

CALL = ROOT / "tests" / "call_from_qgis.py"
PROCESS = shutil.which("qgis_process.bin") or shutil.which(
    "qgis_process"
)  # Debian's script adds a word it doesn't know
PYTHON = os.environ.get("QGIS_PYTHON", "/usr/bin/python3")
NOWHERE = {"PYTHONPATH": "/nowhere", "LD_LIBRARY_PATH": "/nowhere", "GDAL_DRIVER_PATH": "/nowhere"}
"""What would lead vinemap astray if it inherited that from QGIS."""


class Place:
    """A survey, a QGIS that has the plugin, and a command that is this checkout."""

    def __init__(self, folder, vineyard):
        self.folder, self.profile = folder, folder / "qgis" / "profiles" / "default"
        self.plugins = self.profile / "python" / "plugins"
        self.survey = write_survey(vineyard, folder / "in")
        self.parcels = self.survey.with_name("parcels.gpkg")
        self.product = folder / "A"
        self.inherited = folder / "inherited.txt"
        plugin = write_folder(self.plugins)
        command = folder / "vinemap"
        command.write_text(
            f'#!/bin/sh\nenv >"{self.inherited}"\nPYTHONPATH="{ROOT}" exec "{sys.executable}" -m vinemap "$@"\n'
        )
        command.chmod(0o755)
        (plugin / "command.txt").write_text(f"{command}\n")
        settings = self.profile / "QGIS" / "QGIS3.ini"
        settings.parent.mkdir()
        settings.write_text("[PythonPlugins]\nvinemap=true\n")
        (folder / "runtime").mkdir(mode=0o700)

    def call(self, *words, **more):
        env = {"PATH": os.defpath, "HOME": str(self.folder), "LC_ALL": "C.UTF-8", "QT_QPA_PLATFORM": "offscreen"}
        env |= {"XDG_RUNTIME_DIR": str(self.folder / "runtime"), "QGIS_CUSTOM_CONFIG_PATH": str(self.folder / "qgis")}
        words = list(map(str, words))
        return subprocess.run(words, env=env | more, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def place(vineyard, tmp_path_factory):
    if PROCESS is None or not Path(PYTHON).exists():
        pytest.skip("needs QGIS's qgis_process: apt-get install --no-install-recommends qgis python3-qgis")
    return Place(tmp_path_factory.mktemp("place"), vineyard)


@pytest.fixture(scope="module")
def mapped(place):
    """What ``qgis_process`` says that maps the parcel."""
    words = [f"--CLOUD={place.survey}", f"--BOUNDARY={place.parcels}", "--PARCEL=A", f"--OUTPUT={place.product}"]
    return place.call(PROCESS, "run", "vinemap:mapparcel", *words, **NOWHERE)


@pytest.fixture(scope="module")
def seen(place, mapped):
    """What a program in QGIS's Python sees of the plugin."""
    assert mapped.returncode == 0
    (polygon,) = gpd.read_file(place.parcels).geometry
    out, product = place.folder / "stopped", place.product / "A.gpkg"
    done = place.call(PYTHON, CALL, place.plugins, place.survey, product, polygon.wkt, "EPSG:32632", out)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_parcel_is_mapped(place, mapped):
    assert mapped.returncode == 0, mapped.stdout + mapped.stderr
    assert "A: 6 rows, " in mapped.stdout
    assert f"ROWS_LAYER:\t{place.product / 'A.gpkg'}|layername=rows" in mapped.stdout
    assert all(stage in mapped.stdout for stage in ("DTM", "Key points", "Mesh", "Writing"))
    assert len(gpd.read_file(place.product / "A.gpkg", layer="rows")) == 6
    assert (place.product / "run.json").is_file()


def test_vinemap_inherits_nothing_of_qgis(mapped, place, seen):
    inherited = dict(line.partition("=")[::2] for line in place.inherited.read_text().splitlines())
    assert NOWHERE.keys() & inherited.keys() == set()
    assert seen["environment"] == {
        "HOME": "h",
        "OSGEO4W_ROOT": "C/OSGeo4W",
        "PATH": "/usr/bin:/bin",
        "PYTHONIOENCODING": "utf-8",
        "VINEMAP_PROGRESS": "1",
    }


def test_layers_are_loaded_with_their_styles_in_order(seen):
    assert seen["loaded"] == [
        ["A", "vines", "categorizedSymbol", "EPSG:32632"],
        ["A", "gaps", "categorizedSymbol", "EPSG:32632"],
        ["A", "rows", "graduatedSymbol", "EPSG:32632"],
        ["A", "unmapped", "categorizedSymbol", "EPSG:32632"],
        ["A", "parcel", "singleSymbol", "EPSG:32632"],
    ]


def test_a_run_that_is_stopped_leaves_no_product(seen, place):
    stopped = seen["stopped"]
    assert stopped["results"] == {}
    assert stopped["errors"] == []
    assert stopped["stages"][:2] == ["Reading", "DTM"]
    assert "Writing" not in stopped["stages"]
    assert not (place.folder / "stopped").exists()


def test_selected_features_of_a_layer_in_memory_are_a_boundary(seen, place):
    (polygon,) = gpd.read_file(place.parcels).geometry
    assert seen["stopped"]["boundary"] == [1, "EPSG:32632", pytest.approx(polygon.area, rel=1e-6)]


def test_a_refusal_is_vinemap_s_own_line(seen, place):
    assert seen["refused"]["well"] is False
    assert seen["refused"]["errors"] == [f"{place.survey}x: no such file"]
