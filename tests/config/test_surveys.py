"""Configurations: what they hold, and what is said of a wrong one."""

from pathlib import Path

import pytest

from vinemap.config.settings import Settings
from vinemap.config.surveys import choose_parcel, load_estate, load_settings, load_survey
from vinemap.errors import ConfigError

SURVEY = "survey: barolo\nparcels: [F, curved, blocks]\n"


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
        (SURVEY + "settings: {cover: {low: 4}}\n", r"low (4.0) must be below high (3.6)"),
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


def test_defaults_of_settings_are_those_of_the_stages():
    """A stage called without options works as one called with the default settings."""
    import inspect

    from vinemap.canopy.foliage import living_canopies, separate_canopy
    from vinemap.canopy.model import model_sections
    from vinemap.canopy.sections import cut_sections
    from vinemap.rows.clusters import cluster_rows
    from vinemap.rows.curves import trace_rows
    from vinemap.rows.field import estimate_row_field
    from vinemap.rows.fit import fit_rows
    from vinemap.rows.key_points import detect_key_points
    from vinemap.rows.known import follow_lines
    from vinemap.surfaces.cover import canopy_cover
    from vinemap.surfaces.ground import terrain_model
    from vinemap.surfaces.map import PDALS

    stages = {
        "ground": [terrain_model],
        "cover": [canopy_cover],
        "row_field": [estimate_row_field],
        "key_points": [detect_key_points],
        "clustering": [cluster_rows],
        "rows": [follow_lines],
        "curves": [trace_rows],
        "fit": [fit_rows],
        "sections": [cut_sections],
        "canopy": [separate_canopy, living_canopies],
        "polygon": [model_sections],
    }
    others = Settings().cover.model_dump() | Settings().canopy.model_dump()
    for name, options in Settings().model_dump().items():
        if name in stages:
            parameters = [p for function in stages[name] for p in inspect.signature(function).parameters.values()]
            defaults = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
            for own in ("align", *PDALS):  # the chain's
                options.pop(own, None)
            assert defaults == options | {k: others[k] for k in defaults if k not in options}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("overrides: {A: {setings: {}}}", "overrides.A.setings: did you mean 'settings'?"),
        ("overrides: {A: {settings: {gruond: {}}}}", "overrides.A.settings.gruond: did you mean 'ground'?"),
        (
            "overrides: {A: {settings: {ground: {resolutoin: 1}}}}",
            "overrides.A.settings.ground.resolutoin: did you mean 'resolution'?",
        ),
        ("overrides: {A: {cloud: b.laz}}", "overrides.A.cloud: known are origin, settings"),
        ("overides: {}", "overides: did you mean 'overrides'?"),
        ("job: {limt: 1}", "job.limt: did you mean 'limit'?"),
    ],
)
def test_misspelt_keys_at_every_level(write, text, said):
    with pytest.raises(ConfigError) as error:
        load_survey(write(f"survey: x\n{text}\n"))
    assert str(error.value).endswith(f"survey.yaml: unknown key {said}")


def test_what_is_wrong_for_all_is_said_once(write):
    text = "survey: x\nsettings: {polygon: {c: 4}}\norigin: [0, 999, 0]\noverrides: {A: {}, B: {settings: {fit: {}}}}\n"
    with pytest.raises(ConfigError) as error:
        load_survey(write(text))
    assert str(error.value).count("polygon.c = 4") == str(error.value).count("lies nowhere") == 1
    with pytest.raises(ConfigError, match=r"overrides\.B\.settings\.polygon\.c = 3"):
        load_survey(write("survey: x\noverrides: {A: {}, B: {settings: {polygon: {c: 3}}}}\n"))


@pytest.mark.parametrize(
    "text",
    [
        "job: {limit: .inf}",
        "job: {limit: .nan}",
        "job: {limit: 0}",
        "job: {memory: 0.1}",
        "job: {workers: 0}",
        "job: {engine: dask}",
        "job: {scheduler: 'tcp://a:8786'}",
        "origin: [.nan, 7, 1]",
        "origin: [44, 7, .inf]",
        "origin: [44, 181, 0]",
        "origin: [44, 7]",
        "settings: {ground: {resolution: .nan}}",
        "settings: {cover: {high: -.inf}}",
        "crs: EPSG:99",
        "parcels: []",
        "parcels: A",
        "overrides: {A: 5}",
        "parcels: [A]\noverrides: {B: {}}",
        "simulate: barolo",
    ],
)
def test_values_that_cannot_be(write, text):
    with pytest.raises(ConfigError):
        load_survey(write(f"survey: x\n{text}\n"))


