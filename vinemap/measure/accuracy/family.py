"""One family of vineyards measured, seed by seed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vinemap.chain import map_rows, model_canopies
from vinemap.cloud.points import PointCloud
from vinemap.config.settings import PolygonOptions, Settings
from vinemap.measure.accuracy.canopies import CanopyErrors, compare_canopies, pool_canopies
from vinemap.measure.accuracy.meshes import MeshErrors, compare_meshes, pool_meshes
from vinemap.measure.accuracy.pictures import draw
from vinemap.measure.accuracy.rows import Errors, compare, pool
from vinemap.measure.accuracy.trust import Trust, pool_trust, trust
from vinemap.simulate.families import family

if TYPE_CHECKING:
    from pathlib import Path


def measure(name: str, seeds: int, out: Path | None = None) -> tuple[Errors, CanopyErrors, MeshErrors, Trust]:
    """Errors over all seeds of a family, and confidence beside truth; draws its worst row into a folder."""
    cases, canopies, meshes, trusts = [], [], [], []
    ours, thesis = Settings(), Settings(polygon=PolygonOptions(foot="soil"))
    for seed in range(seeds):
        survey = family(name, seed)
        points = PointCloud(survey.xyz, survey.rows.crs)
        found = map_rows(points, ours)
        errors, worst = compare(survey, found)
        model, on_soil = (model_canopies(found, settings) for settings in (ours, thesis))
        canopies.append(compare_canopies(survey, found, model, on_soil, errors.pairs, step=ours.sections.step))
        meshes.append(compare_meshes(survey, found, model, step=ours.sections.step))
        trusts.append(trust(found, model, errors.pairs, canopies[-1].volume, step=ours.sections.step))
        cases.append((errors, worst, survey, found, f"{name}, seed {seed}"))
    if out:
        _, worst, survey, found, title = max(cases, key=lambda case: case[1].badness if case[1] else 0.0)
        draw(worst, survey, found, title, out / f"{name}.png")
    rows = pool([errors for errors, *_ in cases])
    return rows, pool_canopies(canopies), pool_meshes(meshes), pool_trust(trusts)
