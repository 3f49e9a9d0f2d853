"""A season of an estate: flights that are shifted and noisy, vines that grow, are grubbed up and planted, one register.

``python -m vinemap.measure.season --out build/season``
"""

from __future__ import annotations

from datetime import date, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import click
import geopandas as gpd
import numpy as np
import pyogrio
import shapely

from vinemap import paths
from vinemap.config.surveys import SurveyConfig, survey_config
from vinemap.evaluate.rows import match_rows
from vinemap.jobs.register import register_products
from vinemap.jobs.survey import map_survey
from vinemap.measure.tables import as_text
from vinemap.parcel import map_parcel
from vinemap.product.json_values import read_object
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.scenes import rows_of
from vinemap.simulate.survey import simulate, write_survey
from vinemap.simulate.terrain import PLACE, hillside

FLIGHTS, FIRST = 12, date(2026, 4, 15)
EVERY = timedelta(days=15)
SHIFT = 0.2
"""Metres by which flights lie aside, each another way."""
GRUBBED, REPLANTED, BARE, PLANTED = 4, 6, 6, 8
"""Flights from which a row of A is no more, D is another planting, and E is bare and planted again."""
HEIGHTS, YOUNG = (0.9, 2.0), 1.1
"""Metres of canopies on the first flight and the last, and of new plantings."""
BARE_FLAGS = "no_canopy|kept"
"""Flags of rows that somebody would look at."""
OTHERS = "they are other rows"
"""What is said of a parcel that may be planted anew."""
SAME = 0.6
"""Metres on either side of a true row within which a row is that."""
Row = tuple[str, str, int]
"""Parcel, planting and number of a true row."""


class Flight(NamedTuple):
    """One of the flights."""

    name: str
    day: date
    config: SurveyConfig
    rows: dict[Row, Any]
    """Lines of what stands, where the flight sees them."""


def standing(flight: int) -> dict[Row, Any]:
    """Rows (n, 2) that stand when an estate is flown, before its shift."""
    x, y = PLACE
    places = {name: (x + 60 * k, y) for k, name in enumerate("ABCDE")}
    plantings = {
        ("A", "old"): rows_of(6, length=24, azimuth=33, centre=places["A"]),
        ("B", "old"): rows_of(5, length=24, radius=60, centre=places["B"]),
        ("C", "old"): rows_of(5, length=22, fan=6, azimuth=100, centre=places["C"]),
        ("D", "old"): rows_of(5, length=20, azimuth=10, centre=places["D"]) if flight < REPLANTED else [],
        ("D", "new"): rows_of(6, length=18, spacing=2.2, azimuth=10, centre=places["D"]) if flight >= REPLANTED else [],
        ("E", "old"): rows_of(5, length=20, azimuth=60, centre=places["E"]) if flight < BARE else [],
        ("E", "new"): rows_of(5, length=20, spacing=2.8, azimuth=60, centre=places["E"]) if flight >= PLANTED else [],
    }
    rows = {(*of, k): line for of, lines in plantings.items() for k, line in enumerate(lines, start=1)}
    return {row: line for row, line in rows.items() if not (flight >= GRUBBED and row == ("A", "old", 3))}


def fly(flight: int, folder: Path) -> Flight:
    """Simulate a flight, as it would be uploaded; the first one's polygons are the estate's."""
    name, day = f"flight {flight:02d}", FIRST + (flight - 1) * EVERY
    turn = 2 * np.pi * flight * 0.381966
    shift = SHIFT * np.array([np.cos(turn), np.sin(turn)]) * (flight > 1)
    rows = {row: np.asarray(line) + shift for row, line in standing(flight).items()}
    height = float(np.interp(flight, (1, FLIGHTS), HEIGHTS))
    x, y = PLACE
    vineyards = []
    for k, parcel in enumerate("ABCDE"):
        mine = {row: line for row, line in rows.items() if row[0] == parcel}
        outline = None if mine else shapely.Point(x + 60 * k, y).buffer(15)
        young = any(planting == "new" for _, planting, _ in mine)
        how: dict[str, Any] = {"height": YOUNG if young else height, "bottom": 0.35, "outline": outline}
        how["gaps"] = (3,) if mine else ()
        vineyards.append(Vineyard(parcel, list(mine.values()), **how))
    survey = simulate(vineyards, hillside(0.1), name="estate", density=200, seed=flight)
    cloud = write_survey(survey, folder / "in" / name, flown=day)
    boundaries = folder / "in" / "flight 01" / "parcels.gpkg"
    register = folder / "register.gpkg"
    config = survey_config(
        survey=name, cloud=cloud, boundaries=boundaries, row_register=register if register.exists() else None
    )
    return Flight(name, day, config, {row: shapely.LineString(line) for row, line in rows.items()})


