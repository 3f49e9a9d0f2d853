"""Canopies of rows as polygons across them: the steps from foliage to c-gons, row by row."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.canopy.cgon import enclose
from vinemap.canopy.feet import find_feet
from vinemap.canopy.foliage import NO_CANOPY, living_canopies, separate_canopy
from vinemap.canopy.growth import foliage_reach, grow
from vinemap.canopy.numbers import Measures, measure_sections, tabulate_sections
from vinemap.canopy.peeling import peel_sections
from vinemap.canopy.points import join
from vinemap.canopy.sections import cut_sections
from vinemap.compute import machine
from vinemap.compute.threads import in_threads

if TYPE_CHECKING:
    import geopandas as gpd
    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.canopy.foliage import Canopy
    from vinemap.canopy.points import Sections
    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Values
    from vinemap.config.settings import Settings
    from vinemap.geo.raster import Raster


SAMPLE = 16
"""Sections of a row whose points are kept, to hold the model against: more would tell nothing else."""


class CanopyModel(NamedTuple):
    """Canopies of a cloud's rows as polygons across them."""

    at: Sections
    """m sections that have a canopy, without their points."""
    polygons: NDArray[np.float64]
    """c-gons (m, c, 2) in the sections' frames, metres to the left and above the soil."""
    table: gpd.GeoDataFrame
    """The sections in numbers."""
    reach: Values
    """Metres (m,) by which the foliage reaches beyond its points."""
    sampled: Flags
    """Whether sections (m,) are among the sample, ``SAMPLE`` of a row, at equal steps."""
    sample: Sections
    """Those, with the points that their polygons are drawn around."""


def find_canopies(
    cloud: Cloud, rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame, dtm: Raster, settings: Settings
) -> list[Canopy]:
    """Cut sections across the rows, and keep those that have a canopy, with its points, row by row.

    Parameters
    ----------
    cloud, rows, gaps, dtm
        As of :func:`vinemap.canopy.sections.cut_sections`.
    settings : Settings
        Of sections, canopy and the heights of the cover.
    """
    low, high, margin = settings.cover.low, settings.cover.high, settings.canopy.margin
    cut, options = settings.sections.model_dump(), settings.canopy.model_dump()
    living = {name: options.pop(name) for name in ("min_points", "min_share")}
    separate = partial(separate_canopy, high=high, **options)
    canopies = cut_sections(cloud, rows, gaps, dtm, separate, low=low, high=high, margin=margin, **cut)
    return living_canopies(canopies, **living)


def find_leaves(
    cloud: Cloud, rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame, dtm: Raster, settings: Settings
) -> list[Sections]:
    """Canopy points of sections that leave nothing between them; parameters are as of :func:`find_canopies`."""
    dense = settings.sections.model_copy(update={"step": min(settings.sections.step, settings.sections.width)})
    all_along = settings.model_copy(update={"sections": dense})
    return [canopy.sections for canopy in find_canopies(cloud, rows, gaps, dtm, all_along)]


def model_sections(
    canopies: list[Canopy], crs: CRS, *, c: int = 7, share: float = 0.02, foot: str = "foliage", min_points: int = 8
) -> CanopyModel:
    """Model the canopies of sections by polygons (section 3.2).

    Parameters
    ----------
    canopies : list of Canopy
        One a row. They are taken from the list as they are modelled, as all together they are large.
    crs : CRS
        Of their places.
    c : int
        Vertices of a polygon.
    share : float
        Share of a section's points that is peeled off.
    foot : str
        Where v1, v2 and vc stand: "foliage", or the thesis's "soil".
    min_points : int
        Canopy points of a section; above a foot that the sections around tell half of them do.
    """
    model_row = partial(_model_row, c=c, share=share, on_foliage=foot == "foliage", least=max(3, min_points // 2))
    canopies.reverse()
    models = in_threads(model_row, (canopies.pop() for _ in range(len(canopies))) if canopies else [NO_CANOPY])
    machine.give_back()
    at = join([model.at for model in models])
    polygons = np.concatenate([model.polygons for model in models])
    measures = Measures(*(np.concatenate(column) for column in zip(*(m.measures for m in models), strict=True)))
    reach, sampled = (np.concatenate([getattr(model, name) for model in models]) for name in ("reach", "sampled"))
    table = tabulate_sections(at, polygons, measures, crs=crs)
    return CanopyModel(at, polygons, table, reach, sampled, join([model.sample for model in models]))


class _RowModel(NamedTuple):
    at: Sections
    polygons: NDArray[np.float64]
    measures: Measures
    reach: Values
    sampled: Flags
    sample: Sections


def _model_row(canopy: Canopy, *, c: int, share: float, on_foliage: bool, least: int) -> _RowModel:
    """Polygons of a row's sections."""
    sections, feet = find_feet(canopy.sections)
    peeled = peel_sections(sections.points, sections.start, share=share)
    sections = sections.subset(peeled.kept)
    reach = foliage_reach(sections, peeled.area, peeled.perimeter, np.diff(peeled.start))
    outline, start, grown = grow(peeled.hull, peeled.start, feet, reach)
    model = enclose(outline, start, grown if on_foliage else canopy.soil, c=c, slide=on_foliage)
    # The foot that the sections around tell may leave a young vine nothing, and points on a line have no area.
    valid = model.valid & (model.hull_area > 0) & (np.diff(sections.start) >= least)
    if not valid.all():
        sections = sections.subset(np.repeat(valid, np.diff(sections.start)), valid)
    areas = model.shared_area[valid], model.area[valid], model.hull_area[valid]
    measures = measure_sections(sections, grown[valid, 0, 1], areas, c=c)
    sampled = np.zeros(len(sections.row_id), dtype=bool)
    sampled[np.linspace(0, len(sampled) - 1, min(len(sampled), SAMPLE)).round().astype(int)] = True
    sample = sections.subset(np.repeat(sampled, np.diff(sections.start)), sampled)
    return _RowModel(sections.without_points(), model.polygon[valid], measures, reach[valid], sampled, sample)
