"""Ends and gaps of a row: where canopy begins and stops along it, what wasn't seen, how many vines are missing."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import geopandas as gpd
import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d

from vinemap.geo.curve import between, extend, resample, way_along
from vinemap.geo.raster import sample
from vinemap.rows.centre_line import CELL, EDGE, runs_above

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vinemap.compute.arrays import Flags, Values
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.seen import Seen

MISSING, UNSEEN = "missing", "unseen"
"""States of a gap: no vine stands there, or nothing tells whether one does."""
SEEN, OUTSIDE = "seen", "outside"
"""What is told, beside ``UNSEEN``, of the place beyond an end where the next vine would be."""

AROUND = 0.3
"""Metres, a standard deviation, of the surroundings with which the canopy of an end is compared."""
CORE, NARROW = 0.5, 0.5
"""Share of a canopy's half width, and metres to both sides at the least, within which it tells where it ends."""
SHORTEST = 0.35
"""Metres of canopy along a row, below which it is a stray shoot or weed and no vine."""
OWN = 0.3
"""Share of a canopy across that must lie outside of another row's for it to tell where it ends."""
NEAR, SPREAD = 0.25, 4.0
"""Metres, and times that known ends are off in the median, by which one may be."""
ACROSS = 0.5
"""Cover at the sides of what stands beyond a known end, in that of its middle, from which it runs across the row."""
USUAL = 1.0
"""Metres between vines that are taken where nothing tells."""
VERTEX = 0.5
"""Metres between the vertices of a curve."""
NOTHING = np.empty(0)


class Standing(NamedTuple):
    """Curve (n, 2), its runs of canopy (k, 2) in metres along it, and the canopy's contrast.

    ``goes_on`` tells of either end whether it may go on: what it was cut from ends no vine's distance beyond it. Before
    a row is cut, ``sides`` (k,) is the cover at both sides of each run, in that of its middle. ``told`` says of either
    end whether canopy tells it, as it does unless the end is known and nothing ends near it. ``half`` is the canopy's
    half width in metres, at half its cover and at the ``EDGE`` of it.
    """

    curve: Values
    runs: Values
    contrast: float
    goes_on: tuple[bool, bool] = (False, False)
    sides: Values = NOTHING
    told: tuple[bool, bool] = (True, True)
    half: tuple[float, float] = (0.0, 0.0)

    @property
    def length(self) -> float:
        """Metres from end to end."""
        return float(way_along(self.curve)[-1])

    @property
    def empty(self) -> Values:
        """Stretches (k + 1, 2) before, between and after the runs, in metres along the curve."""
        return np.concatenate([[0.0], self.runs.ravel(), [self.length]]).reshape(-1, 2)


class Known(NamedTuple):
    """What is known of a row: metres at which it begins and ends along the curve on which it is looked for.

    Either may be off by up to ``slack`` metres; the course may be if it ``moves``. Canopy has ``least`` metres of full
    cover across it.
    """

    start: float
    end: float
    slack: float
    moves: bool
    least: float


def find_canopy(
    curve: Values,
    image: Values,
    ridge: Values,
    end_share: float,
    *,
    least: float = 0.0,
    theirs: Flags | None = None,
) -> Standing | None:
    """Find the canopy along a curve; None where there is none.

    Images (stations, cells across) are of the canopy's cover along it; its ridge tells how it stands out. From so many
    metres of full cover across on there may be canopy. What stands in cells that are other rows' is theirs.
    """
    across = image.mean(axis=0)
    core = _core(across)
    profile = image[:, core].sum(axis=1) * CELL
    if theirs is not None and theirs.any():
        profile = _own(image[:, core], ~theirs[:, core])
    present = profile[profile > max(0.3 * np.quantile(profile, 0.95), least)]
    if len(present) == 0:
        return None
    typical = float(np.median(present))
    profile *= typical / thereabouts(profile, typical, around=AROUND / CELL)
    edge = end_share * typical
    # Thin canopies have holes: what a weaker trace joins is one run, from its first to its last full edge.
    weak = runs_above(profile, 0.5 * edge)
    full = runs_above(profile, edge)
    runs = [(f[0, 0], f[-1, 1]) for a, b in weak if len(f := full[(full[:, 0] >= a) & (full[:, 1] <= b)])]
    metres = np.interp(np.reshape(runs, (-1, 2)), np.arange(len(curve)), way_along(curve))
    long = np.diff(metres, axis=1)[:, 0] >= SHORTEST
    if not long.any():
        return None
    sides = np.array([_sides(ridge[int(a) : int(b) + 1]) for a, b in np.array(runs)[long]])
    contrast = float(np.clip(1 - _sides(ridge[profile > edge]), 0, 1))
    return Standing(curve, metres[long], contrast, sides=sides, half=(_half(across, 0.5), _half(across, EDGE)))


