"""PDAL as an engine: its pipelines on a stand-in that works as PDAL does, the error without it, and PDAL itself."""

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import geopandas as gpd
import laspy
import numpy as np
import pytest
import rasterio
import shapely
from commands import free_of_prefect, python
from pipelines import Pipeline, Stage, numbers
from pyproj import CRS, Transformer

from vinemap import paths
from vinemap.cloud import pdal as pdal_engine
from vinemap.cloud.las import read_cloud
from vinemap.cloud.pdal import ground_pipeline, read_cloud_pdal, reading_pipeline
from vinemap.config.settings import GroundOptions, Settings
from vinemap.errors import DependencyError, InputError
from vinemap.evaluate.rows import evaluate_rows
from vinemap.geo.boundaries import read_boundary
from vinemap.geo.raster import sample
from vinemap.parcel import map_parcel
from vinemap.simulate.survey import write_survey
from vinemap.surfaces.ground import terrain_model

ROOT = Path(__file__).parents[2]
UTM = CRS.from_epsg(32632)
DEGREES = CRS.from_epsg(4326)
SQUARE = shapely.box(414710, 4940710, 414730, 4940740)
WITH_PDAL = Settings(ground=GroundOptions(engine="pdal"))
USABLE = ("filters.expression", {"expression": "Classification != 7 && Classification != 18 && Withheld == 0"})


def inside(vineyard):
    """Corners of the parcel, without its edge."""
    west, south, east, north = vineyard.parcels.total_bounds
    return (west + 2, south + 2), (east - 2, north - 2)


@pytest.fixture
def pdal(monkeypatch):
    """The stand-in, in PDAL's place."""

    def kinds(group, *names):
        makers = {
            name: staticmethod(lambda kind=f"{group}s.{name}", **options: Stage(kind, **options)) for name in names
        }
        return type(group.title(), (), makers)

    module = ModuleType("pdal")
    module.__version__, module.info = "3.5.5", SimpleNamespace(version="2.10.0")
    module.Reader = kinds("reader", "las", "copc")
    module.Filter = kinds("filter", "expression", "reprojection", "crop", "smrf")
    monkeypatch.setitem(sys.modules, "pdal", module)
    monkeypatch.setattr(Pipeline, "made", [])
    return module


def stages_of(pipeline):
    return [(stage.type, stage.options) for stage in pipeline.stages]


def write_las(path, xyz, crs=UTM, scales=(0.001, 0.001, 0.001), vlrs=(), **dimensions):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.array(scales), np.floor(xyz.min(axis=0))
    header.vlrs.extend(vlrs)
    if crs is not None:
        header.add_crs(crs)
    las = laspy.LasData(header)
    las.xyz = xyz
    for name, values in dimensions.items():
        las[name] = values
    las.write(path)
    return path


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform([414700, 4940700, 460], [414760, 4940750, 470], (3000, 3))


def in_degrees(xy):
    return np.column_stack(Transformer.from_crs(UTM, DEGREES, always_xy=True).transform(*xy.T))


def assert_same(path, **options):
    """PDAL's points are those of our own reader, in any order."""
    ours, theirs = read_cloud(path, **options), read_cloud_pdal(path, **options)
    assert theirs.crs == ours.crs
    assert theirs.vertical == ours.vertical
    assert theirs.xyz.shape == ours.xyz.shape
    order = [cloud.xyz[np.lexsort(cloud.xyz.round(3).T)] for cloud in (ours, theirs)]
    assert np.allclose(*order, rtol=0, atol=1e-6)
    assert theirs.classification.shape == (len(theirs.xyz),)
    return theirs


def test_pipeline_of_a_whole_file(pdal):
    assert stages_of(reading_pipeline(Path("a.laz"), source=UTM, target=UTM)) == [
        ("readers.las", {"filename": "a.laz", "override_srs": UTM.to_wkt()}),
        USABLE,
    ]


def test_pipeline_with_another_crs_and_a_boundary(pdal):
    """Of the file's CRS PDAL hears the horizontal part only: told of heights, it would move them to the ellipsoid."""
    source, flat = CRS.from_user_input("EPSG:4258+7837"), CRS.from_epsg(4258)
    stages = stages_of(reading_pipeline(Path("a.las"), source=source, target=UTM, polygon=SQUARE))
    assert stages == [
        ("readers.las", {"filename": "a.las", "override_srs": flat.to_wkt()}),
        USABLE,
        ("filters.reprojection", {"in_srs": flat.to_wkt(), "out_srs": UTM.to_wkt()}),
        ("filters.crop", {"polygon": shapely.to_wkt(SQUARE), "a_srs": UTM.to_wkt()}),
    ]


