"""Polygons of parcels, read from people's files."""

from __future__ import annotations

import difflib
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import shapely

from vinemap import naming
from vinemap.errors import InputError
from vinemap.geo.crs import project
from vinemap.geo.layers import KML, kind_of, parts_of, polygons_of, read_layers, some_of, words_of
from vinemap.geo.place import check_place

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path, PurePath

    import geopandas as gpd
    import pandas as pd
    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.geo.layers import Layer

PARCEL_LAYERS = ("parcel", "parcels")
"""What the layer of polygons is called where there are several, in large letters or small."""
AREAS, OTHERS = ("Polygon", "Surface"), ("Point", "LineString", "Curve", "None")
"""What kinds of layers are called that hold polygons, and that hold none; in the rest there may be some."""
WORDS, NUMBERS = ("parcel", "name", "label"), ("code", "id")
"""Columns that are likely to name polygons, the likeliest first, and such as number them."""
HALF = 0.5
"""Share of the polygons that have a name, from which on the others lack one."""
USELESS = (9, 0)
"""Rank of columns that name nothing, or not each polygon."""
LONGEST_WORD = 31
"""Letters of a name beyond which it may be an identifier that a program gave."""
OF_KML = {"description", "timestamp", "begin", "end", "altitudemode", "tessellate", "extrude", "visibility"}
OF_KML |= {"draworder", "icon", "snippet"}
"""Columns of every KML, which name nothing."""
Boundary = tuple[shapely.Geometry, "CRS"]
"""A polygon and its CRS."""


class Parcel(NamedTuple):
    """The boundary of a parcel, and what is to be known of it: a sentence each."""

    boundary: Boundary
    remarks: tuple[str, ...] = ()


class NoAreaError(InputError):
    """Something in a file of polygons is none."""


class _Table(NamedTuple):
    """What a file holds."""

    frame: gpd.GeoDataFrame
    area: NDArray[np.bool_]
    """Which of its rows have polygons."""
    columns: dict[str, pd.Series]
    """Those that may name them, as words: the likeliest first."""
    usable: bool
    """Whether the first one does, as far as it is filled in."""


def read_boundary(path: Path, *, parcel: str | None = None) -> Boundary:
    """Read the polygon of a parcel from GeoPackage, GeoJSON, KML, KMZ or Shapefile, or a ``.zip`` with one.

    Parameters and errors are those of :func:`read_parcel`.
    """
    return read_parcel(path, parcel=parcel).boundary


def read_parcel(path: Path, *, parcel: str | None = None, lone: bool = False, local: bool = False) -> Parcel:
    """Read the polygon of a parcel, and what is to be known of it.

    Parameters
    ----------
    path : Path
        File whose only layer of polygons, or whose layer ``parcel`` or ``parcels``, is read; of KML all layers are.
    parcel : str, optional
        Name that one of the polygon's columns holds; without a name all polygons count. The column is that of
        :func:`read_parcels`, or the next one that holds the name.
    lone : bool
        Whether a file's only polygon is the parcel's even if it has another name, which is told.
    local : bool
        Whether coordinates are local, and need no CRS.

    Raises
    ------
    InputError
        If the file can't be read, has no polygon or no CRS, or none with the parcel's name.
    """
    table = _read_table(path, local=local)
    if parcel is not None:
        found = _found(table, _places(table), parcel, path, lone=lone)
        if isinstance(found, InputError):
            raise found
        return found
    made = _parcel(table, np.arange(len(table.frame)), path)
    n, others = np.count_nonzero(table.area), [_described(table, row) for row in np.flatnonzero(~table.area).tolist()]
    told = {
        f"{path.name} holds what is no polygon, and is left out: {some_of(others)}": bool(others),
        f"all {n} polygons of {path.name} count as one parcel": n > 1,
    }
    return made._replace(remarks=(*made.remarks, *(remark for remark, holds in told.items() if holds)))


