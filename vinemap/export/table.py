"""Tables of rows and vines over many parcels and dates, as CSV and Parquet, with what their columns are beside them.

Tidy: a line a row (or vine) and date, a column a quantity (Wickham 2014, https://doi.org/10.18637/jss.v059.i10).
Columns are described by a Data Package: https://specs.frictionlessdata.io/tabular-data-package/.
"""

from __future__ import annotations

import json
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import pandas as pd
import shapely

from vinemap import naming, paths
from vinemap.compute.threads import in_threads
from vinemap.errors import InputError
from vinemap.evaluate.changes import follow_rows
from vinemap.export.field import read_layers
from vinemap.geo.crs import WGS84, is_local
from vinemap.product.layers import REAL, TEXT, WHOLE
from vinemap.product.seasons.products import Product, read_product, read_record, same_places, shift_between

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import geopandas as gpd

    from vinemap.compute.arrays import Floats

DATE = "date"


class Column(NamedTuple):
    """A column of a table: its type, its unit ("1" where it is a share), decimals, and what it is."""

    kind: str
    unit: str | None
    digits: int
    description: str


def _real(unit: str, digits: int, description: str) -> Column:
    return Column(REAL, unit, digits, description)


def _whole(description: str) -> Column:
    return Column(WHOLE, None, 0, description)


def _text(description: str) -> Column:
    return Column(TEXT, None, 0, description)


KEYS = {
    "survey": _text("Name of the survey; the parcel's where it was mapped alone"),
    "date": Column(DATE, None, 0, "Day of the flight (UTC), as the cloud's header states it"),
    "parcel": _text("Name of the parcel in that survey"),
    "row": _text(
        "The vine row itself, the same on all dates: its label at the last of them, with a date where it is gone since"
    ),
    "label": _text("Number of the row and name of the parcel at that date"),
    "turned": _whole("1 where e1, from which vines are counted, is the other end than at the row's last date, else 0"),
}
"""What tells lines from one another."""
ROWS = KEYS | {
    "row_id": _whole("Number of the row at that date"),
    "block": _whole("Number of the block of one direction and spacing"),
    "length_m": _real("m", 3, "Length along the curve, 3D"),
    "orientation_deg": _real("deg", 2, "Mean direction, anticlockwise from true east"),
    "elevation_m": _real("m", 3, "Mean elevation of the ground along the row"),
    "elevation_diff_m": _real("m", 3, "Elevation of end en less that of e1"),
    "spacing_m": _real("m", 3, "Distance to its neighbours"),
    "height_m": _real("m", 3, "Height of the canopy above ground"),
    "bottom_m": _real("m", 3, "Height above ground at which foliage begins"),
    "width_m": _real("m", 3, "Width of the canopy"),
    "volume_m3": _real("m3", 3, "Volume of the foliage"),
    "trv_m3_ha": _real("m3/ha", 1, "Tree-row volume: height x width x 10,000 / spacing"),
    "lwa_m2_ha": _real("m2/ha", 1, "Leaf-wall area: both sides of the wall, on a hectare"),
    "gap_m": _real("m", 3, "Length of its gaps, as far as it was seen"),
    "n_missing": _whole("Vines missing in it, as far as it was seen"),
    "unseen_m": _real("m", 3, "Length of which the cloud shows nothing: neither canopy nor gap"),
    "support": _real("1", 4, "Share of its length that has canopy, as far as it was seen"),
    "confidence": _real("1", 4, "How sure it is a whole row, 0 to 1"),
    "canopy_confidence": _real("1", 4, "How far to trust height, width and volume, 0 to 1"),
    "mesh_error_m": _real("m", 3, "How far the foliage's surface lies from the row's mesh, as its points tell"),
    "flags": _text("What is odd beside its neighbours; nothing where nothing is"),
    "e1_lat": _real("deg", 9, "Latitude of end e1, the western one, or a known row's first (WGS 84)"),
    "e1_lon": _real("deg", 9, "Longitude of end e1 (WGS 84)"),
    "en_lat": _real("deg", 9, "Latitude of end en (WGS 84)"),
    "en_lon": _real("deg", 9, "Longitude of end en (WGS 84)"),
}
VINES = KEYS | {
    "row_id": _whole("Number of the row at that date"),
    "number": _whole("Number of the vine in its row, from e1, missing ones counted"),
    "position_m": _real("m", 3, "Where along the row it stands, from e1"),
    "state": _text("vine, missing, weak, or unseen"),
    "height_m": _real("m", 3, "Height above ground of its stretch of canopy"),
    "width_m": _real("m", 3, "Width of its stretch of canopy"),
    "volume_m3": _real("m3", 4, "Volume of the foliage of its stretch"),
    "position_sd_m": _real("m", 3, "Standard deviation of its position along the row"),
    "lat": _real("deg", 9, "Latitude (WGS 84)"),
    "lon": _real("deg", 9, "Longitude (WGS 84)"),
}
TABLES = {"rows": ROWS, "vines": VINES}
KEY = {"rows": ["survey", "date", "parcel", "label"], "vines": ["survey", "date", "parcel", "label", "number"]}
TYPES = {TEXT: "string", DATE: "date", WHOLE: "integer", REAL: "number"}
"""Types of a table's schema."""


