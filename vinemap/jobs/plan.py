"""What a survey needs: which parcels are up to date, which can't be mapped, and which are to be."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vinemap import paths
from vinemap.config.names import check_parcel
from vinemap.errors import ConfigError, InputError
from vinemap.geo.boundaries import NoAreaError, Parcel, read_parcels
from vinemap.geo.crs import is_local, parse_crs
from vinemap.geo.layers import read_points, some_of
from vinemap.geo.lines import KnownRows, read_rows, rows_of
from vinemap.jobs.outcomes import CURRENT, DONE, FAILED, LEFT, OUTSIDE, Outcome, earlier_in
from vinemap.jobs.register import Known, candidates_due, known_of
from vinemap.product.recipe import VINES, Recipe, Source, fit_for, flown, product_in, read_clouds, read_source, vines_of
from vinemap.product.seasons.products import GONE, whose

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from datetime import datetime

    import geopandas as gpd

    from vinemap.config.surveys import SurveyConfig
    from vinemap.geo.boundaries import Boundary


class Plan(NamedTuple):
    """What is to be done for a survey, and what is settled without."""

    sources: tuple[Source, ...]
    flown: datetime
    recipes: list[Recipe]
    settled: list[Outcome]
    listed: bool
    """Whether somebody has named the parcels, so that each must be in the cloud."""
    register: Known | None = None
    """What the register says, where there is one."""

    def due(self, outcomes: Iterable[Outcome]) -> list[str]:
        """Parcels whose rows the register is to be offered, after what became of them."""
        mapped = {one.parcel: one.state == DONE for one in outcomes if one.state in (DONE, CURRENT) and one.rows}
        return candidates_due(self.register, self.flown, mapped)


def plan_survey(config: SurveyConfig, folder: Path, *, again: bool = False) -> Plan:
    """Find out which parcels of a survey need to be mapped: those whose recipe is another than their product's.

    Parameters
    ----------
    config : SurveyConfig
        The survey.
    folder : Path
        Folder of its products' folders.
    again : bool
        Whether to map them all.

    Raises
    ------
    InputError
        If the cloud, the boundaries or the rows can't be read.
    DependencyError
        If an engine can't be loaded.
    """
    cloud = config.cloud or paths.survey_cloud(config.survey)
    boundaries = config.boundaries or paths.survey_boundaries(config.survey)
    hashed, known = earlier_in(folder)
    clouds = read_clouds(cloud, hashed)
    polygons: dict[str, Parcel | InputError | None]
    crs, listed = parse_crs(config.crs) if config.crs else None, config.parcels is not None
    local = crs is not None and is_local(crs)
    sources: tuple[Source, ...]
    if config.boundaries is None and config.parcels is None and not boundaries.exists():
        sources, polygons = clouds, {config.survey: None}
    else:
        sources = *clouds, read_source(boundaries, hashed)
        polygons = {**read_parcels(boundaries, config.parcels, local=local)}
    sources += tuple(read_source(path, hashed) for path in (config.rows, config.vines) if path)
    rows, lost = _known_rows(config, polygons, local=local)
    vines, strays = _known_vines(config, polygons, local=local)
    files, date = tuple(source.path for source in clouds), min(map(flown, clouds))
    register = _registered(config, date, polygons, rows, lost)
    plan = Plan(sources, date, [], [*lost, *strays], listed, register)
    lasting = {FAILED} if listed else {FAILED, OUTSIDE}
    hopeless = {name: one for name, one in known.items() if one.state in lasting and not one.heals}
    plan.settled.extend(_unusable(polygons, listed=listed))
    caseless = paths.is_caseless(folder)
    named, nameless = _named(_whole(polygons), caseless=caseless)
    plan.settled.extend(nameless)
    for parcel, polygon in named.items():
        own = config.of_parcel(parcel)
        boundary, remarks = polygon or (None, ())
        recipe = Recipe(
            parcel=parcel,
            clouds=files,
            sources=sources,
            boundary=boundary,
            settings=fit_for(own.settings, files),
            crs=crs,
            origin=own.origin,
            flown=date,
            survey=config.survey,
            remarks=remarks,
            known=rows.get(parcel),
            vines=vines.get(parcel),
        )
        settled = None if again else _settled(recipe, folder, hopeless.get(parcel))
        if settled:
            plan.settled.append(settled)
        else:
            plan.recipes.append(recipe)
    if not listed:
        if strange := sorted(config.own_overrides() - polygons.keys()):
            plan.settled.append(Outcome("overrides", LEFT, reason=f"no parcel is called {some_of(strange)}"))
        plan.settled.extend(_gone(folder, config.survey, polygons, caseless=caseless))
    return plan


def _unusable(polygons: Mapping[str, Parcel | InputError | None], *, listed: bool) -> list[Outcome]:
    """What becomes of parcels whose polygons can't be used: what is none is left out, where nobody has named it."""
    return [
        Outcome(name, LEFT if isinstance(one, NoAreaError) and not listed else FAILED, reason=str(one))
        for name, one in polygons.items()
        if isinstance(one, InputError)
    ]


def _settled(recipe: Recipe, folder: Path, hopeless: Outcome | None) -> Outcome | None:
    """What becomes of a parcel that needs no work: its product is up to date, or it would fail as it did before."""
    key, product = recipe.key, product_in(paths.parcel_folder(folder, recipe.parcel))
    if product and (product.key, product.parcel) == (key, recipe.parcel):
        numbers = product.rows, product.length, 0.0
        return Outcome(recipe.parcel, CURRENT, *numbers, reason="; ".join(product.warnings), key=key)
    if not (hopeless and hopeless.key == key):
        return None
    return outside(recipe, folder) if hopeless.state == OUTSIDE else hopeless


