"""A survey's file."""

import pytest


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "survey.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write
