"""How well modelled canopies are, against the foliage of simulated vineyards."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely
from scipy.spatial import cKDTree

from vinemap.canopy.numbers import modelling_indices, summarise_rows
from vinemap.geo.curve import cross
from vinemap.simulate.plants import foliage_outlines

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from vinemap.canopy.model import CanopyModel
    from vinemap.chain import RowMap
    from vinemap.compute.arrays import Floats
    from vinemap.simulate.plants import Foliage
    from vinemap.simulate.survey import Survey

SLAB = 0.4
"""Metres along a row over which the true foliage is averaged."""
NEAR = 0.15
"""Metres from a section within which the foliage's stations must lie to tell its truth."""


class CanopyErrors(NamedTuple):
    """What is wrong with the canopies of a map, or of several."""

    good: Floats
    """G (m,) of sections against the true foliage, leaves' reach included (Table 3.1)."""
    under: Floats
    over: Floats
    hull_over: Floats
    """O (m,) against the outline that the points tell."""
    soil: Floats
    """G − U − O (m,) of the thesis's polygons, whose feet stand on the soil, against the true foliage."""
    height: Floats
    """Error (rows,) of the mean height in metres."""
    width: Floats
    volume: Floats
    """Error (rows,) of the foliage's volume, as a share of it."""


def compare_canopies(
    survey: Survey, found: RowMap, model: CanopyModel, on_soil: CanopyModel, pairs: pd.DataFrame, *, step: float
) -> CanopyErrors:
    """Hold canopies against the truth of their survey.

    Parameters
    ----------
    survey : Survey
        With the true foliage.
    found : RowMap
        Rows of the survey.
    model, on_soil : CanopyModel
        Their canopies, and those of the thesis's feet.
    pairs : DataFrame
        Matched rows of :func:`vinemap.evaluate.rows.evaluate_rows`.
    step : float
        Metres between sections.
    """
    if len(survey.foliage.row) == 0 or len(model.table) == 0:
        return CanopyErrors(*[np.empty(0)] * 8)
    outlines = _slabs(survey.foliage)
    good, under, over = _against_truth(survey.foliage, outlines, model)
    soil_good, soil_under, soil_over = _against_truth(survey.foliage, outlines, on_soil)
    rows = summarise_rows(found.rows, model.table, step=step)
    mine, true = pairs["row_id"].to_numpy(dtype=int) - 1, pairs["reference"].to_numpy(dtype=int) - 1
    volume = true_volumes(survey)[true]
    return CanopyErrors(
        good,
        under,
        over,
        model.table["over"].to_numpy(),
        soil_good - soil_under - soil_over,
        rows["height_m"].to_numpy()[mine] - survey.rows["mean_height"].to_numpy()[true],
        rows["width_m"].to_numpy()[mine] - survey.rows["mean_width"].to_numpy()[true],
        rows["volume_m3"].to_numpy()[mine] / volume - 1,
    )


def pool_canopies(errors: Sequence[CanopyErrors]) -> CanopyErrors:
    """Errors of several maps as those of one."""
    return CanopyErrors(*(np.concatenate(values) for values in zip(*errors, strict=True)))


def _slabs(foliage: Foliage) -> Floats:
    """Mean outlines of the foliage in slabs as long as sections are, at every station."""
    outlines = foliage_outlines(foliage)
    near = [np.roll(np.arange(len(outlines)), step) for step in (-2, -1, 0, 1, 2)]
    beside = [np.hypot(*(foliage.xy[other] - foliage.xy).T) < SLAB / 2 + 0.05 for other in near]
    total = np.sum([outlines[o] * b[:, None, None] for o, b in zip(near, beside, strict=True)], axis=0)
    mean: Floats = total / np.sum(beside, axis=0)[:, None, None]
    return mean


def _against_truth(foliage: Foliage, outlines: Floats, model: CanopyModel) -> tuple[Floats, Floats, Floats]:
    canopy = model.at
    distance, nearest = cKDTree(foliage.xy).query(canopy.origin[:, :2])
    known = distance < NEAR
    at, tangent = nearest[known], canopy.tangent[known]
    away = foliage.xy[at] - canopy.origin[known, :2]
    outlines = outlines[at]
    outlines[:, :, 0] += cross(tangent, away)[:, None]
    true, polygons = shapely.make_valid(shapely.polygons(outlines)), shapely.polygons(model.polygons[known])
    polygons = shapely.make_valid(polygons)
    areas = [np.asarray(shapely.area(p)) for p in (shapely.intersection(true, polygons), polygons, true)]
    good, under, over = modelling_indices(*areas)
    return np.asarray(good), np.asarray(under), np.asarray(over)


def true_volumes(survey: Survey) -> Floats:
    """Volume (rows,) of the foliage in m³, leaves' reach included."""
    area = shapely.area(shapely.polygons(foliage_outlines(survey.foliage)))
    weights = area * survey.foliage.step
    out: Floats = np.bincount(survey.foliage.row, weights=weights, minlength=len(survey.rows)).astype(float)
    return out
