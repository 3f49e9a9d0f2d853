"""Parcels outside the cloud, with odd names or polygons, or whose place is taken: they cost no other."""

import json
import shutil

import doubles
import geopandas as gpd
import pytest
import shapely
from squares import square, write_polygons
from systems import POSIX

from vinemap.cloud.las import read_cloud
from vinemap.cloud.pieces import read_piece, split_cloud
from vinemap.cloud.tiles import Collector
from vinemap.errors import InputError
from vinemap.geo.boundaries import read_parcels
from vinemap.jobs import survey
from vinemap.jobs.outcomes import CURRENT, DONE, FAILED, OUTSIDE
from vinemap.product import recipe
from vinemap.product.seasons.products import GONE


def test_parcels_that_are_not_in_the_cloud(job):
    job.draw(A=0, B=1, away=50)
    outcomes = job.run()
    assert outcomes["away"].state == OUTSIDE
    assert outcomes["away"].line() == "away: not in the cloud"
    assert job.states() == {"A": CURRENT, "B": CURRENT, "away": OUTSIDE}
    assert job.worked == []
    assert not (job.folder / "away").exists()


def test_a_parcel_that_is_no_longer_in_the_cloud(job):
    """Its product stays, which is said, and as long as it is there."""
    job.draw(A=0, B=1, C=2)
    job.run()
    job.draw(A=0, B=50, C=60)
    for _ in range(2):
        outcomes = job.run()
        assert outcomes["B"].line() == "B: not in the cloud: its earlier product stays, of another cloud or polygon"
        assert (job.folder / "B" / "points.txt").is_file()
    shutil.rmtree(job.folder / "B")
    assert job.run()["B"].line() == "B: not in the cloud"


def test_what_is_otherwise_in_a_parcel_that_is_not_there(job):
    job.draw(**{"A": 0, "North 3": 1})
    found = job.run(overrides={"A": {}, "North  3": {}, "north 3": {}, "B": {}})
    assert found["overrides"].line() == "overrides: left out: no parcel is called B, north 3"
    assert "overrides" not in job.run(overrides={"A": {}, "B": {}}, parcels=["A", "B"])


def test_one_parcel_that_is_not_in_the_cloud(job, monkeypatch):
    """All others being up to date."""
    monkeypatch.setattr(survey, "follow", needs_points)
    job.draw(A=0, B=1)
    job.run()
    job.draw(A=0, B=1, away=50)
    assert job.states() == {"A": CURRENT, "B": CURRENT, "away": OUTSIDE}


def test_a_parcel_that_somebody_names_must_be_in_the_cloud(job, monkeypatch):
    job.draw(A=0, B=1, away=50)
    monkeypatch.setattr(survey, "follow", needs_points)
    assert job.states()["away"] == OUTSIDE
    outcomes = job.run(parcels=["A", "away"])
    assert outcomes["away"].state == FAILED
    assert "no point lies inside the boundary" in outcomes["away"].reason


def needs_points(one, folder, *, piece=None, **options):
    if piece:
        read_piece(piece, Collector())
    else:
        read_cloud(one.clouds, boundary=one.boundary)
    return doubles.follow(one, folder, piece=piece, **options)


def test_a_survey_of_which_no_parcel_is_in_the_cloud_fails(job, monkeypatch):
    monkeypatch.setattr(survey, "follow", needs_points)
    job.draw(away=50)
    outcomes = job.run()
    assert "none of its parcels lies in the cloud" in outcomes["parcels.geojson"].line()
    assert job.states() == {"away": OUTSIDE, "parcels.geojson": FAILED}
    assert job.worked == []


def test_names_that_cannot_name_folders(job):
    odd = {"a/b": "a-b", "CON": "_CON", "x" * 65: "x" * 64, ".hidden": "hidden", "tab here": "tab here"}
    drawn = ["A", "é" * 64, "🍇" * 40, "..", *odd, "a:b"]
    job.draw(**{name: k for k, name in enumerate(drawn)})
    outcomes = job.run()
    bad = {"..": "can't name a file, nor a parcel", "a:b": "its folder would be that of 'a"}
    assert {parcel for parcel, one in outcomes.items() if one.state == DONE} == set(drawn) - set(bad)
    for name, folder in odd.items():
        assert recipe.product_in(job.folder / folder).parcel == name
    for name, reason in bad.items():
        assert outcomes[name].state == FAILED
        assert reason in outcomes[name].reason
        assert outcomes[name].line().count("\n") == 0
    assert {*odd, *bad} <= {one["parcel"] for one in job.record()["parcels"]}
    assert job.states() == {parcel: CURRENT if one.state == DONE else FAILED for parcel, one in outcomes.items()}
    assert job.worked == []