def test_parcels_inherit_what_they_leave_open(write):
    config = load_survey(
        write(
            "survey: x\norigin: [44, 7, 100]\nsettings: {polygon: {c: 9}, fit: {smoothing: 5}}\n"
            "overrides:\n  A: {settings: {fit: {min_gap: 1}}}\n"
            "  B: {origin: [45, 8, 0], settings: {polygon: {c: 11}}}\n  C:\n"
        )
    )
    other, a, b, c = (config.of_parcel(name) for name in ("other", "A", "B", "C"))
    assert other == c
    assert (other.origin.lat, other.settings.polygon.c, other.settings.fit.smoothing) == (44, 9, 5)
    assert (a.origin.lat, a.settings.polygon.c, a.settings.fit.smoothing, a.settings.fit.min_gap) == (44, 9, 5, 1)
    assert (b.origin.lat, b.settings.polygon.c, b.settings.fit.smoothing) == (45, 11, 5)


def test_null_is_said_and_an_empty_section_says_nothing(write, tmp_path):
    common = "origin: [44, 7, 100]\nsettings: {missing: {vine_spacing: 0.9}, fit: }\njob:\n"
    estate = load_estate(
        write(f"{common}rows: all.gpkg\noverrides:\n  A: {{settings: {{missing: {{vine_spacing: null}}}}}}\n")
    )
    assert estate.settings.fit == Settings().fit
    assert estate.of_parcel("A").settings.missing.vine_spacing is None
    own = tmp_path / "own.yaml"
    own.write_text("rows: null\ncloud: null\norigin: null\nsettings: {missing: {vine_spacing: null}}\noverrides:\n")
    config = estate.of_survey("may", own, cloud=Path("a.laz"), boundaries=None)
    assert (config.cloud, config.rows, config.origin) == (Path("a.laz"), Path("all.gpkg"), None)
    assert config.settings.missing.vine_spacing is None
    own.write_text("settings:\njob:\n")
    assert estate.of_survey("may", own).settings.missing.vine_spacing == 0.9
    own.write_text("settings:\n  # fit: {smoothing: 5}\n")
    assert load_settings(own) == Settings()


def test_surveys_inherit_what_they_leave_open(write, tmp_path):
    """Estate, survey, parcel: the nearest counts, key by key."""
    estate = load_estate(
        write(
            "settle: 5\ncrs: EPSG:32632\njob: {limit: 60, workers: 1}\n"
            "settings: {polygon: {c: 9}, fit: {smoothing: 5}}\n"
            "overrides: {A: {settings: {polygon: {c: 10}}}, e\u0301: &n {settings: {polygon: {c: 12}}}, North 3: *n}\n"
        )
    )
    own = tmp_path / "own.yaml"
    own.write_text(
        "settings: {fit: {smoothing: 6}}\njob: {limit: 90}\noverrides: {A: {settings: {fit: {min_gap: 2}}}}\n"
    )
    config = estate.of_survey("may", own)
    assert (config.survey, config.crs, config.job.limit, config.job.workers) == ("may", "EPSG:32632", 90, 1)
    assert (config.settings.polygon.c, config.settings.fit.smoothing) == (9, 6)
    a = config.of_parcel("A").settings
    assert (a.polygon.c, a.fit.smoothing, a.fit.min_gap) == (10, 6, 2)
    own.write_text("parcels: [é, B,  North   3]\n", encoding="utf-8")
    config = estate.of_survey("june", own)
    assert config.of_parcel("é").settings.polygon.c == 12
    assert list(config.overrides) == ["é", "North 3"]
    assert estate.of_survey("may", None, cloud=Path("a.laz")).cloud == Path("a.laz")
    assert list(estate.of_survey("may", None).overrides) == ["A", "é", "North 3"]
    own.write_text("overrides: {A: {}, B: {}}\n")
    assert estate.of_survey("may", own).own_overrides() == {"B"}


def test_a_parcel_that_states_nothing_is_no_other_for_it(write):
    """What it leaves open isn't taken from the defaults."""
    config = load_survey(write("survey: x\nsettings: {polygon: {c: 9}}\noverrides: {A: {settings: {}}}\n"))
    assert config.of_parcel("A") == config.of_parcel("B")
