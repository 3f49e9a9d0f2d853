"""Scenes to simulate: shapes of rows, the example survey, and an estate that is flown in three years.

``python -m vinemap.simulate.scenes data/surveys`` writes the three flights of that estate.
"""

from __future__ import annotations

import math
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import shapely
import shapely.ops
from scipy.interpolate import PchipInterpolator

from vinemap import paths
from vinemap.geo.crs import from_wgs84, parse_crs
from vinemap.geo.main import Origin, main_to_wgs84
from vinemap.simulate.plants import Vineyard
from vinemap.simulate.rays import Obstacle
from vinemap.simulate.survey import Survey, simulate, write_survey
from vinemap.simulate.terrain import PLACE, hillside, surface_through

if TYPE_CHECKING:
    from vinemap.simulate.terrain import Array

TABLE_2_1_ORIGIN = Origin(44.611669149, 7.924423195, 428.735)
ROW_14_BEND = 0.6
"""How far row 14 keeps off its chord (m): row 15's start lies 0.9 m off that chord, and the rows 1.5 m apart."""
SHORTEST = 6.0
"""Metres of a row that fills a corner, at least."""
FLIGHTS = {"2024-05": date(2024, 5, 14), "2025-06": date(2025, 6, 17), "2026-07": date(2026, 7, 7)}
"""Flights of the estate, and their days."""


def rows_of(
    n: int = 8,
    *,
    length: float = 40.0,
    spacing: float = 2.5,
    azimuth: float = 0.0,
    radius: float = math.inf,
    fan: float = 0.0,
    centre: tuple[float, float] = PLACE,
) -> list[Array]:
    """Rows side by side: parallel, fanned, or on concentric arcs.

    Parameters
    ----------
    n, length, spacing : int, float, float
        Number of rows, length of the middle one and distance between them (m).
    azimuth : float
        Direction of the rows, degrees anticlockwise from east. Rows are numbered towards its left.
    radius : float
        Of the middle row (m); positive bends to the left. Rows on arcs subtend the same angle.
    fan : float
        Angle between the first and the last row (degrees), each turned about its middle.
    centre : tuple
        Middle of the block, x and y (m).

    Returns
    -------
    list of array (m, 2)
    """
    u = np.linspace(-length / 2, length / 2, int(length / 0.25) + 2)
    rows = []
    for i in range(n):
        v = (i - (n - 1) / 2) * spacing
        if math.isfinite(radius):
            along, across = (radius - v) * np.sin(u / radius), radius - (radius - v) * np.cos(u / radius)
        else:
            turn = math.radians(fan) * (i / max(n - 1, 1) - 0.5)
            along, across = u * math.cos(turn), v + u * math.sin(turn)
        cos, sin = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        rows.append(np.column_stack([centre[0] + along * cos - across * sin, centre[1] + along * sin + across * cos]))
    return rows


def rows_in(outline: shapely.Polygon, *, spacing: float, azimuth: float) -> list[Array]:
    """Straight rows (m, 2) that fill a convex outline from edge to edge, as those of a block do that ends at tracks.

    Spacing and azimuth are as of :func:`rows_of`. A corner in which a row would be shorter than ``SHORTEST`` has none.
    """
    x, y = outline.centroid.coords[0]
    reach = float(shapely.hausdorff_distance(outline.centroid, outline))
    n = 2 * int(reach / spacing) + 1
    lines = rows_of(n, length=2 * reach, spacing=spacing, azimuth=azimuth, centre=(x, y))
    inside = shapely.intersection([shapely.LineString(line) for line in lines], outline)
    return [np.array(line.segmentize(0.25).coords) for line in inside if line.length >= SHORTEST]