class Tables(NamedTuple):
    """Tables by name, and the products they are of."""

    tables: dict[str, pd.DataFrame]
    products: list[dict[str, Any]]

    def told(self) -> str:
        """What is in them, in words."""
        lines = ", ".join(f"{len(table):,} lines of {name}" for name, table in self.tables.items())
        kinds = "csv, parquet" if find_spec("pyarrow") else "csv; Parquet needs pyarrow: pip install 'vinemap[parquet]'"
        return f"table: {lines} ({kinds})"


class _Flight(NamedTuple):
    """What is read of a product, which shows a parcel on one date."""

    about: dict[str, Any]
    """``survey``, ``flown``, ``parcel``, and its ``key``."""
    place: Product | None
    rows: gpd.GeoDataFrame
    vines: gpd.GeoDataFrame | None


def read_tables(products: Sequence[Path]) -> Tables:
    """Read the rows of products, and their vines where they have such a layer, into one table each.

    Rows are followed from date to date by where they stand, see :func:`vinemap.evaluate.changes.follow_rows`.

    Parameters
    ----------
    products : sequence of Path
        Folders or GeoPackages; one that is given twice counts once.

    Raises
    ------
    InputError
        If one is no whole product, or two are of one parcel, survey and date.
    """
    known = dict(map(_folder_and_record, products))
    read = in_threads(lambda one: _read(*one), known.values())
    seen: dict[tuple[str, ...], Path] = {}
    for folder, one in zip(known, read, strict=True):
        key = one.about["survey"], one.about["flown"], one.about["parcel"]
        if key in seen:
            raise InputError(
                f"{naming.shown(folder)} and {naming.shown(seen[key])}: both are {key[2]} of {key[0]}, "
                f"flown on {key[1]}: leave one out"
            )
        seen[key] = folder
    placed = [(one, one.place) for one in read if one.place]
    groups = [[placed[k][0] for k in group] for group in same_places([place for _, place in placed])]
    groups += [[one] for one in read if not one.place]
    parts: dict[str, list[pd.DataFrame]] = {"rows": [], "vines": []}
    for flights, named in zip(groups, in_threads(_follow, groups), strict=True):
        for one, followed in zip(flights, named, strict=True):
            parts["rows"].append(_lines(one.about, one.rows, followed, ROWS))
            if one.vines is not None:
                own = followed.set_axis(one.rows["label"])
                own = own[~own.index.duplicated(keep="last")].reindex(one.vines["label"])
                parts["vines"].append(_lines(one.about, one.vines, own, VINES))
    tables = {name: _sorted(pd.concat(found, ignore_index=True), name) for name, found in parts.items() if found}
    return Tables(tables, sorted((one.about for one in read), key=lambda about: tuple(about.values())))


def _folder_and_record(product: Path) -> tuple[Path, tuple[Path, dict[str, Any]]]:
    folder, record = read_record(product)
    return folder.resolve(), (folder, record)


def _read(folder: Path, record: dict[str, Any]) -> _Flight:
    parcel = record["parcel"]
    path = paths.geopackage(folder, parcel)
    rows, layers = read_layers(path, wanted=["vines"])
    vines = layers.get("vines")
    if vines is not None and not is_local(vines.crs):
        places = vines.geometry.to_crs(WGS84)
        vines = vines.assign(lat=places.y, lon=places.x)
    about = {
        "survey": str(record.get("survey") or parcel),
        "flown": str(record.get("flown") or "")[:10],
        "parcel": parcel,
        "key": str(record.get("key")),
    }
    return _Flight(about, None if is_local(rows.crs) else read_product(folder), rows, vines)


