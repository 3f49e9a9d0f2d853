"""Vines one by one: where they stand along their rows, and which are missing, weak or were not seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from vinemap.canopy.numbers import lengths_of
from vinemap.evaluate.planting import Edges, estimate_extent, estimate_spacing, place_vines
from vinemap.evaluate.trunks import known_spacing, with_known
from vinemap.geo.curve import at, tangents
from vinemap.geo.raster import sample_across
from vinemap.rows.standing.canopy import thereabouts
from vinemap.rows.standing.gaps import MISSING, UNSEEN

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Raster

VINE, WEAK = "vine", "weak"
"""States of places where there are vines; those where there is none, or none was seen, are as gaps'."""
CELL = 0.1
"""Metres between the stations along a row at which its cover is looked at."""
AROUND = 2.0
"""Metres, a standard deviation, of the surroundings with which a row's cover is compared."""
BARE, SHORTEST = 0.45, 0.45
"""Share of that cover below which there is no canopy, and metres of it from which its edges tell of vines."""
STRAY = 0.35
"""Metres of canopy below which it is a stray shoot or a weed in a gap."""
MODELLED = 0.6
"""Share of the area of the row's median section that shows canopy, whatever the cover: where rows touch, it is of their
ridges alone."""
EMPTY, CORE = 0.35, 0.3
"""Share of cover below which a vine is missing, and extents to both sides of its place in which it is looked for."""
FEW = 4.0
"""Points that a bare stretch would have, if it were canopy, from which it is one: 1 in 50 has none by chance."""
HALF = 0.5
"""Share of the volume of the block's median vine below which one is weak."""
LEFT = 1.5
"""Times the space that vines of a block usually leave between them, below which such a space is no gap."""


class _Stand(NamedTuple):
    """How a row's canopy stands: its edges, and its cover (stations,) along it as a share of what it is thereabouts."""

    edges: Edges
    cover: Values