def barolo(*, density: float = 380.0, density_outside: float = 60.0) -> Survey:
    """Survey of three parcels in Barolo, EPSG:32632: Table 2.1's parcel F, a contour vineyard, two blocks.

    F's rows end where the thesis's do and keep its mean elevations; the rest of the hillside is made up.

    Parameters
    ----------
    density, density_outside : float
        Rays a square metre inside parcels and outside.
    """
    data = np.genfromtxt(paths.TABLE_2_1, delimiter=",", names=True)
    crs = parse_crs("EPSG:32632")
    main = [np.column_stack([data[f"{axis}{end}"] for axis in "xyz"]) for end in ("1", "n_corrected")]
    e1, en = (from_wgs84(main_to_wgs84(end, TABLE_2_1_ORIGIN), crs) for end in main)
    along = np.linspace(0, 1, 61)[:, None]
    rows = [first + (last - first) * along for first, last in zip(e1[:, :2], en[:, :2], strict=True)]
    chord = en[13, :2] - e1[13, :2]
    length = float(np.linalg.norm(chord))
    nearest = (e1[14, :2] - e1[13, :2]) @ chord / length**2
    bend = PchipInterpolator([0, nearest, 1], [0, -ROW_14_BEND, 0])(np.linspace(0, 1, 241))[:, None]
    rows[13] = e1[13, :2] + chord * np.linspace(0, 1, 241)[:, None] + bend * np.array([-chord[1], chord[0]]) / length

    curved = rows_of(10, length=60, radius=50, azimuth=20, centre=(414865, 4940773))
    blocks = rows_of(8, length=40, spacing=2.4, azimuth=-80, centre=(414764, 4940736))
    blocks += rows_of(9, length=35, spacing=2.8, azimuth=-35, centre=(414800, 4940733))
    # {Main} is a tangent plane: what lies 0.4 km from its origin stands 1 cm higher above the ellipsoid.
    lift = np.mean([e1[:, 2] - main[0][:, 2], en[:, 2] - main[1][:, 2]], axis=0)
    means = [(end[None, :2], float(end[2])) for end in np.concatenate([e1, en])]
    means += [(row, float(z)) for row, z in zip(rows, data["elevation_as_printed_m"] + lift, strict=True)]
    contours = np.concatenate([row[::24] for row in curved[::3]])
    apex = np.array([414865 - 50 * math.sin(math.radians(20)), 4940773 + 50 * math.cos(math.radians(20))])
    up = 474 + 0.25 * (50 - np.linalg.norm(contours - apex, axis=1)) + 0.03 * (contours[:, 0] - 414865)
    means += [(xy[None], float(z)) for xy, z in zip(contours, up, strict=True)]
    terrain = surface_through(means, hillside(0.15, uphill=100, undulation=0.06, elevation=467, seed=1))
    return simulate(
        [
            Vineyard("F", rows, gaps=(2, 3, 3, 4, 5)),
            Vineyard("curved", curved, height=1.85, half_width=0.25, gaps=(2, 3, 4, 5)),
            Vineyard("blocks", blocks, height=2.0, half_width=0.3, dead=0.04, gaps=(2, 3, 5)),
        ],
        terrain,
        name="barolo",
        density=density,
        density_outside=density_outside,
        obstacles=[
            Obstacle(414784, 4940725, 2.2, 2.0, 5.2, bottom=1.4),
            Obstacle(414783, 4940750, 2.0, 1.6, 2.7, solid=True),
        ],
        seed=1,
    )


def estate(flight: str, *, density: float = 250.0) -> Survey:
    """An estate of three parcels as one of :data:`FLIGHTS` sees it: what stands there is the same but for what follows.

    Canopies grow. Row 3 of "Bric" lacks its last four vines until 2026, row 2 of it two vines, row 4 of "Conca" one,
    and row 5 of "Bric" three from 2025 on. "Costa" is planted anew by 2026, closer and in another direction. The later
    flights lie aside.

    Parameters
    ----------
    flight : str
        Its name.
    density : float
        Rays a square metre.
    """
    year, (x, y), vine = FLIGHTS[flight].year, PLACE, 0.9
    height, shift = {2024: (1.2, (0.0, 0.0)), 2025: (1.7, (0.24, -0.16)), 2026: (1.9, (-0.18, 0.13))}[year]
    bric = rows_of(7, length=45 * vine, azimuth=15, centre=(x, y))
    conca = rows_of(6, length=38 * vine, radius=60, azimuth=15, centre=(x - 6, y + 24))
    costa = rows_of(6, length=32 * vine, azimuth=100, centre=(x + 40, y + 22))
    outlines = [shapely.MultiLineString(rows).convex_hull.buffer(3.0) for rows in (bric, conca, costa)]
    if year < 2026:
        end = shapely.LineString(bric[2])
        bric[2] = np.array(shapely.ops.substring(end, 0, 41 * vine).coords)
    else:
        costa = rows_in(outlines[2].buffer(-2.0), spacing=2.2, azimuth=85)
    lost = [(bric[1], 18, 2), (conca[3], 25, 1), *([(bric[4], 30, 3)] if year > 2024 else [])]
    bare = [shapely.ops.substring(shapely.LineString(row + shift), k * vine, (k + n) * vine) for row, k, n in lost]
    gaps = shapely.MultiPolygon(shapely.buffer(bare, 0.3, cap_style="flat").tolist())
    young = {"height": 0.9, "half_width": 0.18, "bottom": 0.3} if year == 2026 else {"height": height}
    planted: list[tuple[str, list[Array], dict[str, Any]]] = [
        ("Bric", bric, {"height": height}),
        ("Conca", conca, {"height": height}),
        ("Costa", costa, young),
    ]
    vineyards = [
        Vineyard(name, [row + shift for row in rows], outline=outline, bare=gaps, dead=0.0, vine_spacing=vine, **how)
        for (name, rows, how), outline in zip(planted, outlines, strict=True)
    ]
    return simulate(vineyards, hillside(0.12), name=flight, density=density, seed=year)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
def main(folder: Path) -> None:
    """Write the flights of the estate, each into a folder of its name in FOLDER, with its parcels and what is true."""
    for flight, day in FLIGHTS.items():
        click.echo(f"{day}: {write_survey(estate(flight), folder / flight, flown=day)}")


if __name__ == "__main__":
    main()
