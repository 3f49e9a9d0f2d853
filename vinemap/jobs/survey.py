"""Many parcels of one cloud in one job: read once, worked in processes, one parcel's fault costing no other."""

from __future__ import annotations

import contextvars
import json
import time
import warnings
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from datetime import UTC, datetime
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, Protocol

from vinemap import paths
from vinemap.cloud.files import worded
from vinemap.cloud.pdal.engine import check_engines
from vinemap.cloud.pieces import split_cloud
from vinemap.compute import machine
from vinemap.errors import ConfigError, InputError, OutsideError, VinemapError, WorkerError, own_fault
from vinemap.jobs.outcomes import DONE, FAILED, LEFT, Outcome, write_record
from vinemap.jobs.plan import Plan, elsewhere, outside, plan_survey
from vinemap.jobs.register import is_due, note
from vinemap.jobs.workers import Worker, Workers
from vinemap.parcel import follow
from vinemap.product.globe import survey_tileset
from vinemap.product.pages.survey import write_index
from vinemap.product.stac import write_collection
from vinemap.product.store import unwritable, workshop, write_whole
from vinemap.stages import call

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Future
    from contextlib import AbstractContextManager
    from pathlib import Path

    from pyproj import CRS

    from vinemap.cloud.pieces import Piece
    from vinemap.config.surveys import JobOptions, SurveyConfig
    from vinemap.geo.boundaries import Boundary
    from vinemap.product.recipe import Recipe
    from vinemap.product.record import Summary


class Engine(Protocol):
    """Takes calls from as many threads as it has slots, as :class:`vinemap.jobs.workers.Workers` does."""

    slots: int

    def run(self, function: Callable[..., Any], *args: Any, limit: float | None, **kwargs: Any) -> Any:
        """Run a function, or raise a VinemapError."""

    def stop(self) -> None:
        """Break off what runs."""


def map_survey(
    config: SurveyConfig,
    folder: Path,
    *,
    again: bool = False,
    step: Callable[..., Any] = call,
) -> Iterator[Outcome]:
    """Map the parcels of a survey that need it, and leave the product of each in a folder of its name.

    The cloud is read once and every point goes to the parcels that hold it. Each parcel is then worked by a process of
    its own: what goes wrong there, a crash or too long a time even, is that parcel's alone. ``survey.json`` in the
    folder tells at the end what became of each, and ``index.html`` shows it.

    Parameters
    ----------
    config : SurveyConfig
        The survey.
    folder : Path
        Folder of the products' folders.
    again : bool
        Whether to map parcels that are up to date as well, and those known to fail.
    step : callable
        Runs the work on a parcel, as ``step(parcel, function, *args, **kwargs)``, in a thread.

    Yields
    ------
    Outcome
        Of each parcel, as it comes.

    Raises
    ------
    VinemapError
        If the cloud or the boundaries can't be read at all, or nothing can be written.
    """
    began = datetime.now(UTC)
    check_engines(config.all_settings())
    with workshop(folder) as aside:
        plan = plan_survey(config, folder, again=again)
        outcomes: list[Outcome] = []
        try:
            yield from _noted(plan.settled, outcomes)
            if plan.recipes:
                yield from _noted(_work(plan, config, folder, aside, step), outcomes)
            yield from _noted(elsewhere(config, outcomes), outcomes)
            yield from _noted(_register(plan, config, folder, outcomes), outcomes)
        except InputError as error:
            done = {outcome.parcel for outcome in outcomes}
            left = [recipe for recipe in plan.recipes if recipe.parcel not in done]
            outcomes += [Outcome(r.parcel, FAILED, reason=str(error), key=r.key) for r in left]
            raise
        finally:
            if outcomes:
                write_record(folder, config.survey, plan.sources, outcomes, began=began, listed=plan.listed)
                given = [(source.path, source.record()) for source in plan.sources]
                products = write_collection(folder, survey=config.survey, flown=plan.flown, sources=given)
                _write_tileset(paths.tileset(folder), products)
                _write_page(folder, config.survey)


