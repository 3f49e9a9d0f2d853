"""Route graph for the route server of Nav2, the navigation of ROS 2 robots, as its ``GeoJsonGraphFileLoader`` reads it.

https://docs.nav2.org/configuration/packages/configuring-route-server.html
"""

from __future__ import annotations

import itertools
import json
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import shapely

from vinemap import paths
from vinemap.geo.holes import comes_back

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import geopandas as gpd

    from vinemap.export.field import Field

NEAR = 0.1
"""Metres from a row at which a way counts as one through it."""


class _Edge(NamedTuple):
    """A way between two nodes, by their positions."""

    start: int
    end: int
    metadata: dict[str, Any]


def write_nav2(field: Field, folder: Path, *, frame: str, grid: bool) -> None:
    """Write the graph: a node at every vertex of a lane, and edges both ways along lanes and between their ends.

    The route server goes straight from node to node, whatever an edge's geometry, so curves are in the nodes. Ends are
    joined, start to start and end to end, where two lanes have a row in common and the way leads through none, as it
    would without a headland, nor through a hole or notch of the parcel; what lies between blocks isn't known.

    Parameters
    ----------
    field : Field
        The parcel with its lanes.
    folder : Path
        Where the file goes.
    frame : str
        Name of the frame in which the robot knows the coordinates ("map").
    grid : bool
        Whether coordinates are those of the product's CRS, and not of {Main}.

    Raises
    ------
    OSError
        If it can't be written.
    """
    lanes, rows = field.plane(field.lanes, grid=grid), field.plane(field.rows, grid=grid)
    vertices = [shapely.get_coordinates(line) for line in lanes.geometry]
    first = np.cumsum([0, *map(len, vertices)]).tolist()
    nodes = np.concatenate(vertices)
    clear = [{"clear_m": round(float(m), 2)} if np.isfinite(m) else {} for m in lanes["clear_m"]]
    edges = [
        _Edge(k, k + 1, {"class": "lane", "lane": int(lane)} | room)
        for lane, room, a, b in zip(lanes["lane_id"], clear, first, first[1:], strict=False)
        for k in range(a, b - 1)
    ]
    outline = field.plane(field.outline, grid=grid).union_all() if field.bounded else None
    edges += _headlands(lanes, rows, first, nodes, outline)
    both = [way for edge in edges for way in (edge, edge._replace(start=edge.end, end=edge.start))]
    features = [_feature({"id": k, "frame": frame}, "Point", xy.tolist()) for k, xy in enumerate(nodes)]
    for k, edge in enumerate(both, start=len(nodes)):
        ends = nodes[[edge.start, edge.end]]
        properties = {"id": k, "startid": edge.start, "endid": edge.end, "overridable": True, "metadata": edge.metadata}
        cost = {"cost": round(float(np.hypot(*(ends[1] - ends[0]))), 3)}
        features.append(_feature(properties | cost, "MultiLineString", [ends.tolist()]))
    graph = {"type": "FeatureCollection", "name": f"{field.parcel} lanes", "features": features}
    text = json.dumps(graph, ensure_ascii=False, allow_nan=False).replace('{"type": "Feature"', '\n{"type": "Feature"')
    paths.exported(folder, field.parcel, "graph", ".geojson").write_text(text + "\n", encoding="utf-8")


def _headlands(
    lanes: gpd.GeoDataFrame,
    rows: gpd.GeoDataFrame,
    first: list[int],
    nodes: np.ndarray[Any, Any],
    within: shapely.Geometry | None,
) -> Iterator[_Edge]:
    beside = [
        {*right.split("+"), *left.split("+")} - {""}
        for right, left in zip(lanes["right_rows"], lanes["left_rows"], strict=True)
    ]
    vines = shapely.force_2d(rows.geometry.to_numpy())
    for a, b in itertools.combinations(range(len(lanes)), 2):
        if beside[a] & beside[b]:
            for start, end in ((first[a], first[b]), (first[a + 1] - 1, first[b + 1] - 1)):
                way = shapely.linestrings(nodes[[start, end]])
                if within is not None and comes_back(np.array([way]), within).any():
                    continue
                if (near := float(shapely.distance(way, vines).min())) > NEAR:
                    yield _Edge(start, end, {"class": "headland", "clear_m": round(2 * near, 2)})


def _feature(properties: dict[str, Any], kind: str, coordinates: list[Any]) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}
