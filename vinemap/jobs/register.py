"""The register in a night's work: rows that it knows, candidates that it is offered, and products put into it."""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from vinemap import naming, paths
from vinemap.errors import BusyError, InputError, OutputError
from vinemap.evaluate.changes import are_others, estimate_shift, lie_aside
from vinemap.evaluate.rows import match_rows
from vinemap.geo.crs import is_local, parse_crs, project
from vinemap.geo.layers import some_of
from vinemap.geo.lines import KnownRows, rows_of
from vinemap.product.register.edits import Settled, are_lines, number, settle
from vinemap.product.register.file import make_register, read_register, stamps_of, update_register
from vinemap.product.register.tables import Update
from vinemap.product.seasons.products import outline_in, read_record, read_rows

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.config.surveys import SurveyConfig
    from vinemap.geo.boundaries import Boundary
    from vinemap.product.register.tables import Register

NEAR = 0.3
"""Share of the spacing within which rows are the same."""
OVERLAP, WIDTH = 0.5, 0.6
"""Share of the longer row, and metres, in which the two are."""
MARGIN = 0.05
"""Share of the extent of parcels about it in which rows may be theirs, as a box is none in another CRS."""
SPACING = 2.5
"""Metres between rows where nothing tells it."""
NONE: dict[str, Any] = {"planted": None, "grubbed": None, "edited": None}


class Known(NamedTuple):
    """What a register says for a survey."""

    path: Path
    rows: dict[str, KnownRows]
    """Of parcels that have some."""
    remarks: tuple[str, ...]
    edited: bool
    """Whether something was edited of which its history doesn't tell yet."""
    offered: dict[str, str]
    """When parcels were flown of whose rows there are candidates."""
    closed: frozenset[str]
    """Parcels in which there are rows, whenever."""
    parcels: Mapping[str, Boundary | None]


def today() -> str:
    """Date of today."""
    return f"{datetime.now(UTC):%Y-%m-%d}"


def known_of(config: SurveyConfig, flown: datetime, parcels: Mapping[str, Boundary | None]) -> Known | None:
    """What the register knows of a survey's parcels on the day of its flight; None where there is no register.

    Raises
    ------
    InputError
        If the register can't be read, or is named and isn't there.
    BusyError
        If another program keeps it to itself.
    """
    path = config.row_register or paths.REGISTER
    local = config.crs is not None and is_local(parse_crs(config.crs))
    if local or not (config.row_register or path.exists()):
        return None
    day, there = f"{flown:%Y-%m-%d}", _settled(path, stamps_of(path), today())
    if there.loose:
        there = _settle(read_register(path), today(), parcels)
    standing = there.grubbed > day
    here = np.zeros(len(there.rows), dtype=bool)
    for name, boundary in parcels.items():
        if boundary is None:
            here |= there.rows["parcel"].to_numpy() == name
    bounded = [boundary for boundary in parcels.values() if boundary]
    for crs in {crs for _, crs in bounded}:
        west, south, east, north = shapely.total_bounds([shape for shape, own in bounded if own == crs])
        margin = MARGIN * max(east - west, north - south)
        around = project(shapely.box(west - margin, south - margin, east + margin, north + margin), crs, there.crs)
        here[there.tree.query(around) if np.isfinite(shapely.bounds(around)).all() else slice(None)] = True
    rows = there.rows[here & standing & (there.planted <= day)].reset_index(drop=True)
    lines = gpd.GeoDataFrame(
        {"parcel": rows["parcel"], "row_id": rows["row_id"].astype("Int64"), "label": rows["label"]},
        geometry=gpd.GeoSeries(rows["line"], crs=there.crs),
    )
    found, _ = rows_of(KnownRows(lines), parcels)
    closed = frozenset(there.rows.loc[standing, "parcel"].dropna().unique())
    return Known(path, found, there.remarks, there.edited, there.offered, closed, parcels)


class _Standing(NamedTuple):
    """Rows of a register that have a line, each of which is itself."""

    rows: pd.DataFrame
    crs: CRS
    planted: NDArray[np.object_]
    grubbed: NDArray[np.object_]
    """Dates as text, of which one that isn't known is before or after all others."""
    tree: shapely.STRtree
    loose: bool
    """Whether there are some that belong to no parcel yet."""
    remarks: tuple[str, ...]
    edited: bool
    offered: dict[str, str]


@lru_cache(maxsize=1)
def _settled(path: Path, stamps: tuple[int, ...], day: str) -> _Standing:
    """Rows of a register, once for all surveys of a night."""
    del stamps
    return _settle(read_register(path), day, {})


