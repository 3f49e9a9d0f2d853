"""The register of an estate: what is edited in it by hand, whose number stays whose, and what can be wrong with it."""

import sqlite3
from pathlib import PureWindowsPath

import geopandas as gpd
import numpy as np
import pyogrio
import pytest
import shapely
from products import place_product

from vinemap.errors import BusyError, InputError
from vinemap.jobs.register import register_products
from vinemap.product.register import file
from vinemap.product.register.edits import settle
from vinemap.product.register.file import read_register, update_register
from vinemap.product.register.tables import Update

LINES = np.array([shapely.LineString([(428000, 4940000 + 3 * k), (428030, 4940001 + 3 * k)]) for k in range(5)])


@pytest.fixture(scope="module")
def registered(tmp_path_factory):
    """A register of two parcels, F and G, of five rows each."""
    folder = tmp_path_factory.mktemp("registered")
    how = {"survey": "june", "flown": "2026-06-10"}
    places = {"F": LINES, "G": shapely.transform(LINES, lambda xy: xy + [0, 100])}
    products = [place_product(folder / "june", name, lines, **how) for name, lines in places.items()]
    told = list(register_products(products, folder / "register.gpkg"))
    assert told == [f"{name}: rows registered: 5 → {folder / 'register.gpkg'}" for name in "FG"]
    return folder / "register.gpkg"


@pytest.fixture
def path(registered, tmp_path):
    (tmp_path / "register.gpkg").write_bytes(registered.read_bytes())
    return tmp_path / "register.gpkg"


def edit(path, change, crs=None):
    """Have GDAL change the rows, and save the layer anew."""
    rows = pyogrio.read_dataframe(path, layer="rows")
    rows = change(rows)
    pyogrio.write_dataframe(
        rows.to_crs(crs) if crs else rows, path, layer="rows", driver="GPKG", geometry_type="LineString"
    )


def night(path, day="2026-07-01", parcels=None):
    """What another night makes of it: labels of F and of all by their uid, entries of the history, remarks."""
    said = []

    def change(register):
        settled = settle(register, day, parcels or {})
        said.extend(settled.remarks)
        return Update(settled.rows, settled.entries)

    foreseen = settle(read_register(path), day, parcels or {}).rows
    before = len(read_register(path).past)
    update_register(path, change)
    register = read_register(path)
    assert [*foreseen["label"]] == [*register.rows["label"]]
    again = settle(register, day, parcels or {})
    assert len(again.entries) == 0
    assert not again.rows["dirty"].any()
    past = register.past.iloc[before:]
    labels = dict(zip(register.rows["uid"], register.rows["label"], strict=True))
    return labels, list(zip(past["uid"], past["label"], past["what"], strict=True)), said


LOST = "{} rows of the register had another's number or name, and got their own: {}"
FIVE = {k: f"{k} F" for k in range(1, 6)} | {k + 5: f"{k} G" for k in range(1, 6)}


def moved(rows):
    ends = shapely.get_coordinates(rows.geometry[1])
    rows.loc[1, "geometry"] = shapely.LineString([ends[0] - [2, 0], ends[1]])
    return rows


def shifted(rows):
    rows.loc[1, "geometry"] = shapely.transform(rows.geometry[1], lambda xy: xy + [0, 0.4])
    return rows


def split(rows):
    """As QGIS does: both parts have what the row had."""
    (x, y), (u, v) = shapely.get_coordinates(rows.geometry[1])
    parts = rows.iloc[[1, 1]].copy()
    near, far = (x + 0.3 * (u - x), y + 0.3 * (v - y)), (x + 0.35 * (u - x), y + 0.35 * (v - y))
    parts.geometry = [shapely.LineString([(x, y), near]), shapely.LineString([far, (u, v)])]
    return gpd.pd.concat([rows.drop(1), parts])


def drawn(rows):
    return gpd.pd.concat(
        [rows, gpd.GeoDataFrame(geometry=[shapely.transform(LINES[4], lambda xy: xy + [0, 3])], crs=rows.crs)]
    )