def _register(plan: Plan, config: SurveyConfig, folder: Path, outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Write what the register is to know of a job; what is to be told of that."""
    due = plan.due(outcomes)
    if not plan.register or not (due or is_due(plan.register)):
        return []
    remarks = note(plan.register, plan.flown, config.survey, due, folder)
    return [Outcome("register", LEFT, reason=remark) for remark in remarks]


def _write_tileset(path: Path, products: Sequence[Path]) -> None:
    """Write the 3D Tiles of all products, or none."""
    if tileset := survey_tileset([paths.tileset(product) for product in products]):
        write_whole(path, json.dumps(tileset))
    else:
        path.unlink(missing_ok=True)


def _write_page(folder: Path, survey: str) -> None:
    """Write the survey's page; a fault of our own in it neither fails a job nor hides why one failed."""
    try:
        write_index(folder, survey)
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 - as said
        warnings.warn(f"{paths.index(folder)} can't be written: {own_fault(error)}", RuntimeWarning, stacklevel=2)


def _noted(outcomes: Iterator[Outcome] | list[Outcome], into: list[Outcome]) -> Iterator[Outcome]:
    for outcome in outcomes:
        into.append(outcome)
        yield outcome


def _engine(plan: Plan, config: SurveyConfig) -> AbstractContextManager[Engine]:
    """What runs the parcels."""
    job = config.job
    if job.engine == "dask":
        from vinemap.jobs.dask import DaskWorkers

        return DaskWorkers(job.scheduler or "", memory=job.memory)
    n = min(job.workers or machine.most_processes(), len(plan.recipes))
    return Workers(n, cores=max(1, machine.cores() // n), memory=_memory(job, n))


def _memory(job: JobOptions, n: int) -> int:
    """Bytes that each of n processes may take."""
    return int(job.memory * 1e9) if job.memory else machine.share(n)


def _work(
    plan: Plan,
    config: SurveyConfig,
    folder: Path,
    aside: Path,
    step: Callable[..., Any],
) -> Iterator[Outcome]:
    with _engine(plan, config) as workers, ThreadPoolExecutor(workers.slots) as threads:
        try:
            jobs = _jobs(plan, config, folder, aside)
            # Two for each slot, so that it need not wait until this is asked for the next outcome.
            waiting: set[Future[Outcome]] = set()
            while True:
                for recipe, piece in islice(jobs, 2 * workers.slots - len(waiting)):
                    if isinstance(piece, Outcome):
                        yield piece
                        continue
                    run = partial(_run, recipe, piece, plan, folder, aside, config.job.limit, workers, step)
                    waiting.add(threads.submit(contextvars.copy_context().run, run))
                if not waiting:
                    break
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for job in done:
                    yield job.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            workers.stop()
            raise


def _jobs(
    plan: Plan, config: SurveyConfig, folder: Path, aside: Path
) -> Iterator[tuple[Recipe, Piece | Outcome | None]]:
    """Recipes with their points, the largest first; with none where a parcel reads them itself, of a COPC's, say."""
    dealt: dict[str, list[Recipe]] = {}
    for recipe in plan.recipes:
        if recipe.boundary is not None:
            dealt.setdefault(recipe.settings.ground.engine, []).append(recipe)
    together = [recipes for recipes in dealt.values() if len(recipes) > 1]
    named = {recipe.parcel for recipes in together for recipe in recipes}
    yield from ((recipe, None) for recipe in plan.recipes if recipe.parcel not in named)
    for number, recipes in enumerate(together):
        place = aside / str(number)
        place.mkdir()
        yield from _dealt(recipes, plan, config, folder, place)


def _dealt(
    recipes: list[Recipe], plan: Plan, config: SurveyConfig, folder: Path, aside: Path
) -> Iterator[tuple[Recipe, Piece | Outcome]]:
    """Recipes of one engine, which reads their cloud once, with their points."""
    clouds, limit = recipes[0].clouds, config.job.limit * len(recipes)
    reader = Worker(cores=machine.cores(), memory=_memory(config.job, 1))
    how = {"crs": recipes[0].crs, "engine": recipes[0].settings.ground.engine}
    try:
        pieces = reader.run(_split, clouds, [recipe.boundary for recipe in recipes], aside, **how, limit=limit)
    except WorkerError as error:
        raise WorkerError(f"{worded(clouds)}: can't be read: {error}") from error
    finally:
        reader.close()
    recipes[0].check()
    sizes = [0 if isinstance(piece, InputError) else piece.path.stat().st_size for piece in pieces]
    for k in sorted(range(len(pieces)), key=lambda k: -sizes[k]):
        recipe, piece = recipes[k], pieces[k]
        if isinstance(piece, InputError):
            yield recipe, Outcome(recipe.parcel, FAILED, reason=str(piece), key=recipe.key, heals=piece.heals)
        elif sizes[k] == 0 and not plan.listed:
            yield recipe, outside(recipe, folder)
        else:
            yield recipe, piece


def _split(
    clouds: Sequence[Path], boundaries: Sequence[Boundary], aside: Path, *, crs: CRS | None, engine: str
) -> list[Piece | InputError]:
    try:
        return split_cloud(clouds, boundaries, aside, crs=crs, engine=engine)
    except OSError as error:
        raise unwritable(aside.parent, error) from error


def _run(
    recipe: Recipe,
    piece: Piece | None,
    plan: Plan,
    folder: Path,
    aside: Path,
    limit: float,
    workers: Engine,
    step: Callable[..., Any],
) -> Outcome:
    """Have a parcel worked, and tell what became of it."""
    began, key = time.perf_counter(), recipe.key
    failed = partial(Outcome, recipe.parcel, FAILED, key=key)
    target = paths.parcel_folder(folder, recipe.parcel)
    options = {"piece": piece, "drafts": aside, "within": folder, "limit": limit}
    try:
        summary: Summary = step(recipe.parcel, workers.run, follow, recipe, target, **options)
    except OutsideError as error:
        return failed(reason=str(error)) if plan.listed else outside(recipe, folder)
    except VinemapError as error:
        heals = error.heals or not isinstance(error, (InputError, ConfigError))
        return failed(seconds=time.perf_counter() - began, reason=str(error), heals=heals)
    except Exception as error:  # noqa: BLE001 - a fault of our own costs no other parcel
        return failed(reason=own_fault(error), heals=True)
    finally:
        if piece:
            piece.path.unlink(missing_ok=True)
    numbers = summary.rows, round(summary.length, 3), round(summary.seconds, 3)
    return Outcome(recipe.parcel, DONE, *numbers, reason="; ".join(summary.warnings), key=key)