def test_a_file_in_the_place_of_a_product(job):
    job.folder.mkdir()
    (job.folder / "B").write_text("mine")
    outcomes = job.run()
    assert {parcel: one.state for parcel, one in outcomes.items()} == {"A": DONE, "B": FAILED, "C": DONE}
    assert outcomes["B"].reason == f"{job.folder / 'B'}: can't be written (is a file): choose another folder"
    assert (job.folder / "B").read_text() == "mine"
    (job.folder / "B").unlink()
    assert job.states() == {"A": CURRENT, "B": DONE, "C": CURRENT}


@POSIX
@pytest.mark.parametrize("to", ["A", "../elsewhere", "B", "gone"])
def test_a_link_in_the_place_of_a_product(job, to):
    """Neither another parcel's product nor a folder elsewhere is touched."""
    (job.folder.parent / "elsewhere").mkdir()
    job.folder.mkdir()
    (job.folder / "B").symlink_to(to)
    for expected in (DONE, CURRENT):
        assert job.states() == {"A": expected, "B": FAILED, "C": expected}
    assert json.loads((job.folder / "A" / "run.json").read_text())["parcel"] == "A"
    assert list((job.folder.parent / "elsewhere").iterdir()) == []


def test_polygons_that_cannot_be_brought_to_the_cloud(job, tmp_path):
    """One that lies nowhere on earth costs no other, nor are they mistaken for each other."""
    shapes = gpd.GeoSeries([square(k) for k in range(3)], crs=32632).to_crs(4326)
    nowhere = shapely.box(7.9, 95, 7.91, 95.01)
    polygons = dict(zip("AxBC", [shapes[0], nowhere, shapes[1], shapes[2]], strict=True))
    write_polygons(job.boundaries, polygons, crs=4326)
    outcomes = job.run()
    assert {parcel: one.state for parcel, one in outcomes.items()} == {"A": DONE, "x": FAILED, "B": DONE, "C": DONE}
    assert "save it with its CRS" in outcomes["x"].reason
    points = read_cloud(job.cloud).xyz
    for k, parcel in enumerate("ABC"):
        inside = shapely.contains_xy(square(k), *points[:, :2].T).sum()
        assert int((job.folder / parcel / "points.txt").read_text()) == pytest.approx(inside, abs=1)
    boundaries = [read_parcels(job.boundaries)["x"].boundary] * 2
    assert [type(piece) for piece in split_cloud(job.cloud, boundaries, tmp_path)] == [InputError, InputError]


def test_polygons_without_a_place_on_earth(job):
    """As QGIS saves them where nobody chose a CRS."""
    local = 'LOCAL_CS["Undefined Cartesian SRS",UNIT["metre",1],AXIS["X",EAST],AXIS["Y",NORTH]]'
    job.boundaries = job.boundaries.with_suffix(".gpkg")
    write_polygons(job.boundaries, {"A": 0, "B": 1}, crs=local)
    outcomes = job.run()
    assert {one.state for one in outcomes.values()} == {FAILED}
    assert all("Undefined Cartesian SRS can't be brought to" in one.reason for one in outcomes.values())
    with pytest.raises(InputError, match="check their CRS"):
        read_cloud(job.cloud, boundary=read_parcels(job.boundaries)["A"].boundary)


def test_a_single_polygon_and_none(job):
    """A survey that nobody drew is one parcel of its own name."""
    job.draw(A=0)
    assert job.states() == {"A": DONE}
    job.boundaries.unlink()
    assert job.states(boundaries=None) == {"may": DONE, "A": GONE}
    assert job.states(boundaries=None) == {"may": CURRENT, "A": GONE}
    with pytest.raises(InputError, match=r"parcels\.geojson: no such file"):
        job.run()
