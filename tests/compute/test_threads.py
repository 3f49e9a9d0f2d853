"""Work on several cores, and items made ahead."""

import gc
import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from vinemap.compute import machine
from vinemap.compute.threads import ahead, in_threads, stretches


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 1000])
def test_stretches_cover_every_item_once(n):
    parts = stretches(n)
    assert [k for first, last in parts for k in range(first, last)] == list(range(n))
    assert len(parts) == (machine.cores() if n >= 16 else 1)


def test_results_in_the_items_order():
    def slow_first(k):
        time.sleep(0.02 if k == 0 else 0)
        return k * k

    assert in_threads(slow_first, range(20)) == [k * k for k in range(20)]
    assert in_threads(slow_first, iter(())) == []


def test_one_item_stays_in_its_thread():
    assert in_threads(lambda _: threading.current_thread(), [0]) == [threading.current_thread()]


def test_nested_work_is_done_one_after_the_other_where_it_is():
    log = []

    def outer(k):
        def inner(m):
            log.append((k, m))
            return k, m, threading.current_thread()

        return threading.current_thread(), in_threads(inner, range(50))

    for k, (thread, found) in enumerate(in_threads(outer, range(8))):
        assert thread is not threading.current_thread()
        assert found == [(k, m, thread) for m in range(50)]
        assert [m for j, m in log if j == k] == list(range(50))


def test_an_error_in_an_item_comes_through():
    def fail(k):
        if k == 3:
            raise ValueError("item 3")
        return k

    with pytest.raises(ValueError, match="item 3"):
        in_threads(fail, range(10))
    assert in_threads(abs, [-1, -2]) == [1, 2]


def test_no_item_goes_on_after_an_error():
    """What a caller clears away behind an error must not be written anew."""
    begun, ended = [], []

    def work(k):
        begun.append(k)
        if k == 0:
            raise OSError("disk full")
        time.sleep(0.05)
        ended.append(k)

    with pytest.raises(OSError, match="disk full"):
        in_threads(work, range(3))
    at_once = sorted(ended)
    time.sleep(0.3)
    assert sorted(ended) == at_once == sorted(set(begun) - {0})


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_child_has_threads_of_its_own():
    code = (
        "import os; from vinemap.compute.threads import in_threads\n"
        "assert in_threads(abs, [-1, -2]) == [1, 2]\n"
        "child = os.fork()\n"
        "if child == 0:\n    os._exit(0 if in_threads(abs, [-1, -2]) == [1, 2] else 1)\n"
        "raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))"
    )
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", code], timeout=60, check=False)
    assert run.returncode == 0


def makers():
    return [t for t in threading.enumerate() if t.name.startswith("ThreadPoolExecutor") and t not in kept]


kept = threading.enumerate()


@pytest.fixture(autouse=True)
def known_threads():
    in_threads(abs, [-1] * 50)
    kept[:] = threading.enumerate()


def test_ahead_keeps_the_order():
    with ahead(iter(range(100))) as items:
        assert list(items) == list(range(100))
    assert makers() == []


def test_ahead_of_nothing():
    with ahead(iter(())) as items:
        assert list(items) == []


def test_ahead_makes_no_more_than_one_item_before_it_is_asked():
    made = []

    def source():
        for k in range(100):
            made.append(k)
            yield k

    with ahead(source()) as items:
        assert [next(items), next(items)] == [0, 1]
        time.sleep(0.05)
        assert made == [0, 1, 2]


def test_ahead_passes_errors_on_where_they_belong():
    def source():
        yield from (np.zeros(1), np.ones(1))
        raise ValueError("broken item")

    got = []

    def take_all():
        with ahead(source()) as items:
            got.extend(float(item[0]) for item in items)

    with pytest.raises(ValueError, match="broken item"):
        take_all()
    assert got == [0, 1]
    assert makers() == []


@pytest.mark.parametrize("fails", [False, True])
def test_ahead_stops_its_thread_when_nobody_wants_more(fails):
    closed = threading.Event()

    def source():
        try:
            k = 0
            while True:
                yield k
                k += 1
        finally:
            closed.set()

    def take_two():
        with ahead(source()) as items:
            next(items)
            assert next(items) == 1
            assert len(makers()) == 1
            if fails:
                raise KeyError("mine")

    if fails:
        with pytest.raises(KeyError, match="mine"):
            take_two()
    else:
        take_two()
    assert makers() == []
    gc.collect()
    assert closed.is_set()