def test_pipeline_of_a_copc(pdal):
    assert stages_of(reading_pipeline(Path("a.copc.laz"), source=UTM, target=UTM, copc=True)) == [
        ("readers.copc", {"filename": "a.copc.laz", "override_srs": UTM.to_wkt()}),
        USABLE,
    ]
    bounds = "([414709.7, 414730.3], [4940709.7, 4940740.3])"
    assert stages_of(reading_pipeline(Path("a.copc.laz"), source=UTM, target=UTM, polygon=SQUARE, copc=True)) == [
        ("readers.copc", {"filename": "a.copc.laz", "override_srs": UTM.to_wkt(), "bounds": bounds}),
        USABLE,
        ("filters.crop", {"polygon": shapely.to_wkt(SQUARE), "a_srs": UTM.to_wkt()}),
    ]


def test_bounds_of_a_copc_in_degrees_hold_the_whole_boundary(pdal):
    wide = shapely.box(414000, 4940000, 417000, 4943000)
    reader = reading_pipeline(Path("a.copc.laz"), source=DEGREES, target=UTM, polygon=wide, copc=True).stages[0]
    west, east, south, north = numbers(reader.options["bounds"])
    lon, lat = in_degrees(shapely.get_coordinates(shapely.segmentize(wide, 10))).T
    assert west < lon.min() < lon.max() < east
    assert south < lat.min() < lat.max() < north
    assert (east - west) * (north - south) < 1.1 * np.ptp(lon) * np.ptp(lat)


def test_pipeline_of_the_ground(pdal, points):
    pipeline = ground_pipeline(points)
    [(name, options)] = stages_of(pipeline)
    assert name == "filters.smrf"
    assert options == {"cell": 0.5, "slope": 0.7, "window": 8.0, "scalar": 0.35, "threshold": 0.15}
    [given] = pipeline.inputs
    assert given.dtype == np.dtype([("X", "f8"), ("Y", "f8"), ("Z", "f8")])
    assert (np.column_stack([given[name] for name in "XYZ"]) == points).all()


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_reads_what_our_own_reader_reads(pdal, tmp_path, points, suffix):
    assert_same(write_las(tmp_path / f"a.{suffix}", points))


def test_reads_degrees(pdal, tmp_path, points):
    xyz = np.column_stack([in_degrees(points[:, :2]), points[:, 2]])
    path = write_las(tmp_path / "a.las", xyz, CRS.from_epsg(4979), scales=(1e-9, 1e-9, 0.001))
    assert assert_same(path).crs.to_epsg() == 32632
    assert len(assert_same(path, boundary=(SQUARE, UTM)).xyz) > 500


def test_reads_feet(pdal, tmp_path):
    feet = np.random.default_rng(0).uniform([6e6, 2.1e6, 1000], [6e6 + 300, 2.1e6 + 300, 1100], (500, 3))
    assert assert_same(write_las(tmp_path / "a.laz", feet, CRS.from_epsg(2227))).xyz[:, 2].max() < 336


def test_reads_heights_of_a_stated_datum_and_another_crs_on_demand(pdal, tmp_path, points):
    path = write_las(tmp_path / "a.laz", points, CRS.from_user_input("EPSG:25832+7837"))
    assert assert_same(path).vertical == "DHHN2016 height"
    assert assert_same(path, crs=UTM).crs == UTM


def test_clips_to_a_boundary_of_parts_in_another_crs(pdal, tmp_path, points):
    parts = shapely.union_all([SQUARE, shapely.box(414740, 4940710, 414750, 4940740)])
    degrees = shapely.transform(shapely.segmentize(parts, 1), in_degrees)
    cloud = assert_same(write_las(tmp_path / "a.laz", points), boundary=(degrees, DEGREES))
    assert len(cloud.xyz) == pytest.approx(shapely.contains_xy(parts, points[:, :2]).sum(), abs=2)


