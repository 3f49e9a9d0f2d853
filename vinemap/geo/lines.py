"""Known rows in people's files, as lines or posts, shared out among parcels."""

from __future__ import annotations

import hashlib
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from vinemap.errors import InputError
from vinemap.geo.crs import project
from vinemap.geo.layers import KML, Layer, kind_of, parts_of, read_layers, some_of, words_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray
    from pyproj import CRS
    from shapely.geometry.base import BaseGeometry

    from vinemap.compute.arrays import Floats
    from vinemap.geo.boundaries import Boundary

ROW_LAYER = "rows"
NUMBERS, NAMES = ("row_id", "row"), ("label", "name")
"""Columns that number known rows, and that name them, the likeliest first."""
POSTS = (*NUMBERS, *NAMES, "code")
"""Columns that may tell to which row a post belongs."""
LAST_NUMBER = 65_535
"""The greatest number of a row."""
INSIDE = 0.5
"""Share of its length with which a line belongs to a parcel."""
Row = shapely.LineString | str | None
"""A line, or in words what there is instead, if it ought to be one."""


class KnownRows(NamedTuple):
    """Rows that somebody knows, and what is to be known of them: a sentence each."""

    lines: gpd.GeoDataFrame
    """LineString in plan, from e1 to en, with ``row_id`` and ``label``, in the order of the file."""
    remarks: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """What tells where they are from others."""
        shapes = b"".join(shapely.to_wkb(self.lines.geometry.to_numpy()))
        return hashlib.sha256(self.lines.crs.to_string().encode() + shapes).hexdigest()


def read_rows(path: Path, *, crs: CRS | None = None, local: bool = False) -> KnownRows:
    """Read known rows: lines, or else posts, two or more of one name for a row, the first at e1.

    Parameters
    ----------
    path : Path
        GeoPackage, GeoJSON, KML, KMZ, DXF or Shapefile, or a ``.zip`` with one. What counts is its layer ``rows``, or
        else the only one of lines, or of points; of KML all layers do.
    crs : CRS, optional
        CRS of the coordinates where the file states none, as DXF never does.
    local : bool
        Whether coordinates are local, and need no CRS.

    Returns
    -------
    KnownRows
        With ``row_id`` and ``label`` as they are given, missing where they aren't; :func:`rows_of` gives them to all.

    Raises
    ------
    InputError
        If the file can't be read, has no CRS or no row, or more than one layer that may be meant.
    """
    table = read_layers(path, partial(_row_layers, path), "rows", drawn=True, crs=crs, local=local)
    table = abreast_apart(table).reset_index(drop=True)
    lines = [_as_row(shape) for shape in table.geometry]
    if path.suffix.lower() == ".dxf":
        of = table["Layer"].astype(str).where([isinstance(line, shapely.LineString) for line in lines])
        drawn = [Layer(str(path), name, "LineString") for name in dict.fromkeys(of.dropna())]
        chosen = [layer.name for layer in _row_layers(path, drawn)]
        lines = [line if name in chosen else None for name, line in zip(of, lines, strict=True)]
    told = table.drop(columns=table.geometry.name)
    columns = {str(name).lower().replace(" ", "_"): words_of(told[name]) for name in told}
    if any(isinstance(line, shapely.LineString) for line in lines):
        names = _named(columns, list(range(len(lines))))
    else:
        names, lines = _rows_of_posts(table, columns, path)
    lines = _once(lines)
    kept = [isinstance(line, shapely.LineString) for line in lines]
    others = [(k, what) for k, what in enumerate(lines) if isinstance(what, str)]
    left = [f"{what} {word!r}" if isinstance(word := names["label"][k], str) else what for k, what in others]
    remarks = (f"{path.name} holds what is no row, and is left out: {some_of(left)}",) if left else ()
    shapes = gpd.GeoSeries([line for line, is_row in zip(lines, kept, strict=True) if is_row], crs=table.crs)
    return KnownRows(gpd.GeoDataFrame(names.loc[kept].reset_index(drop=True), geometry=shapes), remarks)


def _row_layers(path: Path, layers: Sequence[Layer]) -> Sequence[Layer]:
    """Layers of a file that hold rows."""
    kml = path.suffix.lower() in KML
    named = [layer for layer in layers if layer.name.lower() == ROW_LAYER]
    if named or kml or len(layers) < 2:
        return (named if kml else named[:1]) or layers
    for shape in ("LineString", "Point"):
        found = [layer for layer in layers if shape in layer.kind]
        if len(found) == 1:
            return found
    names = ", ".join(layer.name for layer in layers)
    raise InputError(f"{path}: any of its layers may be meant ({names}): name that of the rows {ROW_LAYER}")


