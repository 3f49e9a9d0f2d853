"""A picture of an estate's flights side by side: vines one by one, by the height of their canopy, in their rows.

``python -m vinemap.measure.flights PRODUCTS FILE.png`` draws all surveys in a folder of products.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import click
import matplotlib as mpl
import numpy as np
import pyogrio
import shapely
from matplotlib.colors import LinearSegmentedColormap, Normalize
from PIL import Image

from vinemap import paths
from vinemap.errors import InputError
from vinemap.product.qgis.style import GREY, INK, RED, VIGOUR
from vinemap.product.seasons.products import Product, read_products
from vinemap.rows.standing.gaps import MISSING, UNSEEN

if TYPE_CHECKING:
    from collections.abc import Sequence

    import geopandas as gpd
    from matplotlib.axes import Axes

WIDTH, HEIGHT = 4.2, 3.5
"""Inches of a flight."""
COLOURS = 128
"""Colours of the picture."""
LEAST = 0.1
"""Metres, at least, between the lowest and the highest canopy on the scale."""


def draw(products: Path, path: Path) -> None:
    """Draw the flights whose products lie side by side in a folder, the earliest first.

    Parameters
    ----------
    products : Path
        Folder of the surveys' folders.
    path : Path
        PNG file to write.

    Raises
    ------
    InputError
        If there is no product of a survey, or none has vines.
    """
    mpl.use("agg")
    import matplotlib.pyplot as plt

    surveys = [found for folder in sorted(products.glob("*/")) if (found := list(read_products(folder)))]
    surveys.sort(key=lambda found: found[0].flown)
    vines = [[_layer(one, "vines") for one in found] for found in surveys]
    heights = np.concatenate([table["height_m"].to_numpy(dtype=float) for tables in vines for table in tables] or [[]])
    if not np.isfinite(heights).any():
        raise InputError(f"{products}: no survey's products with vines in it")
    low, high = np.nanquantile(heights, [0.02, 0.98])
    scale = Normalize(low, max(high, low + LEAST)), LinearSegmentedColormap.from_list("vigour", VIGOUR)
    figure, axes = plt.subplots(
        1,
        len(surveys),
        figsize=(WIDTH * len(surveys), HEIGHT),
        sharex=True,
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    for plot, found, tables in zip(axes[0], surveys, vines, strict=True):
        _flight(plot, found, tables, scale)
    bar = figure.colorbar(mpl.cm.ScalarMappable(*scale), ax=axes, shrink=0.7, pad=0.01, aspect=30)
    bar.set_label("vines by height (m); ×: missing", color=INK, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=110)
    plt.close(figure)
    Image.open(drawn).convert("RGB").quantize(COLOURS, method=Image.Quantize.FASTOCTREE).save(path, optimize=True)


def _layer(product: Product, name: str) -> gpd.GeoDataFrame:
    return pyogrio.read_dataframe(paths.geopackage(product.folder, product.parcel), layer=name)


def _flight(
    axes: Axes,
    products: Sequence[Product],
    vines: Sequence[gpd.GeoDataFrame],
    scale: tuple[Normalize, mpl.colors.Colormap],
) -> None:
    """One flight: outlines, rows with their numbers, and vines."""
    norm, colours = scale
    for product, table in zip(products, vines, strict=True):
        outline, rows = _layer(product, "parcel"), _layer(product, "rows")
        outline.boundary.plot(ax=axes, color="#5b3f8c", lw=0.8, ls="--")
        top = max(shapely.get_coordinates(outline.geometry).tolist(), key=lambda corner: corner[1])
        axes.annotate(product.parcel, top, fontsize=8, color=INK, ha="center", va="bottom")
        for line, number in zip(rows.geometry, rows["row_id"], strict=True):
            x, y = np.array(line.coords)[:, :2].T
            axes.plot(x, y, color=GREY, lw=0.5)
            angle = np.degrees(np.arctan2(y[1] - y[0], x[1] - x[0]))
            place = {"ha": "right", "va": "center", "rotation": angle, "rotation_mode": "anchor"}
            axes.annotate(f"{number} ", (x[0], y[0]), fontsize=5.5, color=INK, **place)
        gone = table["state"] == MISSING
        standing = table[~gone & (table["state"] != UNSEEN)]
        axes.scatter(
            standing.geometry.x, standing.geometry.y, c=standing["height_m"], norm=norm, cmap=colours, s=5, lw=0
        )
        axes.scatter(table[gone].geometry.x, table[gone].geometry.y, color=RED, s=9, marker="x", lw=1)
    axes.set_title(f"flown {products[0].flown:%Y-%m-%d}", fontsize=9, color=INK)
    axes.set_aspect("equal")
    axes.axis("off")


@click.command()
@click.argument("products", type=click.Path(path_type=Path))
@click.argument("path", type=click.Path(path_type=Path))
def main(products: Path, path: Path) -> None:
    """Draw the flights of an estate."""
    draw(products, path)


if __name__ == "__main__":
    main()
