"""Courses to rows: centre lines, ends and gaps from the points themselves.

Rasters have told where rows run; their cells would leave a centimetre or two in every end. Here the points near each
row are put into its own frame, where cover is counted in cells that turn and shift with the row, so that neither the
parcel's place nor its rotation matters.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from vinemap.compute.threads import in_threads
from vinemap.geo.curve import across, between, extend, normals, resample, way_along
from vinemap.rows.centre_line import CELL, EDGE, USUAL, centre_line, half_width, half_widths, smooth_course
from vinemap.rows.standing.canopy import Standing, cut_to_canopy, find_canopy
from vinemap.rows.standing.gaps import lay_out
from vinemap.rows.standing.known_ends import Known, cut_as_known
from vinemap.rows.standing.parting import own_rows, part_rows
from vinemap.rows.straightened import Share, deal, straighten, where_vines_are

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import geopandas as gpd

    from vinemap.cloud.tiles import Cloud
    from vinemap.compute.arrays import Flags, Ints, Values
    from vinemap.geo.raster import Raster
    from vinemap.surfaces.cover import Levels
    from vinemap.surfaces.seen import Seen

    _Dealt = Callable[..., Iterator[tuple[Ints, list[Share]]]]
    """Deals points to curves, of half widths, distances of curtains, and what is known of them."""
    _Fitted = Callable[..., Standing | None]
    """Fits a row to its share."""

MARGIN = 1.5
"""Metres beyond a course's ends where canopy is still looked for."""
FARTHER = 4
"""Times that it is looked for as far again, where it hasn't ended."""
POINTS_A_METRE = 200.0
"""Canopy points in a metre of row for which the smoothing is meant."""
APART = 0.3
"""Share of a row's cover beside it up to which it stands apart from its neighbours."""
LEAST_CONTRAST = 0.6
"""Contrast of a lone row's canopy to what lies beside it, below which it is a bush or a hedge."""


def fit_rows(
    courses: gpd.GeoDataFrame,
    cloud: Cloud,
    cover: Raster,
    levels: Levels,
    dtm: Raster,
    seen: Seen,
    within: shapely.Geometry | None = None,
    *,
    high: float = 3.6,
    smoothing: float = 2.5,
    end_share: float = 0.6,
    min_gap: float = 0.8,
) -> tuple[gpd.GeoDataFrame, gpd.GeoDataFrame]:
    """Fit the rows' curves to the points of their canopies.

    Parameters
    ----------
    courses : GeoDataFrame
        LineString with ``spacing_m``, ``curtains_m`` (between two curtains of a row, 0 where it has one) and ``alone``
        (whether no other row runs beside it). Of known rows, which stay without canopy, too, with ``moves``,
        ``slack_m``, ``before_m``, ``after_m`` and ``least_m`` as of :func:`vinemap.rows.known.follow_lines`.
    cloud : PointCloud or TiledCloud
        The parcel's points with their heights above ground.
    cover : Raster
        Canopy cover; where it is zero there are trees or houses, whose points don't count.
    levels : Levels
        Heights from which points count as canopy: of its body for the centre line and the ends, of its ridge for the
        contrast, and for the centre line where canopies don't stand apart whole.
    dtm, seen, within
        As for :func:`vinemap.rows.standing.gaps.lay_out`, which tells what is returned.
    high : float
        Height in metres above which no point is canopy.
    smoothing : float
        Wavelength in metres below which bends of the centre line are taken for noise, at 200 canopy points a metre of
        row; it grows with the fifth root of their distance.
    end_share : float
        Share of the cover thereabouts at which a row's canopy begins and ends.
    min_gap : float
        Metres without canopy that make a gap.
    """
    looked_at = [_looked_at(course) for course in courses.to_dict("records")]
    curtains = courses["curtains_m"].to_numpy()
    half = np.maximum(
        half_widths(courses, [curve for curve, _ in looked_at], cover, levels),
        half_width(courses["spacing_m"]) + curtains / 2,
    )
    dealt = partial(deal, cloud, where_vines_are(cover, levels, half), levels, high=high)
    fitted = partial(_fit, smoothing=smoothing, end_share=end_share)
    rows = _followed(looked_at, half, curtains, dealt, fitted)
    if settled := [of for _, of in looked_at if of]:
        rows = dict(enumerate(cut_as_known(list(rows.values()), settled)))
    else:
        rows = own_rows(rows)
        rows |= _parted(rows, courses["spacing_m"].to_numpy(), half, curtains, cover, dealt, fitted)
    standing = [
        (spacing, fit)
        for k, (spacing, alone) in enumerate(zip(courses["spacing_m"], courses["alone"], strict=True))
        if (fit := rows.get(k)) and not (alone and fit.contrast < LEAST_CONTRAST)
    ]
    return lay_out(standing, seen, dtm, within=within, min_gap=min_gap)


def _followed(
    looked_at: list[tuple[Values, Known | None]], half: Values, curtains: Values, dealt: _Dealt, fitted: _Fitted
) -> dict[int, Standing]:
    """The rows that stand, by the places of their courses, each followed as far as its canopy goes on."""
    fits: dict[int, Standing | None] = {}
    members, curves = np.arange(len(looked_at)), [curve for curve, _ in looked_at]
    for _ in range(1 + FARTHER):
        known = [looked_at[k][1] for k in members]
        for group, shares in dealt(curves, half[members], curtains[members], known):
            fits |= dict(zip(members[group].tolist(), in_threads(fitted, shares), strict=True))
        unended = _unended(fits, half)
        if not unended:
            break
        members = np.array(list(unended))
        curves = [smooth_course(curve, beyond=MARGIN) for curve in unended.values()]
    return {k: fit for k, fit in sorted(fits.items()) if fit}


