"""What goes to a worker process and what comes back: answers, and errors of any kind."""

import operator
import os
import sys
import threading
import types

import pytest

from vinemap.errors import BusyError, InputError, WorkerError
from vinemap.jobs.workers import Workers


class OddError(InputError):
    """An error that pickle can take apart, but not put together."""

    def __init__(self, one, other):
        super().__init__(f"{one} {other}")


def odd():
    raise OddError("a", "b")


def test_what_a_call_prints_and_reads(worker):
    """Neither gets among calls and answers, from C or from processes of its own either."""
    noise = "import os, sys\nprint('x' * 100_000, flush=True)\nos.write(1, b'y' * 100_000)\nos.system('echo z')"
    assert worker.run(exec, noise) is None
    assert worker.run(eval, "__import__('sys').stdin.read()") == ""
    assert worker.run(eval, "__import__('os').read(0, 10)") == b""
    with pytest.raises(WorkerError, match="EOFError"):
        worker.run(input)
    assert worker.run(pow, 2, 2) == 4


def test_much_comes_and_goes(worker):
    much = os.urandom(1000) * 50_000
    assert worker.run(operator.itemgetter(slice(None)), much, limit=60) == much


@pytest.mark.parametrize("kind", ["InputError", "BusyError"])
def test_errors_of_ours_come_as_they_are(worker, kind):
    process = worker.run(os.getpid)
    with pytest.raises((InputError, BusyError), match=r"^vines 🍇$") as error:
        worker.run(exec, f"from vinemap.errors import {kind}; raise {kind}('vines 🍇')")
    assert type(error.value).__name__ == kind
    assert worker.run(os.getpid) == process


def test_other_errors_are_faults(worker):
    process = worker.run(os.getpid)
    with pytest.raises(WorkerError, match=r"^a fault of vinemap's own \(ZeroDivisionError: .*, <string> line 2\)$"):
        worker.run(exec, "\n1 / 0")
    with pytest.raises(WorkerError, match=r"\(SystemExit: 4, "):
        worker.run(sys.exit, 4)
    with pytest.raises(WorkerError, match=r"\(RecursionError: "):
        worker.run(exec, "f = lambda: f()\nf.__globals__['f'] = f\nf()")
    assert worker.run(os.getpid) == process


@pytest.mark.parametrize(
    "code",
    [
        "from vinemap.errors import InputError\nfrom threading import Lock\nraise InputError(Lock())",
        "class OwnError(Exception): pass\nraise OwnError",
        "class OwnError(Exception):\n  def __str__(self): raise ValueError\nraise OwnError",
        "from vinemap.errors import InputError\nclass OwnError(InputError): pass\nraise OwnError('own')",
    ],
)
def test_errors_that_pickle_cannot_take(worker, code):
    with pytest.raises(WorkerError):
        worker.run(exec, code, limit=60)
    assert worker.run(pow, 2, 2) == 4


def test_errors_that_cannot_be_put_together_here(worker):
    with pytest.raises(WorkerError, match=r"a fault of vinemap's own \(.*OddError"):
        worker.run(odd, limit=60)
    assert worker.run(pow, 2, 2) == 4


def test_results_that_pickle_cannot_take(worker):
    with pytest.raises(WorkerError, match=r"a fault of vinemap's own \(TypeError: cannot pickle"):
        worker.run(threading.Lock)
    assert worker.run(pow, 2, 2) == 4


def test_functions_that_cannot_be_had_there(worker, monkeypatch):
    process = worker.run(os.getpid)
    module = types.ModuleType("nowhere")
    exec("def work(): pass", module.__dict__)
    monkeypatch.setitem(sys.modules, "nowhere", module)
    with pytest.raises(WorkerError, match="No module named 'nowhere'"):
        worker.run(module.work)
    with pytest.raises(Exception, match="pickle"):
        worker.run(lambda: None)
    assert worker.run(os.getpid) == process


def test_it_imports_what_this_process_does(tmp_path, monkeypatch):
    """Not what lies in the folder where a job happens to run; but what is to be had here is to be had there."""
    (tmp_path / "queue.py").write_text("raise ImportError('a file of the user')")
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "vines.py").write_text("def count(): return 42\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path / "own")
    import vines

    with Workers(1) as one:
        assert one.run(vines.count) == 42
