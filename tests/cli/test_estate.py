"""Configured surveys on the command line, where Prefect isn't installed."""

import pytest
from click.testing import CliRunner

from vinemap.cli.main import commands
from vinemap.errors import ConfigError
from vinemap.simulate.survey import write_survey


@pytest.fixture
def say(vineyard, tmp_path, monkeypatch):
    """Runs a command in a folder that has a survey of parcel A; gives what it says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("vinemap.cli.estate.find_spec", lambda module: None)
    write_survey(vineyard, "data/surveys/small")
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "small.yaml").write_text("survey: small\nparcels: [A]\n")

    def run(*words):
        return CliRunner().invoke(commands, words, catch_exceptions=False, standalone_mode=False).stdout

    return run


def test_a_parcel_and_its_survey(say, tmp_path):
    assert say("parcel", "A", "--config", "configs/small.yaml").startswith("A: 6 rows, ")
    assert (tmp_path / "data" / "products" / "small" / "A" / "A.gpkg").is_file()
    head, line = say("survey", "small").splitlines()
    assert head.split() == ["parcel", "rows", "seconds", "state", "reason"]
    assert line.split()[:2] + line.split()[3:] == ["A", "6", "up", "to", "date"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("survey", "small.laz"), "give --boundaries"),
        (("survey", "small", "other"), "give --boundaries"),
        (("survey", "small", "--workers", "2"), "--workers goes with clouds"),
        (("survey", "smal"), "did you mean 'configs/small.yaml'"),
        (("parcel", "A"), "vinemap example makes it"),
        (("nightly",), "vinemap config estate prints one"),
    ],
)
def test_what_names_no_survey_says_what_to_do(say, words, reason):
    with pytest.raises(ConfigError, match=reason):
        say(*words)