def _settle(register: Register, day: str, parcels: Mapping[str, Boundary | None]) -> _Standing:
    settled = settle(register, day, parcels)
    # In an order that edits of other parcels don't change.
    rows = settled.rows[are_lines(settled.rows)].sort_values(["parcel", "row_id"], kind="stable", ignore_index=True)
    planted, grubbed = (rows[name].fillna(none).to_numpy() for name, none in (("planted", ""), ("grubbed", "9")))
    tree, loose = shapely.STRtree(rows["line"].to_numpy()), bool(rows["parcel"].isna().any())
    edited = len(settled.entries) > 0 or bool(settled.rows["dirty"].any())
    return _Standing(rows, register.crs, planted, grubbed, tree, loose, settled.remarks, edited, register.offered)


def candidates_due(known: Known | None, flown: datetime, mapped: Mapping[str, bool]) -> list[str]:
    """Parcels of whose rows the register is to be offered candidates.

    Parameters
    ----------
    mapped : mapping of str to bool
        Parcels with rows that were sought, and whether that was just now.
    """
    if not known:
        return []
    day = f"{flown:%Y-%m-%d}"
    last = {name: known.offered.get(name, "") for name in mapped.keys() - known.rows.keys() - known.closed}
    return sorted(name for name, offered in last.items() if offered < day or (mapped[name] and offered == day))


def is_due(known: Known | None) -> bool:
    """Whether a register has something to note, even if nothing was mapped."""
    return bool(known and (known.edited or known.offered.keys() & (known.rows.keys() | known.closed)))


def note(known: Known, flown: datetime, survey: str, due: Sequence[str], folder: Path) -> list[str]:
    """Write into the register's history what was edited by hand, and candidates: what is to be known of that.

    A register that can't be written costs a sentence alone, and is written another night.
    """
    tables = [(name, read_rows(paths.parcel_folder(folder, name), name)) for name in due]
    day, n = f"{flown:%Y-%m-%d}", 0

    def change(register: Register) -> Update:
        nonlocal n
        settled = settle(register, today(), known.parcels)
        offers = [
            _found(rows, register).assign(parcel=name, survey=survey, flown=day)
            for name, rows in tables
            if rows is not None and len(rows)
        ]
        n = sum(map(len, offers))
        return Update(settled.rows, settled.entries, offers, sorted(known.rows.keys() | known.closed))

    try:
        update_register(known.path, change)
    except (BusyError, InputError, OutputError) as error:
        return [str(error)]
    told = f"{n} rows stand in no register, and are candidates: vinemap register takes them in: {some_of(list(due))}"
    return [f"{known.path}: {told}"] if n else []


def _found(rows: gpd.GeoDataFrame, register: Register) -> pd.DataFrame:
    """Rows of a product as the register has them."""
    lines = project(rows.geometry.to_numpy(), rows.crs, register.crs)
    table = pd.DataFrame(rows[["row_id", "label"]]).reset_index(drop=True)
    shapes = pd.Series([*lines], dtype=object)
    doubt = rows["confidence"].to_numpy() if "confidence" in rows else np.nan
    return table.astype(object).assign(line=shapes, confidence=doubt)


class _Product(NamedTuple):
    parcel: str
    survey: str
    flown: str
    rows: gpd.GeoDataFrame
    reach: shapely.Geometry
    """Where rows of its name are its own, and not those of another parcel of that name."""


def register_products(products: Iterable[Path], path: Path, *, how: str | None = None) -> Iterator[str]:
    """Put the rows of products into a register, and say so in a line for each, and then what is odd in the register.

    Of a parcel in which the register has rows these stay as they are.

    Parameters
    ----------
    products : iterable of Path
        Folders or GeoPackages of products; all are read before anything is written.
    path : Path
        The register, made if it isn't there.
    how : str, optional
        Where the register has rows: "add" takes in those that it lacks; "replace" does so and ends those that are no
        more, on the day of the flight.

    Raises
    ------
    InputError
        If one is no product, or has no place on the globe, or the register can't be read.
    BusyError, OutputError
        If it can't be written.
    """
    given = [_product(product) for product in products]
    if not given:
        return
    make_register(path, given[0].rows.crs)
    told: list[str] = []

    def change(register: Register) -> Update:
        settled = settle(register, today(), {})
        for one in given:
            settled, words = _put(one, settled, register, how)
            told.append(f"{one.parcel}: {words} → {path}")
        told.extend(f"{path}: {remark}" for remark in settled.remarks)
        taken = settled.rows.loc[settled.rows["grubbed"].isna(), "parcel"].dropna().unique()
        return Update(settled.rows, settled.entries, (), sorted(taken))

    update_register(path, change)
    yield from told