def redrawn(rows):
    """Deleted, and drawn anew under its name."""
    line = shapely.transform(rows.geometry[1], lambda xy: xy + [0, 0.5])
    new = gpd.GeoDataFrame({"parcel": ["F"], "label": ["2 F"]}, geometry=[line], crs=rows.crs)
    return gpd.pd.concat([rows.drop(1), new])


def turned(rows):
    rows.loc[1, "geometry"] = rows.geometry[1].reverse()
    return rows


def valued(column, value):
    def change(rows):
        rows.loc[1, column] = value
        return rows

    return change


twice = valued("label", "1 F")


@pytest.mark.parametrize(
    ("change", "labels", "entries"),
    [
        (lambda rows: rows, FIVE, []),
        (moved, FIVE, [(2, "2 F", "moved by 2.00 m")]),
        (shifted, FIVE, [(2, "2 F", "moved by 0.40 m")]),
        (turned, FIVE, [(2, "2 F", "turned round")]),
        (redrawn, FIVE, [(2, "2 F", "moved by 0.50 m")]),
        (split, FIVE | {11: "6 F"}, [(11, "6 F", "split from 2 F"), (2, "2 F", "moved by 10.51 m")]),
        (drawn, FIVE | {11: "6 F"}, [(11, "6 F", "drawn")]),
        (lambda rows: rows.drop(1), {k: v for k, v in FIVE.items() if k != 2}, [(2, "2 F", "removed")]),
        (valued("label", "Nebbiolo"), FIVE | {2: "Nebbiolo"}, [(2, "Nebbiolo", "called Nebbiolo")]),
        (valued("row_id", 21), FIVE, [(2, "2 F", "number 21")]),
        (twice, FIVE, []),
        (valued("label", None), FIVE, []),
        (valued("uid", None), FIVE, []),
        (valued("uid", 1), FIVE, []),
        (valued("grubbed", "2026-06-30"), FIVE, [(2, "2 F", "grubbed up 2026-06-30")]),
        (lambda rows: rows.drop(columns=["uid", "since"]), FIVE, []),
        (lambda rows: rows[::-1], FIVE, []),
    ],
)
def test_an_edit_is_seen_and_numbers_stay_whose_they_are(path, change, labels, entries):
    doubled = ["6 F"] if change is split else ["2 F"] if change is twice else []
    square = (shapely.box(427990, 4939990, 428040, 4940020), read_register(path).crs)
    edit(path, change)
    found, past, said = night(path, parcels={"F": square})
    assert found == labels
    assert sorted(past) == sorted(entries)
    rows = read_register(path).rows.set_index("uid")
    assert {uid for uid, _, what in entries if what != "removed"} == set(rows.index[rows["edited"] == "2026-07-01"])
    assert said == [LOST.format(len(names), ", ".join(names)) for names in [doubled] if names]


def test_another_crs_makes_no_difference(path):
    edit(path, lambda rows: rows, crs=3003)
    assert night(path) == (FIVE, [], [])
    edit(path, shifted, crs=4326)
    labels, past, _ = night(path)
    assert (labels, len(past)) == (FIVE, 1)
    assert read_register(path).crs.to_epsg() == 4326


def test_rows_alone_saved_anew_are_a_register(path):
    rows = pyogrio.read_dataframe(path, layer="rows")
    path.unlink()
    pyogrio.write_dataframe(rows.to_crs(3003), path, layer="rows", driver="GPKG")
    labels, _, _ = night(path)
    assert labels == FIVE
    assert {name for name, _ in pyogrio.list_layers(path)} >= {"rows", "history", "candidates"}


def test_what_is_no_row_is_left_out_and_not_lost(path):
    def crossed(rows):
        x, y = 428000, 4940010
        rows.loc[1, "geometry"] = shapely.LineString([(x, y), (x + 20, y), (x + 20, y + 5), (x + 10, y - 5)])
        return rows

    edit(path, crossed)
    labels, past, said = night(path)
    assert labels == FIVE
    assert past == []
    assert said == ["what is no row in the register is left out: a line that crosses itself '2 F'"]


