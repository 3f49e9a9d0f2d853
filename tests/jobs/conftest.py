"""Jobs with made-up work, a folder in which surveys arrive, and a process that works."""

import doubles
import pytest
from products import without_workers
from squares import Job

from vinemap.jobs import survey
from vinemap.jobs.outcomes import DONE
from vinemap.jobs.workers import Worker


@pytest.fixture
def job(tmp_path, monkeypatch):
    monkeypatch.setattr(survey, "follow", doubles.follow)
    without_workers(monkeypatch)
    return Job(tmp_path)


@pytest.fixture
def done(job):
    """A job that has been done once."""
    assert job.states() == dict.fromkeys("ABC", DONE)
    return job


@pytest.fixture
def place(tmp_path):
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


@pytest.fixture(scope="module")
def worker():
    one = Worker()
    yield one
    one.close()
