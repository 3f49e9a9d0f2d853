"""The record of a run: what a product was made of, and what is in it; in a line, what was found."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import shapely

from vinemap import __version__
from vinemap.cloud.pdal.engine import made_by
from vinemap.evaluate.meshes import NUMBERS
from vinemap.geo.place import doubts_of
from vinemap.product.json_values import jsonable
from vinemap.product.notices import (
    ground_notices,
    height_notices,
    known_notices,
    notices,
    pair_notices,
    shift_notices,
    sight_notices,
)
from vinemap.product.pages.page import mean_of
from vinemap.surfaces.flights import disagreement

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import geopandas as gpd

    from vinemap.cloud.tiles import Cloud
    from vinemap.evaluate.shift import Shift
    from vinemap.geo.main import Corner, Origin
    from vinemap.geo.raster import Raster
    from vinemap.product.recipe import Recipe

SQUARE = (
    "plants stand in a square or a quincunx: rows run where they are closer together, or where rows are longer; "
    "row_field.row_direction prescribes another direction"
)
LIBRARIES = ("numpy", "scipy", "laspy", "lazrs", "pyproj", "geopandas", "shapely", "rasterio", "numba", "pygltflib")


class Summary(NamedTuple):
    """What a run found, and where it left it."""

    parcel: str
    folder: Path
    rows: int
    length: float
    seconds: float
    warnings: tuple[str, ...] = ()

    def line(self) -> str:
        """What a run found, as a sentence."""
        remarks = "".join(f"; {warning}" for warning in self.warnings)
        return f"{self.parcel}: {in_words(self.rows, self.length)}, in {self.seconds:.1f} s → {self.folder}{remarks}"


def in_words(rows: int, length: float) -> str:
    """In words, so many rows of so many metres in all."""
    return f"{rows} rows, {length:,.0f} m" if rows else "no vine row found"


def record_of(
    recipe: Recipe,
    points: Cloud,
    layers: dict[str, gpd.GeoDataFrame],
    surfaces: tuple[Raster, Raster],
    *,
    origin: Origin | Corner,
    n_key_points: int,
    square: bool,
    remarks: Sequence[str],
    shift: Shift | None,
) -> dict[str, Any]:
    """What ``run.json`` tells, but for times and files.

    Parameters
    ----------
    recipe : Recipe
        What the product was made of.
    points : PointCloud or TiledCloud
        The points with their heights above ground.
    layers : dict of GeoDataFrame
        Those of the GeoPackage.
    surfaces : (Raster, Raster)
        Terrain, and canopy height, NaN where there are no points.
    origin : Origin or Corner
        Of {Main}.
    n_key_points : int
        Key points that were found.
    square : bool
        Whether rows could as well run another way.
    remarks : sequence of str
        What is to be known of known rows, or of rows in pairs.
    shift : Shift, optional
        How far the cloud lies off them, or lay before it was moved.
    """
    dtm, chm = surfaces
    sections = layers["sections"]
    modelling = sections[["good", "under", "over", "reduction", "quality"]].mean().round(4)
    versions = {"python": platform.python_version()} | {name: version(name) for name in LIBRARIES}
    return {
        "vinemap": __version__,
        "key": recipe.key,
        "survey": recipe.survey,
        "parcel": recipe.parcel,
        "bounded": recipe.boundary is not None,
        "flown": recipe.flown.isoformat(),
        "inputs": [source.record() for source in recipe.sources],
        "settings": recipe.settings.model_dump(mode="json"),
        "crs": points.crs.to_string(),
        "vertical_datum": points.vertical,
        "origin": origin._asdict(),
        "counts": {"points": points.size, "key_points_found": n_key_points}
        | {name: len(layer) for name, layer in layers.items()},
        "length_m": round(float(layers["rows"]["length_m"].sum()), 3),
        "unmapped_m2": layers["unmapped"].groupby("reason")["area_m2"].sum().round(1).to_dict(),
        "modelling": modelling.to_dict() if len(sections) else None,
        "meshes": _meshes(layers["rows"]),
        "shift": _shift(shift, recipe),
        "warnings": _places(recipe, points)
        + [*(recipe.known.remarks if recipe.known else ()), *remarks]
        + shift_notices(shift, layers["rows"])
        + (known_notices(layers["rows"], recipe.known.lines) if recipe.known else [])
        + _flights(points, dtm)
        + notices(layers["rows"], chm, layers["parcel"], layers["unmapped"], points.size)
        + sight_notices(layers["rows"], layers["row_ends"])
        + height_notices(layers["rows"], chm, layers["unmapped"], highest=recipe.settings.cover.high)
        + ground_notices(layers["rows"], chm)
        + ([] if recipe.known else pair_notices(layers["rows"]))
        + ([SQUARE] if square and not recipe.known else []),
        "versions": versions | made_by(recipe.settings.ground),
    }


def _meshes(rows: gpd.GeoDataFrame) -> dict[str, Any]:
    """How far meshes are off, on the mean by the metre of row and row by row, and how far their points lie from them.

    None stands for what isn't known.
    """
    table = rows[["row_id", "label", *NUMBERS]].round(dict.fromkeys(NUMBERS, 4)).astype(object)
    return {
        "mesh_error_m": jsonable(round(mean_of(rows["mesh_error_m"], rows["length_m"].to_numpy(dtype=float)), 4)),
        "rows": jsonable(table.to_dict("records")),
    }


def _shift(shift: Shift | None, recipe: Recipe) -> dict[str, Any] | None:
    """How far a cloud lies off known rows, off which ones, and whether the product's rows do."""
    if shift is None or recipe.known is None:
        return None
    how = recipe.settings.rows
    return shift.record() | {"in_rows": how.course == "fit" and not how.align, "known_rows": recipe.known.key}


def _flights(points: Cloud, dtm: Raster) -> list[str]:
    """Whether flights disagree in height, by how much and where."""
    if (found := disagreement(points, dtm)) is None:
        return []
    metres, share = found
    return [f"two flights disagree by {metres:.2f} m in height on {share:.0%} of the ground: align them, or take one"]


def _places(recipe: Recipe, points: Cloud) -> list[str]:
    """What is to be known of where points and boundary are."""
    known = [*points.remarks, *recipe.remarks]
    if recipe.boundary:
        polygon, crs = recipe.boundary
        known += doubts_of(crs, *shapely.get_coordinates(polygon)[0].tolist())
    return list(dict.fromkeys(known))
