"""A product made of a parcel's points: the chain, and what is told of what it finds."""

from __future__ import annotations

import shutil
from functools import partial
from typing import TYPE_CHECKING, Any

from vinemap import paths
from vinemap.canopy.classification import classify_points
from vinemap.canopy.mesh import section_meshes
from vinemap.canopy.model import find_leaves
from vinemap.canopy.numbers import as_seen, judge_canopies, summarise_rows
from vinemap.chain import map_rows, model_canopies
from vinemap.cloud.tiles import moved
from vinemap.cloud.write import write_classified
from vinemap.compute.threads import aside
from vinemap.evaluate.meshes import measure_meshes
from vinemap.evaluate.trunks import vines_in_rows
from vinemap.evaluate.unmapped import find_unmapped
from vinemap.evaluate.vines import find_vines
from vinemap.geo.crs import project
from vinemap.geo.main import corner_of
from vinemap.product.layers import labelled, parcel_layer
from vinemap.product.rasters import rasters_of, write_rasters
from vinemap.product.record import record_of
from vinemap.product.stac import write_item
from vinemap.product.write import write_product
from vinemap.rows.numbers import describe_rows
from vinemap.rows.standing.gaps import beyond_ends

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import geopandas as gpd
    import shapely

    from vinemap.canopy.mesh import Mesh
    from vinemap.canopy.model import CanopyModel
    from vinemap.chain import RowMap
    from vinemap.cloud.tiles import Cloud, Collector
    from vinemap.config.settings import Settings
    from vinemap.evaluate.shift import Shift
    from vinemap.geo.main import Corner, Origin
    from vinemap.product.recipe import Recipe


def make_product(
    recipe: Recipe, points: Cloud, draft: Path, *, aligned: Collector, run: Callable[..., Any]
) -> dict[str, Any]:
    """Make a product of a parcel's points in the folder of its draft, all but ``run.json``.

    Parameters
    ----------
    recipe : Recipe
        What it is made by.
    points : PointCloud or TiledCloud
        The parcel's points.
    draft : Path
        Folder to write to.
    aligned : Collector
        What takes the points where they are moved to known rows.
    run : callable
        Runs a stage, as ``run(name, function, *args, **kwargs)`` with a name of ``STAGES``.

    Returns
    -------
    dict
        What ``run.json`` is to tell, but for times and files.
    """
    parcel, settings = recipe.parcel, recipe.settings
    with aside() as beside:
        polygon = project(*recipe.boundary, points.crs) if recipe.boundary else None
        known = recipe.known.lines if recipe.known else None
        points, was_off = _aligned(points, known, settings, aligned)
        found = map_rows(points, settings, within=polygon, known=known, step=run)
        rasters = rasters_of(found.dtm, found.chm, found.field)
        written = beside(write_rasters, draft, parcel, rasters)
        main = recipe.origin or corner_of(found.dtm)
        layers, meshes, strays = _layers(recipe, found, points, polygon, main, run)
        record = record_of(
            recipe,
            found.cloud,
            layers,
            (found.dtm, found.chm),
            origin=main,
            shift=was_off or found.shift,
            square=found.field.square,
            n_key_points=found.n_key_points,
            remarks=[*found.remarks, *strays],
        )

        cut = (found.cloud, found.rows, found.gaps, found.dtm) if settings.product.classified else None
        del found  # much memory, that what follows doesn't need

        def write() -> list[str]:
            how = settings.product.model_dump(include={"plain", "geoid", "audit"})
            remarks = write_product(draft, record, layers, rasters, meshes, points, **how)
            if cut:
                classify = partial(classify_points, leaves=find_leaves(*cut, settings))
                write_classified(cut[0], classify, paths.classified_cloud(draft, parcel), flown=recipe.flown)
            written.result()
            return remarks

        record["warnings"] += run("Writing", write)
    shutil.rmtree(paths.tiles(draft), ignore_errors=True)
    write_item(draft, recipe, record, layers["parcel"])
    return record


def _aligned(
    points: Cloud, known: gpd.GeoDataFrame | None, settings: Settings, collector: Collector
) -> tuple[Cloud, Shift | None]:
    """Points, moved to known rows where that is wanted, and how far they lay off these, if it is and they did."""
    shift = map_rows(points, settings, known=known).shift if known is not None and settings.rows.align else None
    return (moved(points, -shift.metres, collector), shift) if shift else (points, None)


def _layers(
    recipe: Recipe,
    found: RowMap,
    points: Cloud,
    polygon: shapely.Geometry | None,
    main: Origin | Corner,
    run: Callable[..., Any],
) -> tuple[dict[str, gpd.GeoDataFrame], list[Mesh], list[str]]:
    """Layers of a product by the rows that were found, with what their canopies, vines and meshes tell.

    Beside them the meshes, and what is to be known of known vines: a sentence each.
    """
    settings, step = recipe.settings, recipe.settings.sections.step
    model = model_canopies(found, settings, step=run)
    rows = judge_canopies(summarise_rows(found.rows, model.table, step=step), model.table, step=step)
    rows, table = as_seen(rows, model.table, tops=recipe.tops)
    rows, ends, key_points = describe_rows(rows, parcel=recipe.parcel, origin=main, threshold=settings.curves.threshold)
    standing, strays = vines_in_rows(recipe.vines, rows, found.shift)
    how = {"vine_spacing": settings.missing.vine_spacing, "step": step, "known": standing}
    rows, gaps, vines = run("Vines", find_vines, rows, found.gaps, table, found.cover, **how)
    rows, meshes = run("Mesh", _meshes, found.cloud, model, rows, step=step, tops=recipe.tops)
    del model  # much memory, that what follows doesn't need
    outlines = parcel_layer(recipe.parcel, rows, polygon, points)
    within, tallest = outlines if polygon else None, settings.cover.high
    layers = {
        "rows": rows,
        "row_ends": ends.assign(beyond=beyond_ends(rows, found.seen, polygon)),
        "key_points": key_points,
        "sections": labelled(table, rows),
        "gaps": labelled(gaps, rows),
        "vines": labelled(vines, rows),
        "unmapped": run("Unmapped", find_unmapped, found.chm, rows, within, tallest=tallest),
        "parcel": outlines,
    }
    return layers, meshes, strays


def _meshes(
    cloud: Cloud, model: CanopyModel, rows: gpd.GeoDataFrame, *, step: float, tops: bool
) -> tuple[gpd.GeoDataFrame, list[Mesh]]:
    """Rows with how far their canopies' meshes are off, and the meshes."""
    rows = measure_meshes(cloud, model, rows, step=step, tops=tops)
    return rows, section_meshes(model.at, model.polygons, rows, step=step)
