"""Commented configurations say all that can be configured, and nothing else."""

from typing import get_args

import pytest
import yaml
from pydantic.fields import FieldInfo

from vinemap.config import template as module
from vinemap.config.settings import Options, Settings
from vinemap.config.surveys import EstateConfig, SurveyConfig, load_estate, load_settings, load_survey
from vinemap.config.template import KINDS, template
from vinemap.errors import ConfigError


def leaves(model, place=""):
    """Fields of a model and of those in it, by their places."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Options):
            yield from leaves(field.annotation, f"{place}{name}.")
        else:
            yield f"{place}{name}", field


FIELDS = {f"{kind}:{place}": field for kind, model in KINDS.items() for place, field in leaves(model)}


def given(data, place=""):
    """Places of what a file states."""
    for name, value in data.items():
        if isinstance(value, dict) and value:
            yield from given(value, f"{place}{name}.")
        else:
            yield f"{place}{name}"


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "a.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_what_it_says_are_the_defaults(write):
    assert load_estate(write(template("estate"))).model_dump() == EstateConfig().model_dump()
    assert load_settings(write(template("settings"))) == Settings()
    survey = load_survey(write(template("survey")))
    assert survey == SurveyConfig(survey=survey.survey)


@pytest.mark.parametrize("kind", KINDS)
def test_it_says_every_key(kind):
    text = template(kind)
    assert list(given(yaml.safe_load(text))) == [place for place, _ in leaves(KINDS[kind])]
    for line in text.splitlines():
        assert len(line) < 160
        assert line == line.rstrip()
        assert "#" in line or line.endswith(":") or not line
    assert text.endswith("\n")


@pytest.mark.parametrize("field", FIELDS.values(), ids=FIELDS)
def test_every_key_is_described(field):
    assert field.description
    assert field.description == field.description.strip().rstrip(".")
    assert "\n" not in field.description


def numeric(field):
    return {int, float} & {field.annotation, *get_args(field.annotation)}


def bounds(field):
    kinds = {type(one).__name__ for one in field.metadata}
    return bool(kinds & {"Ge", "Gt"}), bool(kinds & {"Le", "Lt"})


def test_every_number_has_bounds():
    numbers = {name: field for name, field in FIELDS.items() if numeric(field)}
    assert len(numbers) > 50
    without = [name for name, field in numbers.items() if not bounds(field)[0]]
    assert without == []
    counts = {"settings.reading.max_points", "settings.clustering.min_points", "settings.canopy.min_points"}
    above = {name.partition(":")[2] for name, field in numbers.items() if not bounds(field)[1]}
    assert {f"settings.{name.removeprefix('settings.')}" for name in above} <= counts  # any number of points may do


def test_bounds_and_choices_in_words():
    lines = {line.strip().partition(":")[0]: line for line in template("estate").splitlines() if "#" in line}
    assert "  # seconds that a parcel may take (above 0 to 1000000)" in lines["limit"]
    assert lines["engine"].endswith("(vinemap or pdal)") or lines["engine"].endswith("(processes or dask)")
    assert lines["workers"].strip().startswith("workers: null  # ")
    assert lines["surveys"].startswith("surveys: data/surveys  # ")
    assert lines["cron"].startswith("cron: 0 2 * * *  # ")
    assert lines["overrides"].startswith("overrides: {}  # ")


@pytest.mark.parametrize(
    "value",
    [None, True, 5, 0.25, 1e-9, "no", "1", "a: b", "# a", "", "é", "x" * 150, "- a", "'", '"', "*a", "2026-06-01", {}],
)
def test_defaults_of_any_kind(value):
    """A default stands in one line, before its comment, and is read as what it is."""
    line = f"a: {module._default(FieldInfo(default=value), 'a')}  # about it\n"
    assert yaml.safe_load(line) == {"a": value} or str(yaml.safe_load(line)["a"]) == value


@pytest.mark.parametrize("kind", ["estate", "settings"])
def test_a_value_that_is_out_of_bounds_is_refused(write, kind):
    """Every number in turn, below what may be."""
    load = {"estate": load_estate, "settings": load_settings}[kind]
    for place, field in leaves(KINDS[kind]):
        if numeric(field):
            data = -1e9
            for key in reversed(place.split(".")):
                data = {key: data}
            with pytest.raises(ConfigError, match=place.replace(".", r"\.")):
                load(write(yaml.safe_dump(data)))