def _parted(
    rows: dict[int, Standing],
    spacing: Values,
    half: Values,
    curtains: Values,
    cover: Raster,
    dealt: _Dealt,
    fitted: _Fitted,
) -> dict[int, Standing]:
    """Rows that end in the canopies of others, fitted anew without what is these others'."""
    out, places = {}, list(rows)
    for n, parted in part_rows(list(rows.values()), spacing[places], cover, margin=MARGIN).items():
        k, curves = places[n], [parted.course, *parted.beside]
        like = np.full(len(curves), k)
        for group, shares in dealt(curves, half[like], curtains[like], [None] * len(curves)):
            own = [share for m, share in zip(group, shares, strict=True) if m == 0]
            if own and (row := fitted(own[0], theirs=parted.theirs)):
                out[k] = row
    return out


def _fit(
    share: Share, *, smoothing: float, end_share: float, theirs: shapely.Geometry | None = None
) -> Standing | None:
    """Centre line of a row about its course, between the ends of its canopy, which others' isn't."""
    still, known = np.zeros(len(share.curve)), share.known
    if known and len(share.station) == 0:
        return Standing(share.curve, np.empty((0, 2)), 0.0)
    image, offsets = straighten(share, share.body, still)
    # Crowns lean to the side from which they were seen: where canopies stand apart whole, their flanks tell more.
    if share.ridge is not share.body and not _stands_apart(image):
        image, offsets = straighten(share, share.ridge, still)
    cutoff = smoothing / CELL * _noise_stretch(share)
    reach = _reach(image, offsets, share.half)
    shift: Values = still
    if known is None or known.moves:
        if theirs:
            image = np.where(_within(theirs, share.curve, offsets).any(axis=1, keepdims=True), 0.0, image)
        shift = centre_line(image, offsets, reach=reach, cutoff=cutoff, curtains=share.curtains)
    if known and len(canopy := np.flatnonzero(image.sum(axis=1) * CELL > known.least)):
        shift = shift[np.clip(np.arange(len(shift)), canopy[0], canopy[-1])]
    centred = share.curve + shift[:, None] * normals(share.curve, smoothing=1 / CELL)
    body = ridge = straighten(share, share.body, shift)[0]
    if share.ridge is not share.body:
        ridge = straighten(share, share.ridge, shift)[0]
    if known is None:
        cells = _within(theirs, centred, offsets) if theirs else None
        return cut_to_canopy(centred, body, ridge, end_share, theirs=cells)
    row = find_canopy(centred, body, ridge, end_share, least=known.least)
    return row or Standing(centred, np.empty((0, 2)), 0.0)


def _within(canopies: shapely.Geometry, curve: Values, offsets: Values) -> Flags:
    """Cells (stations, cells across) of a row straightened along a curve that lie in canopies."""
    shapely.prepare(canopies)
    cells = across(curve, offsets, smoothing=1 / CELL)
    out: Flags = shapely.contains_xy(canopies, cells[..., 0], cells[..., 1])
    return out


def _unended(fits: dict[int, Standing | None], half: Values) -> dict[int, Values]:
    """Curves of the rows whose canopy may go on where it wasn't looked for, and not into another row."""
    standing = {k: fit for k, fit in fits.items() if fit}
    rows, tree = list(standing), shapely.STRtree([shapely.LineString(fit.curve) for fit in standing.values()])
    out = {}
    for k, fit in standing.items():
        if not any(fit.goes_on):
            continue
        longer = extend(fit.curve, 2 * MARGIN)
        ways = [shapely.LineString(w) for w, on in zip((longer[:2], longer[-2:]), fit.goes_on, strict=True) if on]
        near = tree.query(ways, predicate="dwithin", distance=half[k])[1]
        if all(rows[other] == k for other in near):
            out[k] = fit.curve
    return out


def _stands_apart(image: Values) -> bool:
    """Whether a straightened row (stations, cells across) has little cover at both its sides."""
    profile = image.mean(axis=0)
    return bool(0.5 * (profile[0] + profile[-1]) <= APART * profile.max())


def _reach(image: Values, offsets: Values, half: float) -> float:
    """Metres to both sides of a row in which its middle is sought: all its canopy, and as much as rows usually have."""
    profile = image.mean(axis=0)
    least = 0.75 * min(half, USUAL)
    inside = np.abs(offsets[profile > 0.5 * EDGE * profile.max()]).max(initial=0.0) + 2 * CELL
    return float(np.clip(inside, least, max(half - CELL, least)))


def _looked_at(course: dict[str, Any]) -> tuple[Values, Known | None]:
    """The curve along which a row's canopy is looked for, and what is known of the row."""
    xy = shapely.get_coordinates(course["geometry"])
    if "moves" not in course:
        return smooth_course(xy, beyond=MARGIN), None
    before, after = course["before_m"], course["after_m"]
    beyond = float(np.ceil(max(before, after) / MARGIN)) * MARGIN
    curve = smooth_course(xy, beyond=beyond) if course["moves"] else extend(xy, beyond)
    curve = resample(between(curve, beyond - before, way_along(curve)[-1] - beyond + after), CELL)
    return curve, Known(before, way_along(curve)[-1] - after, course["slack_m"], course["moves"], course["least_m"])


def _noise_stretch(share: Share) -> float:
    """Factor of the smoothing's wavelength: 1 at ``POINTS_A_METRE``, more where points are fewer."""
    per_metre = float(share.ridge[np.abs(share.left) <= share.half].sum()) / (len(share.curve) * CELL)
    return float(np.clip((POINTS_A_METRE / max(per_metre, 1.0)) ** 0.2, 0.8, 1.6))