def test_leaves_noise_withheld_points_and_strays_out(pdal, tmp_path, points):
    points[:2] = [[414700, 4940700, 9000], [500000, 4990000, 465]]
    classes, withheld = np.zeros((2, len(points)), dtype=np.uint8)
    classes[10:20], classes[20:25], classes[30:50], withheld[60:63] = 7, 18, 2, 1
    path = write_las(tmp_path / "a.laz", points, classification=classes, withheld=withheld)
    assert len(assert_same(path).xyz) == len(points) - 20
    assert len(Pipeline.made[-1].inputs[0]) == len(points) - 20  # SMRF's raster is of these alone


def test_tells_a_copc_by_its_header(pdal, tmp_path, points):
    path = write_las(tmp_path / "a.laz", points, vlrs=[laspy.VLR("copc", 1, record_data=bytes(160))])
    assert_same(path, boundary=(SQUARE, UTM))
    assert "readers.copc" in [pipeline.stages[0].type for pipeline in Pipeline.made]


def test_classes_tell_ground(pdal, tmp_path, points, monkeypatch):
    points[:1000, 2] = 465
    monkeypatch.setattr(Pipeline, "terrain", staticmethod(lambda x, y: np.full(len(x), 465.0)))
    cloud = read_cloud_pdal(write_las(tmp_path / "a.las", points))
    assert set(cloud.classification[np.abs(cloud.xyz[:, 2] - 465) < 0.1]) == {2}
    assert set(cloud.classification[np.abs(cloud.xyz[:, 2] - 465) >= 0.1]) == {1}


def test_bad_clouds(pdal, tmp_path, points):
    with pytest.raises(InputError, match=r"none\.laz: no such file"):
        read_cloud_pdal(tmp_path / "none.laz")
    path = write_las(tmp_path / "a.las", points)
    with pytest.raises(InputError, match=r"a\.las: no point lies inside the boundary"):
        read_cloud_pdal(path, boundary=(shapely.box(0, 0, 10, 10), UTM))
    with pytest.raises(InputError, match=r"n\.las: holds no usable points"):
        read_cloud_pdal(write_las(tmp_path / "n.las", points, classification=np.full(len(points), 7, dtype=np.uint8)))
    with pytest.raises(InputError, match="--crs EPSG:n"):
        read_cloud_pdal(write_las(tmp_path / "b.las", points, crs=None))
    (tmp_path / "text.laz").write_text("no cloud" * 100)
    with pytest.raises(InputError, match=r"text\.laz: can't be read"):
        read_cloud_pdal(tmp_path / "text.laz")


@pytest.mark.parametrize("read", [read_cloud, read_cloud_pdal])
def test_local_files_and_placed_ones_do_not_go_together(pdal, tmp_path, points, read):
    """By whichever engine; local ones of two names do."""
    site, plot = (CRS.from_wkt(f'LOCAL_CS["{name}",UNIT["metre",1]]') for name in ("site", "plot"))
    a, b, c = (write_las(tmp_path / f"{k}.las", points, crs) for k, crs in zip("abc", (site, plot, UTM), strict=True))
    with pytest.raises(InputError, match=r"a\.las: site can't be brought to WGS 84 / UTM zone 32N, that of c\.las$"):
        read([c, a])
    with pytest.raises(InputError, match=r"c\.las: WGS 84 .* can't be brought to local metres, that of a\.las$"):
        read([a, c])
    assert shapely.multipoints(read([a, b]).xyz).bounds == pytest.approx(shapely.multipoints(points).bounds, abs=0.001)


def test_errors_of_pdal_are_one_line_with_the_files_name(pdal, tmp_path, points, monkeypatch):
    def execute(pipeline):
        raise RuntimeError("readers.las: Invalid point count: 3000.\nNumber of points too large for file size.")

    monkeypatch.setattr(Pipeline, "execute", execute)
    with pytest.raises(InputError) as caught:
        read_cloud_pdal(write_las(tmp_path / "a.las", points))
    assert str(caught.value).endswith(
        "a.las: can't be read as LAS or LAZ (readers.las: Invalid point count: 3000.): is it whole?"
    )


