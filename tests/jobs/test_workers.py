"""Worker processes: whatever happens in one costs one call, and none is left behind."""

import contextlib
import ctypes
import errno
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from commands import gone
from systems import LINUX, POSIX

from vinemap.errors import WorkerError
from vinemap.jobs import workers
from vinemap.jobs.workers import Worker, Workers

SOON = 5.0
"""Seconds."""


@pytest.fixture
def own():
    one = Worker()
    yield one
    one.close()


def until(holds):
    """Wait until something holds, but not for ever."""
    deadline = time.monotonic() + SOON
    while not holds():
        assert time.monotonic() < deadline, "it took too long"
        time.sleep(0.01)


def test_calls_run_one_after_the_other_in_one_process(worker):
    first = worker.run(os.getpid)
    assert first != os.getpid()
    assert worker.run(pow, 2, exp=10) == 1024
    assert worker.run(sorted, [2, 3, 1], reverse=True, limit=20) == [3, 2, 1]
    assert worker.run(os.getpid) == first


def test_how_many_cores_it_takes():
    with Workers(1, cores=3) as one:
        assert one.run(eval, "__import__('vinemap.compute.machine').compute.machine.cores()") == 3


HANGS = {
    "busy": "while True: pass",
    "deaf": "import signal, time; signal.pthread_sigmask(signal.SIG_BLOCK, set(signal.Signals)); time.sleep(60)",
    "in C": "import ctypes; ctypes.PyDLL(None).sleep(60)",  # with the GIL
}


@POSIX
@pytest.mark.parametrize("how", HANGS)
def test_a_call_that_hangs(worker, how):
    worker.run(pow, 2, 2)
    began = time.monotonic()
    with pytest.raises(WorkerError, match=r"^took longer than 0\.2 s$") as error:
        worker.run(exec, HANGS[how], limit=0.2)
    assert 0.2 <= time.monotonic() - began < SOON
    assert not error.value.heals
    assert worker.run(pow, 2, 2) == 4


@POSIX
@pytest.mark.parametrize(
    ("function", "words", "said", "heals"),
    [
        (os.abort, (), "its process died (SIGABRT)", False),
        (os._exit, (3,), "its process died (exit code 3)", False),
        (ctypes.string_at, (0,), "its process died (SIGSEGV, a segmentation fault)", False),
        (exec, ("import os; os.kill(os.getpid(), 15)",), "its process died (SIGTERM)", False),
        (
            exec,
            ("import os; os.kill(os.getpid(), 9)",),
            "its process died (SIGKILL, killed by the system, perhaps for want of memory)",
            True,
        ),
    ],
)
def test_a_call_that_dies(worker, function, words, said, heals):
    with pytest.raises(WorkerError) as error:
        worker.run(function, *words, limit=60)
    assert str(error.value) == said
    assert error.value.heals is heals
    assert worker.run(pow, 2, 2) == 4


def test_last_words(worker):
    worker.run(exec, "import sys; print('of another call', file=sys.stderr, flush=True)")
    with pytest.raises(WorkerError, match=r"^its process died \(exit code 3\)$"):
        worker.run(os._exit, 3)
    words = "import os; os.write(2, b'vines\\nlast \\xff' + b'x' * 900 + b'\\n\\n'); os._exit(3)"
    with pytest.raises(WorkerError, match=r"^its process died \(exit code 3\): last .x{194}$"):
        worker.run(exec, words)


@LINUX
def test_a_call_that_takes_too_much_memory():
    with Workers(1, memory=10**9) as one:
        before = one.run(os.getpid)
        with pytest.raises(WorkerError, match=r"^not enough memory$"):
            one.run(bytes, 30 * 10**9)
        assert one.run(os.getpid) != before
        with pytest.raises(WorkerError, match=r"^not enough memory$"):
            one.run(exec, "kept = [bytes(10**8) for _ in range(40)]")
        assert one.run(len, one.run(bytes, 10**8)) == 10**8


@LINUX
def test_text_takes_no_gigabyte_of_that_memory():
    """As Arrow's own pool would, in which pandas keeps text where pyarrow is installed."""
    pytest.importorskip("pyarrow", reason="needs pyarrow, in which pandas keeps text")
    data = "int(re.search(r'VmData:\\s+(\\d+) kB', open('/proc/self/status').read())[1])"
    with Workers(1, memory=3 * 10**9) as one:
        one.run(exec, f"import re, pyarrow; pyarrow.array(['a']); assert {data} < 500_000")


@LINUX
def test_the_system_takes_a_worker_first(worker):
    """Before the process that started it, if memory runs out."""
    assert worker.run(exec, "assert int(open('/proc/self/oom_score_adj').read()) == 900") is None


@POSIX
@pytest.mark.parametrize("n", [1, 10**6])
def test_a_process_that_dies_while_nobody_looks(worker, n):
    """Whether a call fits the pipe to it or not."""
    process = worker.run(os.getpid)
    os.kill(process, signal.SIGKILL)
    os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT)
    assert worker.run(len, bytes(n)) == n
    assert worker.run(os.getpid) != process


@POSIX
def test_a_process_that_dies_just_when_it_is_called(worker, monkeypatch):
    """It looks alive, but nobody reads."""
    process = worker.run(os.getpid)
    os.kill(process, signal.SIGKILL)
    os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT)
    monkeypatch.setattr(worker._process, "poll", lambda: None)
    assert worker.run(len, bytes(10)) == 10


