"""Surveys and parcels by their names: where products lie, and what a single parcel is made of."""

import json

import pytest
import yaml
from squares import Job

from vinemap import paths
from vinemap.config.surveys import load_survey
from vinemap.errors import ConfigError, InputError
from vinemap.jobs import configured
from vinemap.jobs.configured import chosen, map_one, products_folder


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A job in the working folder, and its configuration."""
    monkeypatch.chdir(tmp_path)
    job = Job(tmp_path)
    config = paths.configuration("may")
    config.parent.mkdir()
    config.write_text(yaml.safe_dump({"survey": "may", "cloud": str(job.cloud), "boundaries": str(job.boundaries)}))
    return job


def mapped(monkeypatch, name, parcel):
    """The recipe and the folder that a parcel of a configured survey is mapped by."""
    found = []
    monkeypatch.setattr(configured, "follow", lambda recipe, place, **options: found.append((recipe, place, options)))
    map_one(load_survey(paths.configuration(name)), parcel, step=None)
    ((recipe, place, options),) = found
    return recipe, place, options["within"]


def test_products_lie_in_the_estates_folder_whoever_maps(here, monkeypatch):
    assert chosen("may")[1] == products_folder("may") == paths.survey_products("may")
    assert mapped(monkeypatch, "may", "B")[1:] == (paths.survey_products("may") / "B", paths.survey_products("may"))
    paths.ESTATE.write_text(json.dumps({"surveys": "in", "products": "disk/products"}))
    big = here.folder.parent / "disk" / "products" / "may"
    assert chosen("may")[1].absolute() == big
    assert mapped(monkeypatch, "may", "B")[1].absolute() == big / "B"


def test_a_survey_that_is_not_there_is_said_where_none_has_arrived_yet(here):
    paths.ESTATE.write_text(json.dumps({"surveys": "in"}))
    with pytest.raises(ConfigError, match=r"june\.yaml: no such file, and nothing of that name in in"):
        chosen("june")


def test_one_parcel_is_made_of_what_it_is_made_of_in_a_survey(here, monkeypatch):
    recipes = {one.parcel: one for one in configured.plan_survey(here.config(), here.folder).recipes}
    assert mapped(monkeypatch, "may", "B")[0].key == recipes["B"].key


def test_a_survey_without_boundaries_is_one_parcel_by_its_name(here, monkeypatch):
    paths.configuration("may").write_text(yaml.safe_dump({"survey": "may", "cloud": str(here.cloud)}))
    assert mapped(monkeypatch, "may", "may")[0].boundary is None
    with pytest.raises(InputError, match="B: the survey may has no boundaries, so that it is one parcel: may"):
        mapped(monkeypatch, "may", "B")


def test_a_parcel_that_is_not_there(here, monkeypatch):
    with pytest.raises(InputError, match=r"parcels\.geojson: .*'X'"):
        mapped(monkeypatch, "may", "X")
