"""A product is made anew if what it is made of has changed, and only then."""

import errno
import json
import os
from datetime import UTC, datetime
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pytest
import shapely
from systems import POSIX

from vinemap.config.settings import Settings
from vinemap.errors import BusyError, InputError
from vinemap.geo.crs import parse_crs
from vinemap.geo.main import Origin
from vinemap.product import recipe
from vinemap.product.recipe import Source, flown, product_in, read_source, recipe_of, vines_of

PLACE = np.array([414_700.0, 4_940_700.0])


def write_las(path, *, seed=0, date=datetime(2024, 6, 1, tzinfo=UTC)):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = [*PLACE, 0]
    header.creation_date = date
    header.add_crs(parse_crs("EPSG:32632"))
    las = laspy.LasData(header)
    las.xyz = np.random.default_rng(seed).uniform([*PLACE, 0], [*(PLACE + 20), 2], (50, 3))
    las.write(path)
    return path


def write_polygons(path, names, *, crs=32632, grow=0.0):
    squares = [shapely.box(*(PLACE + 20 * k), *(PLACE + 20 * k + 15)).buffer(grow) for k in range(len(names))]
    gpd.GeoDataFrame({"name": names}, geometry=squares, crs=32632).to_crs(crs).to_file(path)
    return path


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
    numbers = {k: v for k, v in options.model_dump().items() if isinstance(v, (int, float)) or not v}
    name, value = next(iter((numbers or options.model_dump()).items()))
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


def test_the_date_is_the_headers_or_else_the_files(tmp_path):
    cloud = write_las(tmp_path / "a.las", date=datetime(2023, 2, 1, tzinfo=UTC))
    assert flown(read_source(cloud)) == datetime(2023, 2, 1, tzinfo=UTC)
    with cloud.open("r+b") as stream:
        stream.seek(90)
        stream.write(bytes(4))
    os.utime(cloud, (1_700_000_000.9, 1_700_000_000.9))
    assert flown(read_source(cloud)) == datetime.fromtimestamp(1_700_000_000, UTC)
    source = read_source(cloud)
    cloud.unlink()
    with pytest.raises(InputError, match=r"a\.las: no such file"):
        flown(source)


@pytest.fixture
def hashed(monkeypatch):
    """Names of the files whose content is read."""
    read, digest = [], recipe.hashlib.file_digest

    def file_digest(stream, kind):
        read.append(Path(stream.name).name)
        return digest(stream, kind)

    monkeypatch.setattr(recipe.hashlib, "file_digest", file_digest)
    return read


def long_ago(path, seconds=100.0):
    """What is known of a file that was read so many seconds after its last change."""
    stat = path.stat()
    return read_source(path)._replace(read=max(stat.st_mtime, stat.st_ctime) + seconds)


def test_a_file_that_is_known_is_not_read_again(cloud, hashed):
    known = long_ago(cloud)
    assert read_source(cloud, [known._replace(path=Path("other.las")), known]) is known
    assert hashed == ["may.las"]


def test_what_is_known_goes_through_json(cloud, hashed):
    """As a survey's record keeps it."""
    known = long_ago(cloud)
    stored = json.loads(json.dumps({**known._asdict(), "path": str(cloud)}))
    again = Source(Path(stored["path"]), stored["sha256"], tuple(stored["stamp"]), stored["read"])
    assert read_source(cloud, [again]) is again
    assert hashed == ["may.las"]


def test_a_file_read_within_the_clocks_granularity_of_its_change_is_read_again(cloud, hashed):
    """It may have changed once more without its time telling."""
    for seconds in (-1, 0, 1, recipe.SETTLED - 0.1):
        read_source(cloud, [long_ago(cloud, seconds)])
    assert len(hashed) == 8
    read_source(cloud, [long_ago(cloud, recipe.SETTLED + 0.1)])
    assert len(hashed) == 9


@POSIX
def test_a_file_of_the_future_is_read_again(cloud, hashed):
    """Written by a machine whose clock is ahead."""
    os.utime(cloud, (4e9, 4e9))
    known = read_source(cloud)
    assert read_source(cloud, [known]).sha256 == known.sha256
    assert len(hashed) == 2