def read_parcels(
    path: Path, names: Sequence[str] | None = None, *, local: bool = False
) -> dict[str, Parcel | InputError]:
    """Read the polygons of parcels, or what is wrong with one.

    Parameters
    ----------
    path : Path
        As for :func:`read_parcel`.
    names : sequence of str, optional
        Names of parcels; by default those in a column in which no name stands twice: ``parcel``, ``name`` or ``label``,
        if half of the polygons have one, which makes the others wrong alone; else a column that has one for each. A
        single polygon that nothing names is the parcel's, whatever that is called.
    local : bool
        As for :func:`read_parcel`.

    Raises
    ------
    InputError
        If the file can't be read, has no polygon or no CRS, or no column that names them.
    """
    table = _read_table(path, local=local)
    if names is not None:
        places = _places(table)
        return {name: _found(table, places, name, path) for name in names}
    if not table.usable:
        n = np.count_nonzero(table.area)
        raise InputError(f"{path}: no column has a name of its own for each of its {n} polygons: add one, 'name'")
    found: dict[str, Parcel | InputError] = {}
    column, words = next(iter(table.columns.items()))
    remarks = _called_otherwise(table)
    for row, (word, unnamed) in enumerate(zip(words, words.isna(), strict=True)):
        name = f"polygon {row + 1}" if unnamed else str(word)
        if not table.area[row]:
            found.setdefault(name, NoAreaError(f"{_described(table, row)} is no polygon"))
        elif unnamed:
            found[name] = InputError(f"{path}: {name} has no name in column {column!r}: give it one")
        else:
            made = _made(table, np.array([row]), path)
            found[name] = made._replace(remarks=(*made.remarks, *remarks)) if isinstance(made, Parcel) else made
    return found


def _called_otherwise(table: _Table) -> list[str]:
    """Why the column that is likely to name polygons doesn't, where one name in it is that of several."""
    first, *others = table.columns
    for name in others if first.lower() not in WORDS else ():
        words = table.columns[name][table.area]
        if (
            name.lower() in WORDS
            and words.notna().mean() >= HALF
            and (twice := words[words.duplicated()].dropna()).size
        ):
            return [f"it is called after column {first!r}, as {twice.iloc[0]!r} stands more than once in {name!r}"]
    return []


def _places(table: _Table) -> list[dict[str, NDArray[np.int_]]]:
    """The rows of every word of each column."""
    groups = (words.groupby(words).indices for words in table.columns.values())
    return [{str(word): np.asarray(rows) for word, rows in group.items()} for group in groups]


def _found(
    table: _Table, places: list[dict[str, NDArray[np.int_]]], name: str, path: Path, *, lone: bool = False
) -> Parcel | InputError:
    """The polygons of a name, or why there are none."""
    word = naming.composed(name)
    rows = next((rows[word] for rows in places if word in rows), None)
    if rows is None and len(table.frame) == 1 and not _is_named(table, word):
        rows = np.arange(1)
    if rows is not None:
        made, n = _made(table, rows, path), np.count_nonzero(table.area[rows])
        told = f"{n} polygons of {path.name} are called {name!r}, and count as one parcel"
        return made if isinstance(made, InputError) or n < 2 else made._replace(remarks=(*made.remarks, told))
    if lone and len(table.frame) == 1:
        made = _made(table, np.arange(1), path)
        told = f"the only polygon of {path.name} was taken, though none of its columns says {name!r}"
        return made if isinstance(made, InputError) else made._replace(remarks=(*made.remarks, told))
    lower = {word.lower(): word for rows in places for word in sorted(rows)}
    close = difflib.get_close_matches(word.lower(), sorted(lower), n=1, cutoff=0.5)
    hint = f"did you mean {lower[close[0]]!r}?" if close else "check the name"
    n = np.count_nonzero(table.area)
    return InputError(f"{path}: none of its {n} polygons has {name!r} in a column: {hint}")


def _is_named(table: _Table, asked: str) -> bool:
    """Whether the only polygon has a name; numbers are names to those who ask for a number."""
    likely = (words[0] for name, words in table.columns.items() if name.lower() in WORDS + NUMBERS)
    return any(isinstance(word, str) and (not word.isdigit() or asked.isdigit()) for word in likely)


def _made(table: _Table, rows: NDArray[np.int_], path: Path) -> Parcel | InputError:
    try:
        return _parcel(table, rows, path)
    except InputError as error:
        return error


def _parcel(table: _Table, rows: NDArray[np.int_], path: Path) -> Parcel:
    """All polygons of some rows, valid and flat."""
    shapes = table.frame.geometry.to_numpy()[rows[table.area[rows]]]
    if len(shapes) == 0:
        raise NoAreaError(f"{_described(table, int(rows[0]))} is no polygon")
    polygons = [part for shape in shapely.force_2d(shapes) for part in polygons_of(shape)]
    known = np.isfinite(shapely.get_coordinates(polygons)).all()
    polygon = _areas(shapely.union_all([_valid(part) for part in polygons])) if known else shapely.Polygon()
    if shapely.is_empty(polygon):
        raise InputError(f"{path}: its polygon is empty or has coordinates that are no numbers")
    kinds = [part.geom_type for shape in shapes for part in parts_of(shape) if not isinstance(part, shapely.Polygon)]
    beside = ", ".join(f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds)))
    remarks = {
        f"of the boundary only polygons count, not what stands beside them ({beside})": bool(kinds),
        "the boundary's outline crosses itself: is all of the parcel within it?": any(map(_crosses, polygons)),
    }
    return Parcel((polygon, table.frame.crs), tuple(remark for remark, holds in remarks.items() if holds))


