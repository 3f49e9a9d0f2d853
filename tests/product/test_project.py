"""The QGIS project of a product; that QGIS understands it is tested in test_qgis.py."""

import io
import xml.etree.ElementTree as ET
import zipfile

import numpy as np
import pytest
import shapely

from vinemap.parcel import map_parcel
from vinemap.product.qgis.print_layout import MAP, map_scale, print_layout
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.survey import simulate, write_survey
from vinemap.simulate.terrain import PLACE, hillside


@pytest.fixture(scope="module")
def products(vineyard, tmp_path_factory):
    """The same product twice."""
    cloud = write_survey(vineyard, tmp_path_factory.mktemp("survey"))
    folder = tmp_path_factory.mktemp("products")
    for name in ("one", "two"):
        map_parcel(cloud, folder / name, parcel="Clos & Fils #3", named=False, boundary=cloud.parent / "parcels.gpkg")
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
    assert len(sources) == 14
    for source in sources:
        assert source.startswith("./")
        assert (products[0] / source.partition("|")[0]).is_file()


def test_the_tree_has_every_layer_once_lines_above_rasters(document):
    leaves = [leaf.get("id") for leaf in document.find("layer-tree-group").iter("layer-tree-layer")]
    kinds = {layer.findtext("id"): layer.get("type") for layer in document.iter("maplayer")}
    assert sorted(leaves) == sorted(kinds)
    assert [kinds[leaf] for leaf in leaves] == ["vector"] * 8 + ["raster"] * 6
    assert all(len(leaf) > 10 for leaf in leaves)


def test_a_parcel_without_rows_has_none_in_the_legend(tmp_path):
    bare = Vineyard("bare", (), outline=shapely.box(*PLACE, *np.add(PLACE, 20)))
    cloud = write_survey(simulate([bare], hillside(0.1), density=50, seed=1), tmp_path)
    map_parcel(cloud, tmp_path / "out", parcel="bare")
    with zipfile.ZipFile(tmp_path / "out" / "bare.qgz") as archive:
        layout = ET.parse(archive.open("project.qgs")).find("Layouts/Layout")
    assert [leaf.get("id") for leaf in layout.iter("layer-tree-layer")] == ["vinemap_parcel", "vinemap_chm"]
    assert any((item.get("labelText") or "").startswith("no rows · 0 m") for item in layout)


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


@pytest.mark.parametrize("name", ["F", "Vigna Superiore di San Lorenzo in Collina presso la Cascina Alta", "园" * 53])
def test_the_title_fits_on_its_line_even_in_letters_as_wide_as_high(name):
    title = labels(name)[0]
    points = float(title.find("LabelFont").get("description").split(",")[1])
    width, height = (float(side) for side in title.get("size").split(",")[:2])
    left = float(title.get("position").split(",")[0])
    assert 10 < points <= 20
    assert points * 25.4 / 72 * len(name) <= width
    assert points * 25.4 / 72 <= height
    assert left + width < 273, "where the north arrow begins"


def test_a_title_is_no_expression():
    assert labels("Clos [% 1 + 1 %]")[0].get("labelText") == "Clos [%'['%]% 1 + 1 %]"


def labels(title):
    layout = print_layout(title, {"head": [], "foot": []}, (0, 0, 100, 100), [])
    return [item for item in layout.iter("LayoutItem") if item.get("labelText")]


def test_a_huge_survey_fits_on_the_page_too():
    assert map_scale((0, 0, 900_000, 10)) == pytest.approx(1000 * 900_000 * 1.06 / MAP[2], abs=1)