def executed(path, *statements):
    """Change a register by SQL, past what QGIS would allow."""
    database = sqlite3.connect(path, isolation_level=None)
    for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
        database.execute(f'DROP TRIGGER "{name}"')
    for statement in statements:
        database.execute(statement)
    database.close()


def test_what_is_no_date_is_none_and_told(path):
    """Else the row would be left out of all surveys."""
    executed(
        path, "UPDATE rows SET planted = 'last year' WHERE uid = 1", "UPDATE rows SET grubbed = '1/2/25' WHERE uid = 2"
    )
    rows = settle(read_register(path), "2026-07-01", {}).rows
    assert rows[["planted", "grubbed"]].isna().all(axis=None)
    labels, past, said = night(path)
    assert (labels, past) == (FIVE, [])
    odd = "planted 'last year' of 1 F, grubbed '1-2-25' of 2 F"
    assert said == [f"dates of the register that are none count as empty: {odd}: write them as 2026-05-31"]


def test_what_is_odd_is_told_where_products_are_put_in(registered, path):
    """Then or never, as it is mended by that."""
    edit(path, twice)
    product = registered.parent / "june" / "F"
    stay = f"F: 5 rows are in the register, and stay as they are → {path}"
    assert list(register_products([product], path)) == [stay, f"{path}: {LOST.format(1, '2 F')}"]
    assert list(register_products([product], path)) == [stay]


def test_what_others_left_in_its_tables(path):
    """Candidates of no parcel or date, a past of no row, a table without a key."""
    executed(
        path,
        "INSERT INTO candidates (parcel, flown) VALUES (NULL, '2026-01-01'), ('H', NULL), ('F', '2026-06-10')",
        "UPDATE history SET uid = NULL WHERE uid = 10",
    )
    assert read_register(path).offered == {"F": "2026-06-10"}
    assert night(path)[:2] == (FIVE, [(10, "5 G", "drawn")])
    executed(path, "CREATE TABLE other AS SELECT * FROM rows", "DROP TABLE rows", "ALTER TABLE other RENAME TO rows")
    assert len(read_register(path).rows) == 10


def test_a_register_on_a_share_of_windows():
    assert file._uri(PureWindowsPath(r"\\nas\vines\my rows.gpkg")) == "file:////nas/vines/my%20rows.gpkg"
    assert file._uri(PureWindowsPath("C:/vines/rows.gpkg")) == "file:///C:/vines/rows.gpkg"


def test_a_register_that_is_locked_is_left_alone(path, monkeypatch):
    monkeypatch.setattr(file, "PATIENCE", 0.05)
    before = path.read_bytes()
    held = sqlite3.connect(path, isolation_level=None)
    held.execute("BEGIN IMMEDIATE")
    assert len(read_register(path).rows) == 10
    with pytest.raises(BusyError, match="another program keeps the register to itself"):
        night(path)
    held.execute("COMMIT")
    held.execute("BEGIN EXCLUSIVE")
    file._read_once.cache_clear()
    with pytest.raises(BusyError, match="another program keeps the register to itself"):
        read_register(path)
    held.close()
    assert path.read_bytes() == before
    assert night(path)[0] == FIVE


