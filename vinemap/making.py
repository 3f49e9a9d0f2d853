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

    from vinemap.canopy.mesh import Mesh
    from vinemap.canopy.model import CanopyModel
    from vinemap.cloud.tiles import Cloud, Collector
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
    parcel, settings, origin = recipe.parcel, recipe.settings, recipe.origin
    apart, high = settings.sections.step, settings.cover.high
    with aside() as beside:
        polygon = project(*recipe.boundary, points.crs) if recipe.boundary else None
        known = recipe.known.lines if recipe.known else None
        shift = map_rows(points, settings, known=known).shift if known is not None and settings.rows.align else None
        if shift:
            points = moved(points, -shift.metres, aligned)
        found = map_rows(points, settings, within=polygon, known=known, step=run)
        shift, surfaces = shift or found.shift, (found.dtm, found.chm)
        rasters = rasters_of(*surfaces, found.field)
        written = beside(write_rasters, draft, parcel, rasters)
        model = model_canopies(found, settings, step=run)
        main = origin or corner_of(found.dtm)
        rows = judge_canopies(summarise_rows(found.rows, model.table, step=apart), model.table, step=apart)
        rows, table = as_seen(rows, model.table, tops=recipe.tops)
        rows, ends, enhanced = describe_rows(rows, parcel=parcel, origin=main, threshold=settings.curves.threshold)
        standing, strays = vines_in_rows(recipe.vines, rows, found.shift)
        vine_spacing = settings.missing.vine_spacing
        rows, gaps, vines = run(
            "Vines",
            find_vines,
            rows,
            found.gaps,
            table,
            found.cover,
            vine_spacing=vine_spacing,
            step=apart,
            known=standing,
        )
        rows, meshes = run("Mesh", _meshes, found.cloud, model, rows, step=apart, tops=recipe.tops)
        del model  # much memory, that what follows doesn't need
        outlines = parcel_layer(parcel, rows, polygon, points)
        layers = {
            "rows": rows,
            "row_ends": ends.assign(beyond=beyond_ends(rows, found.seen, polygon)),
            "key_points": enhanced,
            "sections": labelled(table, rows),
            "gaps": labelled(gaps, rows),
            "vines": labelled(vines, rows),
            "unmapped": run("Unmapped", find_unmapped, found.chm, rows, outlines if polygon else None, tallest=high),
            "parcel": outlines,
        }
        record = record_of(
            recipe,
            found.cloud,
            layers,
            surfaces,
            origin=main,
            shift=shift,
            square=found.field.square,
            n_key_points=found.n_key_points,
            remarks=[*found.remarks, *strays],
        )

        cut = (found.cloud, found.rows, found.gaps, found.dtm) if settings.product.classified else None
        del found

        def write() -> list[str]:
            how = settings.product.model_dump(include={"plain", "geoid", "audit"})
            remarks = write_product(draft, record, layers, rasters, meshes, points, **how)
            if cut:
                classify = partial(classify_points, leaves=find_leaves(*cut, settings))
                write_classified(cut[0], classify, paths.classified_cloud(draft, parcel))
            written.result()
            return remarks

        record["warnings"] += run("Writing", write)
    shutil.rmtree(paths.tiles(draft), ignore_errors=True)
    write_item(draft, recipe, record, outlines)
    return record


def _meshes(
    cloud: Cloud, model: CanopyModel, rows: gpd.GeoDataFrame, *, step: float, tops: bool
) -> tuple[gpd.GeoDataFrame, list[Mesh]]:
    """Rows with how far their canopies' meshes are off, and the meshes."""
    rows = measure_meshes(cloud, model, rows, step=step, tops=tops)
    return rows, section_meshes(model.at, model.polygons, rows, step=step)
