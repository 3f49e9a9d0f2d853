"""A Prefect server for this machine alone: on loopback, with a folder of its own, sending no usage data.

``python -m flows.server`` is its process.
"""

from __future__ import annotations

import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from http.client import HTTPException
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import urlopen

from filelock import FileLock, Timeout

from vinemap import paths
from vinemap.errors import ConfigError, OutputError, VinemapError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LOOPBACK = "127.0.0.1"
PATIENCE = 180.0
"""Seconds until a server must be ready."""


@contextmanager
def home() -> Iterator[Path]:
    """Give the server's folder, to one process at a time.

    Raises
    ------
    OutputError
        If nothing can be written there.
    ConfigError
        If another process has it.
    """
    folder = paths.prefect_home().resolve()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = FileLock(folder / "lock").acquire(timeout=0)
    except Timeout as error:
        raise ConfigError(f"{folder}: a schedule is at work here already: stop it first") from error
    except OSError as error:
        raise OutputError(f"{folder}: can't be written ({error.strerror or error})") from error
    with held:
        yield folder


@contextmanager
def server(api: str, folder: Path) -> Iterator[subprocess.Popen[bytes] | None]:
    """Give a server that is ready: a process of ours, or None if one answers at that address already.

    Parameters
    ----------
    api : str
        Address of the server's interface, as in ``PREFECT_API_URL``.
    folder : Path
        For its database and its log.

    Raises
    ------
    ConfigError
        If the address is none, another machine's, or in use by something else.
    VinemapError
        If the server doesn't become ready.
    """
    host, port = _address(api)
    if host in {LOOPBACK, "localhost"}:
        os.environ["NO_PROXY"] = os.environ["no_proxy"] = f"{os.environ.get('no_proxy', '')},{host}".lstrip(",")
    if _ready(api):
        yield None
        return
    if host not in {LOOPBACK, "localhost"}:
        raise ConfigError(f"no Prefect server answers at PREFECT_API_URL={api}: start it, or unset the variable")
    if not _free(port):
        raise ConfigError(
            f"port {port} is in use by something that is no Prefect server: "
            f"choose another with PREFECT_API_URL=http://{LOOPBACK}:{port + 1}/api"
        )
    log = folder / "server.log"
    process = _start(api, port, folder, log)
    try:
        deadline = time.monotonic() + PATIENCE
        while not _ready(api):
            if process.poll() is not None or time.monotonic() > deadline:
                raise VinemapError(f"the Prefect server doesn't start: see {log}")
            time.sleep(0.2)
        yield process
    finally:
        _end(process)


def _address(api: str) -> tuple[str, int]:
    with suppress(ValueError):
        parts = urlsplit(api)
        if parts.scheme in {"http", "https"} and parts.hostname:
            return parts.hostname, parts.port or {"http": 80, "https": 443}[parts.scheme]
    raise ConfigError(f"PREFECT_API_URL={api} is no address of a server: http://{LOOPBACK}:4200/api would be one")


def _ready(api: str) -> bool:
    with suppress(OSError, ValueError, HTTPException), urlopen(f"{api}/health", timeout=5) as answer:  # noqa: S310
        return bool(json.load(answer) is True)
    return False


def _free(port: int) -> bool:
    with suppress(OSError), socket.create_server((LOOPBACK, port)):
        return True
    return False


def _start(api: str, port: int, folder: Path, log: Path) -> subprocess.Popen[bytes]:
    settings = {
        "PREFECT_HOME": str(folder),
        "PREFECT_API_URL": api,
        "PREFECT_SERVER_API_HOST": LOOPBACK,
        "PREFECT_SERVER_API_PORT": str(port),
        # By default any web page seen on this machine may give the server orders.
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": f"http://{LOOPBACK}:{port},http://localhost:{port}",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_LOGGING_LEVEL": "WARNING",
        "PREFECT_SERVER_LOGGING_LEVEL": "WARNING",
    }
    try:
        with log.open("wb") as output:
            # Ctrl-C mustn't reach it before the runs have ended.
            return subprocess.Popen(  # noqa: S603 - this module
                [sys.executable, "-m", f"{__package__}.server"],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                start_new_session=True,
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),  # the same on Windows
                env=os.environ | settings,
            )
    except OSError as error:
        raise OutputError(f"{log}: can't be written ({error.strerror or error})") from error


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(15)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdin:
        process.stdin.close()


def main() -> None:
    """Be the server for as long as the process lives that began it."""

    def end_with_it() -> None:
        sys.stdin.buffer.read()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=end_with_it, daemon=True).start()
    sys.argv = ["prefect", "server", "start"]
    runpy.run_module("prefect", run_name="__main__")


if __name__ == "__main__":
    main()
