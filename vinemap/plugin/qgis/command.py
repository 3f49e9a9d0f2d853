"""The command ``vinemap`` in a process of its own: where it is, what it inherits, how it is followed and stopped."""

from __future__ import annotations

import os
import queue
import re
import shlex
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import QgsProcessingException

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

SETTING = "VINEMAP_COMMAND"
WRITTEN = Path(__file__).with_name("command.txt")
"""Where the path of the vinemap stands that wrote this plugin."""
OF_QGIS = {"GDAL_DATA", "GDAL_DRIVER_PATH", "PROJ_LIB", "PROJ_DATA", "LD_LIBRARY_PATH", "QT_PLUGIN_PATH"}
OF_QGIS |= {"DYLD_LIBRARY_PATH", "DYLD_FRAMEWORK_PATH", "__PYVENV_LAUNCHER__"}
"""Variables, beside Python's, by which QGIS leads to its own libraries and their files."""
STAGE = re.compile(r"(\d+)/(\d+) (.+)")
"""A line of progress."""
PATIENCE = 3.0
"""Seconds that vinemap has to end by itself, in which it removes what it has begun."""
ON_WINDOWS = os.name == "nt"


def written_in() -> str:
    """The vinemap that wrote this plugin, if it is still there."""
    path = WRITTEN.read_text(encoding="utf-8").strip() if WRITTEN.is_file() else ""
    return path if path and Path(path).is_file() else ""


def command() -> list[str]:
    """Words that call vinemap: the setting's, else those written in, else what is on PATH.

    Raises
    ------
    QgsProcessingException
        If there is none.
    """
    found = ProcessingConfig.getSetting(SETTING) or written_in() or shutil.which("vinemap")
    if not found:
        raise QgsProcessingException(
            "the command vinemap isn't found: install it, and name its command in "
            "Settings › Options › Processing › Providers › vinemap"
        )
    is_python = re.fullmatch(r"python[\d.]*w?", Path(found).name.lower().replace(".exe", ""))
    return [found, "-m", "vinemap"] if is_python else [found]


def environment(inherited: Mapping[str, str], program: str) -> dict[str, str]:
    """What vinemap inherits of QGIS's environment: nothing by which it would load what belongs to QGIS."""
    kept = {k: value for k, value in inherited.items() if k not in OF_QGIS and not k.startswith("PYTHON")}
    own = Path(program).parent
    # What activating a conda environment adds on Windows, where QGIS puts all of its own on PATH.
    folders = [str(folder) for folder in (own, own / "Library/bin", own.parent / "Library/bin") if folder.is_dir()]
    root = inherited.get("OSGEO4W_ROOT")
    folders += [p for p in inherited.get("PATH", "").split(os.pathsep) if not root or Path(root) not in Path(p).parents]
    return {**kept, "PATH": os.pathsep.join(folders), "PYTHONIOENCODING": "utf-8", "VINEMAP_PROGRESS": "1"}


def call(words: Sequence[str], feedback: Any, *, heard: Callable[[str], object] = len) -> None:
    """Run vinemap, tell how far it is, and stop it when that is asked for.

    Parameters
    ----------
    words : sequence of str
        What to say after ``vinemap``.
    feedback : QgsProcessingFeedback
        Told of stages, and of every line.
    heard : callable
        Called with every line, but for those of progress.

    Raises
    ------
    QgsProcessingException
        With vinemap's own line, if it refuses; if it can't be started.
    """
    program = command()
    feedback.pushCommandInfo(" ".join(map(shlex.quote, [*program, *words])))
    apart: dict[str, Any] = {"creationflags": 0x08000000} if ON_WINDOWS else {"start_new_session": True}  # no console
    try:
        process = subprocess.Popen(  # noqa: S603 - what the user names
            [*program, *words],
            env=environment(os.environ, program[0]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            **apart,
        )
    except OSError as error:
        raise QgsProcessingException(f"{program[0]} can't be started ({error.strerror})") from error
    try:
        refusal = _follow(process, feedback, heard)
    finally:
        stop(process)
    # With 1 and no refusal, some parcels failed, each of which has said so.
    if not feedback.isCanceled() and (refusal or process.returncode not in (0, 1)):
        raise QgsProcessingException(refusal or f"{program[0]} ended with code {process.returncode}")


def _follow(process: subprocess.Popen[str], feedback: Any, heard: Callable[[str], object]) -> str:
    """Pass on what a process says until it ends or is to be stopped; gives the line with which it refuses."""
    said: queue.Queue[tuple[Any, str]] = queue.Queue()
    streams = [process.stdout, process.stderr]
    for stream in streams:
        threading.Thread(target=_read, args=(stream, said), daemon=True).start()
    refusal = ""
    while (streams or process.poll() is None) and not feedback.isCanceled():
        try:
            stream, line = said.get(timeout=0.1)
        except queue.Empty:
            continue
        stage = STAGE.fullmatch(line.rstrip())
        if not line:
            streams.remove(stream)
        elif stage and stream is process.stderr:
            feedback.setProgress(100 * int(stage[1]) / int(stage[2]))
            feedback.setProgressText(stage[3])
        elif line.startswith("vinemap: ") and stream is process.stderr:
            refusal = line[len("vinemap: ") :].rstrip()
        else:
            tell = feedback.pushInfo if stream is process.stdout else feedback.reportError
            tell(line.rstrip())
            heard(line.rstrip())
    return refusal


def _read(stream: IO[str], into: queue.Queue[tuple[Any, str]]) -> None:
    """Lines of a stream, and an empty one at its end."""
    with stream:
        for line in stream:
            into.put((stream, line))
    into.put((stream, ""))


def stop(process: subprocess.Popen[str]) -> None:
    """End a process and all that it has begun, if it hasn't ended: as they do when they are asked to, else at once."""
    if process.poll() is not None:
        return
    if ON_WINDOWS:
        end = ["taskkill", "/F", "/T", "/PID", str(process.pid)]
        subprocess.run(end, check=False, capture_output=True, creationflags=0x08000000)  # noqa: S603
    else:
        _send(process, signal.SIGTERM)
        until = time.monotonic() + PATIENCE
        while _send(process, 0) and time.monotonic() < until:
            time.sleep(0.05)
        _send(process, signal.SIGKILL)
    process.wait()


def _send(process: subprocess.Popen[str], number: int) -> bool:
    """Send a signal to a process and all that it has begun; whether one of them was still there."""
    process.poll()  # one that has ended is there until somebody asks
    try:
        os.killpg(process.pid, number)
    except OSError:
        return False
    return True
