"""The chain, once: from the cloud of a parcel to its product."""

from __future__ import annotations

import json
import time
from datetime import UTC, datetime
from importlib import import_module
from threading import Thread
from typing import TYPE_CHECKING, Any, TypeVar

from vinemap import paths
from vinemap.cloud.bins import block_side
from vinemap.cloud.las import read_cloud
from vinemap.cloud.pdal.engine import check_engines
from vinemap.cloud.pdal.ground import classified
from vinemap.cloud.pieces import read_piece
from vinemap.cloud.tiles import Collector
from vinemap.compute import machine
from vinemap.config.names import check_parcel
from vinemap.geo.main import check_near
from vinemap.product import store
from vinemap.product.qgis.changed import changed
from vinemap.product.recipe import Recipe, recipe_of
from vinemap.stages import call

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from pyproj import CRS

    from vinemap.cloud.pieces import Piece
    from vinemap.cloud.tiles import Cloud
    from vinemap.config.settings import Settings
    from vinemap.geo.main import Origin
    from vinemap.product.record import Summary

T = TypeVar("T")

BYTES_A_POINT = {"vinemap": 60, "pdal": 200}
"""Memory that a run takes, by its engine: half of the machine's is for it."""


def map_parcel(
    cloud: Path | Sequence[Path],
    folder: Path,
    *,
    parcel: str,
    named: bool = True,
    settings: Settings | None = None,
    boundary: Path | None = None,
    crs: CRS | None = None,
    origin: Origin | None = None,
    rows: Path | None = None,
    rows_crs: CRS | None = None,
    vines: Path | None = None,
    step: Callable[..., Any] = call,
) -> Summary:
    """Map the rows and canopies of one parcel, and leave the product in a folder.

    Parameters
    ----------
    cloud : Path or sequence of Path
        Files or addresses of any format, worked as one, or folders of such.
    folder : Path
        Where the product goes, whole or not at all.
    parcel : str
        Its name, which names its files and follows the numbers of its rows.
    named : bool
        Whether the boundary's polygon must have that name, where the file has several; else all of them count.
    settings : Settings, optional
        Settings of the stages.
    boundary : Path, optional
        File with the polygon to clip to.
    crs : CRS, optional
        CRS of the cloud's coordinates, where the file states none or a wrong one.
    origin : Origin, optional
        Origin of {Main}; by default the south-western corner of the parcel at its lowest terrain.
    rows, rows_crs : Path, CRS, optional
        Known rows, which aren't sought, as of :func:`vinemap.geo.lines.read_rows`.
    vines : Path, optional
        Points of known vines, whose places aren't estimated.
    step : callable
        Runs a stage, as ``step(name, function, *args, **kwargs)`` with a name of ``STAGES``.

    Raises
    ------
    VinemapError
        If the input can't be used or the product can't be written.
    """
    name = check_parcel(parcel)
    if settings:
        check_engines([settings])
    recipe = recipe_of(
        cloud,
        parcel=name,
        named=named,
        settings=settings,
        boundary=boundary,
        crs=crs,
        origin=origin,
        rows=rows,
        rows_crs=rows_crs,
        vines=vines,
    )
    return follow(recipe, folder, step=step)


def follow(
    recipe: Recipe,
    folder: Path,
    *,
    piece: Piece | None = None,
    drafts: Path | None = None,
    within: Path | None = None,
    step: Callable[..., Any] = call,
) -> Summary:
    """Make a product by its recipe.

    Parameters
    ----------
    recipe : Recipe
        What it is made of.
    folder : Path
        Where the product goes, whole or not at all.
    piece : Piece, optional
        The parcel's points, where the cloud was read before.
    drafts, within : Path, optional
        As for :func:`vinemap.product.store.product`.
    step : callable
        As for :func:`map_parcel`; the same errors are raised.
    """
    settings, origin = recipe.settings, recipe.origin
    check_engines([settings])
    began = time.perf_counter()
    seconds: dict[str, float] = {}

    def run(name: str, function: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        machine.give_back()  # of what the stages before are done with
        start = time.perf_counter()
        out: T = step(name, function, *args, **kwargs)
        seconds[name] = round(time.perf_counter() - start, 3)
        return out

    with store.product(folder, drafts=drafts, within=within) as draft:
        Thread(target=import_module, args=["vinemap.making"]).start()  # half a second that reading needn't wait for
        points: Cloud = run("Reading", _read, recipe, piece, draft)
        if origin:
            check_near(origin, points.extent[0], points.crs)
        from vinemap.making import make_product
        from vinemap.product.notices import change_notices
        from vinemap.product.record import Summary

        aligned = _collector(settings, paths.tiles(draft) / "moved")
        record = make_product(recipe, points, draft, aligned=aligned, run=run)
        record["warnings"] += change_notices(changed(folder))
        record |= {
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": seconds | {"All": round(time.perf_counter() - began, 3)},
            "files": {path.name: path.stat().st_size for path in sorted(draft.iterdir())},
        }
        paths.run_record(draft).write_text(json.dumps(record, indent=2, ensure_ascii=False), encoding="utf-8")
    length, took = record["length_m"], time.perf_counter() - began
    return Summary(recipe.parcel, folder, record["counts"]["rows"], length, took, tuple(record["warnings"]))


def _read(recipe: Recipe, piece: Piece | None, draft: Path) -> Cloud:
    """The points that a recipe asks for, in memory or in tiles beside the draft, as its engine gives them."""
    settings, collector = recipe.settings, _collector(recipe.settings, paths.tiles(draft))
    engine = settings.ground.engine
    if piece:
        cloud = read_piece(piece, collector)
    else:
        cloud = read_cloud(recipe.clouds, collector=collector, crs=recipe.crs, boundary=recipe.boundary, engine=engine)
        recipe.check()
    if engine == "vinemap":
        return cloud
    return classified(cloud, settings.ground, _collector(settings, paths.tiles(draft) / "classified"))


def _collector(settings: Settings, folder: Path) -> Collector:
    """What takes points, in tiles in a folder beyond what memory is for."""
    most = settings.reading.max_points or machine.memory() // 2 // BYTES_A_POINT[settings.ground.engine]
    return Collector(folder, most=most, block=block_side(settings.ground.resolution))
