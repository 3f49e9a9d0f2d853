"""Products in a real QGIS: nothing invalid, everything styled, a map that can be printed.

``make test-qgis`` runs them alone. The pictures stay in ``build/qgis``.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path
from threading import Timer

import cv2
import numpy as np
import pytest
import shapely
from drives import images, poses
from products import place_product

from vinemap.config.drives import Start
from vinemap.jobs.register import register_products
from vinemap.odometry.drive import map_drive
from vinemap.parcel import map_parcel
from vinemap.product.register.edits import settle
from vinemap.product.register.file import read_register, update_register
from vinemap.product.register.tables import Update
from vinemap.simulate.camera import LOW
from vinemap.simulate.survey import write_survey

OPEN, EDIT = (Path(__file__).parents[1] / f"{verb}_in_qgis.py" for verb in ("open", "edit"))
PICTURES = Path(__file__).parents[2] / "build" / "qgis"
PYTHONS = [os.environ.get("QGIS_PYTHON"), "/usr/bin/python3"]
"""Pythons that QGIS may be installed for, an own choice first."""


def start(python, program, *args, folder):
    """A QGIS that runs a program of ours, with pipes to it; what it says of errors stands in ``said.txt``."""
    (folder / "runtime").mkdir(mode=0o700, exist_ok=True)
    env = {"PATH": os.defpath, "HOME": str(folder), "LC_ALL": "C.UTF-8", "QT_QPA_PLATFORM": "offscreen"}
    env |= {"XDG_RUNTIME_DIR": str(folder / "runtime")}
    pipe = subprocess.PIPE
    with (folder / "said.txt").open("wb") as said:
        return subprocess.Popen([python, program, *args], env=env, stdin=pipe, stdout=pipe, stderr=said, text=True)


@pytest.fixture(scope="module")
def qgis(tmp_path_factory):
    """The Python that QGIS is installed for, a home for it, and a QGIS that opens what it is told to."""
    folder = tmp_path_factory.mktemp("home")
    for python in PYTHONS:
        if python and Path(python).exists():
            with start(python, OPEN, folder=folder) as opener:
                if opener.stdout.readline():
                    yield python, folder, opener
                    opener.stdin.close()
                    return
    pytest.skip("needs QGIS for Python: apt-get install --no-install-recommends python3-qgis, or set QGIS_PYTHON")


@pytest.fixture(scope="module")
def open_in_qgis(qgis):
    """What QGIS sees in a file, of which it draws a picture of a name, by the file and the name."""
    _, folder, opener = qgis
    PICTURES.mkdir(parents=True, exist_ok=True)

    def opened(path, name, page=None):
        waited = Timer(120, opener.kill)
        waited.start()
        opener.stdin.write(json.dumps([str(path), str(PICTURES / f"{name}.png"), page and str(page)]) + "\n")
        opener.stdin.flush()
        seen = opener.stdout.readline()
        waited.cancel()
        assert seen, (folder / "said.txt").read_text()
        return json.loads(seen)

    return opened


@pytest.fixture(scope="module")
def product(vineyard, tmp_path_factory):
    cloud = write_survey(vineyard, tmp_path_factory.mktemp("survey"))
    folder = tmp_path_factory.mktemp("products") / "first"
    map_parcel(cloud, folder, parcel="Clos & Fils #3", named=False, boundary=cloud.parent / "parcels.gpkg")
    # Nothing may lead back to where it was made.
    return shutil.move(folder, folder.with_name("moved"))


@pytest.fixture(scope="module")
def layers(open_in_qgis, product):
    seen = open_in_qgis(product / "Clos & Fils #3.gpkg", "layers")
    assert seen["errors"] == []
    assert seen["colours"] > 20
    return {layer["name"]: layer for layer in seen["layers"]}


@pytest.fixture(scope="module")
def project(open_in_qgis, product):
    return open_in_qgis(product / "Clos & Fils #3.qgz", "project", PICTURES / "page.png")


def test_the_bare_geopackage_is_styled(layers):
    assert set(layers) == {"rows", "row_ends", "key_points", "sections", "gaps", "vines", "unmapped", "parcel"}
    assert all(layer["valid"] and layer["styled"] and layer["crs"] for layer in layers.values())
    assert layers["rows"]["labels"]
    assert layers["rows"]["renderer"] == layers["sections"]["renderer"] == "graduatedSymbol"
    assert all("m³/m" in c["label"] for c in layers["rows"]["classes"])
    assert layers["gaps"]["renderer"] == "categorizedSymbol"
    assert layers["gaps"]["classes"] == [{"label": "missing", "colour": "#d7263d"}]
    assert layers["unmapped"]["renderer"] == "categorizedSymbol"
    assert layers["unmapped"]["classes"][-1] == {"label": "too tall", "colour": "#566a8c"}
    assert layers["vines"]["renderer"] == "categorizedSymbol"
    assert layers["vines"]["classes"][0] == {"label": "vine", "colour": "#1d2b24"}
    assert layers["sections"]["scale"] == layers["vines"]["scale"] == 800


def test_the_bare_geopackage_explains_itself(layers):
    assert all(layer["about"] for layer in layers.values())
    assert layers["rows"]["aliases"]["volume_m3"] == "Volume (m³)"
    assert layers["parcel"]["aliases"]["area_m2"] == "Area (m²)"
    assert "missing vines" in layers["rows"]["tip"]
    assert "reason" in layers["unmapped"]["tip"]


def test_the_project_opens_at_the_parcel_with_everything_valid(project):
    assert project["read"]
    assert project["title"] == "Clos & Fils #3"
    assert project["crs"] == "EPSG:32632"
    assert len(project["layers"]) == 14
    assert all(layer["valid"] and layer["crs"] for layer in project["layers"])
    assert project["errors"] == []
    assert project["colours"] > 200
    assert 50 < project["drawn_at"] < 1000


def test_the_project_has_the_styles_of_the_product(project, layers):
    named = {layer["name"]: layer for layer in project["layers"]}
    rows = named["Rows: canopy volume per metre"]
    assert rows["classes"] == layers["rows"]["classes"]
    assert rows["labels"]
    rasters = {name: layer["renderer"] for name, layer in named.items() if layer["kind"] == "raster"}
    assert rasters.pop("Relief") == "hillshade"
    assert set(rasters.values()) == {"singlebandpseudocolor"}
    assert all(layer["nodata"] == -9999 for layer in named.values() if layer["kind"] == "raster")


def test_lines_lie_above_rasters(project):
    kinds = [layer["kind"] for layer in project["layers"] if layer["name"] in project["visible"]]
    assert kinds == sorted(kinds, reverse=True)


def test_the_page_can_be_printed(project):
    assert project["page"]
    assert {"QgsLayoutItemMap", "QgsLayoutItemLegend", "QgsLayoutItemScaleBar"} < set(project["items"])
    assert (PICTURES / "page.png").stat().st_size > 20_000


def test_a_raster_alone_finds_its_colours(open_in_qgis, product):
    seen = open_in_qgis(product / "Clos & Fils #3_chm.tif", "chm")
    assert seen["layers"][0]["renderer"] == "singlebandpseudocolor"
    assert seen["layers"][0]["valid"]


def test_a_track_opens_beside_the_rows(open_in_qgis, tmp_path):
    recording = tmp_path / "frames"
    recording.mkdir()
    shots = [*images(poses(8)), np.zeros((240, 320), np.uint8)]
    for k, image in enumerate(shots):
        cv2.imwrite(str(recording / f"{k}.png"), image)
    for name, start in {"placed": Start(44.61167, 7.92442, 72.5), "nowhere": None}.items():
        map_drive([recording], tmp_path / f"{name}.gpkg", camera=LOW, start=start)
        seen = open_in_qgis(tmp_path / f"{name}.gpkg", f"track_{name}")
        assert seen["errors"] == []
        assert seen["crs"] == ("EPSG:32632" if start else "")
        layers = {layer["name"]: layer for layer in seen["layers"]}
        assert set(layers) == {"track", "poses", "band"}
        assert all(layer["valid"] and layer["styled"] and layer["about"] for layer in layers.values())
        assert [c["label"] for c in layers["poses"]["classes"]] == ["measured", "flagged"]
        assert layers["poses"]["aliases"]["heading_deg"] == "Heading, clockwise from north (°)"
        assert layers["poses"]["n"] == 9


def test_a_register_is_edited_while_it_is_written(qgis, open_in_qgis, tmp_path):
    """In ten ways; the layer is open until the end."""
    lines = np.array([shapely.LineString([(428000, 4940000 + 3 * k), (428030, 4940001 + 3 * k)]) for k in range(5)])
    for name, north in (("F", 0), ("G", 100)):
        there = [shapely.affinity.translate(line, yoff=north) for line in lines]
        place_product(tmp_path / "june", name, np.array(there), survey="june", flown="2026-06-10")
    path = tmp_path / "register.gpkg"
    list(register_products([tmp_path / "june" / name for name in "FG"], path))
    square = {"F": (shapely.box(427990, 4939990, 428040, 4940020), read_register(path).crs)}
    python, _, _ = qgis
    with start(python, EDIT, path, folder=tmp_path) as editor:
        assert editor.stdout.readline() == "saved\n"
        update_register(path, lambda register: Update(*settle(register, "2026-07-01", square)[:2]))
        editor.stdin.close()
    register = read_register(path)
    assert sorted(zip(register.rows["uid"], register.rows["row_id"], register.rows["label"], strict=True)) == [
        *((1, 1, "1 F"), (2, 2, "2 F"), (3, 3, "3 F"), (5, 5, "Barbera"), (6, 1, "1 G"), (7, 22, "2 G"), (8, 3, "3 G")),
        *((9, 4, "4 G"), (10, 5, "5 G"), (11, 6, "6 F"), (12, 7, "7 F")),
    ]
    past = register.past.iloc[10:]
    assert dict(zip(past["uid"], past["what"], strict=True)) == {
        1: "moved by 2.00 m",
        2: "moved by 0.30 m",
        3: "moved by 9.00 m",
        4: "removed",
        5: "called Barbera",
        6: "turned round",
        7: "number 22",
        10: "grubbed up 2026-06-20",
        11: "split from 3 F",
        12: "drawn",
    }
    seen = open_in_qgis(path, "register")
    assert seen["errors"] == []
    layers = {layer["name"]: layer for layer in seen["layers"]}
    assert set(layers) == {"rows", "candidates", "history"}
    assert all(layer["valid"] and layer["styled"] and layer["crs"] for layer in layers.values())
