"""Files of polygons that aren't written as they should be, but can't be misunderstood."""

import json

import geopandas as gpd
import pytest
import shapely

from vinemap.errors import InputError
from vinemap.geo.boundaries import read_boundary, read_parcels

CORNERS = [(7.92, 44.61), (7.93, 44.61), (7.93, 44.62)]
KML = """<kml xmlns="http://www.opengis.net/kml/2.2"><Placemark><name>A</name><LinearRing><coordinates>
7.92,44.61 7.93,44.61 7.93,44.62 7.92,44.61</coordinates></LinearRing></Placemark></kml>"""


def test_an_outline_that_does_not_end_where_it_begins_is_closed(tmp_path):
    shapes = {"open": CORNERS, "closed": [*CORNERS, CORNERS[0]]}
    features = [
        {"type": "Feature", "properties": {"name": name}, "geometry": {"type": "Polygon", "coordinates": [corners]}}
        for name, corners in shapes.items()
    ]
    (tmp_path / "a.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    found = read_parcels(tmp_path / "a.geojson")
    assert found["open"].boundary[0].equals(found["closed"].boundary[0])


def test_a_ring_is_no_polygon(tmp_path):
    (tmp_path / "a.kml").write_text(KML)
    with pytest.raises(InputError, match=r"a\.kml: holds no polygon"):
        read_boundary(tmp_path / "a.kml")


@pytest.mark.parametrize("layer", ["Parcel", "parcels"])
def test_the_layer_of_parcels_among_others(tmp_path, layer):
    path, polygon = tmp_path / "a.gpkg", shapely.box(0, 0, 9, 9)
    for name, shape in ((layer, polygon), ("soil", polygon.buffer(5))):
        gpd.GeoDataFrame(geometry=[shape], crs=32632).to_file(path, layer=name)
    assert read_boundary(path)[0].equals(polygon)
    gpd.GeoDataFrame(geometry=[polygon], crs=32632).to_file(path, layer="PARCELS" if layer == "Parcel" else "parcel")
    with pytest.raises(InputError, match="has several layers of polygons"):
        read_boundary(path)
