"""Surveys by their names: what a configuration says of one, or what has arrived under that name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinemap import paths
from vinemap.config.surveys import SurveyConfig, load_estate, load_survey
from vinemap.errors import ConfigError
from vinemap.geo.crs import parse_crs
from vinemap.jobs.estate import arrivals
from vinemap.jobs.register import known_of
from vinemap.parcel import follow
from vinemap.product.recipe import recipe_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from vinemap.product.record import Summary


def chosen(survey: str) -> tuple[SurveyConfig, Path]:
    """Configuration of a survey and the folder of its products, by the name of a file or of what has arrived.

    Raises
    ------
    ConfigError
        If there is no such survey.
    """
    path = Path(survey) if survey.endswith((".yaml", ".yml")) else paths.configuration(survey)
    if path.is_file() or not paths.ESTATE.is_file():
        config = load_survey(path)
        return config, paths.survey_products(config.survey)
    estate = load_estate(paths.ESTATE)
    found = {arrival.name: arrival for arrival in arrivals(estate)}
    if survey not in found:
        raise ConfigError(f"{path}: no such file, and nothing of that name in {estate.surveys}")
    arrival = found[survey]
    if not arrival.config:
        raise ConfigError(f"{survey}: {arrival.reason}")
    return arrival.config, estate.products / survey


def map_one(config: SurveyConfig, parcel: str, *, step: Callable[..., Any]) -> Summary:
    """Map one parcel of a configured survey, whose stages ``step`` is handed, as of :func:`vinemap.parcel.map_parcel`.

    Raises
    ------
    VinemapError
        As that function.
    """
    survey = config.survey
    recipe = recipe_of(
        config.cloud or paths.survey_cloud(survey),
        parcel=parcel,
        boundary=config.boundaries or paths.survey_boundaries(survey),
        crs=parse_crs(config.crs) if config.crs else None,
        survey=survey,
        rows=config.rows,
        rows_crs=parse_crs(config.rows_crs) if config.rows_crs else None,
        vines=config.vines,
        **dict(config.of_parcel(parcel)),
    )
    known = None if config.rows else known_of(config, recipe.flown, {parcel: recipe.boundary})
    if known:
        recipe = recipe._replace(known=known.rows.get(parcel))
    products = paths.survey_products(survey)
    return follow(recipe, paths.parcel_folder(products, parcel), within=products, step=step)