@POSIX
def test_another_file_of_the_same_size_and_time_is_read(cloud, tmp_path, hashed):
    known = long_ago(cloud)
    stat = cloud.stat()
    other = write_las(tmp_path / "other.las", seed=1)
    os.utime(other, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    other.replace(cloud)
    assert (cloud.stat().st_size, cloud.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)
    assert read_source(cloud, [known]).sha256 != known.sha256


@POSIX
def test_a_file_changed_in_place_whose_time_was_set_back_is_read(cloud, hashed):
    known = long_ago(cloud)
    stat = cloud.stat()
    with cloud.open("r+b") as stream:
        stream.seek(-1, os.SEEK_END)
        stream.write(b"\x7f")
    os.utime(cloud, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert cloud.stat().st_mtime_ns == stat.st_mtime_ns
    assert read_source(cloud, [known]).sha256 != known.sha256


@pytest.mark.parametrize("how", ["grows", "is replaced", "is gone"])
def test_a_file_that_changes_while_it_is_read(cloud, tmp_path, monkeypatch, how):
    other, digest = write_las(tmp_path / "other.las", seed=1), recipe.hashlib.file_digest

    def file_digest(stream, kind):
        found = digest(stream, kind)
        if how == "grows":
            with cloud.open("ab") as more:
                more.write(b"more")
        elif how == "is replaced":
            other.replace(cloud)
        else:
            cloud.unlink()
        return found

    monkeypatch.setattr(recipe.hashlib, "file_digest", file_digest)
    with pytest.raises(BusyError, match=r"may\.las: changed while it was read: try again") as error:
        read_source(cloud)
    assert error.value.heals


def test_a_source_can_be_checked_later(made, cloud):
    made.sources[0].check()
    with cloud.open("ab") as stream:
        stream.write(b"more")
    with pytest.raises(BusyError):
        made.sources[0].check()


@pytest.mark.parametrize(
    ("number", "kind"), [(errno.EIO, BusyError), (errno.ESTALE, BusyError), (errno.EACCES, InputError)]
)
def test_a_disk_that_fails(cloud, monkeypatch, number, kind):
    """What may pass is told from what won't."""
    for name in ("open", "stat"):
        with monkeypatch.context() as patch:
            patch.setattr(Path, name, lambda *words, **options: (_ for _ in ()).throw(OSError(number, "broken")))
            with pytest.raises(kind, match=r"may\.las: can't be read \(broken\)"):
                read_source(cloud)


def test_what_is_no_file(tmp_path):
    with pytest.raises(InputError, match="none: no such file"):
        read_source(tmp_path / "none")
    with pytest.raises(InputError, match="can't be read"):
        read_source(tmp_path)
    with pytest.raises(InputError, match="can't be read"):
        read_source(tmp_path / ("x" * 300))


@POSIX
def test_a_name_that_is_no_unicode_can_be_told(tmp_path):
    """As of a file that was copied from an old disk."""
    path = tmp_path / os.fsdecode(b"Nebbiolo \xe0.las")
    write_las(tmp_path / "a.las").rename(path)
    with pytest.raises(InputError, match="rename it") as error:
        read_source(path)
    assert str(error.value).encode()


RECORD = {
    "key": "k",
    "parcel": "A",
    "counts": {"rows": 3},
    "length_m": 12.5,
    "warnings": ["few points"],
    "files": {"A.gpkg": 4, "A_dtm.tif": 0},
}


def write_product(folder, record):
    folder.mkdir()
    (folder / "A.gpkg").write_bytes(b"1234")
    (folder / "A_dtm.tif").touch()
    (folder / "run.json").write_text(record if isinstance(record, str) else json.dumps(record), encoding="utf-8")
    return folder


def test_a_whole_product(tmp_path):
    assert product_in(write_product(tmp_path / "A", RECORD)) == ("k", "A", 3, 12.5, ("few points",))


@pytest.mark.parametrize("file", ["A.gpkg", "A_dtm.tif", "run.json"])
def test_a_product_that_lacks_a_file(tmp_path, file):
    folder = write_product(tmp_path / "A", RECORD)
    (folder / file).unlink()
    assert product_in(folder) is None


@pytest.mark.parametrize("content", [b"123", b"12345", b""])
def test_a_product_with_a_file_of_another_size(tmp_path, content):
    folder = write_product(tmp_path / "A", RECORD)
    (folder / "A.gpkg").write_bytes(content)
    assert product_in(folder) is None


@pytest.mark.parametrize("name", list(RECORD))
@pytest.mark.parametrize("value", [None, 5, [1]])
def test_a_record_of_something_else(tmp_path, name, value):
    record = {key: known for key, known in RECORD.items() if key != name}
    assert product_in(write_product(tmp_path / "A", record)) is None
    if name in ("counts", "files") or (name == "warnings" and value != [1]):
        (tmp_path / "A" / "run.json").write_text(json.dumps(RECORD | {name: value}))
        assert product_in(tmp_path / "A") is None


def test_a_torn_record(tmp_path):
    text = json.dumps(RECORD)
    folder = write_product(tmp_path / "A", text)
    assert product_in(folder)
    for n in range(len(text)):
        (folder / "run.json").write_text(text[:n])
        assert product_in(folder) is None
    for other in (b"[]", b"null", b"\xff\xfe", bytes(10)):
        (folder / "run.json").write_bytes(other)
        assert product_in(folder) is None


def test_no_product(tmp_path):
    assert product_in(tmp_path / "none") is None
    (tmp_path / "A").touch()
    assert product_in(tmp_path / "A") is None


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