def test_it_is_stopped_from_another_thread(own):
    own.start()
    with ThreadPoolExecutor(1) as threads:
        call = threads.submit(own.run, time.sleep, 60)
        with pytest.raises(TimeoutError):
            call.result(0.1)
        began = time.monotonic()
        own.stop()
        with pytest.raises(WorkerError, match=r"^stopped$") as error:
            call.result(SOON)
    assert time.monotonic() - began < SOON
    assert not error.value.heals
    with pytest.raises(WorkerError, match=r"^stopped$"):
        own.run(pow, 2, 2)


def test_who_calls_is_interrupted(own, monkeypatch):
    """As by Ctrl-C: an answer that comes too late isn't taken for that of the next call."""
    process = own.run(os.getpid)
    with monkeypatch.context() as patch:
        patch.setattr(workers, "_receive", lambda stream: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            own.run(pow, 2, 3)
    assert gone(process)
    assert own.run(pow, 2, 2) == 4


@POSIX
def test_an_interrupt_is_for_who_calls(worker):
    """Ctrl-C goes to all processes of a terminal, but it is for the first to end the others."""
    assert worker.run(exec, "import os, signal; os.kill(os.getpid(), signal.SIGINT)") is None


def test_an_answer_at_the_last_moment(own, monkeypatch):
    """The call after it doesn't meet a process that is just being killed."""
    receive = workers._receive

    def late(stream):
        message = receive(stream)
        until(lambda: own._process.poll() is not None)
        return message

    own.start()
    own.run(pow, 2, 2)
    with monkeypatch.context() as patch:
        patch.setattr(workers, "_receive", late)
        assert own.run(pow, 2, 3, limit=0.5) == 8
    assert own._process is None
    assert own.run(pow, 2, 2, limit=60) == 4


@pytest.mark.parametrize("what", ["subprocess.Popen", "tempfile.TemporaryFile"])
def test_no_process_can_be_started(own, monkeypatch, what):
    """As where memory, processes, open files or the folder of temporary files are used up."""

    def fail(*words, **options):
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    with monkeypatch.context() as patch:
        patch.setattr(f"vinemap.jobs.workers.{what}", fail)
        with pytest.raises(WorkerError, match=r"^no process can be started \(Cannot allocate memory\)$") as error:
            own.run(pow, 2, 2)
    assert error.value.heals
    assert own.run(pow, 2, 2) == 4


def test_not_all_processes_can_be_started(monkeypatch):
    started, popen = [], subprocess.Popen

    def second_fails(*words, **options):
        if started:
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        started.append(popen(*words, **options))
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", second_fails)
    with pytest.raises(WorkerError, match="no process can be started"):
        Workers(2)
    assert started[0].returncode is not None


PARENT = """
import sys, threading
from vinemap.jobs.workers import Workers
workers = Workers(2)
for code in ("import time; time.sleep(600)", "while True: pass"):
    threading.Thread(target=workers.run, args=(exec, code), daemon=True).start()
print(*(worker._process.pid for worker in workers._all), flush=True)
sys.stdin.read()
"""


@LINUX
@pytest.mark.parametrize("when", ["at once", "at work"])
def test_none_outlives_the_process_that_started_it(when):
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        processes = [int(word) for word in parent.stdout.readline().split()]
        if when == "at work":  # the second counts to no end
            until(lambda: Path(f"/proc/{processes[1]}/task").is_dir())
            until(lambda: len(list(Path(f"/proc/{processes[1]}/task").iterdir())) > 1)
        parent.kill()
    assert len(processes) == 2
    until(lambda: all(gone(process) for process in processes))


@LINUX
def test_nothing_is_left_open():
    def here():
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    with Workers(1) as one:
        one.run(pow, 2, 2)
    before = here()
    for _ in range(20):
        one = Worker()
        one.start()
        one.close()
        one.close()
    with Workers(2) as two:
        for code in ("import os; os._exit(3)", "import time; time.sleep(60)"):
            with pytest.raises(WorkerError):
                two.run(exec, code, limit=0.5)
    assert here() == before
    with contextlib.suppress(ChildProcessError):  # there are none at all
        assert os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None


@LINUX
def test_one_ends_though_others_were_started_after_it():
    """None keeps another's pipes open."""
    with Workers(3) as three:
        for k in (1, 0, 2):
            one = three._all[k]._process
            one.stdin.close()
            assert one.wait(SOON) == 0
            assert [other._process.poll() for other in three._all].count(None) == 2 - [1, 0, 2].index(k)


def test_free_workers_take_calls():
    with Workers(2) as two, ThreadPoolExecutor(2) as threads:
        assert list(threads.map(lambda k: two.run(pow, k, 2), range(20))) == [k * k for k in range(20)]
        calls = [threads.submit(two.run, function, 3) for function in (os._exit, len, abs)]
        assert [type(call.exception()) for call in calls] == [WorkerError, WorkerError, type(None)]
        assert len({two.run(os.getpid) for _ in range(4)}) == 1
    with pytest.raises(WorkerError, match="stopped"):
        two.run(pow, 2, 2)
