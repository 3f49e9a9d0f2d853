"""The geoid above the ellipsoid: given, or from the grids that PROJ has here."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pyproj import CRS
from pyproj.transformer import AreaOfInterest, TransformerGroup

from vinemap.geo.crs import is_ellipsoidal, to_wgs84, with_vertical

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from vinemap.compute.arrays import Floats


class Geoid(NamedTuple):
    """What is added to heights to make them ellipsoidal."""

    height: Callable[[Floats], Floats]
    """Metres of the geoid above the ellipsoid (n,) at points (n, 3) of the CRS."""
    source: str
    """Where it is from, in words."""


def find_geoid(vertical: str | None, crs: CRS, at: ArrayLike, *, given: float | None = None) -> Geoid:
    """Choose the geoid for heights above a vertical datum.

    Parameters
    ----------
    vertical : str or None
        Name of the vertical datum.
    crs : CRS
        The horizontal, projected CRS.
    at : array_like of shape (n, 3)
        Points in it: for the first the best of PROJ's grids is chosen, which must hold them all.
    given : float, optional
        Height of the geoid above the ellipsoid, m, which counts before all others. Without it PROJ's grids do, and
        where none is installed the heights stay as they are.
    """
    if given is not None:
        return _level(given, "the setting product.geoid")
    if vertical is None:
        return _level(0.0, "none: the cloud states no vertical datum, its heights are taken as they are")
    if is_ellipsoidal(vertical):
        return _level(0.0, "none: the cloud's heights are ellipsoidal")
    whole = with_vertical(crs, vertical)
    if not whole.is_compound:
        return _level(0.0, f"none: PROJ doesn't know {vertical!r}, heights are taken as they are")
    points = np.atleast_2d(np.asarray(at, dtype=float))
    lat, lon, _ = to_wgs84(points, crs)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of grids that are missing
        group = TransformerGroup(
            whole,
            CRS.from_epsg(4979),
            always_xy=True,
            area_of_interest=AreaOfInterest(lon, lat, lon, lat),
        )
    for transform in group.transformers:
        # A ballpark transformation, which leaves heights alone, is of no known accuracy (and at times the best of all).
        if transform.accuracy < 0:
            continue

        def height(points: Floats, convert: Callable[..., Any] = transform.transform) -> Floats:
            return np.asarray(convert(points[:, 0], points[:, 1], np.zeros(len(points)))[2])

        if np.isfinite(height(points)).all():
            return Geoid(height, f"PROJ: {transform.description} (to {transform.accuracy:g} m)")
    return _level(0.0, f"none: PROJ has no geoid grid for {vertical!r} installed, heights are taken as they are")


def _level(metres: float, source: str) -> Geoid:
    return Geoid(lambda points: np.full(len(points), metres), source)
