"""What was changed in a register by hand, found by comparing rows with what they were, and whose number is whose."""

from __future__ import annotations

from contextlib import suppress
from datetime import date
from itertools import count
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import shapely

from vinemap.errors import InputError
from vinemap.geo.crs import project
from vinemap.geo.layers import some_of
from vinemap.geo.lines import INSIDE, LAST_NUMBER
from vinemap.product.register.tables import DATES, HISTORY, REGISTER

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.compute.arrays import Values
    from vinemap.geo.boundaries import Boundary
    from vinemap.product.register.tables import Register

MOVED = 0.02
"""Metres by which a line must lie elsewhere to have been moved: less comes of another CRS."""
BESIDE = 0.5
"""Metres on either side of what a row was within which a line is a part of it."""
HAND, REMOVED = "hand", "removed"
STATE = ("parcel", "row_id", "label", "planted", "grubbed")
"""What is known of a row beside its line."""
RENAMED = {"parcel": "given to {}", "row_id": "number {}", "label": "called {}", "planted": "planted {}"}
RENAMED |= {"grubbed": "grubbed up {}"}


class Settled(NamedTuple):
    """Rows of a register of which every one is itself."""

    rows: pd.DataFrame
    """As of the register with ``dirty``, and with ``uid``, ``row_id`` and ``label`` where there is a ``parcel``."""
    entries: pd.DataFrame
    """What has changed by hand, for the past."""
    remarks: tuple[str, ...] = ()
    """What is to be known of the rows: a sentence each."""


def settle(register: Register, day: str, parcels: Mapping[str, Boundary | None]) -> Settled:
    """Find what was edited by hand, and give every row what is its own.

    A row is the same as long as its ``uid`` is. Of rows with the same one, as a line has that was split, the one that
    is called as before keeps it, or else the one that is most of what it was; a line drawn anew under the name of one
    that is gone is that row. Numbers that a row of the parcel had once are no other's.

    Parameters
    ----------
    register : Register
        As read.
    day : str
        Date of today, as 2026-05-31.
    parcels : mapping of str to Boundary
        Those to which lines without a ``parcel`` may belong.
    """
    rows, past = register.rows.copy(), register.past
    last = past.drop_duplicates("uid", keep="last").set_index("uid")
    usable = are_lines(rows)
    lines: Values = rows["line"].where(usable, None).to_numpy()
    undated = _without_odd_dates(rows)
    before = rows.drop(columns="line")
    rows["parcel"] = _parcels(rows, lines, register.crs, parcels)
    here = lines if register.crs == register.past_crs else _brought(lines, register)
    split = _identify(rows, last, here, usable)
    rows, odd = number(rows, past)
    entries = _entries(rows, last, here, split, register, day)
    by_hand = rows["uid"].isin(entries["uid"])
    rows.loc[by_hand, "edited"] = day
    rows.loc[by_hand & rows["since"].isna(), "since"] = day
    rows["dirty"] = (rows[before.columns].fillna("") != before.fillna("")).any(axis=1)
    left = [_described(row) for row in rows[~usable].itertuples()]
    told = {
        f"what is no row in the register is left out: {some_of(left)}": left,
        f"dates of the register that are none count as empty: {some_of(undated)}: write them as 2026-05-31": undated,
        f"{len(odd)} rows of the register had another's number or name, and got their own: {some_of(odd)}": odd,
    }
    return Settled(rows, entries, tuple(remark for remark, holds in told.items() if holds))


def are_lines(rows: pd.DataFrame) -> NDArray[np.bool_]:
    """Which rows (n,) of a register have a line."""
    return np.array([isinstance(line, shapely.LineString) for line in rows["line"]], dtype=bool)


def _without_odd_dates(rows: pd.DataFrame) -> list[str]:
    """Leave out, in place, what are no dates of planting and grubbing; which those are, and of which rows."""
    odd: list[str] = []
    for column in DATES[HISTORY][:2]:
        wrong = rows.index[[day is not None and not _is_date(day) for day in rows[column]]]
        odd += [f"{column} {rows[column][k]!r} of {rows['label'][k] or 'a new row'}" for k in wrong]
        rows.loc[wrong, column] = None
    return odd


def _is_date(word: str) -> bool:
    with suppress(ValueError):
        return f"{date.fromisoformat(word)}" == word
    return False


