"""Search of a model's [a, b, c] by its quality score, as in section 3.3: ``python -m vinemap.measure.tune CLOUD``.

Every model is held against the foliage's outlines in fine, fixed sections (V_ref of Table 3.1): between its own
sections its mesh runs straight, so that sections far apart are paid for. R follows the cloud's density, so that Q
compares models of one cloud only.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click
import numpy as np
import shapely
from scipy.optimize import differential_evolution

from vinemap.canopy.numbers import modelling_indices
from vinemap.chain import map_rows, model_canopies
from vinemap.cli.options import FILE
from vinemap.cloud.las import read_cloud
from vinemap.config.settings import PolygonOptions, SectionOptions, Settings
from vinemap.errors import InputError
from vinemap.geo.boundaries import read_boundary
from vinemap.geo.crs import parse_crs
from vinemap.terminal import plain_errors

if TYPE_CHECKING:
    from vinemap.canopy.model import CanopyModel
    from vinemap.chain import RowMap
    from vinemap.compute.arrays import Flags, Values

BOUNDS = [(0.1, 1.0), (0.1, 2.0), (5, 11)]
"""The thesis's ranges of a and b, in metres, and of c."""
THESIS = (0.4, 0.25, 7)
"""What the thesis found best."""
REFERENCE = {"width": 0.4, "step": 0.1}
"""Sections against which models are held."""
OUTLINE = 30
"""Vertices with which a polygon is as good as the foliage's outline."""
PANELS = {"good": (0, 1), "under": (0, 1), "over": (0, 1), "reduction": (-0.1, 0.1), "quality": (-0.5, 1.1)}
"""What is drawn of a model, and between which bounds."""
GENERATIONS = 12
"""Of the differential evolution."""
LENGTH = 128.0
"""Metres of rows that are enough for a search, as in the thesis."""


class Score(NamedTuple):
    """Indices of a model at every section of the reference (n,), R at the model's own (m,)."""

    good: Values
    under: Values
    over: Values
    reduction: Values

    @property
    def quality(self) -> Values:
        """Q (n,) of Eq. 23, with the mean of R."""
        return self.good - (self.under + self.over) + mean(self.reduction)


def mean(values: Values) -> float:
    """Mean, 0 of nothing."""
    return float(values.mean()) if len(values) else 0.0


def score(found: RowMap, reference: CanopyModel, a: float, b: float, c: int, foot: str) -> Score:
    """Indices of the model [a, b, c] of the rows that were found."""
    model = _model(found, {"width": a, "step": b}, c, foot)
    polygons, known = _between(model, reference, reach=2.5 * b)
    outlines = np.array(shapely.make_valid(shapely.polygons(reference.polygons)))
    drawn = np.full(len(outlines), shapely.Polygon(), dtype=object)
    drawn[known] = shapely.make_valid(shapely.polygons(polygons[known]))
    shared, mine, area = (
        np.asarray(shapely.area(shape)) for shape in (shapely.intersection(drawn, outlines), drawn, outlines)
    )
    return Score(*modelling_indices(shared, mine, area), model.table["reduction"].to_numpy())


def _model(found: RowMap, sections: dict[str, float], c: int, foot: str) -> CanopyModel:
    settings = Settings(
        sections=SectionOptions.model_validate(sections | {"min_points": 0}),
        polygon=PolygonOptions.model_validate({"c": c, "foot": foot}),
    )
    return model_canopies(found, settings)


def _between(model: CanopyModel, reference: CanopyModel, *, reach: float) -> tuple[Values, Flags]:
    """Polygons (n, c, 2) of a model's mesh at the sections of the reference, and whether it has one there."""
    mine, wanted = model.at, reference.at
    out = np.full((len(wanted.row_id), *model.polygons.shape[1:]), np.nan)
    for row_id in np.unique(mine.row_id):
        own, there = np.flatnonzero(mine.row_id == row_id), np.flatnonzero(wanted.row_id == row_id)
        position, at = mine.position[own], wanted.position[there]
        after = np.clip(np.searchsorted(position, at), 1, max(len(own) - 1, 1))
        if len(own) < 2:
            continue
        low, high = position[after - 1], position[after]
        inside = (at >= low) & (at <= high) & (high - low <= reach)
        part = ((at - low) / (high - low))[inside, None, None]
        first, second = model.polygons[own[after - 1]][inside], model.polygons[own[after]][inside]
        out[there[inside]] = (1 - part) * first + part * second
    return out, np.asarray(np.isfinite(out).all(axis=(1, 2)))