def outside(recipe: Recipe, folder: Path) -> Outcome:
    """What is to be known of a parcel without a point in the cloud, and of the product that it may have in a folder."""
    there = product_in(paths.parcel_folder(folder, recipe.parcel))
    stays = "its earlier product stays, of another cloud or polygon"
    reason = stays if there and there.parcel == recipe.parcel else ""
    return Outcome(recipe.parcel, OUTSIDE, reason=reason, key=recipe.key)


def elsewhere(config: SurveyConfig, outcomes: Iterable[Outcome]) -> list[Outcome]:
    """What is to be told where all parcels lie beside the cloud."""
    if {one.state for one in outcomes} - {LEFT, GONE} != {OUTSIDE}:
        return []
    boundaries = config.boundaries or paths.survey_boundaries(config.survey)
    reason = "none of its parcels lies in the cloud: do both show the same place, in the right CRS?"
    return [Outcome(boundaries.name, FAILED, reason=reason)]


def _named(parcels: Mapping[str, Parcel | None], *, caseless: bool) -> tuple[dict[str, Parcel | None], list[Outcome]]:
    """Parcels whose names can name folders, each another, and what is to be known of the rest."""
    named: dict[str, Parcel | None] = {}
    taken: dict[str, str] = {}
    wrong = []
    for name, parcel in parcels.items():
        try:
            check_parcel(name)
        except ConfigError as error:
            wrong.append(Outcome(name, FAILED, reason=str(error)))
            continue
        folder = paths.parcel_folder(Path(), name).name
        if (other := taken.setdefault(folder.casefold() if caseless else folder, name)) != name:
            reason = f"its folder would be that of {other!r}, {folder}: give one of the two another name"
            wrong.append(Outcome(name, FAILED, reason=reason))
            continue
        named[name] = parcel
    return named, wrong


def _gone(folder: Path, survey: str, parcels: Iterable[str], *, caseless: bool) -> list[Outcome]:
    """What is to be known of products of a survey whose parcels it hasn't any more."""

    def name(place: Path) -> str:
        return place.name.casefold() if caseless else place.name

    there = {name(paths.parcel_folder(folder, parcel)) for parcel in parcels}
    others = sorted(record.parent for record in folder.glob(f"*/{paths.RUN}") if name(record.parent) not in there)
    return [
        Outcome(one[0], GONE, reason=f"no polygon has this name any more: {place} stays, and counts nowhere")
        for place in others
        if (one := whose(place)) and one[1] == survey
    ]


def _known_rows(
    config: SurveyConfig, polygons: Mapping[str, Parcel | InputError | None], *, local: bool
) -> tuple[dict[str, KnownRows], list[Outcome]]:
    """Known rows of each parcel that has some, and what becomes of those that lie in none."""
    path = config.rows
    if path is None:
        return {}, []
    rows = read_rows(path, crs=parse_crs(config.rows_crs) if config.rows_crs else None, local=local)
    known, homeless = rows_of(rows, _bounds(polygons))
    if not homeless or (known and config.parcels is not None):
        return known, []
    reason = f"{path.name}: {len(homeless)} of {len(rows.lines)} known rows lie in no parcel: {some_of(homeless)}"
    return known, [Outcome("known rows", LEFT, reason=reason)]


def _known_vines(
    config: SurveyConfig, polygons: Mapping[str, Parcel | InputError | None], *, local: bool
) -> tuple[dict[str, gpd.GeoSeries], list[Outcome]]:
    """Points of the known vines of each parcel, and what becomes of those that stand in none."""
    path = config.vines
    if path is None:
        return {}, []
    points = read_points(path, VINES, crs=parse_crs(config.rows_crs) if config.rows_crs else None, local=local)
    known = vines_of(points, _bounds(polygons))
    homeless = len(points) - len(set().union(*(own.index for own in known.values())))
    if not homeless or (homeless < len(points) and config.parcels is not None):
        return known, []
    reason = f"{path.name}: {homeless} of {len(points)} known vines stand in no parcel"
    return known, [Outcome("known vines", LEFT, reason=reason)]


def _registered(
    config: SurveyConfig,
    date: datetime,
    polygons: Mapping[str, Parcel | InputError | None],
    rows: dict[str, KnownRows],
    lost: list[Outcome],
) -> Known | None:
    """What the register says; it gives rows of its own to parcels for which none are known yet."""
    register = known_of(config, date, _bounds(polygons))
    if register:
        register = register._replace(closed=register.closed | rows.keys())
        rows |= {name: own for name, own in register.rows.items() if name not in rows}
        lost += [Outcome("register", LEFT, reason=f"{register.path}: {remark}") for remark in register.remarks]
    return register


def _whole(polygons: Mapping[str, Parcel | InputError | None]) -> dict[str, Parcel | None]:
    """The parcels whose polygons could be read, or that need none."""
    return {name: one for name, one in polygons.items() if not isinstance(one, InputError)}


def _bounds(polygons: Mapping[str, Parcel | InputError | None]) -> dict[str, Boundary | None]:
    """Boundaries of the parcels whose polygons could be read; None of those that need none."""
    return {name: one.boundary if one else None for name, one in _whole(polygons).items()}
