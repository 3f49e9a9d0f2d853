"""Surveys by their names: what a configuration says of one, or what has arrived under that name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinemap import paths
from vinemap.cloud.pdal.engine import check_engines
from vinemap.config.surveys import SurveyConfig, load_estate, load_survey
from vinemap.errors import ConfigError, InputError
from vinemap.jobs.estate import arrivals
from vinemap.jobs.plan import plan_survey
from vinemap.parcel import follow

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
        return config, products_folder(config.survey)
    estate = load_estate(paths.ESTATE)
    found = {arrival.name: arrival for arrival in arrivals(estate)} if estate.surveys.exists() else {}
    if survey not in found:
        raise ConfigError(f"{path}: no such file, and nothing of that name in {estate.surveys}")
    arrival = found[survey]
    if not arrival.config:
        raise ConfigError(f"{survey}: {arrival.reason}")
    return arrival.config, products_folder(survey)


def products_folder(survey: str) -> Path:
    """Folder of a survey's products: in the estate's, where there is one, so that every night finds them.

    Raises
    ------
    ConfigError
        If the estate's configuration can't be read.
    """
    return load_estate(paths.ESTATE).products / survey if paths.ESTATE.is_file() else paths.survey_products(survey)


def map_one(config: SurveyConfig, parcel: str, *, step: Callable[..., Any]) -> Summary:
    """Map one parcel of a configured survey, whose stages ``step`` is handed, as of :func:`vinemap.parcel.map_parcel`.

    Raises
    ------
    VinemapError
        As that function.
    """
    products = products_folder(config.survey)
    alone = config.boundaries is None and not paths.survey_boundaries(config.survey).exists()
    check_engines(config.all_settings())
    own = config if alone else config.model_copy(update={"parcels": [parcel]})
    plan = plan_survey(own, products, again=True)
    recipe = next((recipe for recipe in plan.recipes if recipe.parcel == parcel), None)
    if recipe is None:
        why = [outcome.reason for outcome in plan.settled if outcome.parcel == parcel]
        one = f"{parcel}: the survey {config.survey} has no boundaries, so that it is one parcel: {config.survey}"
        raise InputError("; ".join(why) or one)
    return follow(recipe, paths.parcel_folder(products, parcel), within=products, step=step)
