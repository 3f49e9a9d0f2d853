"""A product is made anew if what it is made of has changed, and only then."""

import os
from datetime import UTC, datetime

import geopandas as gpd
import numpy as np
import pytest
import shapely
from ingredients import PLACE, write_las, write_polygons

from vinemap.config.settings import Settings
from vinemap.errors import InputError
from vinemap.geo.crs import parse_crs
from vinemap.geo.main import Origin
from vinemap.product import recipe
from vinemap.product.recipe import recipe_of, vines_of


@pytest.fixture
def cloud(tmp_path):
    return write_las(tmp_path / "may.las")


@pytest.fixture
def boundaries(tmp_path):
    return write_polygons(tmp_path / "parcels.gpkg", ["A", "B"])


@pytest.fixture
def made(cloud, boundaries):
    """Recipe of parcel A."""
    return recipe_of(cloud, parcel="A", boundary=boundaries)


def test_the_key_tells_each_ingredient(made, cloud, boundaries, tmp_path, monkeypatch):
    shape, crs = made.boundary
    origin = Origin(44.6, 7.9, 428.7)
    other = recipe_of(write_las(tmp_path / "june.las", seed=1), parcel="A", boundary=boundaries)
    settings = Settings.model_validate({"polygon": {"c": 9}})
    keys = {
        "same": made.key,
        "parcel": made._replace(parcel="B").key,
        "cloud": made._replace(sources=other.sources).key,
        "polygon": made._replace(boundary=(shape.buffer(0.01), crs)).key,
        "its crs": made._replace(boundary=(shape, parse_crs("EPSG:32633"))).key,
        "no polygon": made._replace(boundary=None).key,
        "settings": made._replace(settings=settings).key,
        "crs": made._replace(crs=parse_crs("EPSG:32632")).key,
        "other crs": made._replace(crs=parse_crs("EPSG:25832")).key,
        "origin": made._replace(origin=origin).key,
        "other origin": made._replace(origin=origin._replace(alt=428.8)).key,
        "survey": made._replace(survey="may").key,
    }
    monkeypatch.setattr(recipe, "__version__", "99.0")
    keys["version"] = made.key
    assert len(set(keys.values())) == len(keys)
    assert all(len(key) == 64 for key in keys.values())


@pytest.mark.parametrize("stage", list(Settings.model_fields))
def test_every_setting_is_in_the_key(made, stage):
    """One other value of one setting of each stage."""
    options = getattr(Settings(), stage)
    values = options.model_dump()
    numbers = {k: v for k, v in values.items() if isinstance(v, (int, float))}
    name, value = next(iter((numbers or {k: v for k, v in values.items() if not v} or values).items()))
    other = {type(None): 1000, bool: not value, str: "keep"}.get(type(value))
    changed = options.model_copy(update={name: value + 1 if other is None else other})
    assert made._replace(settings=Settings().model_copy(update={stage: changed})).key != made.key


def test_known_rows_of_the_parcel_are_in_the_key(made, cloud, boundaries, tmp_path):
    """Where they run, which way, and what they are called; what belongs to another parcel isn't."""
    x, y = PLACE
    line = shapely.LineString([(x + 1, y + 2), (x + 13, y + 4)])
    beside, last = (shapely.transform(line, lambda xy, by=by: xy + by) for by in (20, 100))
    written = []

    def key(lines, numbers, crs=32632):
        written.append(tmp_path / f"rows{len(written)}.gpkg")
        frame = gpd.GeoDataFrame({"row_id": numbers}, geometry=lines, crs=32632).to_crs(crs)
        frame.to_file(written[-1], layer="rows")
        recipe = recipe_of(cloud, parcel="A", boundary=boundaries, rows=written[-1])
        assert recipe.sources[-1].path == written[-1]
        assert len(recipe.known.lines) == 1
        told = [f"{len(lines) - 1} known rows lie outside of the parcel, and are left out: 8"] * (len(lines) > 1)
        assert list(recipe.remarks) == told
        return recipe.key

    alone = key([line], [7])
    assert key([line, beside], [7, 8]) == alone
    assert key([line, last], [7, 8]) == alone
    others = [key([line.reverse()], [7]), key([line], [6]), key([shapely.transform(line, lambda xy: xy + 0.01)], [7])]
    assert len({made.key, alone, *others}) == 5
    assert key([line], [7], 25832) not in {alone, made.key}
    with pytest.raises(InputError, match=r"none of its 1 rows lies in the parcel: is its CRS the right one\?"):
        key([last], [8])


