"""What a survey needs: which parcels are up to date, which can't be mapped, and which are to be."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vinemap import __version__, paths
from vinemap.config.names import check_parcel
from vinemap.errors import ConfigError, InputError, OutputError
from vinemap.geo.boundaries import NoAreaError, Parcel, read_parcels
from vinemap.geo.crs import is_local, parse_crs
from vinemap.geo.layers import read_points, some_of
from vinemap.geo.lines import KnownRows, read_rows, rows_of
from vinemap.jobs.register import Known, candidates_due, known_of
from vinemap.product.recipe import VINES, Recipe, Source, fit_for, flown, product_in, read_clouds, read_source, vines_of
from vinemap.product.record import in_words
from vinemap.product.seasons.products import GONE, places_of, whose
from vinemap.product.store import write_whole

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import geopandas as gpd

    from vinemap.config.surveys import SurveyConfig
    from vinemap.geo.boundaries import Boundary

DONE, CURRENT, OUTSIDE, LEFT, FAILED = "done", "up to date", "not in the cloud", "left out", "failed"
"""What can become of a parcel, beside that it is ``GONE``."""


@dataclass(frozen=True)
class Outcome:
    """What became of a parcel."""

    parcel: str
    state: str
    rows: int = 0
    length: float = 0.0
    """Of all rows (m)."""
    seconds: float = 0.0
    reason: str = ""
    """Why it failed, or what is to be known of it."""
    heals: bool = False
    """Whether it may go well another time, with the same input."""
    key: str = ""
    """Of the recipe."""

    def line(self) -> str:
        """What became of the parcel, as a sentence."""
        what = f"{in_words(self.rows, self.length)}, in {self.seconds:.1f} s" if self.state == DONE else self.state
        colon = "; " if self.state == DONE else ": "
        return f"{self.parcel}: {what}{colon if self.reason else ''}{' '.join(self.reason.split())}"


COLUMNS = ("parcel", "rows", "seconds", "state", "reason")
"""Of a table of what became of parcels."""


def in_table(outcomes: Iterable[Outcome]) -> list[tuple[str, ...]]:
    """What became of parcels in words, as rows of a table of ``COLUMNS``."""
    return [(o.parcel, str(o.rows), f"{o.seconds:.1f}", o.state, " ".join(o.reason.split())) for o in outcomes]


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


class _Earlier(NamedTuple):
    """What the last job in a folder has left."""

    sources: list[Source]
    outcomes: dict[str, Outcome]


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
    hashed, known = _earlier(folder)
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


def check_same(folder: Path, clouds: Sequence[Path]) -> None:
    """Make sure that a folder of products is no other survey's, as clouds' names alone don't tell them apart.

    Parameters
    ----------
    folder : Path
        Folder of products' folders.
    clouds : sequence of Path
        Files that are to be mapped there: one must lie where one of the earlier lay, in whatever format, or have its
        name and size; of several it is enough that one lies in the same folder.

    Raises
    ------
    OutputError
        If it holds products of others.
    """
    earlier = _earlier(folder).sources if places_of(folder) else []
    known = {(one.path.name, *one.stamp[:1]) for one in earlier}
    known |= {(one.path.absolute().parent, paths.bare(one.path)) for one in earlier}
    known |= {(one.path.absolute().parent,) for one in earlier if len(clouds) > 1}
    for cloud in clouds:
        place = cloud.absolute().parent
        size = cloud.stat().st_size if cloud.is_file() else None
        if known & {(cloud.name, size), (place, paths.bare(cloud)), (place,)}:
            return
    if earlier:
        raise OutputError(f"{folder}: holds the products of {earlier[0].path}: give another folder with --out")


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


def _earlier(folder: Path) -> _Earlier:
    """What the last job in a folder has left, if it can be read."""
    try:
        record = json.loads(paths.survey_record(folder).read_text(encoding="utf-8"))
        sources = [
            Source(Path(s["path"]), str(s["sha256"]), tuple(s["stamp"]), float(s["read"])) for s in record["sources"]
        ]
        outcomes = {one["parcel"]: Outcome(**one) for one in record["parcels"] if isinstance(one["parcel"], str)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return _Earlier([], {})
    return _Earlier(sources, outcomes)


def write_record(folder: Path, survey: str, plan: Plan, outcomes: Iterable[Outcome], began: datetime) -> None:
    """Write ``survey.json``: what became of each parcel, for people and for the next job.

    Raises
    ------
    OSError
        If it can't be written.
    """
    known = _earlier(folder).outcomes if plan.listed else {}
    known |= {o.parcel: replace(o, state=DONE if o.state == CURRENT else o.state) for o in outcomes}
    record = {
        "vinemap": __version__,
        "survey": survey,
        "began": began.isoformat(timespec="seconds"),
        "seconds": round((datetime.now(UTC) - began).total_seconds(), 3),
        "sources": [{"path": str(s.path), "sha256": s.sha256, "stamp": s.stamp, "read": s.read} for s in plan.sources],
        "parcels": [asdict(known[name]) for name in sorted(known)],
    }
    write_whole(paths.survey_record(folder), json.dumps(record, indent=2, ensure_ascii=False))