def _brought(lines: Values, register: Register) -> Values:
    """Lines in the CRS of what they were."""
    try:
        return project(lines, register.crs, register.past_crs)
    except InputError:
        return lines


def _described(row: Any) -> str:
    return f"{row.line} {row.label!r}" if row.label else str(row.line)


def _parcels(rows: pd.DataFrame, lines: Values, crs: CRS, parcels: Mapping[str, Boundary | None]) -> pd.Series:
    """Parcels (n,) of rows, of those that were drawn without one by their place."""
    found = rows["parcel"].copy()
    free = [k for k in np.flatnonzero(found.isna()).tolist() if lines[k] is not None]
    for name, boundary in parcels.items() if free else ():
        if boundary:
            moved = project(lines[free], crs, boundary[1])
            held = shapely.length(shapely.intersection(moved, boundary[0])) >= INSIDE * shapely.length(moved)
            found.iloc[[k for k, inside in zip(free, held, strict=True) if inside]] = name
    return found


def _identify(rows: pd.DataFrame, last: pd.DataFrame, lines: Values, usable: NDArray[np.bool_]) -> dict[int, int]:
    """Give rows their ``uid``, in place; which new ones (by theirs) were split from which."""
    claims = rows["uid"].where(rows["uid"].isin(last.index) | (len(last) == 0), None)
    was: dict[Any, Any] = {one.Index: (one.line, one.parcel, one.label) for one in last.itertuples()}
    labels, parcels = rows["label"].tolist(), rows["parcel"].tolist()
    parts: dict[int, int] = {}
    doubled = claims[claims.notna() & claims.duplicated(keep=False)]
    for uid in doubled.unique().tolist():
        line, _, label = was.get(uid, (None, None, None))
        places = doubled.index[doubled == uid].tolist()
        # Of parts with the same name, as of a line that was split, the name tells nothing.
        keeps = max(places, key=lambda k: (usable[k], labels[k] == label, _shared(lines[k], line), -k))
        parts |= {k: uid for k in places if k != keeps}
    claims[list(parts)] = None
    taken = set(claims.dropna())
    names = {(parcel, label): uid for uid, (_, parcel, label) in was.items() if uid not in taken}
    free = np.flatnonzero(claims.isna() & rows["parcel"].notna() & usable).tolist()
    for k in free:
        if uid := names.pop((parcels[k], labels[k]), None):
            claims[k] = uid
    fresh = count(max([*taken, *was], default=0) + 1)
    split: dict[int, int] = {}
    for k in free:
        if claims[k] is None:
            claims[k] = next(fresh)
            split |= {claims[k]: parts[k]} if k in parts else {}
    rows["uid"] = claims
    return split


def _shared(line: Any, was: shapely.LineString | None) -> float:
    """Metres of a line that run along what a row was."""
    return float(np.nan_to_num(shapely.length(shapely.intersection(line, shapely.buffer(was, BESIDE)))))


