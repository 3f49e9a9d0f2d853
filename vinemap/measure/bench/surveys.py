"""Surveys of the benchmark, of any size: vineyards like the thesis's parcel F, and such as are planted densely."""

from __future__ import annotations

import json
import math
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import shapely

    from vinemap.compute.arrays import Floats
    from vinemap.simulate.plants import Vineyard
    from vinemap.simulate.terrain import Terrain

DENSITY = 500.0
"""Rays a square metre of the parcel; a tenth of them finds neither leaf nor ground."""
DENSITY_OUTSIDE = 60.0
SPACING = 2.7
"""Metres between rows."""
MARGIN = 13.0
"""Metres of bare ground about the rows, less about few: half of parcel F is such."""
CLOSE = 1.7
"""Metres between rows that are planted densely."""
ROW, ROWS, TRACK = 36.0, 26, 6.0
"""Length (m) and number of the rows of a dense block, and metres of track between blocks."""
DENSE_POINTS = 130.0
"""Points a square metre of a dense parcel."""
DENSE_RAYS = 162.0
"""Rays that give them."""


class Plot(NamedTuple):
    """A vineyard of one parcel, and how it is seen."""

    rows: list[Floats]
    vineyard: Vineyard
    terrain: Terrain
    seen: Mapping[str, Any]
    """As :func:`vinemap.simulate.survey.simulate` takes it."""


def plot(millions: float) -> Plot:
    """Parcel on which about so many million points are found: number and length of rows grow with its square root.

    Rows are 2.7 m apart on a bend of 800 m radius and a slope of 15%, with bare ground about them: 16 rows of 112 m on
    a hectare where 4.7 million points lie, as in parcel F.
    """
    from vinemap.simulate.plants import Vineyard
    from vinemap.simulate.scenes import rows_of
    from vinemap.simulate.terrain import hillside

    n = max(round(7.4 * math.sqrt(millions)), 3)
    margin = margin_of(millions)
    width = (n - 1) * SPACING + 2 * margin
    edge = 2 * 6 * DENSITY_OUTSIDE
    length = (1e6 * millions - edge * width) / (0.94 * DENSITY * width + edge) - 2 * margin
    rows = rows_of(n, length=max(length, 5.0), spacing=SPACING, azimuth=18, radius=800)
    gaps = (2, 3, 3, 4, 5) * math.ceil(n / 24)
    vineyard = Vineyard("F", rows, gaps=gaps, outline=outline(rows, margin))
    seen = {"density": DENSITY, "density_outside": DENSITY_OUTSIDE, "seed": 1}
    return Plot(rows, vineyard, hillside(0.15, uphill=100), seen)


