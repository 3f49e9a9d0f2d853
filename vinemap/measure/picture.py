"""A picture of a product: its rows over the terrain and the canopies' height, and its meshes seen from above.

``python -m vinemap.measure.picture PRODUCT PARCEL FILE.png`` draws README's.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
import geopandas as gpd
import matplotlib as mpl
import numpy as np
import rasterio
import shapely
from matplotlib.collections import PolyCollection
from matplotlib.colors import LightSource, LinearSegmentedColormap, Normalize

from vinemap import paths
from vinemap.product.gltf import read_glb
from vinemap.product.qgis.style import CANOPY, GREY, HIGHEST_CANOPY, INK, LOWEST_CANOPY, RED, VIGOUR
from vinemap.rows.standing.gaps import MISSING, UNSEEN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

SIZE = (12.0, 4.0)
SUN = np.array([-0.62, -0.3, 0.72])
TILT = 42.0
"""Degrees above the horizon from which the meshes are seen."""
TURN = -24.0
"""Degrees by which they are turned, anticlockwise."""
FOLIAGE, SOIL = np.array([0.45, 0.68, 0.33]), np.array([0.93, 0.88, 0.80])
TERRAIN_STEP = 2
"""Cells of the DTM a facet of the ground."""


def draw(product: Path, parcel: str, path: Path) -> None:
    """Draw a parcel's product.

    Parameters
    ----------
    product : Path
        Its folder.
    parcel : str
        Its name.
    path : Path
        PNG file to write.
    """
    mpl.use("agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=SIZE, width_ratios=(1, 1.15), layout="constrained")
    _map(left, product, parcel)
    _scene(right, product, parcel)
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)


def _map(axes: Axes, product: Path, parcel: str) -> None:
    layers = {name: gpd.read_file(paths.geopackage(product, parcel), layer=name) for name in ("rows", "gaps", "parcel")}
    chm, where = _read(paths.raster(product, parcel, "chm"))
    dtm, _ = _read(paths.raster(product, parcel, "dtm"))
    relief = LightSource(azdeg=315, altdeg=45).hillshade(dtm, vert_exag=2, dx=0.25, dy=0.25)
    outline = layers["parcel"].union_all()
    x = np.linspace(*where[:2], chm.shape[1])
    y = np.linspace(*where[:1:-1], chm.shape[0])
    inside = shapely.contains_xy(outline, *np.meshgrid(x, y))
    axes.imshow(np.where(inside, relief, np.nan), extent=where, cmap="gray", vmin=-1.2, vmax=1.0)
    heights = np.where(inside & (chm > LOWEST_CANOPY), chm, np.nan)
    canopy = LinearSegmentedColormap.from_list("canopy", CANOPY[1:])
    axes.imshow(heights, extent=where, cmap=canopy, vmin=LOWEST_CANOPY, vmax=HIGHEST_CANOPY, interpolation="none")
    rows = layers["rows"]
    volume = rows["volume_m3"] / rows["length_m"]
    colours = LinearSegmentedColormap.from_list("vigour", VIGOUR)(Normalize()(volume.to_numpy()))
    for line, label, colour in zip(rows.geometry, rows["label"], colours, strict=True):
        x, y = np.array(line.coords)[:, :2].T
        axes.plot(x, y, color=INK, lw=2.6, solid_capstyle="butt")
        axes.plot(x, y, color=colour, lw=1.7, solid_capstyle="butt")
        angle = np.degrees(np.arctan2(y[1] - y[0], x[1] - x[0]))
        place = {"ha": "right", "va": "center", "rotation": angle, "rotation_mode": "anchor"}
        axes.annotate(str(label).split()[0] + " ", (x[0], y[0]), fontsize=6, color=INK, **place)
    for state, gaps in layers["gaps"].groupby("state"):
        gaps.plot(ax=axes, color={MISSING: RED, UNSEEN: GREY}[state], lw=3, capstyle="butt")
    layers["parcel"].boundary.plot(ax=axes, color="#5b3f8c", lw=1, ls="--")
    west, south, east, north = layers["parcel"].total_bounds
    axes.set(xlim=(west - 4, east + 1), ylim=(south - 1, north + 1), aspect="equal")
    axes.axis("off")


def _read(path: Path) -> tuple[NDArray[np.float64], tuple[float, float, float, float]]:
    with rasterio.open(path) as source:
        box = source.bounds
        return source.read(1, masked=True).filled(np.nan), (box.left, box.right, box.bottom, box.top)


def _scene(axes: Axes, product: Path, parcel: str) -> None:
    """Facets of ground and canopies in their order from back to front, lit by the sun."""
    facets = [_ground(product, parcel), _canopies(product, parcel)]
    corners = np.concatenate([at for at, _ in facets])
    colours = np.concatenate([np.broadcast_to(colour, (len(at), 3)) for at, colour in facets])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    light = 0.5 + 0.5 * np.clip(normals @ SUN / np.where(lengths > 0, lengths, 1), 0, 1)
    tilt, turn = np.radians([TILT, TURN])
    middle = corners.reshape(-1, 3).mean(axis=0)
    x, y, z = np.moveaxis(corners - middle, 2, 0)
    x, y = x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)
    seen = np.stack([x, y * np.sin(tilt) + z * np.cos(tilt)], axis=-1)
    depth = (y * np.cos(tilt) - z * np.sin(tilt)).mean(axis=1) + np.where(np.arange(len(x)) < len(facets[0][0]), 2.0, 0)
    order = np.argsort(-depth)
    lit = np.clip(colours * light[:, None], 0, 1)[order]
    axes.add_collection(PolyCollection(list(seen[order]), facecolors=lit, edgecolors=lit, linewidths=0.3))
    low, high = seen.reshape(-1, 2).min(axis=0), seen.reshape(-1, 2).max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.axis("off")


Facets = tuple["NDArray[np.float64]", "NDArray[np.float64]"]


def _ground(product: Path, parcel: str) -> Facets:
    """Triangles (n, 3, 3) of the terrain within the parcel, in the order from south to north, and their colour."""
    values, (west, east, south, north) = _read(paths.raster(product, parcel, "dtm"))
    outline = gpd.read_file(paths.geopackage(product, parcel), layer="parcel").union_all()
    ny, nx = values.shape
    x = np.linspace(west, east, nx, endpoint=False)[::TERRAIN_STEP]
    y = np.linspace(north, south, ny, endpoint=False)[::TERRAIN_STEP]
    grid = np.dstack([*np.meshgrid(x, y), values[::TERRAIN_STEP, ::TERRAIN_STEP]])
    nw, ne, sw, se = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    corners = np.concatenate([np.stack(t, axis=2).reshape(-1, 3, 3) for t in ((nw, sw, se), (nw, se, ne))])
    inside = shapely.contains_xy(outline, *corners.mean(axis=1)[:, :2].T)
    return corners[inside & np.isfinite(corners).all(axis=(1, 2))], SOIL


def _canopies(product: Path, parcel: str) -> Facets:
    """Triangles (n, 3, 3) of the canopies, and their colour."""
    meshes = read_glb(paths.canopy_mesh(product, parcel)).meshes
    return np.concatenate([np.empty((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)]), FOLIAGE


@click.command()
@click.argument("product", type=click.Path(path_type=Path))
@click.argument("parcel")
@click.argument("path", type=click.Path(path_type=Path))
def main(product: Path, parcel: str, path: Path) -> None:
    """Draw the product of a parcel."""
    draw(product, parcel, path)


if __name__ == "__main__":
    main()
