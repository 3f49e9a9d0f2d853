"""Exported lines compared with those of the product, in metres."""

import json
import math
import shutil

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Transformer

from vinemap.geo.crs import parse_crs

NAME = "Côte 1"
UTM = parse_crs("EPSG:32632")


def in_grid(lon_lat):
    """Degrees in the product's CRS."""
    to_grid = Transformer.from_crs(4326, UTM, always_xy=True)
    return np.column_stack(to_grid.transform(*np.asarray(lon_lat, dtype=float)[:, :2].T))


def assert_same(found, truth, *, within=0.01):
    """Lines lie on each other within a centimetre and have one direction."""
    assert len(found) == len(truth)
    for line, true in zip(found, truth, strict=True):
        true_xy = shapely.get_coordinates(true)
        assert shapely.hausdorff_distance(shapely.LineString(line), shapely.force_2d(true), 0.02) < within
        assert np.abs(line[[0, -1]] - true_xy[[0, -1]]).max() < within


def coordinates(path):
    collection = json.loads(path.read_text(encoding="utf-8"))
    assert collection["type"] == "FeatureCollection"
    assert "crs" not in collection
    return collection["features"]


def graph(path):
    """Nodes and edges of a Nav2 route graph; an unknown or a missing key fails."""
    nodes, edges = {}, {}
    for feature in coordinates(path):
        assert set(feature) == {"type", "properties", "geometry"}
        properties, geometry = feature["properties"], feature["geometry"]
        if geometry["type"] == "Point":
            assert set(properties) == {"id", "frame"}
            nodes[properties["id"]] = (properties["frame"], *geometry["coordinates"])
        else:
            assert geometry["type"] == "MultiLineString"
            assert set(properties) == {"id", "startid", "endid", "cost", "overridable", "metadata"}
            way = [nodes[properties["startid"]][1:], nodes[properties["endid"]][1:]]
            assert geometry["coordinates"] == [[list(xy) for xy in way]]
            assert properties["cost"] == pytest.approx(math.dist(*way), abs=0.001)
            assert properties["cost"] > 0
            assert properties["overridable"] is True
            edges[properties["id"]] = properties
    assert not set(nodes) & set(edges)
    return nodes, edges


def few(product, folder, n, **columns):
    """Copy a product, with its first n rows."""
    shutil.copytree(product, folder)
    path = folder / f"{NAME}.gpkg"
    rows = pyogrio.read_dataframe(path, layer="rows").assign(**columns)
    pyogrio.write_dataframe(rows[:n], path, layer="rows", geometry_type="LineString Z")
    return folder