def dense(millions: float) -> Plot:
    """Parcel planted densely, on which about so many million points are found, as matched photographs give them.

    Blocks of 26 rows 36 m long and 1.7 m apart, divided by tracks 6 m wide, with nothing bare about them: 4.3 km of
    rows on a hectare where 1.3 million points lie. A row ends up to 0.8 m early, and vines are missing in every third.
    """
    from vinemap.simulate.matching import Matching
    from vinemap.simulate.plants import Vineyard
    from vinemap.simulate.terrain import PLACE, hillside

    area = 1e6 * millions / DENSE_POINTS
    columns = max(round(math.sqrt(area) / (ROW + TRACK)), 1)
    n = max(round(area / (columns * (ROW + TRACK) - TRACK) / (CLOSE + TRACK / ROWS)), 3)
    rng, turn = np.random.default_rng(1), math.radians(18)
    along, left = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    rows = []
    for column in range(columns):
        for k in range(n):
            early, late = rng.uniform(0, 0.8, 2)
            u = column * (ROW + TRACK) + np.linspace(early, ROW - late, round(4 * ROW))[:, None]
            rows.append(PLACE + u * along + (k * CLOSE + k // ROWS * TRACK) * left)
    gaps = (2, 3, 3, 4, 5) * math.ceil(len(rows) / 15)
    canopy: dict[str, Any] = {"height": 1.8, "half_width": 0.3, "leafiness": 7.0}
    vineyard = Vineyard("dense", rows, gaps=gaps, outline=outline(rows, CLOSE / 2), **canopy)
    seen: dict[str, Any] = {"density": DENSE_RAYS, "density_outside": DENSE_POINTS, "surroundings": 3.0, "seed": 1}
    seen |= {"sensor": Matching()}
    return Plot(rows, vineyard, hillside(0.1, uphill=100), seen)


FAMILIES: Mapping[str, Callable[[float], Plot]] = {"F": plot, "dense": dense}


def margin_of(millions: float) -> float:
    """Metres of bare ground about the rows of a parcel on which about so many million points are found."""
    return MARGIN * min(1.0, math.sqrt(millions / 4.7))


def outline(rows: list[Floats], margin: float) -> shapely.Polygon:
    """Parcel of rows and the bare ground about them (m)."""
    import shapely

    return shapely.MultiLineString(rows).convex_hull.buffer(margin)


def survey(millions: float, folder: str, family: str = "F") -> dict[str, Any]:
    """Simulate a survey of that size and family unless it is there; its name holds a hash of how it is made."""
    import geopandas as gpd

    from vinemap.measure.accuracy.canopies import true_volumes
    from vinemap.simulate.survey import simulate, write_survey

    name = f"{family}-{millions:g}M-{_made_by()}"
    cloud = Path(folder, name, f"{name}.laz")
    boundary, truth, volumes = (cloud.with_name(file) for file in ("parcels.gpkg", "truth.gpkg", "volumes.json"))
    if not cloud.is_file():
        made = FAMILIES[family](millions)
        found = simulate([made.vineyard], made.terrain, name=name, **made.seen)
        cloud.parent.mkdir(parents=True, exist_ok=True)
        volumes.write_text(json.dumps(true_volumes(found).tolist()), encoding="utf-8")
        write_survey(found, cloud.parent)
    area = float(gpd.read_file(boundary).area.sum())
    volume = sum(json.loads(volumes.read_text(encoding="utf-8")))
    return {"cloud": str(cloud), "boundary": str(boundary), "truth": str(truth), "area": area, "volume": volume}


def estate(millions: float, parcels: int, folder: str) -> dict[str, Any]:
    """Simulate a survey of that size with many parcels, some way apart, unless it is there."""
    import laspy
    import pandas as pd
    from shapely import affinity

    from vinemap.geo.crs import parse_crs
    from vinemap.simulate.plants import Vineyard
    from vinemap.simulate.survey import simulate

    name = f"{millions:g}M-{parcels}-{_made_by()}"
    cloud = Path(folder, name, f"{name}.laz")
    boundary = cloud.with_name("parcels.gpkg")
    if not cloud.is_file():
        cloud.parent.mkdir(parents=True, exist_ok=True)
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.scales, header.offsets = np.full(3, 0.001), np.array([414_000.0, 4_940_000.0, 300.0])
        header.add_crs(parse_crs("EPSG:32632"))
        draft, polygons = cloud.with_suffix(".part"), []
        made = plot(millions / parcels)
        hull = outline(made.rows, margin_of(millions / parcels))
        apart = np.ptp(np.concatenate(made.rows), axis=0).max() + 2 * MARGIN + 10
        with laspy.open(draft, mode="w", header=header, do_compress=True) as writer:
            for k in range(parcels):
                shift = apart * np.array(divmod(k, 5))
                rows = [row + shift for row in made.rows]
                where = affinity.translate(hull, *shift)
                vineyard = Vineyard(f"{k + 1}", rows, gaps=made.vineyard.gaps, outline=where)
                found = simulate([vineyard], made.terrain, density=DENSITY, density_outside=DENSITY_OUTSIDE, seed=k)
                points = laspy.ScaleAwarePointRecord.zeros(len(found.xyz), header=header)
                points.x, points.y, points.z = found.xyz.T
                writer.write_points(points)
                polygons.append(found.parcels)
        pd.concat(polygons).to_file(boundary, layer="parcels")
        draft.replace(cloud)
    return {"cloud": str(cloud), "boundaries": str(boundary)}


def example(folder: str) -> dict[str, Any]:
    """Write the embedded example unless it is there."""
    from vinemap.simulate.scenes import barolo
    from vinemap.simulate.survey import write_survey

    cloud = Path(folder, f"barolo-{_made_by()}", "barolo.laz")
    if not cloud.is_file():
        write_survey(barolo(), cloud.parent)
    return {"cloud": str(cloud), "boundary": str(cloud.with_name("parcels.gpkg"))}


def _made_by() -> str:
    """Changes when the code does that makes surveys."""
    from vinemap import simulate

    rooms = Path(__file__), *sorted(Path(simulate.__file__).parent.glob("*.py"))
    return f"{zlib.crc32(b''.join(path.read_bytes() for path in rooms)):08x}"
