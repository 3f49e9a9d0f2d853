"""Names of surveys and parcels, and of their folders."""

import pytest

from vinemap.config.names import check_name, check_parcel
from vinemap.config.surveys import choose_parcel, load_survey
from vinemap.errors import ConfigError
from vinemap.naming import safe


@pytest.mark.parametrize(
    "name", ["../F", "a/b", "a\\b", "", ".hidden", "a" * 80, "con:", "x\n", "end.", "Go!", "a;b", "a%20b"]
)
def test_names_with_characters_of_paths(name):
    with pytest.raises(ConfigError, match="can't name a file"):
        check_name(name)


@pytest.mark.parametrize("name", ["F", "parcel 12", "Cà_Mia-3", "7.b", "60% #2"])
def test_good_names(name):
    assert check_name(name) == check_parcel(name) == safe(name) == name


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("123/4", "123-4"),
        ("CON", "_CON"),
        ("com¹", "_com¹"),
        ("Nul .gpkg", "_Nul .gpkg"),
        ("CONIN$", "_CONIN$"),
        (".hidden", "hidden"),
        ("a%20b", "a-20b"),
        ("Go!", "Go-"),
        ("12;13", "12-13"),
        ("x" * 80, "x" * 64),
    ],
)
def test_names_of_parcels_that_cannot_name_folders(name, folder):
    assert check_parcel(name) == name
    assert safe(name) == folder == safe(folder)


@pytest.mark.parametrize("name", ["", " ", "..", "../F", "a/../b", "a\\..", "...", "a\x07"])
def test_what_names_no_parcel(name):
    with pytest.raises(ConfigError, match="can't name a file, nor a parcel"):
        check_parcel(name)


def test_names_that_yaml_takes_for_something_else(write):
    config = load_survey(write("survey: 2026-06-01\nparcels: ['no', '1', 2026-06-01, 7.b, 1e, 'null']\n"))
    assert config.survey == "2026-06-01"
    assert config.parcels == ["no", "1", "2026-06-01", "7.b", "1e", "null"]
    for word in ("no", "1", "1.5", "012", "off", "1_000", "1:30"):
        with pytest.raises(ConfigError, match=r"parcels\.1 = .*: put it in quotes$"):
            load_survey(write(f"survey: x\nparcels: [A, {word}]\n"))
        with pytest.raises(ConfigError, match="put it in quotes"):
            load_survey(write(f"survey: x\noverrides: {{{word}: {{}}}}\n"))


SURROGATE = '"\\ud800"'
NO_NAMES = ("..", "' '", "''", SURROGATE)
"""What names neither a survey nor a parcel, whose folder may have another name."""


@pytest.mark.parametrize("name", ["..", "/etc", "'C:'", "CON", "nul.txt", "a/b", "' '", "-a", "''", "a*", SURROGATE])
def test_names_of_surveys_parcels_and_overrides(write, name):
    texts = [f"survey: {name}\n", f"survey: x\nparcels: [A, {name}]\n", f"survey: x\noverrides: {{{name}: {{}}}}\n"]
    for text in texts if name in NO_NAMES else texts[:1]:
        with pytest.raises(ConfigError, match="can't name a file") as error:
            load_survey(write(text))
        assert str(error.value).encode()
    for text in () if name in NO_NAMES else texts[1:]:
        assert load_survey(write(text))


def test_names_are_composed(write):
    config = load_survey(write("survey: Ca\u0300\nparcels: [e\u0301]\noverrides: {é: {origin: [44, 7, 100]}}\n"))
    assert (config.survey, config.parcels) == ("Cà", ["é"])
    assert config.of_parcel("é").origin.alt == 100
    assert choose_parcel(config, "e\u0301") == "é"
