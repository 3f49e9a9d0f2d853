"""Products in the formats that were asked for, each in a folder of its own."""

from __future__ import annotations

import json
from functools import partial
from typing import TYPE_CHECKING, Any

from pyogrio.errors import DataLayerError, DataSourceError, FeatureError

from vinemap import __version__, naming, paths
from vinemap.errors import EmptyError, InputError, reason_of
from vinemap.export import MESHES, TABLE
from vinemap.export.agopengps import write_agopengps
from vinemap.export.field import read_field
from vinemap.export.gazebo import write_gazebo
from vinemap.export.isoxml import write_isoxml
from vinemap.export.meshes import write_canopy
from vinemap.export.nav2 import write_nav2
from vinemap.export.opennav_coverage import write_opennav_coverage
from vinemap.export.table import read_tables, write_tables
from vinemap.export.vector import write_geojson, write_shapefile
from vinemap.product import store
from vinemap.product.seasons.products import products_of, whose

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from vinemap.export.field import Field


def export_products(
    products: Sequence[Path],
    out: Path,
    *,
    formats: Sequence[str],
    lines: str = "lanes",
    headland: float = 3.0,
    outer: bool = False,
    frame: str = "map",
    grid: bool = False,
    vertices: int | None = None,
) -> Iterator[str]:
    """Write products into ``out/<parcel>/<format>``, each whole or not at all, and say so in a line for each parcel.

    The table of all of them goes into ``out/table``. An earlier export is replaced; other files in its folder stay. One
    of several that has nothing to export costs the others nothing: it is named at the end.

    Parameters
    ----------
    products : sequence of Path
        Folders or GeoPackages of products, or folders of surveys; all are read before the first is written.
    out : Path
        Folder of the parcels' folders.
    formats : sequence of str
        Of :data:`vinemap.export.FORMATS`.
    lines : str
        What guidance is written of: "lanes", "rows" or "both".
    headland, outer, vertices
        As for :func:`vinemap.export.lanes.lanes_between`; rows for opennav_coverage have as many vertices, too.
    frame, grid
        As for :func:`vinemap.export.opennav_coverage.write_opennav_coverage`.

    Raises
    ------
    InputError
        If one is no product, or bears the name of another; at the end, if one has nothing to export.
    OutputError
        If nothing can be written there.
    """
    if "nav2" in formats and lines == "rows":
        raise InputError("nav2 needs lanes: leave --lines rows out, or name the other formats")
    products = [one for given in products for one in products_of(given)]
    of_parcels = [kind for kind in formats if kind != TABLE]
    wanted = lines if set(of_parcels) - set(MESHES) else "rows"
    drawn: dict[str, Any] = {"headland": headland, "outer": outer, "vertices": vertices}
    fields, empty = [], []
    for product in products if of_parcels else ():
        try:
            fields.append(read_field(product, lines=wanted, **drawn))
        except EmptyError as error:
            empty.append(str(error))
    if empty and not fields:
        raise InputError("; ".join(empty))
    names = [naming.safe(field.parcel) for field in fields]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"several products are called {', '.join(twice)}: export them one by one, each with its --out")
    tables = read_tables(products) if TABLE in formats else None
    writers = _writers(lines=lines, frame=frame, grid=grid, vertices=vertices)
    for field in fields:
        targets = [paths.export_folder(out, field.parcel, kind) for kind in of_parcels]
        others = {known[1] for target in targets if (known := whose(target))} - {field.survey}
        for kind, target in zip(of_parcels, targets, strict=True):
            write, options = writers[kind]
            _write_whole(
                target, partial(write, field, **options), _record(field, kind, {"lines": lines} | drawn | options)
            )
        lanes = f", {len(field.lanes)} lanes" if wanted != "rows" else ""
        place = naming.shown(paths.parcel_folder(out, field.parcel))
        told = f"; it replaces that of the survey {', '.join(sorted(others))}" if others else ""
        yield f"{field.parcel}: {len(field.rows)} rows{lanes} → {place} ({', '.join(of_parcels)}){told}"
    if tables:
        target = paths.table_folder(out)
        record = {"vinemap": __version__, "format": TABLE, "products": tables.products}
        _write_whole(target, partial(write_tables, tables), record)
        yield f"{tables.told()} → {naming.shown(target)}"
    if empty:
        raise InputError("; ".join(empty))


def _writers(
    *, lines: str, frame: str, grid: bool, vertices: int | None
) -> dict[str, tuple[Callable[..., None], dict[str, Any]]]:
    """What writes a parcel in each format, and with which of the options."""
    robot: dict[str, Any] = {"frame": frame, "grid": grid}
    return {
        "agopengps": (write_agopengps, {"lines": lines}),
        "gazebo": (write_gazebo, {}),
        "geojson": (write_geojson, {}),
        "isoxml": (write_isoxml, {"lines": lines}),
        "nav2": (write_nav2, robot),
        "obj": (write_canopy, {"kind": "obj", "grid": grid}),
        "opennav_coverage": (write_opennav_coverage, robot | {"vertices": vertices}),
        "ply": (write_canopy, {"kind": "ply", "grid": grid}),
        "shapefile": (write_shapefile, {}),
    }


def _write_whole(target: Path, write: Callable[[Path], None], record: dict[str, Any]) -> None:
    with store.product(target, within=target.parent) as draft:
        try:
            write(draft)
        except (DataSourceError, DataLayerError, FeatureError) as error:
            raise OSError(reason_of(error)) from error
        record["files"] = sorted(path.relative_to(draft).as_posix() for path in draft.rglob("*") if path.is_file())
        paths.run_record(draft).write_text(json.dumps(record, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def _record(field: Field, kind: str, options: dict[str, Any]) -> dict[str, Any]:
    return {
        "vinemap": __version__,
        "survey": field.survey,
        "parcel": field.parcel,
        "product": field.key,
        "format": kind,
        "options": options,
        "origin": field.origin._asdict(),
        "crs": field.rows.crs.to_string(),
    }
