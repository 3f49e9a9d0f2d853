"""The picture of a product shows its rows, its gaps and its canopies."""

import numpy as np
from matplotlib.image import imread

from vinemap.measure.picture import draw
from vinemap.parcel import map_parcel
from vinemap.simulate.survey import write_survey


def test_both_halves_are_drawn(vineyard, tmp_path):
    cloud = write_survey(vineyard, tmp_path)
    map_parcel(cloud, tmp_path / "A", parcel="A", boundary=cloud.with_name("parcels.gpkg"))
    draw(tmp_path / "A", "A", tmp_path / "a.png")
    red, green, blue = np.moveaxis(imread(tmp_path / "a.png")[..., :3], 2, 0)
    half = red.shape[1] // 2
    gaps = (red > 0.7) & (green < 0.3) & (blue < 0.4)
    assert gaps[:, :half].mean() > 5e-4
    assert not gaps[:, half:].any()
    foliage = (green > red + 0.1) & (green > blue + 0.15)
    assert foliage[:, half:].mean() > 0.02