def test_known_vines_of_the_parcel_are_in_the_key(made, cloud, boundaries, tmp_path):
    """Where they stand; what stands elsewhere isn't, and is no reason to fail unless all do."""
    x, y = PLACE

    def key(places):
        gpd.GeoDataFrame(geometry=gpd.points_from_xy(*np.transpose(places)), crs=32632).to_file(tmp_path / "v.gpkg")
        recipe = recipe_of(cloud, parcel="A", boundary=boundaries, vines=tmp_path / "v.gpkg")
        assert recipe.sources[-1].path == tmp_path / "v.gpkg"
        return recipe.key

    inside = [(x + 1, y + 2), (x + 2, y + 2)]
    alone = key(inside)
    assert key([*inside, (x + 500, y)]) == alone
    assert len({made.key, alone, key(inside[:1])}) == 3
    with pytest.raises(InputError, match=r"none of its vines stands in the parcel: is its CRS the right one\?"):
        key([(x + 500, y)])


def test_vines_stand_in_parcels_or_half_a_metre_beside(made):
    """Whatever their CRS: in degrees a half would be all of a country."""
    (x, y, *_), utm = made.boundary[0].bounds, made.boundary[1]
    points = gpd.GeoSeries(gpd.points_from_xy([x + 1, x - 0.4, x - 0.6, x + 900], [y + 1] * 4), crs=utm).to_crs(4326)
    outline = gpd.GeoSeries([made.boundary[0]], crs=utm).to_crs(4326)
    parcels = {"metres": made.boundary, "degrees": (outline[0], outline.crs), "all": None}
    found = vines_of(points, parcels)
    assert {name: [*own.index] for name, own in found.items()} == {
        "metres": [0, 1],
        "degrees": [0, 1],
        "all": [*range(4)],
    }


def test_the_key_tells_nothing_else(made, cloud, boundaries, tmp_path):
    """A file touched, renamed, beside others; polygons beside it, in another order, drawn from another corner."""
    os.utime(cloud, (1, 1))
    assert recipe_of(cloud, parcel="A", boundary=boundaries).key == made.key
    assert made._replace(flown=datetime(2024, 6, 2, tzinfo=UTC)).key == made.key  # as a file without a date is touched
    moved = cloud.rename(tmp_path / "survey of may.las")
    assert recipe_of(moved, parcel="A", boundary=boundaries).key == made.key
    more = write_polygons(tmp_path / "more.gpkg", ["A", "B", "C", "D"])
    again = recipe_of(moved, parcel="A", boundary=more)
    assert again.sources[1].sha256 != made.sources[1].sha256
    assert again.key == made.key
    drawn = gpd.read_file(more)
    corners = np.roll(np.array(drawn.geometry[0].exterior.coords)[:-1], 2, axis=0)[::-1]
    drawn.loc[0, "geometry"] = shapely.Polygon(corners)
    drawn[::-1].to_file(tmp_path / "turned.geojson")
    assert recipe_of(moved, parcel="A", boundary=tmp_path / "turned.geojson").key == made.key
    assert made._replace(settings=Settings.model_validate(Settings().model_dump())).key == made.key


def test_a_parcel_that_is_called_as_its_cloud_takes_the_only_polygon_and_says_so(tmp_path):
    """That is its name by default; another name must be the polygon's, and so must this one where there are several."""
    cloud = write_las(tmp_path / "north.las")
    one, two = (write_polygons(tmp_path / f"{len(names)}.gpkg", names) for names in (["n"], ["n", "s"]))
    made = recipe_of(cloud, parcel="north", boundary=one)
    assert made.boundary == recipe_of(cloud, parcel="n", boundary=one).boundary
    assert made.remarks == ("the only polygon of 1.gpkg was taken, though none of its columns says 'north'",)
    for parcel, boundary in (("south", one), ("north", two)):
        with pytest.raises(InputError, match=r"has '(south|north)' in a column"):
            recipe_of(cloud, parcel=parcel, boundary=boundary)


@pytest.mark.parametrize("year", [1980, 2999])
def test_a_date_that_no_flight_can_have_is_none(tmp_path, year):
    """Of a header, and of the file."""
    path = write_las(tmp_path / "a.las", date=datetime(year, 5, 1, tzinfo=UTC))
    os.utime(path, (1_700_000_000, 1_700_000_000))
    assert recipe.flown(recipe.read_source(path)) == datetime.fromtimestamp(1_700_000_000, UTC)
    os.utime(path, (4_000_000_000, 4_000_000_000))
    assert recipe.flown(recipe.read_source(path)) <= datetime.now(UTC)
