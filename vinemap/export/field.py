"""What every format is written from: the layers of a product, and the lanes between its rows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import shapely
from pyogrio.errors import DataLayerError, DataSourceError

from vinemap import naming, paths
from vinemap.errors import EmptyError, InputError
from vinemap.export.lanes import lanes_between
from vinemap.geo.crs import WGS84, is_local
from vinemap.geo.main import Corner, Origin, origin_of, to_main
from vinemap.product.seasons.products import read_record

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path


class Field(NamedTuple):
    """A parcel as a machine wants it."""

    folder: Path
    """The product's."""
    parcel: str
    survey: str
    """Name of the survey; the parcel's where it was mapped alone."""
    flown: str
    """Date of the survey, as 2026-05-31."""
    key: str
    """That of the product's recipe."""
    origin: Origin | Corner
    rows: gpd.GeoDataFrame
    lanes: gpd.GeoDataFrame
    """Of :func:`vinemap.export.lanes.lanes_between`; empty if they weren't asked for."""
    row_ends: gpd.GeoDataFrame
    gaps: gpd.GeoDataFrame
    outline: gpd.GeoDataFrame
    """Layer ``parcel`` of the product."""
    bounded: bool
    """Whether that is a polygon that was given, and not one about the rows."""

    def wgs84(self, layer: str) -> gpd.GeoDataFrame:
        """One of the layers in longitude and latitude, to a tenth of a millimetre; heights stay, to a millimetre.

        Raises
        ------
        InputError
            If its coordinates are local.
        """
        self.check_placed()
        frame: gpd.GeoDataFrame = getattr(self, layer).to_crs(WGS84)
        shapes, high = frame.geometry.to_numpy(), bool(frame.has_z.all())
        shapes = shapely.transform(shapes, lambda xyz: np.c_[xyz[:, :2].round(9), xyz[:, 2:].round(3)], include_z=high)
        return frame.set_geometry(gpd.GeoSeries(shapes, index=frame.index, crs=WGS84))

    def check_placed(self) -> None:
        """Make sure that the parcel has a place on the globe; InputError if its coordinates are local."""
        if is_local(self.rows.crs):
            raise InputError(
                f"{self.parcel}: its coordinates are local, but this format wants latitude and longitude: "
                "take nav2, opennav_coverage, gazebo, ply or obj"
            )

    def guidance(self, lines: str) -> gpd.GeoDataFrame:
        """``label``, ``kind`` ("lane", "row"), ``width_m`` (of the lane, or the rows' spacing) of chosen lines."""
        kinds = {
            "lane": self.lanes[["label", "width_m", "geometry"]],
            "row": self.rows[["label", "spacing_m", "geometry"]].rename(columns={"spacing_m": "width_m"}),
        }
        chosen = [part.assign(kind=kind) for kind, part in kinds.items() if lines in (f"{kind}s", "both") and len(part)]
        table: gpd.GeoDataFrame = pd.concat(chosen, ignore_index=True)
        return table

    def plane(self, frame: gpd.GeoDataFrame, *, grid: bool) -> gpd.GeoDataFrame:
        """A layer in plan, in metres to the millimetre: in {Main}, or as it is in the grid of the product's CRS."""
        shapes = shapely.force_3d(frame.geometry.to_numpy(), z=self.origin.alt)
        if not grid:
            shapes = shapely.transform(shapes, lambda xyz: to_main(xyz, frame.crs, self.origin), include_z=True)
        shapes = shapely.transform(shapely.force_2d(shapes), lambda xy: xy.round(3))
        return frame.set_geometry(gpd.GeoSeries(shapes, index=frame.index))

    def blocks(self) -> Iterator[tuple[int | None, Field]]:
        """Each block of rows with its number, for formats that know of one block only; None if there is one."""
        numbers = sorted(self.rows["block"].unique())
        for block in numbers:
            rows, lanes = (layer[layer["block"] == block] for layer in (self.rows, self.lanes))
            yield int(block) if len(numbers) > 1 else None, self._replace(rows=rows, lanes=lanes)


def read_layers(
    path: Path, others: Sequence[str] = (), *, wanted: Sequence[str] = ()
) -> tuple[gpd.GeoDataFrame, dict[str, gpd.GeoDataFrame]]:
    """Rows of a product's GeoPackage, and other layers of it; of what is ``wanted`` those that it has.

    Raises
    ------
    InputError
        If it can't be read, lacks a column or heights, as another program may have saved it, or has a row without
        number, name, block or line, as somebody may have drawn one.
    """
    try:
        rows = pyogrio.read_dataframe(path, layer="rows", fid_as_index=True)
        there = [name for name in wanted if name in pyogrio.list_layers(path)[:, 0]]
        layers = {name: pyogrio.read_dataframe(path, layer=name) for name in (*others, *there)}
    except (DataSourceError, DataLayerError) as error:
        raise InputError(f"{naming.shown(path)}: can't be read ({error}): map the parcel again") from error
    lost = [column for column in ("row_id", "label", "block", "spacing_m", "width_m") if column not in rows]
    lost += ["heights"] if len(rows) and not rows.has_z.any() else []
    if lost:
        raise InputError(
            f"{naming.shown(path)}: its rows have no {', '.join(lost)} any more, as saved anew by another program: "
            "map the parcel again"
        )
    for column in ("row_id", "label", "block", "geometry"):
        lacking = rows[column].isna() | (rows.is_empty if column == "geometry" else False)
        if lacking.any():
            raise InputError(
                f"{naming.shown(path)}: row with fid {lacking.idxmax()} has no {column}: fill that in, or delete the "
                "row, or map the parcel with it among known rows (--rows)"
            )
    return rows.reset_index(drop=True), layers


def read_field(product: Path, *, lines: str, headland: float, outer: bool, vertices: int | None = None) -> Field:
    """Read a product, given by its folder or its GeoPackage, and draw its lanes if they are wanted.

    Raises
    ------
    EmptyError
        If it has no row, or no lane where one is wanted.
    InputError
        If it is no whole product, or has a row without number, name, block or line.
    """
    folder, record = read_record(product)
    parcel, origin = record["parcel"], origin_of(record["origin"])
    path = paths.geopackage(folder, parcel)
    rows, layers = read_layers(path, ("row_ends", "gaps", "parcel"))
    if len(rows) == 0:
        raise EmptyError(f"{naming.shown(path)}: has no row to export")
    rows = rows.sort_values("row_id", ignore_index=True)
    bounded = bool(record.get("bounded"))
    within = shapely.union_all(layers["parcel"].geometry.to_numpy()) if bounded else None
    between = rows if lines != "rows" else rows[:0]
    lanes = lanes_between(between, within, headland=headland, outer=outer, vertices=vertices)
    if lines != "rows" and len(lanes) == 0:
        raise EmptyError(
            f"{naming.shown(path)}: no two rows are neighbours, so there is no lane: ask for --outer, or --lines rows"
        )
    known: dict[str, Any] = {
        "bounded": bounded,
        "survey": str(record.get("survey") or parcel),
        "flown": str(record.get("flown") or "2000-01-01")[:10],
        "key": str(record.get("key")),
    }
    rest = {"row_ends": layers["row_ends"], "gaps": layers["gaps"], "outline": layers["parcel"]}
    return Field(folder=folder, parcel=parcel, origin=origin, rows=rows, lanes=lanes, **known, **rest)
