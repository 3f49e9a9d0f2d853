"""What tests of STAC metadata share."""

import json
import socket

import pystac
import pytest
from catalogs import SCHEMAS
from pystac.validation import JsonSchemaSTACValidator

from vinemap.product.recipe import read_source


@pytest.fixture
def no_network(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("the network was asked for")

    monkeypatch.setattr(socket, "create_connection", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


@pytest.fixture(scope="session")
def validator():
    found = JsonSchemaSTACValidator()
    found.schema_cache |= SCHEMAS
    return found


@pytest.fixture
def validate(validator):
    """Check a file of STAC, and give it; the schemas it was held against must be those of its kind."""

    def check(path, *extensions):
        known = json.loads(path.read_text(encoding="utf-8"))
        kind = "item" if known["type"] == "Feature" else "collection"
        against = pystac.validation.validate_dict(known, validator=validator)
        assert against == [f"https://schemas.stacspec.org/v1.1.0/{kind}-spec/json-schema/{kind}.json", *extensions]
        assert "NaN" not in path.read_text(encoding="utf-8")
        return known

    return check


@pytest.fixture(scope="session")
def source(tmp_path_factory):
    """A cloud and boundaries, as far as a survey's item wants to know of them."""
    folder = tmp_path_factory.mktemp("surveys") / "barolo 2024"
    folder.mkdir()
    files = folder / "barolo #1.laz", folder / "parcels.gpkg"
    for path in files:
        path.write_bytes(path.name.encode())
    return [(path, read_source(path).record()) for path in files]