def test_a_parcel_with_pdal(pdal, tmp_path, vineyard, monkeypatch):
    """Rows, terrain and record of a run in which the ground is what the simulation knows it to be."""
    monkeypatch.setattr(Pipeline, "terrain", staticmethod(vineyard.terrain))
    survey = write_survey(vineyard, tmp_path / "in")
    boundary = survey.parent / "parcels.gpkg"
    summary = map_parcel(survey, tmp_path / "out", parcel="A", boundary=boundary, settings=WITH_PDAL)
    assert summary.rows == 6
    found = evaluate_rows(gpd.read_file(paths.geopackage(summary.folder, "A"), layer="rows"), vineyard.rows)
    assert (found.good, found.extra, found.missed) == (100, 0, 0)
    assert found.dep.mean < 0.08
    assert found.dek.mean < 0.02
    with rasterio.open(paths.raster(summary.folder, "A", "dtm")) as dtm:
        x, y = np.random.default_rng(0).uniform(*inside(vineyard), (3000, 2)).T
        error = np.abs([z[0] for z in dtm.sample(zip(x, y, strict=True))] - vineyard.terrain(x, y))
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.1
    record = json.loads(paths.run_record(summary.folder).read_text())
    assert record["settings"]["ground"]["engine"] == "pdal"
    assert record["versions"]["pdal"] == "3.5.5"
    assert record["versions"]["libpdal"] == "2.10.0"
    assert {stage.type for pipeline in Pipeline.made for stage in pipeline.stages} >= {"readers.las", "filters.smrf"}


def test_without_pdal(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pdal", None)
    for refused in (
        lambda: reading_pipeline(Path("a.laz"), source=UTM, target=UTM),
        lambda: read_cloud_pdal(tmp_path / "none.laz"),
        lambda: map_parcel(tmp_path / "none.laz", tmp_path / "out", parcel="A", settings=WITH_PDAL),
    ):
        with pytest.raises(DependencyError, match="conda install -c conda-forge python-pdal"):
            refused()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="no such file"):
        map_parcel(tmp_path / "none.laz", tmp_path / "out", parcel="A")


def test_with_a_pdal_that_lacks_what_is_used(pdal, monkeypatch):
    monkeypatch.delattr(pdal.Filter, "expression")
    with pytest.raises(DependencyError, match="expression"):
        pdal_engine.load_pdal()


@pytest.mark.parametrize(
    ("command", "settings"),
    [
        (["vinemap", "run", "none.laz", "--settings", "s.yaml"], "ground: {engine: pdal}"),
        (
            ["flows.parcel", "s.yaml", "F"],
            "{survey: barolo, simulate: barolo, parcels: [F], settings: {ground: {engine: pdal}}}",
        ),
    ],
)
def test_commands_without_pdal_end_at_once(tmp_path, command, settings):
    """One line and exit code 2 before anything is read, simulated or written, even if somebody has PDAL."""
    (tmp_path / "pdal.py").write_text("raise ImportError('libpdalcpp.so: cannot open shared object file')\n")
    (tmp_path / "s.yaml").write_text(settings)
    environment = free_of_prefect() | {"PREFECT_HOME": str(tmp_path / "prefect")}
    done = python("-m", *command, cwd=tmp_path, environment=environment)
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("vinemap: ground.engine: pdal")
    assert done.stderr.count("\n") == 1
    for word in ("libpdalcpp.so", "conda install -c conda-forge python-pdal", "leave ground.engine out"):
        assert word in done.stderr
    assert {path.name for path in tmp_path.iterdir()} - {"prefect", "__pycache__"} == {"pdal.py", "s.yaml"}


def test_pdal_itself(tmp_path, vineyard):
    try:
        pdal_engine.load_pdal()
    except DependencyError as error:
        pytest.skip(str(error))
    survey = write_survey(vineyard, tmp_path)
    cloud = assert_same(survey, boundary=read_boundary(survey.parent / "parcels.gpkg"))
    dtm = terrain_model(cloud, engine="pdal")
    xy = np.random.default_rng(0).uniform(*inside(vineyard), (3000, 2))
    error = np.abs(sample(dtm, xy) - vineyard.terrain(*xy.T))
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.12


def test_other_formats_are_not_its_own(pdal):
    with pytest.raises(InputError, match=r"a\.e57: ground\.engine: pdal reads LAS, LAZ and COPC on a disk alone"):
        read_cloud_pdal([Path("b.laz"), Path("a.e57")])