def as_rows(shapes: Sequence[BaseGeometry | None]) -> list[Row]:
    """Lines of rows in plan, each once, or what there is instead of one, in words."""
    given = np.array([*shapes, None], dtype=object)[:-1]
    plain = (shapely.get_type_id(given) == shapely.GeometryType.LINESTRING) & shapely.is_simple(given)
    plain &= (shapely.length(given) > 0) & np.isfinite(shapely.length(given)) & ~shapely.is_closed(given)
    flat = shapely.remove_repeated_points(shapely.force_2d(given))
    return _once([line if is_row else _as_row(line) for line, is_row in zip(flat.tolist(), plain, strict=True)])


def _as_row(shape: BaseGeometry | None) -> Row:
    """The line of a row in plan, or what there is instead, in words."""
    parts = [shapely.force_2d(p) for p in parts_of(shape) if isinstance(p, shapely.LineString) and not p.is_empty]
    if not parts or _are_abreast(shape):
        return "a line of parts side by side" if parts else kind_of(shape)
    if not all(np.isfinite(shapely.get_coordinates(part)).all() for part in parts):
        return "a line with coordinates that are no numbers"
    line = shapely.remove_repeated_points(joined(parts))
    if line.length == 0:
        return "a line of no length"
    return line if line.is_simple and not line.is_closed else "a line that crosses itself"


def _are_abreast(shape: BaseGeometry | None) -> bool:
    """Whether a line has parts side by side, which are rows of their own, rather than one after the other."""
    parts = shapely.get_parts(shape if isinstance(shape, shapely.MultiLineString) else None)
    longest = max(parts, key=shapely.length, default=shapely.LineString())
    place = shapely.line_locate_point(longest, shapely.line_interpolate_point(parts, 0.5, normalized=True))
    return bool(((place > 0) & (place < longest.length) & (parts != longest)).any())