def test_edits_in_a_log_beside_it_are_seen(path):
    """As QGIS leaves them while it has the file open."""
    assert read_register(path).rows["label"][0] == "1 F"
    held = sqlite3.connect(path, isolation_level=None)
    for name in ("IsEmpty", "MinX", "MaxX", "MinY", "MaxY"):
        held.create_function(f"ST_{name}", 1, lambda blob: 0)
    held.execute("PRAGMA journal_mode = WAL")
    held.execute("UPDATE rows SET label = 'Barbera' WHERE uid = 1")
    assert read_register(path).rows["label"][0] == "Barbera"
    assert night(path)[1] == [(1, "Barbera", "called Barbera")]
    assert held.execute("SELECT edited FROM rows WHERE uid = 1").fetchone() == ("2026-07-01",)
    held.close()


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        (
            lambda p: p.write_bytes(b"no database" * 1000),
            r"can't be read as a register \(file is not a database\): put a copy",
        ),
        (lambda p: p.write_bytes(p.read_bytes()[:50_000]), r"can't be read as a register \("),
        (lambda p: p.unlink(), "no such file: vinemap register makes it of products"),
        (
            lambda p: (
                p.unlink(),
                pyogrio.write_dataframe(gpd.GeoDataFrame(geometry=LINES, crs=32632), p, layer="rows"),
            ),
            "is no register of rows",
        ),
    ],
)
def test_a_register_that_is_none_is_refused_and_stays(path, how, reason):
    how(path)
    before = path.exists() and path.read_bytes()
    with pytest.raises(InputError, match=rf"register\.gpkg: {reason}"):
        read_register(path)
    with pytest.raises(InputError, match=reason):
        update_register(path, lambda register: Update(register.rows, register.past))
    assert (path.exists() and path.read_bytes()) == before


def test_products_of_another_date(path, tmp_path):
    """A row is gone and one planted: told, taken in, or put in place of what was, by what is asked."""
    lines = shapely.transform(LINES[[0, 1, 3, 4]], lambda xy: xy + [0.2, -0.1])
    lines = [*lines, shapely.transform(LINES[4], lambda xy: xy + [0, 3])]
    product = place_product(tmp_path / "july", "F", np.array(lines), survey="july", flown="2026-07-10")
    (told,) = register_products([product], path)
    assert told.startswith("F: 5 rows are in the register, and stay as they are; 1 of the product's aren't among them")
    (told,) = register_products([product], path, how="replace")
    assert told == f"F: rows registered: 1, there before: 4, there no more: 1 → {path}"
    rows = read_register(path).rows.set_index("label")
    assert rows["grubbed"].dropna().to_dict() == {"3 F": "2026-07-10"}
    assert rows["planted"].dropna().to_dict() == {"6 F": "2026-07-10"}
    assert night(path)[1:] == ([], [])
    (told,) = register_products([product], path, how="add")
    assert told == f"F: rows registered: 0, there before: 5 → {path}"


def test_a_parcel_that_is_planted_anew_has_no_row_of_before(path, tmp_path):
    """Though some of the new rows, 2.2 m apart, stand where one was."""
    lines = np.array([shapely.LineString([(428000, 4940000 + 2.2 * k), (428030, 4940001 + 2.2 * k)]) for k in range(6)])
    product = place_product(tmp_path / "july", "F", lines, survey="july", flown="2026-07-10", spacing_m=2.2)
    (told,) = register_products([product], path, how="replace")
    assert told == f"F: rows registered: 6, there before: 0, there no more: 5 → {path}"
    rows = read_register(path).rows
    new = rows[rows["planted"] == "2026-07-10"]
    assert new["label"].tolist() == [f"{k} F" for k in range(6, 12)]
    assert rows.loc[rows["grubbed"] == "2026-07-10", "uid"].tolist() == [1, 2, 3, 4, 5]
    assert read_register(path).past["what"].tolist()[10:] == ["found"] * 6 + ["grubbed up 2026-07-10"] * 5


def test_products_that_cannot_be_registered(registered, tmp_path):
    path = tmp_path / "new" / "register.gpkg"
    with pytest.raises(InputError, match="no product of vinemap"):
        list(register_products([tmp_path], path))
    local = place_product(tmp_path / "june", "L", LINES, survey="june", flown="2026-06-10")
    pyogrio.write_dataframe(
        gpd.GeoDataFrame({"no": [1]}, geometry=[LINES[0]], crs=32632), local / "L.gpkg", layer="rows"
    )
    with pytest.raises(InputError, match="its rows can't be read: map the parcel again"):
        list(register_products([registered.parent / "june" / "F", local], path))
    assert not path.parent.exists()
