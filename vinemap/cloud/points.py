"""Points in memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap.cloud.bins import bin_points
from vinemap.geo.raster import above, cell_of, extent

if TYPE_CHECKING:
    from collections.abc import Iterator

    import shapely
    from numpy.typing import NDArray
    from pyproj import CRS

    from vinemap.cloud.bins import Bins
    from vinemap.compute.arrays import Floats, Values
    from vinemap.geo.raster import Grid, Raster

HIDDEN = -1.0
"""Height in metres of points that are out of sight: no soil, and no canopy."""


@dataclass(frozen=True)
class PointCloud:
    """Points (n, 3) in metres, x east, y north, z up.

    ``vertical`` names the vertical datum that the file states; heights are never moved to another. ``heights`` (n,)
    are metres above the terrain model, once there is one; ``first`` is the index of its first point in a larger cloud.
    ``classification`` (n,) holds ASPRS classes, where the engine that read the points gives them. ``remarks`` are what
    is to be known of its files.
    """

    xyz: Floats
    crs: CRS
    vertical: str | None = None
    heights: Values = field(default_factory=lambda: np.empty(0, dtype=np.float32))
    first: int = 0
    classification: NDArray[np.uint8] | None = None
    remarks: tuple[str, ...] = ()
    _kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def size(self) -> int:
        """Number of points."""
        return len(self.xyz)

    @property
    def extent(self) -> tuple[Floats, Floats]:
        """Least and greatest coordinates (3,)."""
        if "extent" not in self._kept:
            self._kept["extent"] = extent(self.xyz)
        corners: tuple[Floats, Floats] = self._kept["extent"]
        return corners

    def parts(self, near: shapely.Geometry | None = None, reach: float = 0.0) -> Iterator[PointCloud]:
        """The cloud in parts that fit in memory, at the least those within metres of a geometry: here it is one."""
        del near, reach
        yield self

    def bins(self, grid: Grid) -> Bins:
        """The points sorted into the cells of a grid; kept until another grid's are asked for."""
        if "bins" not in self._kept or self._kept["bins"].grid != grid:
            self._kept["bins"] = bin_points(self.xyz, grid)
        bins: Bins = self._kept["bins"]
        return bins

    @property
    def kept_bins(self) -> Bins | None:
        """The points sorted into cells, where they were before."""
        return self._kept.get("bins")

    def forget(self) -> None:
        """Let go of the cells, where nothing more is asked of them."""
        self._kept.pop("bins", None)

    def above(self, dtm: Raster, ceiling: Raster | None = None) -> PointCloud:
        """The cloud with its heights above a terrain model; what is higher than a ceiling is ``HIDDEN``."""
        heights = above(dtm, self.xyz)
        if ceiling:
            heights[heights > ceiling.values.ravel()[cell_of(self.xyz, ceiling.grid)]] = HIDDEN
        return replace(self, heights=heights)
