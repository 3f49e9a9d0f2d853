"""What is compiled ahead is all that a run needs, and where that can't be kept a run goes on as it would."""

import sys
import time

import pytest
from commands import python, vinemap

from vinemap import warm
from vinemap.compute import compiled, machine

MAP = """
import sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from vinemap import warm
from vinemap.config.settings import Settings
from vinemap.parcel import map_parcel

def signatures():
    ours = [module for name, module in sys.modules.items() if name.startswith("vinemap.")]
    found = {f.py_func: f for module in ours for f in vars(module).values() if isinstance(f, Dispatcher)}
    return {f"{f.py_func.__name__}{kind}" for f in found.values() for kind in f.signatures}

cloud, boundary = map(Path, sys.argv[1:])
warm.warm()
before = signatures()
classified = Settings(product={"classified": True})
map_parcel(cloud, Path("product"), parcel="A", boundary=boundary, settings=classified)
print(len(before), sorted(signatures() - before))
"""


def test_after_it_a_run_compiles_nothing(three, tmp_path):
    done = python("-c", MAP, three, three.with_name("more.gpkg"), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    n, new = done.stdout.split(maxsplit=1)
    assert int(n) > 30
    assert new.strip() == "[]"


def test_the_command_says_what_it_did_and_where(tmp_path):
    done = vinemap("warm", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"functions kept in {compiled.folder()}, " in done.stdout
    assert done.stdout.count("\n") == 1


def test_a_cache_that_cannot_be_written(monkeypatch):
    monkeypatch.setattr(compiled, "_folder", lambda: (None, False))
    assert "nothing can be kept" in warm.warm().line()
    with warm.warming(print) as step:
        assert step is print


@pytest.fixture
def cold(monkeypatch, tmp_path):
    """An empty cache on two cores, and a process beside that takes its time."""
    monkeypatch.setattr(compiled, "_folder", lambda: (tmp_path, True))
    monkeypatch.setattr(machine, "cores", lambda: 2)
    done = tmp_path / "done"
    monkeypatch.setattr(
        warm, "BESIDE", [sys.executable, "-c", f"import time; time.sleep(0.3); open({str(done)!r}, 'x').close()"]
    )
    return done


def test_a_stage_waits_for_what_is_compiled_beside(cold):
    with warm.warming(lambda name, function: function()) as step:
        assert not step("Reading", cold.exists)
        assert step("Sections", cold.exists)


def test_what_is_compiled_beside_ends_with_the_run(cold):
    with pytest.raises(KeyboardInterrupt), warm.warming(print):
        raise KeyboardInterrupt
    time.sleep(0.5)
    assert not cold.exists()


def test_on_one_core_all_is_compiled_where_it_is_needed(cold, monkeypatch):
    monkeypatch.setattr(machine, "cores", lambda: 1)
    with warm.warming(lambda name, function: function()) as step:
        assert not step("Sections", cold.exists)