def _half(across: Values, share: float) -> float:
    """Half of the metres across a row on which it has such a share of its most cover (cells,)."""
    return 0.5 * CELL * np.count_nonzero(across >= share * across.max())


def _own(image: Values, own: Flags) -> Values:
    """Metres of cover (stations,) across a row, as far as the cells that are its own tell it."""
    alone = own.all(axis=1)
    across = image[alone if alone.any() else slice(None)].mean(axis=0)
    share = (own * across).sum(axis=1) / across.sum()
    out: Values = np.where(share >= OWN, (own * image).sum(axis=1) * CELL / np.maximum(share, OWN), 0.0)
    return out


def thereabouts(profile: Values, typical: float, *, around: float) -> Values:
    """Cover (stations,) along a row thereabouts, where there is canopy at all: its last vine may be a weak one.

    Told are the cover that is typical of the row, and a standard deviation in stations.
    """
    living = np.clip((profile / typical - 0.2) / 0.2, 0, 1)
    near, weight = (gaussian_filter1d(v, around, mode="constant") for v in (profile * living, living))
    out: Values = (near + 0.1 * typical) / (weight + 0.1)
    return out


def _sides(image: Values) -> float:
    """Cover at both sides of a straightened row, in that of its ridge."""
    aside, ridge = max(1, image.shape[1] // 8), float(image.max(axis=1).mean())
    beside = float(np.concatenate([image[:, :aside], image[:, -aside:]], axis=1).mean())
    return beside / ridge if ridge else 1.0


def cut_to_canopy(
    curve: Values, image: Values, ridge: Values, end_share: float, *, theirs: Flags | None = None
) -> Standing | None:
    """Cut a curve to where its canopy begins and ends, as of :func:`find_canopy`; None where there is none."""
    row = find_canopy(curve, image, ridge, end_share, theirs=theirs)
    if row is None:
        return None
    first, last = row.runs[0, 0], row.runs[-1, 1]
    goes_on = bool(first < USUAL), bool(last > way_along(curve)[-1] - USUAL)
    return Standing(between(curve, first, last), row.runs - first, row.contrast, goes_on, half=row.half)


def cut_as_known(rows: Sequence[Standing], known: Sequence[Known]) -> list[Standing]:
    """Cut rows to where they are known to begin and end, or to canopy that is seen to do so near there.

    How near is told by all: where most known ends lie by canopy's, a row's missing vines don't shorten it.
    """
    bounds = np.array([(one.start, one.end) for one in known])
    seen = np.array([_ends_near(row, one) for row, one in zip(rows, known, strict=True)])
    off = np.abs(seen - bounds)
    most = NEAR + SPREAD * float(np.median(off[np.isfinite(off)])) if np.isfinite(off).any() else 0.0
    places = np.where(off <= most, seen, bounds)
    whole = np.diff(places) > 0
    places = np.where(whole, places, bounds)
    out = []
    for row, (start, end), (first, last) in zip(rows, places, (off <= most) & whole, strict=True):
        runs = np.clip(row.runs, start, end)
        runs = runs[np.diff(runs, axis=1)[:, 0] > 0]
        curve = between(row.curve, start, end)
        out.append(Standing(curve, runs - start, row.contrast, told=(bool(first), bool(last))))
    return out


def _ends_near(row: Standing, known: Known) -> tuple[float, float]:
    """Metres at which a row's canopy is seen to begin and end near where it is known to; NaN where it isn't."""
    whole = float(way_along(row.curve)[-1])
    first = _end_near(whole - row.runs[::-1, ::-1], row.sides[::-1], whole - known.start, whole, known.slack)
    return whole - first, _end_near(row.runs, row.sides, known.end, whole, known.slack)


def _end_near(runs: Values, sides: Values, known: float, whole: float, slack: float) -> float:
    """Metres at which the last run of canopy near a known end ends, and no hedge or row across; NaN where none does.

    What is looked at ends far beyond, or half way to another row.
    """
    ends = (runs[:, 1] <= whole - SHORTEST) | (whole - known < slack)
    near = (np.abs(runs[:, 1] - known) <= slack) & ends
    own = np.flatnonzero(near & ((runs[:, 0] < known) | (sides <= ACROSS)))
    return float(runs[own[-1], 1]) if len(own) else np.nan


def _core(across: Values) -> slice:
    """Cells of the middle of a row, of whose cover (cells,) across it: wide canopies end round, there last.

    All of it, where the row is narrow or its middle hollow.
    """
    middle = len(across) // 2
    if across[middle] < 0.5 * across.max():
        return slice(None)
    reach = round(max(CORE * _half(across, 0.5), NARROW) / CELL)
    return slice(max(middle - reach, 0), middle + reach + 1)


def lay_out(
    standing: Iterable[tuple[float, Standing]],
    seen: Seen,
    dtm: Raster,
    *,
    within: shapely.Geometry | None = None,
    min_gap: float = 0.8,
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Tables of rows and of their gaps.

    Rows end where the parcel does: one that goes on beyond a hole or a notch of its polygon is two. Gaps are parted
    into what was seen, where vines are missing, and what wasn't.

    Parameters
    ----------
    standing : iterable of (float, Standing)
        Rows, with their spacing in metres.
    seen : Seen
        What the cloud shows.
    dtm : Raster
        Terrain, which gives curves their elevation.
    within : Geometry, optional
        The parcel's polygon; by default all that there is.
    min_gap : float
        Metres without canopy that make a gap, of which a part is one, too.

    Returns
    -------
    rows, gaps : GeoDataFrame
        LineStringZ with ``spacing_m``, ``gap_m`` and ``unseen_m`` (length of gaps of either state), ``support`` (share
        of the length that was seen with canopy), ``contrast``, and ``start_told`` and ``end_told``, whether canopy
        tells where the row ends; LineStringZ with ``row`` (position in rows),
        ``start_m``, ``end_m``, ``length_m`` along γ and ``state`` ("missing", "unseen").
    """
    rows: list[tuple[object, ...]] = []
    gaps: list[tuple[object, ...]] = []
    if within is not None:
        shapely.prepare(within)
    for spacing, whole in standing:
        for row in _parted(whole, within, min_gap):
            found = _gaps_of(row, seen, min_gap)
            gaps += [(len(rows), a, b, b - a, state, _line(between(row.curve, a, b), dtm)) for a, b, state in found]
            bare, hidden = (sum(b - a for a, b, state in found if state == one) for one in (MISSING, UNSEEN))
            support = float(np.diff(row.runs, axis=1).sum() / max(row.length - hidden, CELL))
            line = _line(resample(row.curve, VERTEX), dtm)
            rows.append((spacing, float(bare), float(hidden), support, row.contrast, *row.told, line))
    return (
        _frame(rows, ["spacing_m", "gap_m", "unseen_m", "support", "contrast", "start_told", "end_told"], dtm),
        _frame(gaps, ["row", "start_m", "end_m", "length_m", "state"], dtm),
    )


def _parted(row: Standing, within: shapely.Geometry | None, least: float) -> list[Standing]:
    """A row in the parts that a polygon leaves of it: what stands on both sides of a gap that is outside for metres."""
    inside = np.ones(len(row.curve), dtype=bool) if within is None else shapely.contains_xy(within, row.curve)
    if inside.all():
        return [row]
    way, parts = way_along(row.curve), []
    outside = np.cumsum(np.append(~inside[:-1] * np.diff(way), 0.0))
    cuts = np.flatnonzero(np.diff(np.interp(row.empty, way, outside), axis=1)[:, 0] >= least)
    for whole in np.split(row.runs, cuts):
        own = way[inside & (way >= whole[0, 0]) & (way <= whole[-1, 1])]
        held = np.clip(whole, *own[[0, -1]]) if len(own) else whole[:0]
        held = held[held[:, 1] > held[:, 0]]  # canopy may have seemed to reach a little beyond
        runs = held if len(held) else whole
        first, last = runs[0, 0], runs[-1, 1]
        parts.append(row._replace(curve=between(row.curve, first, last), runs=runs - first))
    return parts


def _gaps_of(row: Standing, seen: Seen, least: float) -> list[tuple[float, float, str]]:
    """Start, end and state of a row's gaps of so many metres at the least."""
    gaps = row.empty[np.diff(row.empty, axis=1)[:, 0] >= least]
    if len(gaps) == 0:
        return []
    hidden = seen.hidden(row.curve, max(NARROW / 2, seen.grid.resolution))
    return [part for a, b in gaps for part in _in_states(a, b, np.clip(hidden, a, b), least)]


def _in_states(start: float, end: float, hidden: Values, least: float) -> list[tuple[float, float, str]]:
    """A gap in what was seen of it and what wasn't, in stretches (k, 2) that may lie beside it.

    What is too short for a vine to show, or to hide, is as what lies about it.
    """
    length = np.diff(hidden, axis=1)[:, 0]
    parts: list[tuple[float, float, str]] = []
    at = start
    for a, b in hidden[(length >= least) | (length > (end - start) / 2)]:
        if a - at >= least:
            parts.append((at, a, MISSING))
            at = a
        elif parts:
            at = parts.pop()[0]
        parts.append((at, b, UNSEEN))
        at = b
    if end - at >= least or not parts:
        parts.append((at, end, MISSING))
    else:
        parts[-1] = (parts[-1][0], end, UNSEEN)
    return parts


def beyond_ends(rows: gpd.GeoDataFrame, seen: Seen, within: shapely.Geometry | None = None) -> list[str]:
    """What there is to see where the next vine would stand beyond both ends of rows, one row after the other.

    It is "seen", "unseen", or "outside" the parcel; where it isn't seen the row may go on.

    Parameters
    ----------
    rows : GeoDataFrame
        LineString with ``vine_spacing_m``.
    seen, within
        As of :func:`lay_out`.
    """
    curves = [shapely.get_coordinates(line) for line in rows.geometry]
    ends = [extend(c, by)[[0, -1]] for c, by in zip(curves, rows["vine_spacing_m"], strict=True)]
    xy = np.concatenate([np.empty((0, 2)), *ends])
    inside = np.ones(len(xy), dtype=bool) if within is None else shapely.contains_xy(within, xy)
    told: list[str] = np.where(inside, np.where(seen.at(xy), SEEN, UNSEEN), OUTSIDE).tolist()
    return told


def _line(curve: Values, dtm: Raster) -> shapely.LineString:
    return shapely.LineString(np.column_stack([curve, sample(dtm, curve)]))


def _frame(records: list[tuple[object, ...]], columns: list[str], dtm: Raster) -> gpd.GeoDataFrame:
    data = {name: [r[k] for r in records] for k, name in enumerate(columns)}
    return gpd.GeoDataFrame(data, geometry=[r[-1] for r in records], crs=dtm.crs)
