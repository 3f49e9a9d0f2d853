"""The register in a night's work: its rows are known, others are candidates, and what is wrong costs a line."""

import json
import shutil
import sqlite3

import geopandas as gpd
import numpy as np
import pyogrio
import pytest
import shapely
from products import map_here, place_product

from vinemap.config.surveys import survey_config
from vinemap.errors import InputError
from vinemap.jobs.outcomes import CURRENT, DONE, LEFT
from vinemap.jobs.plan import plan_survey
from vinemap.jobs.register import is_due, note, register_products
from vinemap.jobs.survey import map_survey
from vinemap.product.register import file
from vinemap.product.register.file import read_register


@pytest.fixture(scope="module")
def mapped(three, tmp_path_factory):
    """Products of two parcels of a survey, whose rows are sought."""
    given = {"cloud": three, "boundaries": three.with_name("parcels.gpkg"), "parcels": ["A", "B"]}
    folder = tmp_path_factory.mktemp("mapped") / "products"
    map_here(survey_config(survey="three", **given), folder)
    return given, folder


@pytest.fixture
def survey(mapped, tmp_path):
    """That survey, with a register that has the rows of parcel A."""
    given, folder = mapped
    shutil.copytree(folder, tmp_path / "products")
    list(register_products([tmp_path / "products" / "A"], tmp_path / "register.gpkg"))
    return survey_config(survey="three", **given, row_register=tmp_path / "register.gpkg"), tmp_path / "products"


def test_a_register_from_night_to_night(survey, monkeypatch):
    config, folder = survey
    path = config.row_register
    # Rows of A are known from now on, those of B are offered and not taken in.
    outcomes = {one.parcel: one for one in map_here(config, folder)}
    assert {name: one.state for name, one in outcomes.items()} == {"A": DONE, "B": CURRENT, "register": LEFT}
    assert outcomes["register"].reason == (
        f"{path}: 4 rows stand in no register, and are candidates: vinemap register takes them in: B"
    )
    first = pyogrio.read_dataframe(folder / "A" / "A.gpkg", layer="rows")
    assert first["label"].tolist() == ["1 A", "2 A", "3 A", "4 A"]
    assert pyogrio.read_dataframe(path, layer="candidates")["parcel"].tolist() == ["B"] * 4
    assert len(read_register(path).rows) == 4
    plan = plan_survey(config, folder)
    assert plan.recipes == []
    assert plan.due(plan.settled) == []
    assert not is_due(plan.register)
    # An edit makes its parcel anew, and the history tells of it as soon as it can be written.
    rows = pyogrio.read_dataframe(path, layer="rows")
    rows.loc[1, "label"] = "Barbera"
    pyogrio.write_dataframe(rows.drop(0), path, layer="rows", driver="GPKG")
    plan = plan_survey(config, folder)
    assert [one.known.lines["label"].tolist() for one in plan.recipes] == [["Barbera", "3 A", "4 A"]]
    assert is_due(plan.register)
    monkeypatch.setattr(file, "PATIENCE", 0.05)
    held = sqlite3.connect(path, isolation_level=None)
    held.execute("BEGIN IMMEDIATE")
    (told,) = note(plan.register, plan.flown, "three", [], folder)
    assert told.startswith(f"{path}: another program keeps the register to itself")
    held.close()
    assert note(plan.register, plan.flown, "three", [], folder) == []
    assert read_register(path).past["what"].tolist()[4:] == ["called Barbera", "removed"]
    after = plan_survey(config, folder)
    assert not is_due(after.register)
    assert [one.key for one in after.recipes] == [one.key for one in plan.recipes]
    # Who takes candidates in has them in the rows.
    list(register_products([folder / "B"], path))
    assert len(pyogrio.read_dataframe(path, layer="candidates")) == 0
    assert [recipe.parcel for recipe in plan_survey(config, folder).recipes] == ["A", "B"]


def test_rows_have_their_time(survey):
    """What was grubbed up or planted another year isn't looked for in this one."""
    config, folder = survey
    path = config.row_register

    def known(**dates):
        rows = pyogrio.read_dataframe(path, layer="rows").assign(planted=None, grubbed=None)
        for column, value in dates.items():
            rows.loc[0, column] = value
        pyogrio.write_dataframe(rows, path, layer="rows", driver="GPKG")
        return plan_survey(config, folder).recipes[0].known.lines["label"].tolist()

    day = f"{plan_survey(config, folder).flown:%Y-%m-%d}"
    some, every = ["2 A", "3 A", "4 A"], ["1 A", "2 A", "3 A", "4 A"]
    assert known(planted=day) == known(grubbed="2999-01-01") == every
    assert known(planted="2999-01-01") == known(grubbed=day) == some


def test_a_register_that_cannot_be_read_leaves_products_as_they_are(survey):
    config, folder = survey
    before = gpd.read_file(folder / "A" / "A.gpkg", layer="rows")
    config.row_register.write_bytes(b"no database" * 100)
    with pytest.raises(InputError, match=r"register\.gpkg: can't be read as a register \(file is not a database\)"):
        list(map_survey(config, folder))
    config.row_register.unlink()
    with pytest.raises(InputError, match=r"register\.gpkg: no such file: vinemap register makes it of products"):
        list(map_survey(config, folder))
    assert gpd.read_file(folder / "A" / "A.gpkg", layer="rows").equals(before)


LINES = np.array([shapely.LineString([(428000, 4940000 + 3 * k), (428030, 4940001 + 3 * k)]) for k in range(5)])


@pytest.fixture
def path(tmp_path):
    """A register of a parcel F of five rows."""
    product = place_product(tmp_path / "june", "F", LINES, survey="june", flown="2026-06-10")
    list(register_products([product], tmp_path / "register.gpkg"))
    return tmp_path / "register.gpkg"


@pytest.mark.parametrize("how", [None, "add", "replace"])
def test_a_parcel_of_the_same_name_elsewhere_keeps_its_rows(path, tmp_path, how):
    """As where each of an estate's hills has a parcel 1."""
    away = shapely.transform(LINES[:3], lambda xy: xy + [800, 0])
    product = place_product(tmp_path / "july", "F", away, survey="july", flown="2026-07-10")
    assert list(register_products([product], path, how=how)) == [f"F: rows registered: 3 → {path}"]
    rows = read_register(path).rows
    assert rows["label"].tolist() == [f"{k} F" for k in range(1, 9)]
    assert rows["grubbed"].isna().all()


def test_rows_within_the_polygon_of_a_parcel_are_its_own(path, tmp_path):
    """Though nothing is found beside them any more."""
    product = place_product(tmp_path / "july", "F", LINES[:1], survey="july", flown="2026-07-10")
    record = json.loads((product / "run.json").read_text())
    (product / "run.json").write_text(json.dumps(record | {"bounded": True}))
    polygon = gpd.GeoDataFrame(geometry=[shapely.box(427990, 4939990, 428040, 4940008)], crs=32632)
    pyogrio.write_dataframe(polygon, product / "F.gpkg", layer="parcel", driver="GPKG", append=True)
    (told,) = register_products([product], path, how="replace")
    assert told == f"F: rows registered: 0, there before: 1, there no more: 3 → {path}"
