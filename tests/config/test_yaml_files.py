"""YAML of any kind gives a configuration or a line."""

from pathlib import Path

import pytest

from vinemap.config.surveys import load_estate, load_settings, load_survey
from vinemap.errors import ConfigError

ODD = {
    "python": "a: !!python/object/apply:os.system [ls]",
    "tag": "a: !vine 5",
    "date": "a: !!timestamp may",
    "bool": "a: !!bool maybe",
    "int": "a: !!int maybe",
    "binary number": "a: 0b_",
    "digits": "a: " + "9" * 5000,
    "list as a key": "? [1]\n: 2",
    "tab": "\t- a",
    "two": "a: 1\n---\na: 2",
    "twice": "a: 1\na: 2",
    "twice below": "a: {b: 1, c: 2, b: 3}",
    "deep list": "[" * 800,
    "deep keys": "{a: " * 1000,
    "nul": "a: \0",
    "not there": "a: *b",
}


@pytest.mark.parametrize("what", ODD)
def test_odd_yaml(write, what):
    for load in (load_survey, load_estate, load_settings):
        with pytest.raises(ConfigError, match=r"survey\.yaml: no valid YAML") as error:
            load(write(ODD[what]))
        assert "\n" not in str(error.value)


def test_other_encodings(tmp_path):
    path = tmp_path / "survey.yaml"
    path.write_bytes("\ufeffsurvey: Cà\r\nparcels: [é]\r\n".encode())
    assert load_survey(path).parcels == ["é"]
    for encoding in ("utf-16", "latin-1"):
        path.write_text("survey: Cà\n", encoding=encoding)
        with pytest.raises(ConfigError, match="no valid YAML"):
            load_survey(path)


@pytest.mark.parametrize("key", ["a", "survey", "parcels", "origin", "overrides", "settings", "job"])
def test_laughs_are_few(write, key):
    """Lists of nine times the same, ten deep: 3.5 milliards of words if somebody wrote them out."""
    lists = "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 10))
    with pytest.raises(ConfigError) as error:
        load_survey(write(f"a0: &a0 [ha, ha]\n{lists}{key}: *a9\n"))
    assert len(str(error.value)) < 5000


@pytest.mark.parametrize("text", ["&a [*a]", "survey: &a [*a]", "&a {survey: x, settings: *a, overrides: {A: *a}}"])
def test_what_holds_itself(write, text):
    with pytest.raises(ConfigError):
        load_survey(write(text))


@pytest.mark.parametrize("load", [load_survey, load_estate, load_settings])
def test_files_that_cannot_be_read(tmp_path, load, monkeypatch):
    with pytest.raises(ConfigError, match="no such file: vinemap config prints such files"):
        load(tmp_path / "b.yaml")
    with pytest.raises(ConfigError, match="is a folder: name the file in it"):
        load(tmp_path)
    with pytest.raises(ConfigError, match="can't be read"):
        load(tmp_path / ("x" * 300))
    (tmp_path / "a.yaml").touch()
    monkeypatch.setattr(Path, "read_text", lambda *words, **options: (_ for _ in ()).throw(PermissionError(13, "no")))
    with pytest.raises(ConfigError, match=r"a\.yaml: can't be read \(no\)"):
        load(tmp_path / "a.yaml")
