"""A process that has imported the library, which takes most commands longest: its forks are commands.

Each line that comes in asks for one, as JSON: its words, its folder, its environment, and files for what it says on
stdout and stderr. The exit code goes out.
"""

import gc
import json
import os
import runpy
import signal
import sys
from pathlib import Path

SHARED = "laspy", "pygltflib", "rasterio", "rich.progress", "vinemap.cli.main", "vinemap.jobs.survey"
LIMIT = 300
"""Seconds that a command may take."""


def asked():
    """Words of a command, in a process of its own; none in this one, when nobody will ask any more."""
    for line in sys.stdin:
        words, folder, environment, said = json.loads(line)
        if child := os.fork():
            sys.stdout.write(f"{os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\n")
            sys.stdout.flush()
            continue
        signal.alarm(LIMIT)
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for stream, path in enumerate(said, 1):
            os.dup2(os.open(path, os.O_WRONLY | os.O_APPEND), stream)
        return words
    return []


def run(option, what, *words):
    """Do as ``python`` does with ``-m`` a module or ``-c`` a program."""
    sys.argv[1:] = words
    sys.path.insert(0, "")
    if option == "-m":
        runpy.run_module(what, run_name="__main__", alter_sys=True)
    else:
        exec(what, {"__name__": "__main__"})


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).parents[1])
    for module in SHARED:
        __import__(module)
    gc.freeze()
    if words := asked():
        run(*words)