def _product(product: Path) -> _Product:
    folder, record = read_record(product)
    parcel = str(record["parcel"])
    rows = read_rows(folder, parcel)
    if rows is None:
        raise InputError(f"{naming.shown(product)}: its rows can't be read: map the parcel again")
    if is_local(rows.crs):
        raise InputError(f"{parcel}: its coordinates are local, and a register has rows on the globe: give it a CRS")
    reach = _reach(folder, parcel, rows, bounded=bool(record.get("bounded")))
    return _Product(parcel, str(record.get("survey") or parcel), str(record["flown"])[:10], rows, reach)


def _reach(folder: Path, parcel: str, rows: gpd.GeoDataFrame, *, bounded: bool) -> shapely.Geometry:
    """Where rows of a parcel may stand: in its polygon, or else as far from those that were found as they reach."""
    found = shapely.union_all(rows.geometry.to_numpy()).convex_hull
    if bounded:
        with suppress(ValueError):
            return shapely.buffer(found.union(outline_in(folder, parcel)), SPACING)
    return shapely.buffer(found, max(SPACING, 2 * shapely.minimum_bounding_radius(found)))


def _put(one: _Product, settled: Settled, register: Register, how: str | None) -> tuple[Settled, str]:
    """Put a product's rows into those of a register; what became of them in words."""
    found, rows, past = _found(one.rows, register), settled.rows, register.past
    if len(found) == 0:
        return settled, "no row was found, and none is registered"
    around = shapely.buffer(shapely.union_all(one.rows.geometry.to_numpy()).convex_hull, SPACING)
    placed = project(rows["line"].where(are_lines(rows), None).to_numpy(), register.crs, one.rows.crs)
    beside = shapely.intersects(placed, around) & (rows["parcel"].fillna(one.parcel) == one.parcel).to_numpy()
    beside |= (rows["parcel"] == one.parcel).to_numpy() & shapely.intersects(placed, one.reach)
    standing = beside & ~(rows["grubbed"].fillna("9") <= one.flown).to_numpy()
    there, new = _matched(one.rows, placed[standing], anew=how == "replace")
    gone = rows.index[standing][~there]
    n, extra = int(standing.sum()), int(new.sum())
    if n and not how:
        more = f"; {extra} of the product's aren't among them: --add takes them in" if extra else ""
        return settled, f"{n} rows are in the register, and stay as they are{more}"
    first = not beside.any()
    names = {"parcel": one.parcel, "survey": one.survey, "since": one.flown, "fid": None, "dirty": True}
    fresh = found[new].assign(**NONE, **names)
    if not first:
        fresh["planted"] = one.flown
    top = max([0, *past["uid"].dropna(), *rows["uid"].dropna()])
    fresh["uid"] = [top + k for k in range(1, len(fresh) + 1)]
    known = {n for table in (past, rows) for n in table.loc[table["parcel"] == one.parcel, "row_id"]}
    if fresh["row_id"].isin(known).any():
        fresh[["row_id", "label"]] = None
    ended = len(gone) if how == "replace" else 0
    if ended:
        rows.loc[gone, ["grubbed", "dirty"]] = one.flown, True
    rows, _ = number(pd.concat([rows, fresh[rows.columns]], ignore_index=True), past)
    changed = rows.iloc[len(rows) - len(fresh) :].assign(what="found")
    changed = pd.concat([changed, rows.loc[gone[:ended]].assign(what=f"grubbed up {one.flown}")])
    entries = changed.assign(by=one.survey, date=one.flown)[settled.entries.columns]
    settled = settled._replace(rows=rows, entries=pd.concat([settled.entries, entries], ignore_index=True))
    words = f"rows registered: {len(fresh)}"
    words += f", there before: {n - len(gone)}" if n else ""
    return settled, words + (f", there no more: {ended}" if ended else "")


def _matched(
    rows: gpd.GeoDataFrame, standing: NDArray[np.object_], *, anew: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of a register's rows a product has, and which of its rows the register lacks.

    Where the parcel may have been planted ``anew``, rows that lie aside of those of the register, each another way, are
    none of them.
    """
    lines = shapely.force_2d(rows.geometry.to_numpy())
    spacing = float(np.nanmedian(rows["spacing_m"])) if rows["spacing_m"].notna().any() else SPACING
    near = min(WIDTH, NEAR * spacing)
    shift = estimate_shift(lines, standing, spacing=spacing, overlap=OVERLAP, width=near)
    moved = shapely.transform(lines, lambda xy: xy - shift)
    there, new = np.zeros(len(standing), dtype=bool), np.ones(len(lines), dtype=bool)
    if len(standing):
        j, i = match_rows(moved, standing, overlap=OVERLAP, width=near).T
        if not (anew and are_others(lie_aside(lines[j], standing[i], spacing=spacing), spacing=spacing)):
            there[i], new[j] = True, False
    return there, new
