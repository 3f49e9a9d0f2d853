"""The canopy along a row: where it begins and stops."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from vinemap.geo.curve import between, way_along
from vinemap.rows.centre_line import CELL, EDGE, runs_above

if TYPE_CHECKING:
    from vinemap.compute.arrays import Flags, Values

AROUND = 0.3
"""Metres, a standard deviation, of the surroundings with which the canopy of an end is compared."""
CORE, NARROW = 0.5, 0.5
"""Share of a canopy's half width, and metres to both sides at the least, within which it tells where it ends."""
SHORTEST = 0.35
"""Metres of canopy along a row, below which it is a stray shoot or weed and no vine."""
OWN = 0.3
"""Share of a canopy across that must lie outside of another row's for it to tell where it ends."""
ACROSS, BROAD = 0.5, 2.5
"""Cover at the sides of what stands beyond an end, in that of its middle, from which it runs across the row; and how
many times as wide as the row's canopy a thing is, as a car, that isn't of it."""
HEDGE, CAR = 3.0, 5.5
"""Metres along a row that either takes at the most."""
USUAL = 1.0
"""Metres between vines that are taken where nothing tells."""
NOTHING = np.empty(0)


class Standing(NamedTuple):
    """A row with its canopy."""

    curve: Values
    """Places (n, 2) along its middle."""
    runs: Values
    """Stretches (k, 2) of it with canopy, in metres along it."""
    contrast: float
    """Of the canopy to what stands beside it, 0–1."""
    goes_on: tuple[bool, bool] = (False, False)
    """Whether the canopy may go on beyond either end: no more than a vine's distance was looked at there."""
    sides: Values = NOTHING
    """Cover (k,) at both sides of each run, as a share of that of its middle; none once the row is cut."""
    wide: Values = NOTHING
    """Width (k,) of each run, in that of the row's canopy; none once the row is cut."""
    told: tuple[bool, bool] = (True, True)
    """Whether canopy tells where either end is: not where it is known, and nothing ends near there."""
    half: tuple[float, float] = (0.0, 0.0)
    """Half width of the canopy in metres, where it has half of its cover and where it has the ``EDGE`` of it."""

    @property
    def length(self) -> float:
        """Metres from end to end."""
        return float(way_along(self.curve)[-1])

    @property
    def empty(self) -> Values:
        """Stretches (k + 1, 2) before, between and after the runs, in metres along the curve."""
        return np.concatenate([[0.0], self.runs.ravel(), [self.length]]).reshape(-1, 2)


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

    Parameters
    ----------
    curve : (n, 2) array
        Stations along the row.
    image, ridge : (n, cells across) array
        Cover along it: of the canopy whole, and of its ridge, which tells how it stands out.
    end_share : float
        Share of the cover thereabouts at which canopy begins and ends.
    least : float
        Metres of full cover across a station, below which it has no canopy.
    theirs : (n, cells across) array, optional
        Cells that are in other rows' canopies: what stands there isn't this row's.
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
    parts = [slice(int(a), int(b) + 1) for a, b in np.array(runs)[long]]
    sides = np.array([_sides(ridge[part]) for part in parts])
    wide = np.array([_half(image[part].mean(axis=0), 0.5) for part in parts]) / max(_half(across, 0.5), CELL)
    contrast = float(np.clip(1 - _sides(ridge[profile > edge]), 0, 1))
    half = _half(across, 0.5), _half(across, EDGE)
    return Standing(curve, metres[long], contrast, sides=sides, wide=wide, half=half)


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
    """Cover (stations,) that is usual around each station with canopy: a row's last vine may be a weak one.

    ``typical`` is the cover that is usual in the whole row, ``around`` the standard deviation in stations.
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
    runs = _along(row)
    first, last = runs[0, 0], runs[-1, 1]
    goes_on = bool(first < USUAL), bool(last > way_along(curve)[-1] - USUAL)
    return Standing(between(curve, first, last), runs - first, row.contrast, goes_on, half=row.half)


def _along(row: Standing) -> Values:
    """Runs of a row's canopy without those beyond its ends that run across it, as a hedge does, or are far too wide.

    Where most of its canopy reaches to both sides none can be told.
    """
    if np.median(row.sides) > ACROSS / 2:
        return row.runs
    length = np.diff(row.runs, axis=1)[:, 0]
    across = row.sides > ACROSS
    others = (across & (length <= HEDGE)) | (~across & (row.wide > BROAD) & (length <= CAR))
    own = np.flatnonzero(~others)
    return row.runs[own[0] : own[-1] + 1]


def _core(across: Values) -> slice:
    """Cells of the middle of a row, of whose cover (cells,) across it: wide canopies end round, there last.

    All of it, where the row is narrow or its middle hollow.
    """
    middle = len(across) // 2
    if across[middle] < 0.5 * across.max():
        return slice(None)
    reach = round(max(CORE * _half(across, 0.5), NARROW) / CELL)
    return slice(max(middle - reach, 0), middle + reach + 1)