def number(rows: pd.DataFrame, past: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Give rows with a ``uid`` a number and a name that no other of their parcel has.

    Parameters
    ----------
    rows : DataFrame
        With ``uid``, ``parcel``, ``row_id`` and ``label``.
    past : DataFrame
        The same of what they were.

    Returns
    -------
    rows : DataFrame
        With ``row_id`` and ``label`` of their own.
    odd : list of str
        New names of those that had another's.
    """
    rows = rows.copy()
    known = rows["uid"].notna()
    last = past.drop_duplicates("uid", keep="last").set_index("uid")
    odd: list[str] = []
    lacks = rows[["row_id", "label"]].isna().any(axis=1)
    for column in ("row_id", "label"):
        lacks |= rows.loc[known].duplicated(["parcel", column], keep=False).reindex(rows.index, fill_value=False)
    for parcel in rows.loc[known & lacks, "parcel"].unique():
        of = rows[known & (rows["parcel"] == parcel)]
        was = last.reindex(of["uid"])
        before = past[past["parcel"] == parcel]
        used = {*before["row_id"].dropna(), *of["row_id"].dropna()}
        after = max(used, default=0) + 1
        free = (n for n in count(after if after + len(of) <= LAST_NUMBER else 1) if n not in used)
        numbers = _own(of["row_id"], was["row_id"].to_numpy(), of["uid"])
        numbers = {k: n if n is not None else next(free) for k, n in numbers.items()}
        names = _own(of["label"], was["label"].to_numpy(), of["uid"])
        taken = {*(name for name in names.values() if name), *before["label"].dropna()}
        for k, name in names.items():
            if name is None:
                given, usual = of["label"][k], f"{numbers[k]} {parcel}"
                made = given and given != f"{of['row_id'][k]} {parcel}"
                ways = (f"{given} ({n})" for n in count(2)) if made else _ways(usual)
                names[k] = next(way for way in ways if way not in taken)
                taken.add(names[k])
        given = zip(of.index, of["row_id"], of["label"], strict=True)
        other = [k for k, n, name in given if n not in (None, numbers[k]) or name not in (None, names[k])]
        odd += [str(names[k]) for k in other]
        rows.loc[of.index, "row_id"] = pd.Series(numbers, dtype=object)
        rows.loc[of.index, "label"] = pd.Series(names, dtype=object)
    return rows, odd


def _ways(usual: str) -> Iterator[str]:
    yield usual
    yield from (f"{usual} ({n})" for n in count(2))


def _own(values: pd.Series, was: Values, uids: pd.Series) -> dict[int, Any]:
    """What rows keep of numbers or names: those that had one, or else the oldest; who lost it gets back what was."""
    same = np.array([a == b for a, b in zip(values, was, strict=True)], dtype=bool)
    order = np.lexsort((uids.astype(int), ~same))
    kept: dict[int, Any] = dict.fromkeys(range(len(values)))
    taken: set[Any] = set()
    for given in (values.tolist(), list(was)):
        for k in order.tolist():
            if kept[k] is None and isinstance(given[k], int | str) and given[k] not in taken:
                kept[k] = given[k]
                taken.add(given[k])
    return dict(zip(values.index, kept.values(), strict=True))


def _entries(
    rows: pd.DataFrame, last: pd.DataFrame, lines: Values, split: Mapping[int, int], register: Register, day: str
) -> pd.DataFrame:
    """What the past lacks: how rows have changed, which are new, and which are gone."""
    known = np.flatnonzero(rows["uid"].notna() & np.array([line is not None for line in lines], dtype=bool))
    found = rows.iloc[known].assign(here=lines[known])
    was: Any = last.reindex(found["uid"])
    then = was["line"].where(was["line"].notna(), None).to_numpy()
    same = shapely.equals_exact(found["here"].to_numpy(), then, MOVED)
    for column in STATE:
        same &= found[column].fillna("").to_numpy() == was[column].fillna("").to_numpy()
    same &= was["what"].to_numpy() != REMOVED
    words: list[str] = []
    names: dict[Any, str] = last["label"].to_dict()
    for row, earlier in zip(found[~same].itertuples(), was[~same].itertuples(), strict=True):
        uid: Any = row.uid
        parent = names.get(split.get(uid))
        is_new = not isinstance(earlier.what, str)
        new = f"split from {parent}" if parent else "drawn"
        words.append(new if is_new else ", ".join(_changes(row, earlier)))
    changed = found[~same].assign(what=words, by=HAND, date=day)
    gone = last[(last["what"] != REMOVED) & ~last.index.isin(rows["uid"].dropna())].reset_index()
    left: Values = gone["line"].to_numpy()
    if len(gone) and register.crs != register.past_crs:
        left = project(left, register.past_crs, register.crs)
    gone = gone.assign(what=REMOVED, by=HAND, date=day, line=left)
    columns = [*REGISTER[HISTORY].columns, *DATES[HISTORY], "line"]
    return pd.concat([changed[columns], gone[columns]], ignore_index=True)


def _changes(row: Any, earlier: Any) -> list[str]:
    """In words, how a row differs from what it was."""
    words = ["restored"] if earlier.what == REMOVED else []
    if not shapely.equals_exact(row.here, earlier.line, MOVED):
        turned = shapely.equals_exact(shapely.reverse(row.here), earlier.line, MOVED)
        far = shapely.hausdorff_distance(row.here, earlier.line)
        words.append("turned round" if turned else f"moved by {far:.2f} m")
    for column, what in RENAMED.items():
        now, then = getattr(row, column), getattr(earlier, column)
        if (now or "") != ("" if pd.isna(then) else then):
            words.append(what.format(now or "-"))
    return words