def products_of(flight: Flight, folder: Path) -> gpd.GeoDataFrame:
    """Rows of a flight's products, with ``parcel``, ``true`` (the true row, or None), and ``gone``, if it seems so."""
    found = []
    for parcel in "ABCDE":
        rows = pyogrio.read_dataframe(paths.geopackage(folder / flight.name / parcel, parcel), layer="rows")
        mine = [row for row in flight.rows if row[0] == parcel]
        true: list[Row | None] = [None] * len(rows)
        pairs = match_rows(rows.geometry.to_numpy(), np.array([flight.rows[row] for row in mine]), width=SAME)
        for j, i in pairs.tolist() if mine and len(rows) else ():
            true[j] = mine[i]
        record = read_object(paths.run_record(folder / flight.name / parcel))
        gone = rows["flags"].str.contains(BARE_FLAGS) | any(OTHERS in said for said in record["warnings"])
        found.append(rows[["label", "geometry"]].assign(parcel=parcel, true=true, gone=gone))
    table: gpd.GeoDataFrame = gpd.pd.concat(found, ignore_index=True)
    return table


def react(flight: Flight, rows: gpd.GeoDataFrame, folder: Path) -> list[str]:
    """Do what a grower does about rows without canopy, and about candidates: what that was."""
    register, products, done = folder / "register.gpkg", folder / "products", []
    for parcel, of in rows.groupby("parcel"):
        lost = of.loc[of["gone"], "label"].tolist()
        if not lost:
            continue
        alone = folder / "alone" / flight.name / str(parcel)
        cloud, boundaries = flight.config.cloud, flight.config.boundaries
        assert isinstance(cloud, Path)  # noqa: S101 - as it was made
        summary = map_parcel(cloud, alone, parcel=str(parcel), boundary=boundaries)
        if len(lost) > len(of) / 2 and summary.rows:
            done += list(register_products([alone], register, how="replace"))
            continue
        table = pyogrio.read_dataframe(register, layer="rows")
        table.loc[table["label"].isin(lost), "grubbed"] = f"{flight.day}"
        pyogrio.write_dataframe(table, register, layer="rows", driver="GPKG")
        done.append(f"{parcel}: {', '.join(lost)} grubbed up in QGIS")
    offered = pyogrio.read_dataframe(register, layer="candidates")
    for parcel in offered["parcel"].unique():
        done += list(register_products([products / flight.name / parcel], register))
    return done


@click.command()
@click.option("--out", type=click.Path(path_type=Path), default=Path("build/season"), help="Folder of what is made.")
def main(out: Path) -> None:
    """Fly, map and register a season, and tell whether every row kept its label and what changes were found."""
    register, products = out / "register.gpkg", out / "products"
    labels: dict[Row, set[str]] = {}
    owners: dict[str, set[Row]] = {}
    lines = [
        ["flight", "rows: true", "measured", "labels: as before", "others", "gone: found", "truly", "falsely", "done"]
    ]
    flights = []
    gone_before: set[Row] = set()
    for k in range(1, FLIGHTS + 1):
        flight = fly(k, out)
        flights.append(flight)
        list(map_survey(flight.config, products / flight.name))
        first = products_of(flight, products)
        bare = first[first["gone"]]
        before = {next(iter(labels[row])): row for row in labels if row not in gone_before}
        lost = {row for row in before.values() if row not in flight.rows}
        found = {before[label] for label in bare["label"] if label in before}
        gone_before |= lost
        if k == 1:
            done = list(register_products([products / flight.name / name for name in "ABCDE"], register))
        else:
            done = react(flight, first, out)
        config = flight.config.model_copy(update={"row_register": register})
        list(map_survey(config, products / flight.name))
        if done and k > 1:  # what was found where there was no row is taken in, or measured again
            react(flight, products_of(flight, products), out)
            list(map_survey(config, products / flight.name))
        rows = products_of(flight, products)
        same = other = 0
        for label, row in zip(rows["label"], rows["true"], strict=True):
            if row is not None:
                ok = labels.get(row, {label}) == {label} and owners.get(label, {row}) == {row}
                same, other = same + ok, other + (not ok)
                labels.setdefault(row, set()).add(label)
                owners.setdefault(label, set()).add(row)
        counts = [len(flight.rows), int(rows["true"].notna().sum()), same, other]
        counts += [len(found & lost), len(lost), len(found - lost)]
        lines.append([f"{k:2d} {flight.day}", *map(str, counts), "; ".join(done)])
        click.echo(as_text([lines[0], lines[-1]]))
    click.echo()
    click.echo(as_text(lines))
    left = [
        f"{flight.name}: {one.line()}"
        for flight in flights
        for one in map_survey(flight.config.model_copy(update={"row_register": register}), products / flight.name)
        if one.state != "up to date"
    ]
    click.echo("\n".join(["", f"not up to date at the end: {len(left)}", *left]))


if __name__ == "__main__":
    main()