def reference_model(found: RowMap) -> CanopyModel:
    """The foliage's outlines in fine sections, V_ref of Table 3.1."""
    return _model(found, REFERENCE, OUTLINE, "foliage")


def search(found: RowMap, reference: CanopyModel, *, generations: int = GENERATIONS) -> tuple[float, float, int]:
    """The [a, b, c] of the highest mean Q within the thesis's ranges, to the centimetre, by differential evolution."""

    def rounded(x: Values) -> tuple[float, float, int]:
        return round(float(x[0]), 2), round(float(x[1]), 2), round(float(x[2]))

    def loss(x: Values) -> float:
        return -float(score(found, reference, *rounded(x), "foliage").quality.mean())

    integrality = [False, False, True]
    options = {"seed": 0, "maxiter": generations, "popsize": 6, "polish": False, "tol": 1e-3, "x0": THESIS}
    return rounded(differential_evolution(loss, BOUNDS, integrality=integrality, **options).x)


def some_rows(found: RowMap, length: float) -> RowMap:
    """The map with its longest rows only, of so many metres together."""
    order = found.rows.length.sort_values(ascending=False)
    chosen = order.index[order.cumsum().shift(fill_value=0.0) < length]
    rows = found.rows.loc[sorted(chosen)]
    return found._replace(rows=rows, gaps=found.gaps[found.gaps["row_id"].isin(rows["row_id"])])


def draw(scores: dict[str, Score], path: Path) -> None:
    """Draw the histograms of G, U, O, R and Q of models (Fig. 3.9)."""
    from matplotlib.figure import Figure  # a tool of development

    figure = Figure(figsize=(17, 3.2 * len(scores)), layout="constrained")
    panels = figure.subplots(len(scores), 5, squeeze=False)
    for line, (name, one) in zip(panels, scores.items(), strict=True):
        for axes, key in zip(line, PANELS, strict=True):
            values = getattr(one, key)
            axes.hist(np.clip(values, *PANELS[key]), bins=np.linspace(*PANELS[key], 56), color="tab:green")
            axes.set_title(f"{name}\n{key}: mean {values.mean():.3f}, σ {values.std():.3f}", fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


@click.command()
@click.argument("cloud", type=FILE)
@click.option("--boundary", type=FILE, help="Polygon to clip to.")
@click.option("--parcel", help="Name of the polygon, where the file has several.")
@click.option("--crs", help="CRS of the cloud, as EPSG:n, where the file states none.")
@click.option("--length", default=LENGTH, show_default=True, help="Metres of rows to search with.")
@click.option("--generations", default=GENERATIONS, show_default=True, help="Of the search.")
@click.option("--out", type=FILE, default=Path("build/tune.png"), show_default=True, help="Picture to draw.")
def main(
    cloud: Path,
    boundary: Path | None,
    parcel: str | None,
    crs: str | None,
    length: float,
    generations: int,
    out: Path,
) -> None:
    """Search the [a, b, c] that models the canopies in CLOUD best."""
    polygon = read_boundary(boundary, parcel=parcel) if boundary else None
    points = read_cloud(cloud, crs=parse_crs(crs) if crs else None, boundary=polygon)
    found = some_rows(map_rows(points, Settings()), length)
    if len(found.rows) == 0:
        raise InputError(f"{cloud}: no vine row found, so that there is no canopy to model")
    reference = reference_model(found)
    if len(reference.table) == 0:
        raise InputError(f"{cloud}: has too few points for sections of its canopies")
    best = search(found, reference, generations=generations)
    models = {"best": (*best, "foliage"), "the thesis's": (*THESIS, "foliage"), "on the soil": (*THESIS, "soil")}
    scores = {}
    for name, (a, b, c, foot) in models.items():
        scores[f"{name} [{a:g}, {b:g}, {c}]"] = score(found, reference, a, b, c, foot)
    for name, one in scores.items():
        good, under, over, reduction = (mean(v) for v in (one.good, one.under, one.over, one.reduction))
        click.echo(
            f"{name}: G {good:.3f}, U {under:.3f}, O {over:.3f}, R {reduction:.3f}, "
            f"Q {one.quality.mean():.3f} ± {one.quality.std():.3f}"
        )
    draw(scores, out)
    click.echo(f"{len(found.rows)} rows, {found.rows.length.sum():.0f} m → {out}")


if __name__ == "__main__":
    with plain_errors():
        main(standalone_mode=False)
