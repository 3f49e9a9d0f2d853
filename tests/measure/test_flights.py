"""The picture of an estate's flights shows its vines, and crosses out the missing ones."""

import shutil
from datetime import date

import numpy as np
import pytest
from matplotlib.image import imread

from vinemap import paths
from vinemap.config.settings import Settings
from vinemap.errors import InputError
from vinemap.measure.flights import draw
from vinemap.parcel import map_parcel
from vinemap.product.seasons.products import read_products
from vinemap.simulate.survey import write_survey


def test_flights_are_drawn_side_by_side(vineyard, tmp_path):
    cloud = write_survey(vineyard, tmp_path, flown=date(2025, 6, 17))
    products, settings = tmp_path / "products", Settings.model_validate({"missing": {"vine_spacing": 0.9}})
    map_parcel(cloud, products / "one" / "A", parcel="A", boundary=paths.boundaries(tmp_path), settings=settings)
    assert [one.flown.date() for one in read_products(products / "one")] == [date(2025, 6, 17)]
    shutil.copytree(products / "one", products / "two")
    draw(products, tmp_path / "flights.png")
    red, green, blue = np.moveaxis(imread(tmp_path / "flights.png")[..., :3], 2, 0)
    assert red.shape[1] > 2 * red.shape[0]
    missing = (red > 0.7) & (green < 0.35) & (blue < 0.45)
    vines = (green > red + 0.1) & (green > blue + 0.05)
    for half in np.array_split(np.arange(red.shape[1]), 2):
        assert missing[:, half].any()
        assert vines[:, half].mean() > 5e-4


def test_where_there_is_none_a_line_says_so(tmp_path):
    with pytest.raises(InputError, match="no survey's products"):
        draw(tmp_path, tmp_path / "flights.png")
