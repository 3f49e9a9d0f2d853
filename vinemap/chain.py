"""The chain: from a cloud's points to its rows, and to the model of their canopies."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from vinemap.canopy.model import CanopyModel, find_canopies, model_sections
from vinemap.config.settings import Settings
from vinemap.evaluate.confidence import believed, judge_rows
from vinemap.evaluate.shift import Shift, measure_shift
from vinemap.rows.blocks import flag_rows, group_blocks
from vinemap.rows.clusters import cluster_rows
from vinemap.rows.curtains import curtain_remarks
from vinemap.rows.curves import trace_rows
from vinemap.rows.field import estimate_row_field, refine_row_field
from vinemap.rows.fit import fit_rows
from vinemap.rows.key_points import detect_key_points
from vinemap.rows.known import follow_lines, name_rows
from vinemap.rows.numbers import count_missing, number_rows
from vinemap.stages import call
from vinemap.surfaces.cover import canopy_cover
from vinemap.surfaces.lines import lines_here, space_lines
from vinemap.surfaces.map import map_surfaces

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import geopandas as gpd
    import shapely

    from vinemap.cloud.tiles import Cloud
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.seen import Seen
    from vinemap.surfaces.waves import RowField


class RowMap(NamedTuple):
    """Rows and gaps of a cloud, and what they were found from."""

    cloud: Cloud
    """The points with their heights above ground."""
    dtm: Raster
    chm: Raster
    cover: Raster
    seen: Seen
    """What the cloud shows."""
    field: RowField
    n_key_points: int
    rows: gpd.GeoDataFrame
    gaps: gpd.GeoDataFrame
    remarks: Sequence[str] = ()
    """What is to be known of known rows, or of rows in pairs: a sentence each."""
    shift: Shift | None = None
    """How far the cloud lies off them, where that is told."""


def map_rows(
    points: Cloud,
    settings: Settings | None = None,
    *,
    within: shapely.Geometry | None = None,
    known: gpd.GeoDataFrame | None = None,
    step: Callable[..., Any] = call,
) -> RowMap:
    """Find the rows of a cloud: the chain from the terrain to numbered rows with their gaps (chapter 2).

    Parameters
    ----------
    points : PointCloud or TiledCloud
        The parcel's points.
    settings : Settings, optional
        Settings of the stages.
    within : Geometry, optional
        The polygon to which the points were clipped, in their CRS: rows end where it does.
    known : GeoDataFrame, optional
        LineString with ``row_id`` and ``label`` in any CRS: rows that are measured, and no others sought.
    step : callable
        Runs a stage, as ``step(name, function, *args, **kwargs)`` with a name of ``STAGES``.

    Raises
    ------
    InputError
        If the cloud is too wide for one parcel, or no known row lies in it.
    """
    settings = settings or Settings()
    options, high = settings.model_dump(), settings.cover.high
    cloud, dtm, chm, seen = step("DTM", map_surfaces, points, settings)
    lines, remarks = (None, []) if known is None else lines_here(known, seen, chm.crs)
    cover, levels = step("Canopy cover", canopy_cover, cloud, chm, lines, **options["cover"])
    field = step("Row field", estimate_row_field, cover, **options["row_field"])
    n_key_points = 0
    if lines is None:
        key_points = step("Key points", detect_key_points, cover, dtm, field, **options["key_points"])
        n_key_points = len(key_points)
        clusters = step("Clusters", cluster_rows, key_points, cover, chm, seen, high=high, **options["clustering"])
        courses = step("Curves", trace_rows, clusters, cover, **options["curves"])
        remarks = curtain_remarks(courses)
        del key_points, clusters  # much memory
    else:
        lines, within = space_lines(lines, field), None
        courses = step("Curves", follow_lines, lines, cover, **_how(settings))
    seen = seen.without(levels.crowns, chm.grid)
    shown = {"cover": cover, "levels": levels, "dtm": dtm, "seen": seen}
    fit: Callable[..., Any] = partial(fit_rows, cloud=cloud, high=high, **shown, **options["fit"])
    rows, gaps = step("Ends and gaps", fit, courses, within=within)
    shift = None
    if lines is not None:
        free = follow_lines(lines, cover) if "keep" in _how(settings).values() else courses
        shift = measure_shift(lines, rows if free is courses else fit(free)[0], free["moves"].to_numpy())
        rows = space_lines(rows, field)
    rows = judge_rows(group_blocks(rows), cover, chm, field, seen, high=high)
    rows, gaps = believed(rows, gaps, min_confidence=settings.judging.min_confidence if lines is None else 0.0)
    if lines is None:
        rows, gaps = number_rows(flag_rows(rows), gaps)
    else:
        rows, gaps, told = name_rows(lines, courses, flag_rows(rows), gaps)
        remarks = [*remarks, *told]
    rows, gaps = count_missing(rows, gaps, **options["missing"])
    field = refine_row_field(field, rows)
    return RowMap(cloud, dtm, chm, cover, seen, field, n_key_points, rows, gaps, remarks, shift)


def _how(settings: Settings) -> dict[str, Any]:
    """What of known rows may move."""
    return settings.rows.model_dump(include={"course", "ends"})


def model_canopies(found: RowMap, settings: Settings | None = None, *, step: Callable[..., Any] = call) -> CanopyModel:
    """Model the canopies of the rows that were found: sections, their canopy, and its polygons (chapter 3).

    Parameters are as of :func:`map_rows`, which finds the rows.
    """
    settings = settings or Settings()
    cut = found.cloud, found.rows, found.gaps, found.dtm
    canopies = step("Sections", find_canopies, *cut, settings)
    found.cloud.forget()
    options = settings.polygon.model_dump() | {"min_points": settings.canopy.min_points}
    model: CanopyModel = step("Canopy", model_sections, canopies, found.dtm.crs, **options)
    return model
