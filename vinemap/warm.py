"""All that is compiled, compiled ahead of its first use, by mapping a made-up vineyard."""

from __future__ import annotations

import gc
import os
import subprocess
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from vinemap.compute import compiled, machine
from vinemap.compute.processes import python

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from vinemap.chain import RowMap

ROWS, LENGTH, SPACING = 6, 24.0, 2.5
"""Of the made-up vineyard: rows, and metres."""
POINTS = 40_000
BESIDE = python("from vinemap.warm import compile_beside as f; f()")
"""What runs in a process beside this one."""


class Warmth(NamedTuple):
    """What came of compiling ahead."""

    folder: Path | None
    """Where it is kept; None where nowhere."""
    n: int
    """Functions kept there, each as often as it is compiled for other kinds of numbers."""
    new: int
    """Those that weren't there before."""
    seconds: float

    def line(self) -> str:
        """What people are told."""
        if self.folder is None:
            return "nothing can be kept: neither vinemap's own folder nor the user's cache can be written"
        done = f"{self.new} of them compiled in {self.seconds:.1f} s" if self.new else "all compiled before"
        return f"{self.n} functions kept in {self.folder}, {done}"


def warm() -> Warmth:
    """Compile what isn't kept yet, half of it in a process beside this one."""
    began, folder = time.perf_counter(), compiled.folder()
    before = compiled.kept()
    if folder:
        with _beside() as wait:
            found = map_rows_of_none()
            wait()
        find_canopies_of_none(found)
        model_canopies_of_none()
    return Warmth(folder, len(compiled.kept()), len(compiled.kept() - before), time.perf_counter() - began)


@contextmanager
def warming(step: Callable[..., Any]) -> Iterator[Callable[..., Any]]:
    """Give a ``step`` for :func:`vinemap.parcel.map_parcel` that waits for what is compiled meanwhile before sections.

    Where something is kept already, all is taken to be.
    """
    if not compiled.is_new():
        yield step
        return
    with _beside() as wait:

        def waiting(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            if name == "Sections":
                wait()
            return step(name, function, *args, **kwargs)

        yield waiting


@contextmanager
def _beside() -> Iterator[Callable[[], object]]:
    """Compile in a process that goes with this one; gives what waits for it. Without a core for it, none.

    What it couldn't compile is compiled where it is needed, so that its failing is none of ours.
    """
    if machine.cores() < 2:
        yield int
        return
    nobody: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    with subprocess.Popen(BESIDE, **nobody) as process:  # noqa: S603 - our own
        try:
            yield process.wait
        finally:
            process.kill()


def compile_beside() -> None:
    """Compile what the chain comes to last: what models canopies."""
    gc.disable()  # the process ends before there is much garbage; looking for it would take a seventh of its time
    model_canopies_of_none()
    os._exit(0)  # half a second sooner than LLVM lets go


def map_rows_of_none() -> RowMap:
    """Find rows of the made-up vineyard, from points that are clipped to a polygon."""
    import numpy as np
    import shapely

    from vinemap.chain import map_rows
    from vinemap.cloud.points import PointCloud
    from vinemap.geo.crs import parse_crs
    from vinemap.geo.zones import deal, zones_of

    draw = np.random.default_rng(0)
    x, y = draw.uniform(0, LENGTH, POINTS), draw.uniform(-SPACING, ROWS * SPACING, POINTS)
    z, leaf = draw.normal(0, 0.02, POINTS), np.arange(POINTS) % 2 == 0
    across, up = _leaves(POINTS).T
    xyz = np.column_stack([x, np.where(leaf, SPACING * draw.integers(0, ROWS, POINTS) + across, y), z + leaf * up])
    around = shapely.box(*xyz[:, :2].min(axis=0) - 1, *xyz[:, :2].max(axis=0) + 1)
    return map_rows(PointCloud(deal(xyz, zones_of([around]))[0], parse_crs("EPSG:32632")))


def find_canopies_of_none(found: RowMap) -> None:
    """Tell what is canopy along rows of the made-up vineyard."""
    from vinemap.canopy.model import find_canopies
    from vinemap.config.settings import Settings

    find_canopies(found.cloud, found.rows, found.gaps, found.dtm, Settings())


def model_canopies_of_none() -> None:
    """Tell canopies from soil in made-up sections of a row, and model them."""
    import numpy as np

    from vinemap.canopy.foliage import separate_canopy
    from vinemap.canopy.model import model_sections
    from vinemap.canopy.points import Sections
    from vinemap.evaluate.meshes import distances
    from vinemap.geo.crs import parse_crs

    m, each = 20, 50
    member, leaves = np.arange(m * each, dtype=np.int32), _leaves(m * each).astype(np.float32)
    position, along = np.linspace(0, LENGTH, m), np.tile([1.0, 0.0], (m, 1))
    spacing, extent = np.full(m, SPACING), np.ones(m)
    start, places = np.arange(m + 1) * each, np.column_stack([position, np.zeros((m, 2))])
    heights = leaves[:, 1].copy()
    row_id = np.zeros(m, dtype=np.int64)
    sections = Sections(row_id, position, places, along, spacing, extent, start, leaves, heights, member)
    model = model_sections([separate_canopy(sections)], parse_crs("EPSG:32632"))
    n = len(model.polygons)
    distances(np.zeros((n, 3)), np.arange(n), model.at, model.polygons, step=LENGTH)


def _leaves(n: int) -> NDArray[np.float64]:
    """Points (n, 2) of a canopy's section: metres across it and above ground."""
    import numpy as np

    draw = np.random.default_rng(1)
    angle, away = draw.uniform(0, 2 * np.pi, n), np.sqrt(draw.uniform(0, 1, n))
    return np.column_stack([0.3 * away * np.cos(angle), 1.2 + 0.6 * away * np.sin(angle)])
