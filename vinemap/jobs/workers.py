"""Worker processes: each runs a call at a time, within limits of time and memory, and may die of it alone.

Calls come to a worker through its standard input, and what they give goes back through its standard output. It ends
with the process that started it, whatever that one dies of. Nothing in it needs the caller's own module, so that
notebooks, scripts without a main guard and Dask's daemonic workers can start some.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import queue
import signal
import struct
import subprocess
import tempfile
import threading
import traceback
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NoReturn, Self, TypeVar

from vinemap.compute import machine
from vinemap.compute.processes import die_with_parent, ended_by, last_line, python
from vinemap.errors import VinemapError, WorkerError, own_fault

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

LENGTH = struct.Struct("<Q")
"""Of the number of bytes that stands before a message."""
SERVE = "from vinemap.jobs.workers import serve; serve(*map(int, sys.argv[1:]))"
KILLED = {"SIGKILL": "killed by the system, perhaps for want of memory", "SIGSEGV": "a segmentation fault"}


class Worker:
    """A process that runs calls one after the other, started when it is needed and again after it died.

    Parameters
    ----------
    cores : int
        Cores that its work may take.
    memory : int, optional
        Bytes that it may take; where the system can hold it to them (on Linux), more is a MemoryError.
    """

    def __init__(self, *, cores: int = 1, memory: int | None = None) -> None:
        self._command = python(SERVE, str(cores), str(memory or 0))
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None
        self._stopped = False
        self._starting = threading.Lock()

    def run(self, function: Callable[..., T], *args: Any, limit: float | None = None, **kwargs: Any) -> T:
        """Run a function that can be imported there, with what can be pickled.

        Parameters
        ----------
        limit : float, optional
            Seconds that it may take.

        Raises
        ------
        WorkerError
            If it takes longer, needs more memory, dies, or fails in a way of its own.
        VinemapError
            That the function raises.
        """
        good, value = self._reply(self._given(pickle.dumps((function, args, kwargs))), limit)
        if good:
            result: T = value
            return result
        if isinstance(value, MemoryError):
            self.close()  # what it still holds may be much
            raise WorkerError("not enough memory")
        raise value

    def start(self) -> None:
        """Start the process, so that it is ready when it is needed."""
        if self._process and self._process.poll() is None:
            return
        self.close()
        with self._starting:
            if self._stopped:
                raise WorkerError("stopped")
            pipe = subprocess.PIPE
            try:
                self._said = tempfile.TemporaryFile()  # noqa: SIM115 - closed in close
                self._process = subprocess.Popen(  # noqa: S603
                    self._command, stdin=pipe, stdout=pipe, stderr=self._said, bufsize=0
                )
            except OSError as error:
                raise _healing(f"no process can be started ({error.strerror or error})") from error

    def close(self) -> None:
        """End the process, whatever it does; the next call starts another."""
        process, said, self._process, self._said = self._process, self._said, None, None
        if process:
            process.kill()
            process.wait()
        for stream in (process.stdin, process.stdout, said) if process else (said,):
            if stream:
                with contextlib.suppress(OSError):
                    stream.close()

    def stop(self) -> None:
        """End the process for good; a call that runs fails, from another thread too."""
        with self._starting:
            self._stopped = True
            if self._process:
                self._process.kill()

    def _given(self, message: bytes) -> subprocess.Popen[bytes]:
        """The process, with a message on its way to it."""
        for _ in range(2):
            self.start()
            if not (process := self._process) or not self._said:
                continue
            self._said.seek(0)
            self._said.truncate()
            try:
                _send(process.stdin, message)
            except OSError:  # it died while nobody looked
                self.close()
                continue
            return process
        raise WorkerError("no process can be started")

    def _reply(self, process: subprocess.Popen[bytes], limit: float | None) -> tuple[bool, Any]:
        """Whether a call went well, and what it gave or raised."""
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            process.kill()

        timer = threading.Timer(limit or 0, expire)
        if limit:
            timer.start()
        try:
            answer = _receive(process.stdout)
        except EOFError:
            code = process.wait()
            if expired.is_set():
                raise WorkerError(f"took longer than {limit:g} s") from None
            raise self._dead(code) from None
        except BaseException:
            self.close()
            raise
        finally:
            timer.cancel()
            if limit:
                timer.join()
        if expired.is_set():  # too late for this call, but not for the next
            self.close()
        try:
            good, value = pickle.loads(answer)  # noqa: S301 - from a process of ours
        except Exception as error:
            raise WorkerError(own_fault(error, " in an answer that can't be read")) from error
        return good, value

    def _dead(self, code: int) -> WorkerError:
        """What is said of a process that died, by its exit code and what it said last."""
        if self._stopped:
            return WorkerError("stopped")
        name, last = ended_by(code), last_line(self._said)[:200] if self._said else ""
        why = f"{name}, {KILLED[name]}" if name in KILLED else name
        reason = f"its process died ({why}){f': {last}' if last else ''}"
        return _healing(reason) if name == "SIGKILL" else WorkerError(reason)


class Workers:
    """So many workers, of which the next that is free takes a call; to be used as a context."""

    def __init__(self, n: int, *, cores: int = 1, memory: int | None = None) -> None:
        self.slots = n
        self._all = [Worker(cores=cores, memory=memory) for _ in range(n)]
        self._free: queue.LifoQueue[Worker] = queue.LifoQueue()
        try:
            for worker in self._all:
                worker.start()
                self._free.put(worker)
        except BaseException:
            self.__exit__()
            raise

    def run(self, function: Callable[..., T], *args: Any, limit: float | None = None, **kwargs: Any) -> T:
        """Run a function as :meth:`Worker.run` does, when one is free."""
        worker = self._free.get()
        try:
            return worker.run(function, *args, limit=limit, **kwargs)
        finally:
            self._free.put(worker)

    def stop(self) -> None:
        """End all processes for good."""
        for worker in self._all:
            worker.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        for worker in self._all:
            worker.close()


def _healing(reason: str) -> WorkerError:
    """An error of the moment."""
    error = WorkerError(reason)
    error.heals = True
    return error


def _send(stream: IO[bytes] | None, message: bytes) -> None:
    rest = memoryview(LENGTH.pack(len(message)) + message)
    while rest and stream:
        rest = rest[stream.write(rest) or 0 :]


def _receive(stream: IO[bytes] | None) -> bytes:
    """The next message; EOFError if the other side is gone."""
    return _exactly(stream, LENGTH.unpack(_exactly(stream, LENGTH.size))[0])


def _exactly(stream: IO[bytes] | None, n: int) -> bytes:
    parts = bytearray()
    while len(parts) < n:
        part = stream.read(n - len(parts)) if stream else b""
        if not part:
            raise EOFError
        parts += part
    return bytes(parts)


def serve(cores: int, memory: int) -> NoReturn:
    """Be a worker: do what comes in, until nothing can come any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches this one too, but its parent ends it
    calls, answers = os.fdopen(os.dup(0), "rb", buffering=0), os.fdopen(os.dup(1), "wb", buffering=0)
    # What libraries print must not get among the answers, nor what they read among the calls.
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.dup2(2, 1)
    gc.set_threshold(100_000)  # as in a command: what is imported lives on
    machine.use(cores=cores, memory=memory)
    _limit(memory)
    die_with_parent()
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(calls, inbox), daemon=True).start()
    while True:
        _send(answers, _answer(inbox.get()))


def _listen(calls: IO[bytes], inbox: queue.SimpleQueue[bytes]) -> None:
    """Pass calls on, and end this process in the midst of its work if its parent has ended."""
    try:
        while True:
            inbox.put(_receive(calls))
    finally:
        os._exit(0)


def _answer(message: bytes) -> bytes:
    try:
        function, args, kwargs = pickle.loads(message)  # noqa: S301 - from the process that started this one
        return pickle.dumps((True, function(*args, **kwargs)))
    except (VinemapError, MemoryError) as error:
        return pickle.dumps((False, error))
    except BaseException as error:  # noqa: BLE001 - a fault of our own costs no other parcel
        frame = traceback.extract_tb(error.__traceback__)[-1]
        where = f", {Path(frame.filename).name} line {frame.lineno}"
        return pickle.dumps((False, WorkerError(own_fault(error, where))))


def _limit(memory: int) -> None:
    """Hold this process to so many bytes, and offer it to the system first if memory runs out."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("900", encoding="ascii")
    if memory:
        os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # its own sets a gigabyte aside, which counts
        with contextlib.suppress(ImportError, ValueError, OSError):  # not on Windows
            import resource

            resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