def abreast_apart(table: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """A table of lines in which parts side by side are lines of their own."""
    shapes = [shapely.get_parts(shape) if _are_abreast(shape) else [shape] for shape in table.geometry]
    geometry = [part for parts in shapes for part in parts]
    several = table.iloc[np.repeat(np.arange(len(shapes)), [len(parts) for parts in shapes])]
    return several.set_geometry(gpd.GeoSeries(geometry, index=several.index, crs=table.crs))


def joined(parts: Sequence[shapely.LineString]) -> shapely.LineString:
    """Parts of a line, one after the other in whatever order they come, in the sense of the first one."""
    found, *left = (shapely.get_coordinates(part, include_z=part.has_z) for part in parts)
    while left:
        ways = [np.hypot(*(xy[e] - found[f])[:2]) for xy in left for f, e in ((-1, 0), (-1, -1), (0, 0), (0, -1))]
        k, way = divmod(int(np.argmin(ways)), 4)
        xy = left.pop(k)[:: 1 if way in (0, 3) else -1]
        found = np.concatenate([found, xy] if way < 2 else [xy, found])
    return shapely.LineString(found)


def _once(lines: Sequence[Row]) -> list[Row]:
    """Lines, but for those that are there a second time, whichever way they run."""
    seen: set[bytes] = set()
    out: list[Row] = []
    for line in lines:
        course = shapely.to_wkb(shapely.normalize(line)) if isinstance(line, shapely.LineString) else b""
        out.append("a line that is there twice" if course in seen else line)
        seen |= {course} - {b""}
    return out


def _named(columns: Mapping[str, pd.Series], places: list[int]) -> pd.DataFrame:
    """Numbers and names that columns of words give rows at some places, missing where they don't."""
    columns = {name: words.iloc[places].reset_index(drop=True) for name, words in columns.items()}
    none = pd.Series([None] * len(places), dtype=object)
    numbers, names = (
        next((columns[name] for name in known if name in columns and columns[name].notna().any()), none)
        for known in (NUMBERS, NAMES)
    )
    names = names.where(names.notna(), numbers.where(~numbers.map(_is_number), None))
    numbers = numbers if numbers.map(_is_number).any() else names
    number = pd.Series([int(word) if _is_number(word) else None for word in numbers], dtype="Int64")
    return pd.DataFrame({"row_id": number, "label": names.where(names.notna(), None)})


def _is_number(word: object) -> bool:
    """Whether a word is a number that a row can have."""
    return isinstance(word, str) and word.isdecimal() and len(word) < 20 and 0 < int(word) <= LAST_NUMBER


def _rows_of_posts(
    table: gpd.GeoDataFrame, columns: Mapping[str, pd.Series], path: Path
) -> tuple[pd.DataFrame, list[Row]]:
    """Rows from posts of one name, with their numbers and names."""
    points = [[(part.x, part.y) for part in parts_of(s) if isinstance(part, shapely.Point)] for s in table.geometry]
    for words in (columns[name] for name in POSTS if name in columns):
        rows = [[int(k) for k in same.index] for _, same in words.groupby(words, sort=False)]
        lines = [_through(np.array([xy for k in row for xy in points[k]]).reshape(-1, 2)) for row in rows]
        if any(isinstance(line, shapely.LineString) for line in lines):
            return _named(columns, [row[0] for row in rows]), lines
    there = some_of([*dict.fromkeys(str(_as_row(shape)) for shape in table.geometry)]) or "nothing"
    raise InputError(
        f"{path}: holds no line, and no two points of one name, but {there}: give the first and last post of a row its "
        "name, in a column 'row'"
    )


def _through(posts: Floats) -> Row:
    """The line through a row's posts (n, 2), from the end at which the first one stands."""
    posts = posts[np.isfinite(posts).all(axis=1)]
    if len(np.unique(posts, axis=0)) < 2:
        return "a single post"
    far = posts[np.hypot(*(posts - posts[0]).T).argmax()]
    way = far - posts[np.hypot(*(posts - far).T).argmax()]
    place = posts @ way
    return shapely.LineString(posts[np.argsort(place if place[0] <= np.median(place) else -place, kind="stable")])


def rows_of(known: KnownRows, parcels: Mapping[str, Boundary | None]) -> tuple[dict[str, KnownRows], list[str]]:
    """Known rows of each parcel in which there are some, and what those are called that lie in none.

    A line belongs to the parcels that hold half of it. If a column ``parcel`` names one of them, it is that one's
    alone, and where nothing bounds a parcel, its name decides. Rows without a number of their own get the next ones,
    and rows without a name are called after their number and the parcel.

    Parameters
    ----------
    known : KnownRows
        As read.
    parcels : mapping of str to Boundary
        By their names; None is everywhere.

    Raises
    ------
    InputError
        If nothing leads from the lines' CRS to a boundary's.
    """
    found, homeless = {}, np.ones(len(known.lines), dtype=bool)
    held: dict[str, NDArray[np.intp]] = {}
    owners = known.lines["parcel"].to_numpy() if "parcel" in known.lines else None
    brought: dict[CRS, shapely.STRtree] = {}
    for name, boundary in parcels.items():
        if not boundary:
            inside = np.arange(len(known.lines)) if owners is None else np.flatnonzero(owners == name)
        else:
            polygon, crs = boundary
            if crs not in brought:
                brought[crs] = shapely.STRtree(project(known.lines.geometry.to_numpy(), known.lines.crs, crs))
            tree = brought[crs]
            near = np.sort(tree.query(polygon, predicate="intersects"))
            within = shapely.length(shapely.intersection(tree.geometries[near], polygon))
            inside = near[within >= INSIDE * shapely.length(tree.geometries[near])]
        homeless[inside] = False
        held[name] = inside
    for name, inside in held.items():
        named = [name] * len(inside) if owners is None else owners[inside]
        places = zip(inside.tolist(), named, strict=True)
        if own := [k for k, owner in places if owner == name or k not in held.get(owner, ())]:
            found[name] = _complete(known.lines.iloc[own].reset_index(drop=True), name, known.remarks)
    return found, _called(known.lines, np.flatnonzero(homeless).tolist())


def _called(lines: gpd.GeoDataFrame, places: Sequence[int]) -> list[str]:
    """What lines are called: by their names, their numbers, or their places in the file."""
    numbers, labels = lines["row_id"].tolist(), lines["label"].tolist()
    return [labels[k] or (f"line {k + 1}" if pd.isna(numbers[k]) else str(numbers[k])) for k in places]


def _complete(lines: gpd.GeoDataFrame, parcel: str, remarks: tuple[str, ...]) -> KnownRows:
    """Lines with a number and a name of its own each, and which ones had none."""
    given = lines["row_id"].where(~lines["row_id"].duplicated())
    used = set(given.dropna())
    after = max(used, default=0) + 1
    free = (n for n in count(after if after + len(lines) <= LAST_NUMBER else 1) if n not in used)
    numbers = [next(free) if pd.isna(number) else int(number) for number in given]
    labels: dict[str, bool] = {}
    for number, name in zip(numbers, lines["label"], strict=True):
        wanted = name or f"{number} {parcel}"
        ways = (wanted if k == 1 else f"{wanted} ({k})" for k in count(1))
        label = next(way for way in ways if way not in labels)
        labels[label] = label == name
    names = list(labels)
    odd = [name for name, number in zip(names, given, strict=True) if pd.isna(number)]
    if used and odd:
        remarks += (f"{len(odd)} known rows have no number of their own, and get the next ones: {some_of(odd)}",)
    odd = [name for name, own in labels.items() if not own]
    if lines["label"].notna().any() and odd:
        remarks += (f"{len(odd)} known rows have no name of their own, and are called {some_of(odd)}",)
    return KnownRows(lines.assign(row_id=numbers, label=names), remarks)