def _follow(flights: Sequence[_Flight]) -> list[pd.DataFrame]:
    """For the rows of each flight of a parcel, the latest first, ``row``, the same where a row is, and ``turned``."""
    names: dict[int, str] = {}
    ways: dict[int, Floats] = {}
    found = []
    places = [one.place for one in flights]
    shifts = [shift_between(places[0], one) if places[0] and one else None for one in places[1:]]
    for one, numbers in zip(flights, follow_rows([one.rows for one in flights], shifts=shifts), strict=True):
        since = "" if one is flights[0] else f" ({one.about['flown']})"
        lines = one.rows.geometry.to_crs(flights[0].rows.crs)
        turned = []
        for number, label, line in zip(numbers.tolist(), one.rows["label"], lines, strict=True):
            names.setdefault(number, f"{label}{since}")
            xy = shapely.get_coordinates(line)
            turned.append(int((xy[-1] - xy[0]) @ ways.setdefault(number, xy[-1] - xy[0]) < 0))
        found.append(pd.DataFrame({"row": [names[number] for number in numbers.tolist()], "turned": turned}))
    return found


def _lines(
    about: dict[str, Any], table: gpd.GeoDataFrame, followed: pd.DataFrame, columns: dict[str, Column]
) -> pd.DataFrame:
    """Lines of a product with the columns of a table; those that it hasn't are empty."""
    given = {"survey": about["survey"], "date": about["flown"], "parcel": about["parcel"]}
    given |= {name: followed[name].to_numpy() for name in ("row", "turned")}
    whole = table.drop(columns="geometry").assign(**given).reindex(columns=list(columns))
    for name, column in columns.items():
        if column.kind == REAL:
            whole[name] = whole[name].astype(float).round(column.digits)
        elif column.kind == WHOLE:
            whole[name] = whole[name].astype("Int64")
    return pd.DataFrame(whole)


def _sorted(table: pd.DataFrame, name: str) -> pd.DataFrame:
    by = ["date", "survey", "parcel", "row_id", *(["number"] if name == "vines" else [])]
    return table.sort_values(by, kind="stable", ignore_index=True)


def write_tables(found: Tables, folder: Path) -> None:
    """Write each table as CSV, and as Parquet where pyarrow is installed, and what their columns are.

    Raises
    ------
    OSError
        If one can't be written.
    """
    files = {name: paths.exported_table(folder, name, "csv") for name in found.tables}
    for name, table in found.tables.items():
        table.to_csv(files[name], index=False, lineterminator="\n", encoding="utf-8")
        if find_spec("pyarrow"):
            _write_parquet(table, TABLES[name], paths.exported_table(folder, name, "parquet"))
    text = json.dumps(_data_package(files), indent=2, ensure_ascii=False)
    paths.data_package(folder).write_text(text + "\n", encoding="utf-8")


def _data_package(files: dict[str, Path]) -> dict[str, Any]:
    """Descriptor of a Data Package of some tables: for each its file, its columns with type and unit, and its key."""
    resources = [
        {
            "name": name,
            "path": path.name,
            "profile": "tabular-data-resource",
            "format": "csv",
            "mediatype": "text/csv",
            "encoding": "utf-8",
            "schema": {
                "fields": [_field(column, known) for column, known in TABLES[name].items()],
                "missingValues": [""],
                "primaryKey": KEY[name],
            },
        }
        for name, path in files.items()
    ]
    return {"profile": "tabular-data-package", "name": "vinemap", "title": "Vine rows by date", "resources": resources}


def _field(name: str, column: Column) -> dict[str, str]:
    unit = {"unit": column.unit} if column.unit else {}
    return {"name": name, "type": TYPES[column.kind], **unit, "description": column.description}


def _write_parquet(table: pd.DataFrame, columns: dict[str, Column], path: Path) -> None:
    """Write a table with its types, and unit and description of each column among its field's metadata."""
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {TEXT: pa.string(), DATE: pa.date32(), WHOLE: pa.int64(), REAL: pa.float64()}
    fields = [
        pa.field(name, kinds[one.kind], metadata={"unit": one.unit or "", "description": one.description})
        for name, one in columns.items()
    ]
    dates = pd.to_datetime(table["date"]).dt.date
    parquet.write_table(
        pa.Table.from_pandas(table.assign(date=dates), schema=pa.schema(fields), preserve_index=False), path
    )
