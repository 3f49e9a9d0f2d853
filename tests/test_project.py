"""The QGIS project of a product; that QGIS understands it is tested in test_qgis.py."""

import io
import xml.etree.ElementTree as ET
import zipfile

import pytest
import shapely

from vinemap.parcel import map_parcel
from vinemap.print_layout import MAP, map_scale
from vinemap.synthetic import write_survey


@pytest.fixture(scope="module")
def products(vineyard, tmp_path_factory):
    """The same product twice."""
    cloud = write_survey(vineyard, tmp_path_factory.mktemp("survey"))
    folder = tmp_path_factory.mktemp("products")
    for name in ("one", "two"):
        map_parcel(cloud, folder / name, parcel="Clos & Fils #3", boundary=cloud.parent / "parcels.gpkg")
    return folder / "one", folder / "two"


@pytest.fixture(scope="module")
def document(products):
    with zipfile.ZipFile(products[0] / "Clos & Fils #3.qgz") as archive:
        (name,) = archive.namelist()
        return ET.parse(io.BytesIO(archive.read(name))).getroot()


def test_it_is_the_same_each_time(products):
    one, two = ((folder / "Clos & Fils #3.qgz").read_bytes() for folder in products)
    assert one == two


def test_every_source_is_a_file_beside_it(products, document):
    sources = [layer.findtext("datasource") for layer in document.iter("maplayer")]
    assert len(sources) == 12
    for source in sources:
        assert source.startswith("./")
        assert (products[0] / source.partition("|")[0]).is_file()


def test_the_tree_has_every_layer_once_lines_above_rasters(document):
    leaves = [leaf.get("id") for leaf in document.find("layer-tree-group").iter("layer-tree-layer")]
    kinds = {layer.findtext("id"): layer.get("type") for layer in document.iter("maplayer")}
    assert sorted(leaves) == sorted(kinds)
    assert [kinds[leaf] for leaf in leaves] == ["vector"] * 6 + ["raster"] * 6
    assert all(len(leaf) > 10 for leaf in leaves)


def test_it_opens_at_the_parcel(products, document):
    extent = {e.tag: float(e.text) for e in document.find("mapcanvas/extent")}
    shown = shapely.box(extent["xmin"], extent["ymin"], extent["xmax"], extent["ymax"])
    import geopandas as gpd

    parcel = gpd.read_file(products[0] / "Clos & Fils #3.gpkg", layer="parcel").union_all()
    assert shown.contains(parcel)
    assert shown.area < 2 * parcel.envelope.area


@pytest.mark.parametrize(
    ("size", "scale"), [((190, 160), 1000), ((200, 20), 1000), ((201, 20), 1250), ((20, 160), 1000), ((3, 4), 100)]
)
def test_the_page_has_the_largest_round_scale_that_fits(size, scale):
    found = map_scale((0, 0, *size))
    assert found == scale
    assert all(1000 * length / found <= side for length, side in zip(size, MAP[2:], strict=True))


def test_a_huge_survey_fits_on_the_page_too():
    assert map_scale((0, 0, 900_000, 10)) == pytest.approx(1000 * 900_000 * 1.06 / MAP[2], abs=1)
