"""Configurations: what they hold, and what is said of a wrong one."""

import pytest

from vinemap.config import check_name, choose_parcel, load_settings, load_survey
from vinemap.errors import ConfigError
from vinemap.settings import Settings

SURVEY = "survey: barolo\nparcels: [F, curved, blocks]\n"


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "survey.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_survey_with_settings(write):
    config = load_survey(write(SURVEY + "origin: [44.6, 7.9, 428.7]\nsettings:\n  fit: {smoothing: 5}\n"))
    assert config.parcels == ["F", "curved", "blocks"]
    assert config.origin.lat == 44.6
    assert config.settings.fit.smoothing == 5
    assert config.settings.ground == Settings().ground


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SURVEY + "setings: {}\n", "unknown key setings: did you mean 'settings'?"),
        (
            SURVEY + "settings: {ground: {resolutoin: 1}}\n",
            "unknown key settings.ground.resolutoin: did you mean 'resolution'?",
        ),
        (
            SURVEY + "settings: {ground: {resolution: 0}}\n",
            "settings.ground.resolution = 0: input should be greater than or equal to 0.05",
        ),
        (SURVEY + "settings: {cover: {low: 3}}\n", r"low (3.0) must be below high (2.9)"),
        (SURVEY + "settings: {polygon: {c: 4}}\n", "settings.polygon.c = 4"),
        ("parcels: [F]\n", "survey is missing"),
        ("survey: ../x\nparcels: [F]\n", "'../x' can't name a file"),
        ("survey: [\n", "no valid YAML"),
        ("just words\n", "the file = 'just words'"),
    ],
)
def test_what_is_wrong_is_named(write, text, said):
    with pytest.raises(ConfigError) as error:
        load_survey(write(text))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_missing_file_names_the_nearest(write):
    path = write(SURVEY)
    with pytest.raises(ConfigError, match=r"did you mean .*survey\.yaml"):
        load_survey(path.with_name("survay.yaml"))


def test_settings_alone(write):
    assert load_settings(write("polygon: {c: 9}\n")).polygon.c == 9
    assert load_settings(write("")) == Settings()


def test_unknown_parcel_suggests_the_nearest(write):
    config = load_survey(write(SURVEY))
    assert choose_parcel(config, "F") == "F"
    with pytest.raises(ConfigError, match="did you mean 'curved'"):
        choose_parcel(config, "curvd")
    with pytest.raises(ConfigError, match="did you mean 'F'"):
        choose_parcel(config, "f")
    with pytest.raises(ConfigError, match="known are F, curved, blocks"):
        choose_parcel(config, "zzz")


@pytest.mark.parametrize("name", ["../F", "a/b", "a\\b", "", ".hidden", "a" * 80, "con:", "x\n", "end."])
def test_names_with_characters_of_paths(name):
    with pytest.raises(ConfigError, match="can't name a file"):
        check_name(name)


@pytest.mark.parametrize("name", ["F", "parcel 12", "Cà_Mia-3", "7.b"])
def test_good_names(name):
    assert check_name(name) == name


def test_defaults_of_settings_are_those_of_the_stages():
    """A stage called without options works as one called with the default settings."""
    import inspect

    from vinemap import canopy, clustering, cover, curves, ground, key_points, row_field, row_fit, sections

    stages = {
        "ground": ground.terrain_model,
        "cover": cover.canopy_cover,
        "row_field": row_field.estimate_row_field,
        "key_points": key_points.detect_key_points,
        "clustering": clustering.cluster_rows,
        "curves": curves.trace_rows,
        "fit": row_fit.fit_rows,
        "sections": sections.cut_sections,
        "canopy": [canopy.separate_canopy, canopy.living_canopies],
    }
    for name, options in Settings().model_dump().items():
        if name in stages:
            functions = stages[name] if isinstance(stages[name], list) else [stages[name]]
            parameters = [p for function in functions for p in inspect.signature(function).parameters.values()]
            defaults = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
            assert defaults == options | {k: Settings().cover.model_dump()[k] for k in defaults if k not in options}
