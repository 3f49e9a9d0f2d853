"""A generator in a process of its own: what it gives comes here as it is made, and what it dies of is an error here."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import tempfile
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any

from vinemap.compute.processes import die_with_parent, ended_by, last_line, python
from vinemap.errors import VinemapError, WorkerError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator

SERVE = "from vinemap.compute.apart import serve; serve()"
GIVEN, RAISED, DONE = range(3)
"""What an answer is."""


def apart(function: Callable[..., Iterator[Any]], *args: Any) -> Generator[Any]:
    """What a generator gives that can be imported there, called in another process with what can be pickled.

    The process ends with this generator, and with this process.

    Raises
    ------
    WorkerError
        If the process dies; it heals if the system has killed it.
    Exception
        That the function raises: a VinemapError, MemoryError or OSError as it is, all else as a RuntimeError.
    """
    pipe = subprocess.PIPE
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(python(SERVE), stdin=pipe, stdout=pipe, stderr=said)  # noqa: S603 - our own
        try:
            _give(process.stdin, (function, args))
            while True:
                kind, value = _answer(process, said)
                if kind == RAISED:
                    raise value
                if kind == DONE:
                    return
                yield value
        finally:
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                if stream:
                    with suppress(OSError):
                        stream.close()


def _give(stream: IO[bytes] | None, message: Any) -> None:
    if stream:
        with suppress(OSError):  # it has died, as its answer will tell
            pickle.dump(message, stream, protocol=pickle.HIGHEST_PROTOCOL)
            stream.close()


def _answer(process: subprocess.Popen[bytes], said: IO[bytes]) -> tuple[int, Any]:
    try:
        answer: tuple[int, Any] = pickle.load(process.stdout)  # type: ignore[arg-type]  # noqa: S301 - of our own
    except (EOFError, pickle.UnpicklingError):
        code = process.wait()
    else:
        return answer
    name, last = ended_by(code), last_line(said)[:200]
    error = WorkerError(f"its process died of {name}{f': {last}' if last else ''}")
    error.heals = name == "SIGKILL"
    raise error


def serve() -> None:
    """Be the process that :func:`apart` starts: call the one function that comes in, and pass on what it gives."""
    calls, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print must not get among the answers
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches this one too, but its parent ends it
    die_with_parent()

    def answer(kind: int, value: Any = None) -> None:
        pickle.dump((kind, value), answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()

    try:
        function, args = pickle.load(calls)  # noqa: S301 - from the process that started this one
        for value in function(*args):
            answer(GIVEN, value)
        answer(DONE)
    except BrokenPipeError:
        return
    except (VinemapError, MemoryError, OSError) as error:
        answer(RAISED, error)
    except Exception as error:  # noqa: BLE001 - it is raised where it is awaited
        answer(RAISED, RuntimeError(str(error) or type(error).__name__))