def _valid(polygon: shapely.Polygon) -> shapely.Geometry:
    """What a polygon's outlines go round, without spikes."""
    if polygon.is_valid:
        return polygon
    return shapely.make_valid(polygon, method="structure", keep_collapsed=False)


def _crosses(polygon: shapely.Polygon) -> bool:
    """Whether an outline crosses itself, so that what is inside isn't clear; spikes do no harm."""
    if not shapely.is_valid_reason(polygon).startswith("Self-intersection"):
        return False
    inside = polygons_of(_valid(polygon))
    otherwise = polygons_of(shapely.make_valid(polygon))
    return len(inside) > 1 or not np.isclose(shapely.area(inside).sum(), shapely.area(otherwise).sum(), rtol=1e-6)


def _areas(geometry: shapely.Geometry) -> shapely.Geometry:
    """The polygons of a geometry, without points and lines, such as are left of spikes and double edges."""
    areas = polygons_of(geometry)
    return geometry if len(areas) == len(parts_of(geometry)) else shapely.union_all(areas)


def _described(table: _Table, row: int) -> str:
    """What a row is, in words."""
    kind = kind_of(table.frame.geometry[row])
    words = (words[row] for name, words in table.columns.items() if name.lower() in WORDS)
    return next((f"{kind} {word!r}" for word in words if isinstance(word, str)), kind)


def _read_table(path: Path, *, local: bool = False) -> _Table:
    frame = read_layers(path, partial(_polygon_layers, path), "polygons", local=local)
    area = np.array([bool(polygons_of(shape)) for shape in frame.geometry])
    if not area.any():
        raise InputError(f"{path}: holds no polygon")
    columns = {str(name): words_of(frame[name]) for name in frame.columns if name != frame.geometry.name}
    ranks = {
        name: _rank(name, words[area], measured=_is_measured(frame[name]))
        for name, words in columns.items()
        if name.lower() not in OF_KML
    }
    usable = min(ranks.values(), default=USELESS) < USELESS
    return _Table(frame, area, {name: columns[name] for name in sorted(ranks, key=ranks.__getitem__)}, usable)


def _rank(column: str, words: pd.Series, *, measured: bool) -> tuple[int, int]:
    """How well a column names polygons: the less, the better."""
    known, column = words.dropna(), column.lower()
    filled = len(known) / len(words)
    kinds = [(WORDS, 1.0), (WORDS, HALF), (NUMBERS, 1.0)]
    if known.is_unique:
        for rank, (names, least) in enumerate(kinds):
            if column in names and filled >= least:
                return rank, names.index(column)
        if filled == 1.0 and not measured:
            called = all(len(word) <= LONGEST_WORD and any(map(str.isalpha, word)) for word in known)
            return len(kinds) + (not called), 0
    likely = (WORDS + NUMBERS).index(column) if column in WORDS + NUMBERS else 8
    return USELESS[0], likely


def _is_measured(column: pd.Series) -> bool:
    """Whether a column holds areas and the like, or times, which name nothing."""
    kind = column.dtype.kind
    return kind == "M" or (kind == "f" and bool((column.dropna() % 1 != 0).any()))


def _polygon_layers(path: Path, layers: Sequence[Layer]) -> Sequence[Layer]:
    """The only layer of polygons of a file, or its layer ``parcel`` or ``parcels``; of KML all."""
    if path.suffix.lower() in KML:
        return layers
    sure = [layer for layer in layers if any(word in layer.kind for word in AREAS)]
    open_ = [layer for layer in layers if layer not in sure and not any(word in layer.kind for word in OTHERS)]
    if len(sure) + len(open_) > 1:
        open_ = [layer for layer in open_ if any(map(polygons_of, layer.read().geometry))]
    found = sure + open_ or layers
    named = [layer for layer in found if layer.name.lower() in PARCEL_LAYERS]
    if len(found) > 1 and len(named) != 1:
        names = ", ".join(layer.name for layer in found)
        raise InputError(f"{path}: has several layers of polygons ({names}): save the parcels' alone")
    return named or found[:1]


def boundary_in(boundary: Boundary, target: CRS, path: PurePath) -> shapely.Geometry:
    """A boundary's polygon in the CRS to which a file is brought.

    Raises
    ------
    InputError
        If it can't be brought there.
    """
    polygon = project(*boundary, target)
    if not np.isfinite(shapely.bounds(polygon)).all():
        outline, crs = boundary
        x, y = shapely.get_coordinates(outline)[0].tolist()
        check_place(crs, x, y, "the boundary", remedy="save it with its CRS")
        raise InputError(f"the boundary can't be brought to {target.name}, the CRS of {path}: check its CRS")
    return polygon