def find_vines(
    rows: gpd.GeoDataFrame,
    gaps: gpd.GeoDataFrame,
    sections: gpd.GeoDataFrame,
    cover: Raster,
    *,
    vine_spacing: float | None = None,
    step: float = 0.25,
    known: Mapping[int, Values] | None = None,
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Place the vines of rows, and tell which are missing.

    Parameters
    ----------
    rows : GeoDataFrame
        LineStringZ with ``row_id``, ``block``, ``width_m``, ``gap_m``, ``n_missing`` and ``vine_spacing_m``.
    gaps : GeoDataFrame
        With ``row_id``, ``start_m``, ``end_m``, ``length_m``, ``n_missing`` and ``state``.
    sections : GeoDataFrame
        Sections of these rows, by row and ``position_m``, with ``height_m``, ``width_m``, ``area_m2``, ``n_points``,
        ``extent_m``.
    cover : Raster
        Canopy cover.
    vine_spacing : float, optional
        Metres between vines in a row; by default estimated, block by block.
    step : float
        Metres between sections.
    known : mapping of int to array, optional
        Where all vines of some rows are known to stand, by the rows' positions in the table: metres along them, in
        order.

    Returns
    -------
    rows, gaps : GeoDataFrame
        With ``n_missing`` and ``vine_spacing_m`` by the vines, where there are any; without gaps, and their length in
        ``gap_m``, that are the space which vines usually leave between them.
    vines : GeoDataFrame
        PointZ with ``row_id``, ``number`` (from 1 at e1), ``position_m`` along γ and its standard deviation
        ``position_sd_m``, ``state``, and of the canopy nearest to the vine ``height_m``, ``width_m`` (means) and
        ``volume_m3``; NaN and 0 where it is missing, NaN where it wasn't seen. There is none in blocks of which
        neither they nor the others tell the distance of vines.
    """
    block, unseen = rows["block"].to_numpy(), _unseen(rows, gaps)
    members = [np.flatnonzero(block == one) for one in np.unique(block)]
    stands = [_stands(rows.iloc[own], [unseen[k] for k in own], sections, cover, step) for own in members]
    edges = [[stand.edges for stand in part] for part in stands]
    known = known or {}
    given = [{k: known[one] for k, one in enumerate(own.tolist()) if one in known} for own in members]
    pairs = zip(given, edges, strict=True)
    usual = [vine_spacing or known_spacing(own.values()) or estimate_spacing(told) for own, told in pairs]
    if not all(usual):
        others = known_spacing(known.values()) or estimate_spacing([row for part in edges for row in part])
        usual = [one or others for one in usual]
    spacing, space = rows["vine_spacing_m"].to_numpy(dtype=float, copy=True), np.zeros(len(rows))
    tables = [pd.DataFrame(columns=["row", "position_m", "position_sd_m", "bare", "block"], dtype=float)]
    for own, part, told, theirs, apart in zip(members, stands, edges, given, usual, strict=True):
        if apart:
            extent = estimate_extent(told, apart)
            row, position, deviation = with_known(place_vines(told, apart, extent), theirs)
            bare = _bare(part, row, position, CORE * min(extent, apart))
            columns = own[row], position, deviation, bare, np.full(len(row), block[own[0]])
            tables.append(pd.DataFrame(dict(zip(tables[0].columns, columns, strict=True))))
            spacing[own], space[own] = apart, max(apart - extent, 0)
    table = pd.concat(tables[1:] or tables).astype({"row": np.int64, "bare": bool})
    table = table.sort_values(["row", "position_m"], ignore_index=True)
    rows = rows.assign(vine_spacing_m=spacing)
    vines = _described(table, rows, unseen, sections, step)
    return *_counted(rows, gaps, vines, space), vines


def _unseen(rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame) -> list[Values]:
    """Stretches (k, 2) of each row, in metres along it, that were not seen."""
    hidden = gaps[gaps["state"] == UNSEEN]
    stretches = {i: own[["start_m", "end_m"]].to_numpy(dtype=float) for i, own in hidden.groupby("row_id")}
    return [stretches.get(i, np.empty((0, 2))) for i in rows["row_id"]]


def _stands(
    rows: gpd.GeoDataFrame, unseen: list[Values], sections: gpd.GeoDataFrame, cover: Raster, step: float
) -> list[_Stand]:
    """How the canopies of a block's rows stand along them."""
    lines = shapely.force_2d(rows.geometry.to_numpy())
    lengths = shapely.length(lines)
    stations = [np.arange(CELL / 2, length, CELL) for length in lengths]
    curves = [shapely.get_coordinates(line) for line in lines]
    along = np.concatenate([tangents(*one) for one in zip(curves, stations, strict=True)])
    origin = np.concatenate([at(*one) for one in zip(curves, stations, strict=True)])
    half = np.fmax(rows["width_m"].median() / 4, CELL)
    aside = np.linspace(-half, half, 2 * int(np.ceil(half / CELL)) + 1)
    covers = sample_across(cover, origin, np.column_stack([-along[:, 1], along[:, 0]]), aside).mean(axis=1)
    own = sections[sections["row_id"].isin(rows["row_id"])]
    parts, density = own.groupby("row_id").indices, (own["n_points"] / own["extent_m"]).median()
    places, areas = own[["position_m", "area_m2"]].to_numpy(dtype=float).T
    out = []
    profiles = np.split(covers, np.cumsum([len(station) for station in stations])[:-1])
    for i, length, station, profile, hidden in zip(rows["row_id"], lengths, stations, profiles, unseen, strict=True):
        canopy = _relative(profile)
        if i in parts:
            position, area = places[parts[i]], areas[parts[i]]
            nearest = np.rint(np.interp(station, position, np.arange(len(position)))).astype(np.int64)
            share = np.where(np.abs(position[nearest] - station) <= 0.4 * step, area[nearest] / np.median(area), 0)
            canopy = np.where(share > MODELLED, np.maximum(canopy, share), canopy)
        bare = _bare_runs(canopy)
        edges = _edges(canopy, bare, float(length), hidden)
        for start, end in bare[np.diff(bare, axis=1)[:, 0] * CELL * density < FEW]:
            canopy[start:end] = 1.0
        out.append(_Stand(edges, canopy))
    return out


def _relative(profile: Values) -> Values:
    """Cover (stations,) along a row as a share of what it is thereabouts where there is canopy."""
    present = profile[profile > 0.3 * np.quantile(profile, 0.95)]
    typical = float(np.median(present)) if len(present) else 1.0
    return profile / thereabouts(profile, typical, around=AROUND / CELL)


def _bare_runs(canopy: Values) -> Ints:
    """First stations of bare stretches, and those after their last (k, 2)."""
    out: Ints = np.flatnonzero(np.diff(np.pad((canopy < BARE).astype(int), 1))).reshape(-1, 2)
    return out


def _edges(canopy: Values, bare: Ints, length: float, unseen: Values) -> Edges:
    """Where the canopy of a row begins and ends, between stations, but for stretches (k, 2) that were not seen."""
    inner = bare[(bare[:, 0] > 0) & (bare[:, 1] < len(canopy))]
    before, after = canopy[inner - 1], canopy[inner]
    gaps = (inner + (BARE - before) / (after - before) - 0.5) * CELL
    if len(gaps):
        apart = gaps[1:, 0] - gaps[:-1, 1] >= STRAY
        gaps = np.column_stack([gaps[np.append(True, apart), 0], gaps[np.append(apart, True), 1]])
    gaps = gaps[np.diff(gaps, axis=1)[:, 0] >= SHORTEST]
    for start, end in unseen:
        gaps = gaps[(gaps[:, 1] < start) | (gaps[:, 0] > end)]
    return Edges(length, np.append(gaps[:, 0], length), np.append(gaps[:, 1], 0.0))


def _bare(stands: Sequence[_Stand], row: Ints, position: Values, core: float) -> Flags:
    """Which places (n,) of vines, by row and metres along it, have no canopy within so many metres."""
    out = [np.empty(0, dtype=bool)]
    for k, (_, canopy) in enumerate(stands):
        reached = np.append(0.0, np.cumsum(canopy)) * CELL
        way = np.arange(len(reached)) * CELL
        ends = np.clip(position[row == k] + [[-core], [core]], 0, way[-1])
        out.append(np.diff(np.interp(ends, way, reached), axis=0)[0] < EMPTY * np.diff(ends, axis=0)[0])
    return np.concatenate(out)


def _described(
    table: pd.DataFrame, rows: gpd.GeoDataFrame, unseen: list[Values], sections: gpd.GeoDataFrame, step: float
) -> gpd.GeoDataFrame:
    """Places of vines with what stands there."""
    row, position = table["row"].to_numpy(), table["position_m"].to_numpy()
    dark = np.zeros(len(table), dtype=bool)
    for k, stretches in enumerate(unseen):
        if len(stretches):
            mine = row == k
            dark[mine] = ((position[mine, None] >= stretches[:, 0]) & (position[mine, None] <= stretches[:, 1])).any(
                axis=1
            )
    gone = table["bare"].to_numpy() & ~dark
    sizes = _sizes(table[~gone & ~dark], rows, sections, step).reindex(table.index)
    sizes.loc[gone, "volume_m3"] = 0.0
    usual = sizes["volume_m3"].where(~gone).groupby(table["block"]).transform("median")
    weak = (sizes["volume_m3"] < HALF * usual).to_numpy()
    return gpd.GeoDataFrame(
        {
            "row_id": rows["row_id"].to_numpy()[row],
            "number": table.groupby("row").cumcount().to_numpy() + 1,
            "position_m": position,
            "position_sd_m": table["position_sd_m"].to_numpy(),
            "state": np.select([dark, gone, weak], [UNSEEN, MISSING, WEAK], VINE),
        }
        | {name: sizes[name].to_numpy() for name in ("height_m", "width_m", "volume_m3")},
        geometry=shapely.line_interpolate_point(rows.geometry.to_numpy()[row], position),
        crs=rows.crs,
    )


def _sizes(standing: pd.DataFrame, rows: gpd.GeoDataFrame, sections: gpd.GeoDataFrame, step: float) -> pd.DataFrame:
    """Canopies of vines from the sections that are nearest to them, and no further than the next place."""
    far = 1 + 2 * float(shapely.length(rows.geometry.to_numpy()).max()) if len(rows) else 1.0
    number = pd.Series(np.arange(len(rows)), index=rows["row_id"])
    way = standing["row"].to_numpy() * far + standing["position_m"].to_numpy()
    there = number.reindex(sections["row_id"]).to_numpy() * far + sections["position_m"].to_numpy()
    k = np.searchsorted((way[1:] + way[:-1]) / 2, there)
    spacing = rows["vine_spacing_m"].to_numpy(dtype=float)
    near = np.abs(way[k] - there) <= spacing[standing["row"].to_numpy()[k]] if len(way) else np.zeros(len(there), bool)
    parts = sections.loc[near, ["height_m", "width_m"]].assign(
        volume_m3=(sections["area_m2"] * lengths_of(sections, step))[near], vine=standing.index.to_numpy()[k[near]]
    )
    out: pd.DataFrame = parts.groupby("vine").agg({"height_m": "mean", "width_m": "mean", "volume_m3": "sum"})
    return out


def _counted(
    rows: gpd.GeoDataFrame, gaps: gpd.GeoDataFrame, vines: gpd.GeoDataFrame, space: Values
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Rows and gaps with the missing vines of their own, where vines were placed in a row.

    Gaps are left out that are hardly more than what vines of their row leave between them, ``space`` (rows,) metres.
    """
    placed = set(vines["row_id"])
    gone = vines[vines["state"] == MISSING]
    own = gone.groupby("row_id").size().reindex(rows["row_id"], fill_value=0).to_numpy()
    known = rows["row_id"].isin(placed).to_numpy()
    far = 1 + 2 * float(vines["position_m"].max()) if len(vines) else 1.0
    at_gaps = gaps["row_id"].to_numpy() * far
    way = np.sort((gone["row_id"] * far + gone["position_m"]).to_numpy())
    within = np.searchsorted(way, at_gaps + gaps["end_m"]) - np.searchsorted(way, at_gaps + gaps["start_m"])
    told = gaps["row_id"].isin(placed).to_numpy()
    usual = pd.Series(LEFT * space, index=rows["row_id"]).reindex(gaps["row_id"]).to_numpy()
    between = (within == 0) & (gaps["state"] == MISSING).to_numpy() & (gaps["length_m"].to_numpy() < usual)
    lengths = gaps[between].groupby("row_id")["length_m"].sum().reindex(rows["row_id"], fill_value=0.0).to_numpy()
    return (
        rows.assign(n_missing=np.where(known, own, rows["n_missing"]), gap_m=np.maximum(rows["gap_m"] - lengths, 0)),
        gaps.assign(n_missing=np.where(told, within, gaps["n_missing"]))[~between].reset_index(drop=True),
    )
